"""What a result says of the set-up, and of what the instrument's arm gives way."""

import numpy as np
import torch

from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.results import INSTRUMENT_BASE, Setup
from rmis_calib.solver import Solution
from rmis_calib.solver.model.compliance import FUNCTIONS, MEAN_SQUARES, TURNS
from rmis_calib.solver.observability import Degeneracy
from rmis_calib.solver.solution import Nuisance


def setup_of(solution: Solution) -> Setup | None:
    """The set-up that was estimated; None where it was not."""
    found = solution.setup
    if found is None:
        return None
    matrix, covariance = found.laparoscope_base_T_instrument_base.reshape(4, 4), found.covariance.reshape(12, 12)
    away, variance = found.from_stated.reshape(6), covariance.diagonal()[6:]
    is_stated = bool(torch.isfinite(away).all())
    return Setup(
        RigidTransform("laparoscope_base", INSTRUMENT_BASE, matrix.detach().cpu()),
        rotation_sigma_deg=float(torch.rad2deg(variance[:3].sum().sqrt())),
        translation_sigma_mm=float(variance[3:].sum().sqrt()),
        from_stated_deg=float(torch.rad2deg(away[:3].norm())) if is_stated else None,
        from_stated_mm=float(away[3:].norm()) if is_stated else None,
        covariance=covariance.cpu().numpy(),
    )


def about_setup(solution: Solution, frame: str) -> tuple[str, ...]:
    """What became of the pose of one arm's base in the other's, in words."""
    if frame == INSTRUMENT_BASE:
        return (
            "Nothing states exactly where the arms' bases are (base_T_arm_base), and the laparoscope did not move: the "
            "answer is camera_right_T_instrument_base, the pose of the instrument's base in the camera. It holds as "
            "long as the laparoscope stays there.",
        )
    found = setup_of(solution)
    if found is None:
        still = int(solution.observability.degeneracy.reshape(-1)[0]) & Degeneracy.STATIC_LAPAROSCOPE
        if not still or "setup" not in solution.evidence:
            return ()
        return (
            "The laparoscope did not move: no motion tells whether the arms' bases are where base_T_arm_base says, and "
            "camera_right_T_arm is only as right as that.",
        )
    known = f"to {found.rotation_sigma_deg:.2g} deg, {found.translation_sigma_mm:.2g} mm (1 sigma)"
    if found.from_stated_mm is None:
        return (f"Nothing states where the arms' bases are (base_T_arm_base): that was found too, {known}.",)
    where = f"{found.from_stated_deg:.2g} deg, {found.from_stated_mm:.2g} mm from where base_T_arm_base says"
    if "setup" in solution.evidence:
        return (
            f"The pictures contradict the stated base of an arm: the instrument's base is {where}, {known}. It was "
            "estimated, and every sigma allows for it; check base_T_arm_base of both arms.",
        )
    return (f"The instrument's base is {where}, {known}.",)


def given_way(compliance: Nuisance) -> tuple[float, float]:
    """Root mean square bend, rad, and shift, mm, of the shaft over the range of its poses."""
    squares = compliance.value.reshape(-1, FUNCTIONS).square().cpu() @ torch.tensor(MEAN_SQUARES, dtype=torch.float64)
    return float(squares[:TURNS].sum().sqrt()), float(squares[TURNS:].sum().sqrt())


def about_compliance(solution: Solution) -> tuple[str, ...]:
    """By how much the instrument's arm gives way with its pose, in words, where that was estimated."""
    if "compliance" not in solution.nuisances:
        return ()
    bend_rad, shift_mm = given_way(solution.nuisances["compliance"])
    return (
        f"The shaft is off its kinematics by {np.rad2deg(bend_rad):.2g} deg and {shift_mm:.2g} mm (rms), smoothly with "
        "its pose, which noise does not explain: does the shaft or a joint flex, or the trocar move, or does the lens "
        "model or a joint's scale not fit? It was estimated, and every sigma allows for it.",
    )
