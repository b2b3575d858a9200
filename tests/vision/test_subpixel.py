"""The place of an edge as a function of the pixels: right, and differentiable up to the answer of a calibration."""

import numpy as np
import pytest
import torch
from scipy.special import erf

import rmis_calib as rc
from data_synth.lines import simulate_lines
from data_synth.settings import LineStudyConfig
from rmis_calib.config import parse_config

FOCAL_PX, SIZE, BLUR_PX = 800.0, 17, 1.3


def step(x, blur):
    """A blurred step of height 1 at 0, by the error function."""
    return 0.5 * (1.0 + erf(x / (blur * np.sqrt(2.0))))


@pytest.mark.parametrize("place", [-1.1, -0.3, 0.0, 0.45, 0.9])
@pytest.mark.parametrize("height", [0.5, -0.2])
def test_the_place_of_an_ideal_step(place, height):
    x = np.arange(13) - 6.0
    for blur in (0.7, 1.3, 2.0):
        profile = torch.from_numpy(0.3 + height * step(x - place, blur))
        found = rc.step_place(profile, torch.tensor(blur, dtype=torch.float64), newton_steps=6)
        assert float(found) == pytest.approx(place, abs=1e-6)


def test_slopes_on_both_sides_are_allowed_for():
    """Against a step without them: the middle of the brightnesses is no measure of the place."""
    x = np.arange(13) - 6.0 - 0.4
    profile = 0.3 + 0.5 * step(x, 1.3) + 0.02 * x
    found = rc.step_place(torch.from_numpy(profile), torch.tensor(1.3, dtype=torch.float64))
    assert float(found) == pytest.approx(0.4, abs=0.01)


def test_derivatives_are_those_of_finite_differences():
    generator = torch.Generator().manual_seed(0)
    x = torch.arange(9, dtype=torch.float64) - 4.0
    places = torch.tensor([[-0.6], [0.1], [0.5]], dtype=torch.float64)
    profile = 0.2 + 0.6 * torch.special.ndtr((x - places) / 1.2)
    profile = (profile + 0.01 * torch.randn(3, 9, generator=generator, dtype=torch.float64)).requires_grad_()
    blur = torch.tensor([1.0, 1.2, 1.4], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(rc.step_place, (profile, blur))
    picture = edge_picture(torch.tensor([0.8, 0.6]), 7.3).requires_grad_()
    uv = torch.tensor([[8.2, 1.4], [5.1, 5.6]], dtype=torch.float64)
    across = torch.tensor([0.8, 0.6], dtype=torch.float64)

    def points(picture):
        return rc.edge_points(picture, uv, across, 0.7, BLUR_PX, samples=9)

    assert torch.autograd.gradcheck(points, picture)


def edge_picture(normal, offset):
    """Brightness rises by 0.6 where u n_u + v n_v = offset."""
    v, u = torch.meshgrid(*[torch.arange(SIZE, dtype=torch.float64)] * 2, indexing="ij")
    return 0.2 + 0.6 * torch.special.ndtr((u * normal[0] + v * normal[1] - offset) / BLUR_PX)


def test_an_edge_that_moves_by_a_pixel_moves_its_point_by_a_pixel():
    normal = torch.tensor([0.8, -0.6], dtype=torch.float64)
    offset = torch.tensor(1.7, dtype=torch.float64)
    uv = torch.tensor([8.0, 8.0], dtype=torch.float64)

    def along(offset):
        return (rc.edge_points(edge_picture(normal, offset), uv, normal, 0.7, BLUR_PX) * normal).sum()

    slope, found = torch.func.grad_and_value(along)(offset)
    # Reading between pixels is linear: measured 0.003 px and 0.02, up to 0.03 for an upright edge.
    assert float(found) == pytest.approx(1.7, abs=0.01)
    assert float(slope) == pytest.approx(1.0, abs=0.04)


def test_the_answer_of_a_calibration_has_a_derivative_by_pixels():
    """Each contour point of a simulation has a small picture of its own; from these to the answer it is one graph."""
    noise = {"pixel_noise_px": 0.3, "kinematics_noise_mm": 0.1, "kinematics_noise_deg": 0.03}
    arrays = simulate_lines(LineStudyConfig(trials=1, positions_laparoscope=2, positions_instrument=2, **noise))
    measured = torch.from_numpy(np.asarray(arrays["contour_right"]))  # (1, n, edge, point, xy), NaN out of view
    seen = measured.isfinite().all(-1, keepdim=True)
    truth = torch.where(seen, measured, measured.new_tensor([[0.0, 0.0], [0.1, 0.0]]))
    direction = truth[..., 1, :] - truth[..., 0, :]
    across = torch.stack([-direction[..., 1], direction[..., 0]], -1) / direction.norm(dim=-1, keepdim=True)
    across = across[..., None, :].expand_as(truth).reshape(-1, 2)
    generator = torch.Generator().manual_seed(1)
    start = truth.reshape(-1, 2) + 0.4 / FOCAL_PX * torch.randn(across.shape, generator=generator, dtype=torch.float64)
    # The pictures side by side; each has its own point in the middle.
    middle = torch.full_like(start, SIZE // 2)
    offset = (across * (middle + FOCAL_PX * (truth.reshape(-1, 2) - start))).sum(-1)
    drawn = torch.cat([edge_picture(n, o) for n, o in zip(across, offset, strict=True)], dim=1)
    at = middle + torch.stack([SIZE * torch.arange(len(start)), torch.zeros(len(start))], -1)
    config = parse_config({"measurements": ["contours"], "solver": {"bias_correction": False}})

    def answer(pictures):
        moved = rc.edge_points(pictures, at, across, 0.7, BLUR_PX) - at
        contour = torch.where(seen, (start + moved / FOCAL_PX).reshape(truth.shape), torch.nan)
        return contour, rc.solve(arrays | {"contour_right": contour}, config, differentiable=True).camera_right_T_arm

    pictures = drawn.clone().requires_grad_()
    contour, found = answer(pictures)
    miss_px = FOCAL_PX * ((contour.detach() - measured).reshape(-1, 2) * across).sum(-1).abs()
    # Measured 0.033 px, of points that set out up to 1.2 px away: reading between pixels is linear.
    assert int(seen.sum()) > 200 and float(miss_px.nan_to_num().max()) < 0.05
    weights = torch.randn(3, 4, generator=generator, dtype=torch.float64)
    (gradient,) = torch.autograd.grad((found[0, :3] * weights).sum(), pictures)
    change = torch.randn(pictures.shape, generator=generator, dtype=torch.float64)
    h = 1e-5
    ahead, behind = (answer(drawn + s * h * change)[1][0, :3].detach() for s in (1.0, -1.0))
    assert float((gradient * change).sum()) == pytest.approx(
        float(((ahead - behind) * weights).sum()) / (2 * h), rel=1e-4
    )
