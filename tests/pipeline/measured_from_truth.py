"""Observations of a rendered recording without detecting anything, for tests of what comes after."""

import numpy as np

import rmis_calib as rc

SMALL = {"fx_px": 175.0, "fy_px": 175.0, "cx_px": 80.0, "cy_px": 60.0, "distortion": [0.0] * 5}
"""Intrinsics of small pictures: only their truth is used."""


def observations_from_truth(path, recording, poses, sigma_px=0.05):
    """What a detector with this noise would measure, from truth.npz."""
    truth = np.load(path / "truth.npz")
    generator = np.random.default_rng(0)
    sigma = sigma_px / float(recording.stereo.right.focal)
    arrays = {}
    for key in ("axis", "contour", "end"):
        values = truth[f"right_{key}_xy"][poses.frames]
        arrays[f"{key}_right"] = values + sigma * generator.standard_normal(values.shape)
    return rc.ShaftObservations(
        arm_T_rcm=poses.arm_T_rcm.numpy(),
        rcm_v_axis=poses.rcm_v_axis.numpy(),
        rcm_s_end_mm=poses.rcm_s_end_mm.numpy(),
        shaft_radius_mm=recording.shaft_diameter_mm / 2,
        sigma_image=sigma,
        **arrays,
    )
