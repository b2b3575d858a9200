"""A made-up result of the kind that a real recording gives, and the ways in which one fails."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import data_synth
import rmis_calib as rc
from rmis_calib.geometry.rigid import RigidTransform, rigid_exp
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.calibration import run_calibration
from rmis_calib.report import gather_material, write_report
from rmis_calib.results import CalibrationResult, Motions

N_MOTIONS = 60
REASONS = {
    7: "no dark region",
    21: "edges do not belong to one cylinder",
    22: "edges do not belong to one cylinder",
    48: "shaft too short",
}


def make_result(**changes: Any) -> CalibrationResult:
    rng = np.random.default_rng(4)
    used = np.array([index not in REASONS for index in range(N_MOTIONS)])
    pose = torch.tensor([0.42, -1.13, 0.27, -38.214, 6.907, -101.55], dtype=torch.float64)
    stereo = torch.tensor([0.001, -0.004, 0.0006, -4.352, 0.021, -0.016], dtype=torch.float64)
    root = rng.normal(size=(6, 6)) * np.array([2e-4, 2e-4, 3e-4, 0.05, 0.06, 0.09])[:, None]
    result = CalibrationResult(
        status="ok",
        message="0.05 deg and 0.24 mm at one sigma, from 56 of 60 motions; every direction is observed",
        method="joint",
        camera_right_T_arm=RigidTransform("camera_right", "arm", rigid_exp(pose)),
        camera_left_T_camera_right=RigidTransform("camera_left", "camera_right", rigid_exp(stereo)),
        covariance=root @ root.T,
        observability=observability(),
        motions=Motions(used, tuple(REASONS.get(i, "") for i in range(N_MOTIONS)), 2.0 + np.arange(N_MOTIONS) * 0.5),
        residuals={
            f"{kind}_{camera}": residual(rng, used, size, kind == "end")
            for kind, size in (("contour", 0.21), ("end", 0.9))
            for camera in ("right", "left")
        },
        nuisances={
            "shaft_radius": {"value": 4.0113, "sigma": 0.0121, "unit": "mm"},
            "end_offset": {"value": -3.21, "sigma": 0.11, "unit": "mm"},
            "clock_offset": {"value": 0.0, "sigma": None, "unit": "s"},
            "stereo_translation[0]": {"value": 0.012, "sigma": 0.02, "unit": "mm"},
        },
        head_point_error_px={"right": {"median": 1.1, "rms": 1.42, "max": 3.6, "count": 56}},
        config={"solver": {"method": "joint", "robust_scale": 1.5}, "detector": {"min_length_px": 60, "seed": None}},
        created="2025-03-04T05:06:07+00:00",
    )
    return dataclasses.replace(result, **changes)


def residual(rng: np.random.Generator, used: np.ndarray, size: float, signed: bool) -> dict[str, Any]:
    values = rng.normal(size=len(used)) * size
    values[33] *= 6.0
    values = values if signed else np.abs(values)
    values[~used] = np.nan
    finite = np.abs(values[used])
    return {
        "unit": "px",
        "median": float(np.median(finite)),
        "rms": math.sqrt(np.mean(finite**2)),
        "by_motion": [None if math.isnan(value) else float(value) for value in values],
    }


def observability() -> dict[str, Any]:
    words = (
        ("translation along the viewing direction", 0.19),
        ("rotation about the shaft's mean direction, with the arm's origin moving along", 0.11),
        ("translation across the shaft", 0.06),
        ("rotation about the viewing direction", 0.05),
        ("translation along the shaft", 0.031),
        ("rotation about the image's horizontal axis", 0.018),
    )
    return {
        "verdict": "trustworthy",
        "sentences": [
            "Every direction of the unknown is seen: the weakest moves the working point by 0.19 mm at one sigma."
        ],
        "working_point_sigma_mm": 0.24,
        "directions": [{"sigma_at_working_point_mm": sigma, "words": text} for text, sigma in words],
        "named_cases": [],
        "advice": [],
    }


UNOBSERVABLE = {
    "verdict": "unobservable",
    "sentences": [
        "Translation along the viewing direction is not observable: the laparoscope did not move, no radius is known."
    ],
    "working_point_sigma_mm": None,
    "directions": [
        {
            "sigma_at_working_point_mm": None,
            "words": "translation along the viewing direction",
        },
        {
            "sigma_at_working_point_mm": 12.4,
            "words": "translation across the shaft",
        },
        {"sigma_at_working_point_mm": 0.31, "words": "rotation about the viewing direction"},
    ],
    "named_cases": ["static laparoscope, one camera, axis lines only"],
    "advice": [
        "Give the shaft's diameter (shaft_diameter_mm).",
        "Move the laparoscope by at least 10 deg about two axes.",
    ],
}


@pytest.fixture
def result_with() -> Callable[..., CalibrationResult]:
    """Builds a trustworthy stereo result with the given fields changed."""
    return make_result


@pytest.fixture
def failures() -> dict[str, CalibrationResult]:
    """One result for each way to fail: still with an estimate, without a covariance, and with nothing at all."""
    nothing = {
        "camera_right_T_arm": None,
        "camera_left_T_camera_right": None,
        "covariance": None,
        "head_point_error_px": None,
    }
    rejected = Motions(np.zeros(3, dtype=bool), ("no dark region",) * 3)
    return {
        "weak": make_result(status="weak", message="13.9 deg: too loose", observability={"verdict": "weak"}),
        "unobservable": make_result(
            status="unobservable",
            message="the depth of the arm cannot be told",
            covariance=None,
            camera_left_T_camera_right=None,
            observability=UNOBSERVABLE,
        ),
        "solver_failed": make_result(
            status="solver_failed", message="diverged", residuals={}, observability={}, **nothing
        ),
        "insufficient_data": make_result(
            status="insufficient_data",
            message="0 of 3",
            residuals={},
            nuisances={},
            observability={},
            motions=rejected,
            **nothing,
        ),
    }


@pytest.fixture(scope="session")
def rendered_run(tmp_path_factory: pytest.TempPathFactory) -> CalibrationRun:
    """The calibration of a rendered stereo recording of 20 motions."""
    path = tmp_path_factory.mktemp("report") / "recording"
    data_synth.write_recording(path, data_synth.load_synth_config({"motions": 20, "seed": 7}))
    return run_calibration(rc.load_recording(path))


@pytest.fixture(scope="session")
def run_with_rejections(rendered_run: CalibrationRun) -> CalibrationRun:
    """The same, weak, as if three motions had been rejected for two reasons."""
    used = rendered_run.result.motions.used.copy()
    reasons = list(rendered_run.result.motions.reasons)
    for motion, reason in ((3, "does not fit the other motions"), (9, "no straight edges stand out")):
        used[motion], reasons[motion] = False, reason
    used[15], reasons[15] = False, reasons[3]
    motions = Motions(used, tuple(reasons), rendered_run.result.motions.timestamps_s)
    weak = dataclasses.replace(rendered_run.result, status="weak", message="parts disagree", motions=motions)
    return dataclasses.replace(rendered_run, result=weak)


@pytest.fixture(scope="session")
def refused_run(rendered_run: CalibrationRun) -> CalibrationRun:
    """The same without an answer: four motions were usable, the others showed nothing."""
    reasons = tuple("usable, but there are too few" if i < 4 else "no straight edges stand out" for i in range(20))
    return dataclasses.replace(
        rendered_run,
        result=make_result(
            status="insufficient_data",
            message="Too few motions with a usable shaft: 4 of 20 motions are usable, 6 are needed",
            camera_right_T_arm=None,
            camera_left_T_camera_right=None,
            covariance=None,
            observability={"verdict": "unobservable", "sentences": ["4 of 20 motions are usable, 6 are needed"]},
            motions=Motions(np.zeros(20, dtype=bool), reasons),
            residuals={},
            nuisances={},
            head_point_error_px=None,
            config=rendered_run.result.config,
        ),
        observations=None,
        solution=None,
    )


RUNS = ("rendered_run", "run_with_rejections", "refused_run")


@pytest.fixture(scope="session")
def pages(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, str]]:
    """Reports of a trustworthy, a weak and a refused calibration, as files and texts."""
    folder, written = tmp_path_factory.mktemp("pages"), {}
    for name in RUNS:
        run: CalibrationRun = request.getfixturevalue(name)
        write_report(folder / f"{name}.html", run.result, gather_material(run), title=name, source=name)
        written[name] = (folder / f"{name}.html", (folder / f"{name}.html").read_text("utf-8"))
    return written
