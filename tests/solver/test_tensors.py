"""The axes that annotations tell, and the selections that are made by them."""

from dataclasses import fields, replace

import torch
from torch import Tensor

from rmis_calib.solver import Problem
from rmis_calib.solver.model.measurement_rows import MeasurementRows
from rmis_calib.solver.tensors import axes_of, map_tensors


def everything(problem):
    """The problem with all that it can hold."""
    b, n, j = *problem.valid.shape[:1], problem.n_motions, 5
    one = torch.ones(b, n, 6, j, dtype=torch.float64)
    return replace(
        problem,
        joint_derivative=one,
        joint_offset_sigma=one[:, 0, 0],
        joint_offset_at=one[:, 0, 0],
        clock_derivative=one[..., :2],
        clock_at=one[:, 0, 0, :2],
        laparoscope_base_T_arm=problem.arm_T_rcm,
        laparoscope_base_T_instrument_base=problem.arm_T_rcm[:, 0],
        setup_stated=problem.arm_T_rcm[:, 0],
        joints=one[:, :, 0],
    )


def test_every_tensor_of_the_containers_tells_its_axes(simulate):
    problem = everything(simulate()[0])
    tensors = {field.name for field in fields(Problem) if isinstance(getattr(problem, field.name), Tensor)}
    assert set(axes_of(Problem)) == tensors
    assert axes_of(Problem)["contour_xy"] == ("c", "n", "2", "2", "2")
    assert axes_of(Problem)["joint_derivative"] == ("n", "6", "j")
    assert axes_of(Problem)["radius_mm"] == ()
    assert {name for name, axes in axes_of(MeasurementRows).items() if axes[-1] == "b"} == {"camera_R", "camera_t"}


def test_motions_cameras_and_trials_are_selected_on_their_own_axis(simulate):
    problem = everything(simulate()[0])
    b, c, n = problem.valid.shape
    sizes = {"c": c, "n": n, "j": 5}
    part = problem.select_motions(torch.tensor([4, 1, 1])).cameras(1).take_trials(slice(1, 2))
    for name, axes in axes_of(Problem).items():
        whole, few = getattr(problem, name), getattr(part, name)
        assert whole.shape == (b, *(sizes.get(axis) or int(axis) for axis in axes))
        assert few.shape == (1, *({"c": 1, "n": 3}.get(axis) or sizes.get(axis) or int(axis) for axis in axes))
    assert torch.equal(part.arm_T_rcm[0, 0], problem.arm_T_rcm[1, 4])
    assert torch.equal(part.axis_xy[0, 0, 2], problem.axis_xy[1, 0, 1])


def test_a_function_reaches_every_tensor_and_nothing_else():
    held = {"a": (torch.ones(2), "word"), "b": 3}
    mapped = map_tensors(held, lambda x: 2.0 * x)
    assert torch.equal(mapped["a"][0], torch.full((2,), 2.0))
    assert mapped["a"][1:] == ("word",)
    assert mapped["b"] == 3
