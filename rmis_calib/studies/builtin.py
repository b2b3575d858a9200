"""The methods and noise sources that the studies ship, registered as anybody's own would be."""

from rmis_calib.solver import Problem, Solution, SolverSettings, solve
from rmis_calib.solver.settings import UnknownSettings
from rmis_calib.studies.registry import method, noise_source

SETTINGS = SolverSettings(unknowns=UnknownSettings(radius_sigma_relative=0.0, compliance="never"), groups=0)
"""The simulated radius is exact, and the arms are stiff. Groups of motions only make sigma grow; they do not move the
answer."""


@method("paper", "paper (Algorithm 1)")
def paper(problem: Problem) -> Solution:
    """The published method."""
    return solve(problem, SETTINGS, "paper")


@method("global", "global search, then Eqs. 22 and 23")
def global_search(problem: Problem) -> Solution:
    """Rotation over all of SO(3), then translation."""
    return solve(problem, SETTINGS, "global")


@method("joint-axis", "joint, axis lines")
def joint_axis(problem: Problem) -> Solution:
    """The weighted estimate, from the paper's measurements."""
    return solve(problem, SETTINGS)


@method("joint-contours", "joint, contours", ("contours",))
def joint_contours(problem: Problem) -> Solution:
    """The weighted estimate, from both edges of the shaft and its radius."""
    return solve(problem, SETTINGS)


@method("joint", "joint, contours and shaft ends", ("contours", "ends"))
def joint(problem: Problem) -> Solution:
    """The weighted estimate from all that the detector measures, as `calibrate` does it."""
    return solve(problem, SETTINGS)


@noise_source("kinematics", "Noise in kinematics")
def kinematics(coefficient: float) -> dict[str, float]:
    """Fig. 2 a, b."""
    return {"kinematics_noise_mm": coefficient, "kinematics_noise_deg": coefficient}


@noise_source("kinematics-camera", "Kinematics and camera")
def kinematics_camera(coefficient: float) -> dict[str, float]:
    """Fig. 2 c, d."""
    return kinematics(coefficient) | {"camera_noise_mm": coefficient, "camera_noise_deg": coefficient}


@noise_source("kinematics-camera-stereo", "Kinematics, camera and stereo")
def kinematics_camera_stereo(coefficient: float) -> dict[str, float]:
    """Fig. 2 e, f."""
    return kinematics_camera(coefficient) | {"stereo_noise_mm": coefficient, "stereo_noise_deg": coefficient}
