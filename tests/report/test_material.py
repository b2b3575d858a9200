"""What a report draws, against numbers from other code: OpenCV's projection, SciPy's rotations, and samples."""

import dataclasses

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.report.charts.residuals import drawn_points, residual_figures
from rmis_calib.report.charts.signed import residual_evidence
from rmis_calib.report.drawing.choosing import choose_motions, farthest_apart, typical_spread, worst_apart
from rmis_calib.report.drawing.rejections import rejection_sheets
from rmis_calib.report.drawing.scene import SIGMAS, draw_scene, project, view_axes
from rmis_calib.report.drawing.working_point import ellipse, projection_jacobian, working_point_picture


def opencv_pixels(camera, points: np.ndarray) -> np.ndarray:
    """(n, 2) pixels of points in the camera's frame, by OpenCV."""
    K = np.array([[float(camera.fx), 0, float(camera.cx)], [0, float(camera.fy), float(camera.cy)], [0, 0, 1.0]])
    distortion = np.asarray(camera.distortion, dtype=float)
    return cv2.projectPoints(points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, distortion)[0][:, 0]


def head_points(run: CalibrationRun, matrix: np.ndarray) -> np.ndarray:
    """(m, 3) head points in the right camera, by NumPy."""
    camera_T_rcm = matrix @ run.poses.arm_T_rcm.numpy()
    return np.einsum("mij,mj->mi", camera_T_rcm[:, :3, :3], run.poses.rcm_p_head.numpy()) + camera_T_rcm[:, :3, 3]


def test_head_point_residuals_have_the_sign_and_size_that_projection_tells(rendered_run: CalibrationRun) -> None:
    run = rendered_run
    evidence = residual_evidence(run)
    assert evidence is not None
    kinds = {kind.kind: kind for kind in evidence.kinds}
    assert set(kinds) == {"across", "width", "end", "head_across", "head_along"}
    camera = run.camera(run.views[0])
    matrix = run.result.camera_right_T_arm.matrix.numpy()
    predicted = opencv_pixels(camera, head_points(run, matrix))
    gap = run.recording.head_points.uv_right - predicted
    rcm = matrix @ run.poses.arm_T_rcm.numpy() @ np.array([0.0, 0.0, 0.0, 1.0])
    tip = head_points(run, matrix)
    before = rcm[:, :3] + 0.9 * (tip - rcm[:, :3])
    along = tip[:, :2] / tip[:, 2:] - before[:, :2] / before[:, 2:]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    right = np.stack([-along[:, 1], along[:, 0]], axis=1)  # x right, y down: right of (1, 0) is (0, 1)
    for kind, direction in (("head_along", along), ("head_across", right)):
        mine = kinds[kind].px[~kinds[kind].is_left]
        # Raw pixels are distorted, mine are not: k1 = -0.2 changes lengths by a few per cent within this picture.
        assert np.allclose(mine, (gap * direction).sum(1), atol=0.15 + 0.08 * np.abs(gap).max())


def test_a_shaft_that_is_drawn_too_far_left_is_found_to_the_right(rendered_run: CalibrationRun) -> None:
    """The camera moved so that every prediction moves along +x of the picture by 1 mm at its depth."""
    run = rendered_run
    found = run.result.camera_right_T_arm
    moved = found.matrix.clone()
    moved[0, 3] += 1.0
    result = dataclasses.replace(run.result, camera_right_T_arm=RigidTransform("camera_right", "arm", moved))
    before, after = (
        {kind.kind: kind for kind in residual_evidence(each).kinds}
        for each in (run, dataclasses.replace(run, result=result))
    )
    camera = run.camera(run.views[0])
    for kind, nearer in (("across", 0.3), ("end", 0.1), ("head_along", 0.05)):  # the shaft lies before its head
        right = ~before[kind].is_left
        change = (after[kind].px - before[kind].px)[right]
        depth = head_points(run, found.matrix.numpy())[:, 2]
        # Residuals are measured minus predicted: along the positive direction they fall by its x part.
        expected = -float(camera.focal) / depth * before[kind].across_uv[right][:, 0]
        assert np.corrcoef(change, expected)[0, 1] > 0.95
        assert 0.95 < np.median(change / expected) < 1.05 + nearer


def test_signed_residuals_of_the_edges_are_those_of_the_result(rendered_run: CalibrationRun) -> None:
    """The result's residual of a motion is the rms over both edges' points: at least that of the edges' means."""
    kinds = {kind.kind: kind for kind in residual_evidence(rendered_run).kinds}
    across, width = kinds["across"], kinds["width"]
    for side, name in ((False, "contour_right"), (True, "contour_left")):
        picked = across.is_left == side
        by_motion = rendered_run.result.residuals[name].by_motion[across.motion[picked]]
        edges = np.hypot(across.px[picked], 0.5 * width.px[picked])
        assert (edges <= by_motion + 0.05).all()
        assert np.median(edges / by_motion) > 0.6


def test_thinning_keeps_the_largest_residuals() -> None:
    px = np.random.default_rng(0).normal(size=20_000)
    px[[17, 12_345]] = 40.0, -50.0
    shown = drawn_points(px)
    assert len(shown) <= 700 and {17, 12_345} <= set(shown.tolist())


def test_ellipses_hold_what_they_say(rendered_run: CalibrationRun) -> None:
    """Of answers drawn from the covariance, 39 and 86 of 100 put the head point within the drawn ellipses."""
    run = rendered_run
    picture = working_point_picture(run)
    assert picture is not None
    motion = int(np.flatnonzero(run.poses.frames == picture.overlay.frame)[0])
    rng = np.random.default_rng(1)
    draws = rng.multivariate_normal(np.zeros(6), run.result.covariance, size=20_000)
    matrix = run.result.camera_right_T_arm.matrix.numpy()
    arm_p = np.linalg.inv(matrix) @ np.append(head_points(run, matrix)[motion], 1.0)
    turned = (Rotation.from_rotvec(draws[:, :3]) * Rotation.from_matrix(matrix[:3, :3])).apply(arm_p[:3])
    pixels = opencv_pixels(run.camera(run.views[0]), turned + matrix[:3, 3] + draws[:, 3:])
    marks = {mark.style: mark.points for mark in picture.overlay.marks}
    centre = marks["sigma1"][:-1].mean(0)
    head = opencv_pixels(run.camera(run.views[0]), head_points(run, matrix)[motion][None])[0]
    shown = centre + (pixels - head) * picture.enlarged
    for name, share in (("sigma1", 0.3935), ("sigma2", 0.8647)):
        outline = marks[name].astype(np.float32).reshape(-1, 1, 2)
        inside = [cv2.pointPolygonTest(outline, (float(x), float(y)), False) >= 0 for x, y in shown]
        assert np.mean(inside) == pytest.approx(share, abs=0.02)


def test_the_scale_bar_is_as_long_as_two_points_that_far_apart(rendered_run: CalibrationRun) -> None:
    picture = working_point_picture(rendered_run)
    motion = int(np.flatnonzero(rendered_run.poses.frames == picture.overlay.frame)[0])
    head = head_points(rendered_run, rendered_run.result.camera_right_T_arm.matrix.numpy())[motion]
    assert picture.depth_mm == pytest.approx(head[2])
    ends = head + picture.ruler_mm * np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
    apart = np.linalg.norm(np.diff(opencv_pixels(rendered_run.camera(rendered_run.views[0]), ends), axis=0))
    # Distortion shortens lengths away from the centre, unevenly in its two directions.
    assert picture.ruler_px == pytest.approx(apart * picture.enlarged, rel=0.05)


def test_jacobian_is_opencvs(rendered_run: CalibrationRun) -> None:
    camera, p = rendered_run.camera(rendered_run.views[0]), np.array([12.0, -9.0, 95.0])
    step = 1e-4
    numeric = [
        (opencv_pixels(camera, p + step * axis) - opencv_pixels(camera, p - step * axis))[0] / (2 * step)
        for axis in np.eye(3)
    ]
    assert np.allclose(projection_jacobian(camera, p), np.array(numeric).T, atol=1e-5)
    values = np.diag([4.0, 9.0])
    assert np.allclose(np.abs(ellipse(values)).max(0), [2.0, 3.0], atol=0.01)


def test_worst_motions_are_far_apart_and_typical_ones_in_the_middle() -> None:
    place = np.array([[0.0, 0, 0], [0.1, 0, 0], [50, 0, 0], [100, 0, 0], [0, 100, 0], [100, 100, 0]])
    residual = np.array([9.0, 8.0, 3.0, 2.0, 2.5, np.nan])
    assert worst_apart(residual, place, 2) == (0, 2)  # not 1, which is beside 0
    assert set(typical_spread(residual, place, 3, without=(2,))) == {1, 4}  # quartiles 2.5 and 8
    assert farthest_apart(np.array([0, 1, 3, 5]), place, 2) in ((1, 5), (3, 0))
    assert farthest_apart(np.array([], dtype=int), place, 2) == ()


def test_each_reason_has_a_sheet_with_the_candidate_that_was_refused(run_with_rejections: CalibrationRun) -> None:
    run = run_with_rejections
    chosen = choose_motions(run, 3, 3, 3)
    assert not set(chosen.worst) & {3, 9, 15} and not set(chosen.typical) & {3, 9, 15}
    assert set(chosen.rejected["does not fit the other motions"]) == {3, 15}
    sheets = {sheet.reason: sheet for sheet in rejection_sheets(run, chosen.rejected)}
    assert sheets["does not fit the other motions"].count == 2
    for sheet in sheets.values():
        for overlay in sheet.overlays:
            assert not overlay.used and any(mark.style == "refused" for mark in overlay.marks)
            refused = next(mark.points for mark in overlay.marks if mark.style == "refused")
            taken = run.views[0].detections.contour_uv[overlay.frame, 0, 0].numpy()
            assert np.allclose(refused, taken)


def test_without_an_answer_nothing_is_predicted(refused_run: CalibrationRun) -> None:
    assert residual_evidence(refused_run) is None and residual_figures(None) == ()
    assert working_point_picture(refused_run) is None
    scene = draw_scene(refused_run)
    assert scene is not None and not scene.has_answer and scene.sigma_mm == ()
    assert {line["style"] for line in scene.data["lines"]}.isdisjoint({"camera", "advised"})


def test_the_scene_is_drawn_without_perspective_at_its_scale(rendered_run: CalibrationRun) -> None:
    scene = draw_scene(rendered_run)
    view = scene.data["view"]
    right, up, towards = view_axes(view["yaw"], view["pitch"])
    assert np.allclose(np.stack([right, up, towards]) @ np.stack([right, up, towards]).T, np.eye(3))
    assert np.linalg.det(np.stack([right, up, towards])) == pytest.approx(1.0)
    assert up[2] > 0.0  # base's z is up
    shaft = next(line for line in scene.data["lines"] if line["style"] == "shaft")
    shape = next(shape for shape in scene.shapes if shape["style"] == "shaft")
    a, b = np.array(shaft["points"][0])
    across = np.array([(b - a) @ right, (b - a) @ up])
    assert np.linalg.norm(np.diff(shape["points"], axis=0)) == pytest.approx(view["scale"] * np.linalg.norm(across))
    assert shape["width"] == pytest.approx(2.0 * shaft["radius"] * view["scale"])
    sigmas = np.sqrt(np.linalg.eigvalsh(np.array(scene.data["ellipsoids"][0]["covariance"][0])))
    assert scene.sigma_mm[0] == pytest.approx(SIGMAS * sigmas[-1], rel=1e-3)
    enlarged = [item["sigmas"] / SIGMAS for item in scene.data["ellipsoids"]]
    assert enlarged == [1.0, scene.magnification] and scene.magnification * scene.sigma_mm[0] <= 25.0
    assert [shape["depth"] for shape in scene.shapes] == sorted(shape["depth"] for shape in scene.shapes)
    heads = [next(s["points"] for s in project(scene.data, k) if s["style"] == "head-point") for k in (0, 5)]
    assert not np.allclose(*heads)
