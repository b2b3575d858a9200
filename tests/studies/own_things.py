"""What a user of the studies writes: a method and a noise source of their own."""

import torch

import rmis_calib as rc
from rmis_calib.studies.settings import SetupSettings
from rmis_calib.studies.simulation import make_setup


@rc.studies.method("nothing", "the identity", measurements=("axis",))
def nothing(problem):
    """Says that the camera is the arm."""
    return torch.eye(4, dtype=torch.float64).expand(problem.n_trials, 4, 4)


def shift_ten_mm(data, coefficient, generator):
    """The laparoscope's kinematics are wrong by the same everywhere."""
    data["arm_T_rcm"][..., 0, 3] += 10.0 * coefficient


@rc.studies.noise_source("shifted", "Constant error", disturb=shift_ten_mm)
def shifted(coefficient):
    return {}


@rc.studies.method("root-of-n", "off by 10 mm over the root of the motions")
def root_of_n(problem):
    """Its error is known without trials."""
    exact = make_setup(SetupSettings()).scene.camera_right_T_arm
    estimate = torch.tensor(exact).repeat(problem.n_trials, 1, 1)
    estimate[:, 2, 3] += 10.0 / problem.n_motions**0.5
    return estimate


def _bend(name):
    def disturb(data, coefficient, generator):
        data[name][..., 1, 3] += coefficient

    return disturb


@rc.studies.noise_source("stiff", disturb=_bend("arm_T_rcm"), disturb_board=_bend("base_T_arm"))
def stiff(coefficient):
    return {"kinematics_noise_mm": 0.2 * coefficient, "kinematics_noise_deg": 0.0, "stereo_noise_mm": 0.1 * coefficient}
