"""Overlays and stage pictures are drawn, where and on what they should be."""

import numpy as np
import torch
from drawn_bars import draw_bar

from rmis_calib.vision import ShaftDetector, draw_detections, draw_stage_sheet, draw_stages


def test_an_overlay_marks_contours_and_leaves_the_rest() -> None:
    bar = draw_bar(25.0)
    before = bar.image.copy()
    found = ShaftDetector().detect(bar.batch)
    drawn = draw_detections(bar.image, found, label="frame 0")
    assert np.array_equal(bar.image, before)
    assert drawn.shape == before.shape and drawn.dtype == np.uint8
    changed = (drawn != before).any(-1)
    contour = found.contour_uv[0, 0, 0].numpy()
    on_line = contour[len(contour) // 2].round().astype(int)
    assert changed[on_line[1], on_line[0]]
    assert changed.mean() < 0.05


def test_an_overlay_without_a_shaft_is_the_picture() -> None:
    grey = np.full((240, 320, 3), 128, np.uint8)
    found = ShaftDetector().detect(torch.from_numpy(grey).permute(2, 0, 1)[None])
    assert np.array_equal(draw_detections(grey, found), grey)
    predicted = np.array([[[10.0, 10.0], [300.0, 200.0]], [[np.nan, 0.0], [5.0, 5.0]]])
    assert (draw_detections(grey, found, predicted_uv=predicted) != grey).any()


def test_every_stage_has_a_picture() -> None:
    _, stages = ShaftDetector().explain(draw_bar(25.0).batch)
    pictures = draw_stages(stages)
    assert list(pictures) == sorted(pictures)
    assert all(p.ndim == 3 and p.shape[2] == 3 and p.dtype == np.uint8 for p in pictures.values())
    # The strip's dots lie on the small picture of the bar.
    assert (pictures["7_strips"] != pictures["1_small"]).any()


def test_a_sheet_names_the_stage_that_failed() -> None:
    images = torch.cat([draw_bar(25.0).batch, torch.full((1, 3, 480, 640), 120, dtype=torch.uint8)])
    found, stages = ShaftDetector().explain(images)
    good, failed = (
        draw_stage_sheet(images[i].permute(1, 2, 0).numpy(), found, stages, i, f"frame {i}") for i in range(2)
    )
    assert good.shape == failed.shape and good.dtype == np.uint8
    amber = (failed == [255, 176, 0]).all(-1)
    assert amber.sum() > 1000
    # The frame lies about the third panel of the first row: a picture of one tone.
    assert (amber.sum(0) > 100).argmax() > 2 * good.shape[1] // 5 - 10
