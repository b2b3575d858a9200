"""Line studies: the equations of the problem hold without noise, and the noise is what it says it is."""

import numpy as np
import pytest

from data_synth import LineStudyConfig, simulate_lines
from data_synth.contours import view_cylinder
from data_synth.kinematics import rigid_inverse


def homogeneous(xy: np.ndarray) -> np.ndarray:
    return np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)


def plane(points: np.ndarray) -> np.ndarray:
    n = np.cross(homogeneous(points[..., 0, :]), homogeneous(points[..., 1, :]))
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


@pytest.fixture(scope="module")
def exact() -> dict:
    return simulate_lines(LineStudyConfig(trials=2, pixel_noise_px=0.0, random_hand_eye=True))


def test_shapes(exact: dict) -> None:
    # N = 3^3 * 4^3
    assert exact["arm_T_rcm"].shape == (2, 1728, 4, 4)
    assert exact["axis_left"].shape == (2, 1728, 2, 2)
    assert exact["contour_right"].shape == (2, 1728, 2, 2, 2)
    assert exact["valid_right"].mean() > 0.99


@pytest.mark.parametrize("side", ["right", "left"])
def test_axis_planes_hold_the_axis(exact: dict, side: str) -> None:
    truth = exact["truth"]
    camera_T_arm = truth["camera_right_T_arm"][:, None]
    if side == "left":
        camera_T_arm = truth["camera_left_T_camera_right"][:, None] @ camera_T_arm
    camera_T_rcm = camera_T_arm @ exact["arm_T_rcm"]
    camera_v = np.einsum("tnij,tnj->tni", camera_T_rcm[..., :3, :3], exact["rcm_v_axis"])
    n = plane(exact[f"axis_{side}"])
    good = exact[f"valid_{side}"]
    assert np.abs((n * camera_v).sum(-1)[good]).max() < 1e-12
    assert np.abs((n * camera_T_rcm[..., :3, 3]).sum(-1)[good]).max() < 1e-10
    # Each contour plane is one radius away from the axis; edge 0 on the positive side of its normal u x v + ...
    for edge, sign in ((0, 1.0), (1, -1.0)):
        n_edge = plane(exact[f"contour_{side}"][..., edge, :, :])
        n_edge *= np.sign((n_edge * n).sum(-1, keepdims=True))
        toward = np.einsum("tni,tni->tn", n_edge, camera_T_rcm[..., :3, 3])
        v = view_cylinder(camera_T_rcm[..., :3, 3], camera_v, 4.0)
        flip = np.sign((n * v.n_axis).sum(-1))
        np.testing.assert_allclose((flip * toward)[good], sign * 4.0, atol=1e-10)


def test_edge_0_is_on_the_left_of_the_walk_to_the_tip(exact: dict) -> None:
    good = exact["valid_right"]
    walk = np.diff(exact["axis_right"], axis=-2)[..., 0, :][good]
    across = (exact["contour_right"][..., 0, 0, :] - exact["axis_right"][..., 0, :])[good]
    # x right, y down: the left hand of direction (1, 0) is (0, -1), so walk x left = -1 < 0.
    assert (walk[:, 0] * across[:, 1] - walk[:, 1] * across[:, 0] < 0).all()


def test_end_lies_on_the_axis_at_the_true_offset(exact: dict) -> None:
    truth = exact["truth"]
    s = exact["rcm_s_end_mm"] + truth["shaft_end_offset_mm"]
    T = truth["camera_right_T_rcm"]
    p = T[..., :3, 3] + s[..., None] * np.einsum("tnij,tnj->tni", T[..., :3, :3], exact["rcm_v_axis"])
    seen = np.isfinite(exact["end_right"][..., 0])
    np.testing.assert_allclose((p[..., :2] / p[..., 2:])[seen], exact["end_right"][seen], atol=1e-14)


def test_noise_has_the_stated_size_and_side() -> None:
    c = dict(kinematics_noise_mm=0.3, kinematics_noise_deg=0.1, camera_noise_mm=0.7, camera_noise_deg=0.4)
    out = simulate_lines(LineStudyConfig(trials=4, stereo_noise_mm=0.2, **c))
    truth = out["truth"]
    noise = rigid_inverse(truth["arm_T_rcm"]) @ out["arm_T_rcm"]
    # At least 4 * 1728 samples: 1 sigma of the estimate is 0.85 %.
    np.testing.assert_allclose(noise[..., :3, 3].std(), 0.3, rtol=0.04)
    np.testing.assert_allclose(noise[..., 1, 0].std(), np.deg2rad(0.1), rtol=0.04)
    seen = rigid_inverse(truth["camera_right_T_arm"][:, None] @ truth["arm_T_rcm"]) @ truth["camera_right_T_rcm"]
    np.testing.assert_allclose(seen[..., :3, 3].std(), 0.7, rtol=0.04)
    assert out["sigma_kinematics_rad"] == pytest.approx(np.deg2rad(0.1))
    stereo = rigid_inverse(truth["camera_left_T_camera_right"]) @ out["camera_left_T_camera_right"]
    assert 0.05 < np.abs(stereo[..., :3, 3]).mean() < 0.4


def test_same_seed_same_numbers_and_other_seed_other_numbers() -> None:
    a, b, c = (simulate_lines(LineStudyConfig(trials=1, motion="random", seed=s)) for s in (5, 5, 6))
    np.testing.assert_array_equal(a["axis_right"], b["axis_right"])
    assert not np.allclose(a["axis_right"], c["axis_right"], equal_nan=True)


def test_static_laparoscope_has_one_arm_pose() -> None:
    out = simulate_lines(LineStudyConfig(trials=1, positions_laparoscope=1, positions_instrument=3))
    assert out["arm_T_rcm"].shape == (1, 27, 4, 4)
    assert np.ptp(out["arm_T_rcm"], axis=1).max() == 0.0


def test_a_bent_shaft_is_measured_as_the_lines_through_its_outline() -> None:
    """Outline by brute force: rings of the tube about the bent axis, and of each the points farthest to either side in
    the picture."""
    c = dict(trials=1, pixel_noise_px=0.0, motion="random", random_motions=6, seed=3)
    bent, straight = simulate_lines(LineStudyConfig(shaft_sag_mm=1.0, **c)), simulate_lines(LineStudyConfig(**c))
    T = bent["truth"]["camera_right_T_rcm"][0]
    np.testing.assert_array_equal(bent["arm_T_rcm"], straight["arm_T_rcm"])
    for i in range(6):
        R, p, rcm_v = T[i, :3, :3], T[i, :3, 3], bent["rcm_v_axis"][0, i]
        v, end_mm = R @ rcm_v, bent["rcm_s_end_mm"][0, i] + bent["truth"]["shaft_end_offset_mm"]
        side = R @ (np.eye(3)[0] - rcm_v[0] * rcm_v)
        side /= np.linalg.norm(side)
        s = np.linspace(end_mm - 90.0, end_mm, 9001)
        axis = p + s[:, None] * v
        s = s[(np.abs(axis[:, :2] / axis[:, 2:]) <= [0.8, 0.6]).all(-1)]
        s = np.linspace(s[0], s[-1], 32)
        u = (end_mm - s) / 60.0
        curve = p + s[:, None] * v + (4.0 * u * (1.0 - u))[:, None] * side
        tangent = np.gradient(curve, s, axis=0, edge_order=2)
        tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
        first = np.cross(tangent, [0.0, 0.0, 1.0])
        first /= np.linalg.norm(first, axis=-1, keepdims=True)
        second = np.cross(tangent, first)
        angle = np.linspace(0.0, 2.0 * np.pi, 721)[:, None, None]
        ring = curve + 4.0 * (np.cos(angle) * first + np.sin(angle) * second)  # (angle, station, 3)
        uv = ring[..., :2] / ring[..., 2:]
        along = straight["axis_right"][0, i, 1] - straight["axis_right"][0, i, 0]
        along /= np.linalg.norm(along)
        left = np.array([along[1], -along[0]])
        for edge, sign in ((0, 1.0), (1, -1.0)):
            index = (sign * (uv @ left)).argmax(0)
            x, y = (uv[index, np.arange(len(curve))] @ axis for axis in (along, left))
            slope, height = np.polyfit(x, y, 1)
            measured = bent["contour_right"][0, i, edge]
            off_px = 800.0 * (measured @ left - slope * (measured @ along) - height)
            moved_px = 800.0 * ((measured - straight["contour_right"][0, i, edge]) @ left)
            assert np.abs(off_px).max() < 0.03
            assert np.abs(moved_px).max() > 1.0
