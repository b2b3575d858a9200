"""What a result says of the set-up, and of what the instrument's arm gives way."""

import numpy as np
import torch

from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.results import INSTRUMENT_BASE, InstrumentBase, Setup
from rmis_calib.solver import Solution
from rmis_calib.solver.model.compliance import FUNCTIONS, MEAN_SQUARES, TURNS
from rmis_calib.solver.settings import UnknownSettings
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


def instrument_base_of(solution: Solution) -> InstrumentBase | None:
    """What a laparoscope that stands still tells whatever the set-up is."""
    found = solution.instrument_base
    if found is None or not bool(torch.isfinite(found.covariance).all()):
        return None
    matrix, covariance = found.camera_right_T_instrument_base.reshape(4, 4), found.covariance.reshape(6, 6)
    variance = covariance.diagonal()
    return InstrumentBase(
        RigidTransform("camera_right", INSTRUMENT_BASE, matrix.detach().cpu()),
        rotation_sigma_deg=float(torch.rad2deg(variance[:3].sum().sqrt())),
        translation_sigma_mm=float(variance[3:].sum().sqrt()),
        covariance=covariance.cpu().numpy(),
    )


def about_setup(solution: Solution, frame: str, asked: UnknownSettings) -> tuple[str, ...]:
    """What became of the pose of one arm's base in the other's, in words."""
    if frame == INSTRUMENT_BASE:
        return (
            "Nothing states exactly where the arms' bases are (base_T_arm_base), and the laparoscope did not move: the "
            "answer is camera_right_T_instrument_base, the pose of the instrument's base in the camera. It holds as "
            "long as the laparoscope stays there.",
        )
    found = setup_of(solution)
    if found is None:
        base = instrument_base_of(solution)
        if base is None:
            return ()
        return (
            "The laparoscope did not move: what the data tell is camera_right_T_instrument_base, to "
            f"{base.rotation_sigma_deg:.2g} deg, {base.translation_sigma_mm:.2g} mm (1 sigma; instrument_base in "
            "result.json). camera_right_T_arm is only as right as base_T_arm_base: setup_sigma_mm and setup_sigma_deg "
            "in robot.yaml say how well that is known (0: exactly); where they do not, its sigma allows for "
            f"{asked.setup_doubt_mm:g} mm and {asked.setup_doubt_deg:g} deg.",
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
