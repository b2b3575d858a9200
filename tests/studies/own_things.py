"""What a user of the studies writes: a method and a noise source of their own."""

import torch

import rmis_calib as rc


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
