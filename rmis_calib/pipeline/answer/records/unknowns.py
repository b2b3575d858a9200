"""The unknowns beside the transform with their sigmas, and what recordings of one set-up share of them."""

import torch

from rmis_calib.pipeline.answer.records.setup import given_way
from rmis_calib.results import INTRINSICS, JOINT_OFFSET, Information, Nuisance
from rmis_calib.robot import split_joint_column
from rmis_calib.solver import Solution

CORRECTED = 1.0
"""Correction of a camera in prior sigmas from which it is said."""
OF_ONE_RECORDING = ("clock", "clock_rate", "readout", "end_gap", "joint_offset", "rcm_offset", "setup")
"""Unknowns that another recording of the same set-up need not share."""


def nuisances_of(solution: Solution, joint_columns: tuple[str, ...]) -> dict[str, Nuisance]:
    """Every other unknown with its sigma, and the noise levels that were used."""
    found: dict[str, Nuisance] = {}
    for name, nuisance in solution.nuisances.items():
        if name == "setup":  # has a record of its own
            continue
        if name == "compliance":
            bend_rad, shift_mm = given_way(nuisance)
            found["compliance bend"] = Nuisance(bend_rad, None, "rad rms")
            found["compliance shift"] = Nuisance(shift_mm, None, "mm rms")
            continue
        values, sigmas, held = (item.reshape(-1).tolist() for item in (nuisance.value, nuisance.sigma, nuisance.held))
        for index, (value, sigma, is_held) in enumerate(zip(values, sigmas, held, strict=True)):
            key = name if len(values) == 1 else f"{name}[{index}]"
            unit = nuisance.unit
            if name == "intrinsics":
                what, unit = list(INTRINSICS.items())[index % len(INTRINSICS)]
                key = f"{what} {('right', 'left')[index // len(INTRINSICS)]}"
            if name == "joint_offset":
                joint, unit = split_joint_column(joint_columns[index])
                key = f"{JOINT_OFFSET}{joint}"
            found[key] = Nuisance(value, sigma, unit, is_held)
    for name, level in solution.noise.items():
        found[f"noise {name}"] = Nuisance(float(level), None, _noise_unit(name))
    return found


def about_cameras(solution: Solution) -> tuple[str, ...]:
    """Corrections of the cameras that are larger than their priors, in words."""
    found = solution.nuisances.get("intrinsics")
    if found is None:
        return ()
    said = []
    for camera, (values, pulls) in enumerate(
        zip(found.value.reshape(-1, 4).tolist(), found.pull.reshape(-1, 4).tolist(), strict=True)
    ):
        focal, x, y, lens = values
        parts = [
            (pulls[0], f"the focal length by {-100.0 * focal:+.1f} %"),
            (max(pulls[1], pulls[2], key=abs), f"the principal point by {-100.0 * x:+.2f}, {-100.0 * y:+.2f} % of it"),
            (pulls[3], f"k1 by {-lens:+.3f}"),
        ]
        changed = [words for pull, words in parts if abs(pull) > CORRECTED]
        if changed:
            said.append(f"of the {('right', 'left')[camera]} camera {', '.join(changed)}")
    if not said:
        return ()
    return (f"The data suggest corrected cameras: {'; '.join(said)}. The transform goes with them.",)


def information_of(solution: Solution) -> Information | None:
    """The information on the transform and on what recordings share, the other unknowns eliminated."""
    posterior = solution.posterior
    if posterior is None or not bool(torch.isfinite(posterior.information).all()):
        return None
    layout = posterior.layout
    deviation, weight = (item.reshape(-1) for item in layout.prior(posterior.state))
    names = [
        name if part.stop - part.start == 1 else f"{name}[{index}]"
        for name, part in layout.blocks.items()
        for index in range(part.stop - part.start)
    ]
    is_kept = torch.tensor([name.partition("[")[0] not in OF_ONE_RECORDING for name in names])
    kept, gone = is_kept.nonzero()[:, 0], (~is_kept).nonzero()[:, 0]
    H = posterior.information.reshape(len(names), len(names)).cpu()
    matrix = H[kept][:, kept] - H[kept][:, gone] @ torch.linalg.solve(H[gone][:, gone], H[gone][:, kept])
    shared = kept[6:]
    # The posterior's information, priors included, is divided by what the residuals exceed the noise by.
    excess = float(solution.chi2_per_dof.clamp_min(1.0))
    prior = torch.cat([weight.new_zeros(6), weight[shared] / excess]).cpu()
    away = torch.cat([weight.new_zeros(6), deviation[shared]]).cpu()
    return Information(
        shared_names=tuple(names[index] for index in shared.tolist()),
        shared_prior_sigma=weight[shared].rsqrt().cpu().numpy(),
        matrix=(matrix - torch.diag(prior)).numpy(),
        vector=(matrix @ away).numpy(),
    )


def _noise_unit(name: str) -> str:
    return name.rpartition("_")[2] if name.endswith(("_mm", "_rad", "_deg")) else "x nominal"
