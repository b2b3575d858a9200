"""The scene's labels: on no other label, beside their points; measured with the letters of a real font."""

import itertools

import numpy as np
import pytest
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath

from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.report.drawing.labels import TEXT_SIZES, Place, place_labels
from rmis_calib.report.drawing.scene import SIZE, draw_scene

NAMES = ("base", "RCM", "head point", "arm", "camera left", "camera right")
SIDES = (-1, 1, 1, 1, 1, 1)
FONT = FontProperties(family="DejaVu Sans")  # as wide as any font that a page falls back to


def ink(place: Place, point: np.ndarray, name: str, size: float) -> np.ndarray:
    """Left, top, right and bottom of the letters as SVG sets them."""
    box = TextPath((0.0, 0.0), name, size=size, prop=FONT).get_extents()
    left = point[0] + size * place.dx - (box.x1 if place.anchor == "end" else 0.0)
    baseline = point[1] + size * place.dy
    return np.array([left + box.x0, baseline - box.y1, left + box.x1, baseline - box.y0])


def overlap(a: np.ndarray, b: np.ndarray) -> bool:
    return bool((np.maximum(a[:2], b[:2]) < np.minimum(a[2:], b[2:])).all())


def assert_apart(places: list[Place | None], points: np.ndarray, names: tuple[str, ...]) -> None:
    for size in TEXT_SIZES:
        boxes = [(n, ink(s, p, n, size)) for s, p, n in zip(places, points, names, strict=True) if s is not None]
        assert not [(a[0], b[0]) for a, b in itertools.combinations(boxes, 2) if overlap(a[1], b[1])]


def test_labels_of_points_that_meet_are_moved_apart() -> None:
    rng = np.random.default_rng(7)
    for spread_px in (0.0, 3.0, 12.0, 60.0, 250.0):
        for _ in range(20):
            points = np.array(SIZE) / 2.0 + rng.uniform(-spread_px, spread_px, (len(NAMES), 2))
            assert_apart(place_labels(points, NAMES, SIDES, SIZE), points, NAMES)


def test_labels_with_room_stand_at_their_points_first_place() -> None:
    points = np.array([[480.0, 450.0], [750.0, 150.0], [150.0, 300.0]])
    places = place_labels(points, NAMES[:3], SIDES[:3], SIZE)
    assert [place.side for place in places if place] == [-1, 1, 1]
    assert {place.dy for place in places if place} == {places[1].dy} and places[1].dy < 0.0


def test_of_two_cameras_side_by_side_each_label_stands_on_its_own_side() -> None:
    left, right = place_labels(np.array([[400.0, 300.0], [410.0, 303.0]]), NAMES[4:], (1, 1), SIZE)
    assert left is not None and right is not None
    assert (left.anchor, right.anchor) == ("end", "start") and left.dx < 0.0 < right.dx


def test_labels_stay_inside_the_drawing_and_points_outside_have_none() -> None:
    points = np.array([[950.0, 5.0], [3.0, 535.0], [-1.0, 20.0], [480.0, 541.0]])
    places = place_labels(points, NAMES[2:], (1, 1, 1, 1), SIZE)
    assert places[2] is None and places[3] is None
    for place, point, name in zip(places[:2], points, NAMES[2:], strict=False):
        assert place is not None
        box = ink(place, point, name, max(TEXT_SIZES))
        assert (box[:2] >= 0.0).all() and (box[2:] <= np.array(SIZE)).all()


def test_the_first_view_of_a_calibration_has_its_labels_apart(rendered_run: CalibrationRun) -> None:
    scene = draw_scene(rendered_run)
    assert scene is not None
    labels = [shape for shape in scene.shapes if shape["kind"] == "label"]
    names = tuple(label["name"] for label in labels)
    assert {"camera left", "camera right"} <= set(names)
    assert_apart([label["place"] for label in labels], np.concatenate([label["points"] for label in labels]), names)
    assert list(scene.shapes[-len(labels) :]) == labels  # over everything else
    with pytest.raises(AssertionError):  # at their first place they would meet
        first = [Place(1, -0.45) for _ in labels]
        assert_apart(first, np.concatenate([label["points"] for label in labels]), names)
