"""Where the predicted edges are drawn."""

import numpy as np
import torch

from rmis_calib.geometry.cameras import Camera
from rmis_calib.pipeline.answer.predicted_shaft import in_picture, shaft_edges
from rmis_calib.report.drawing.frames import shortened


def test_edges_run_from_the_rcm_to_the_end_of_the_shaft():
    """A shaft at 100 mm, along +x from x = -90 to x = 10 mm: in pictures of f = 500 px its edges end at u = 370."""
    camera = Camera.from_values(500.0, 500.0, 320.0, 240.0, image_size=(480, 640))
    rcm, end = torch.tensor([-90.0, 0.0, 100.0]).double(), torch.tensor([10.0, 0.0, 100.0]).double()
    uv = in_picture(camera, shaft_edges(rcm, end, 4.0))
    v = 240.0 + np.array([-1.0, 1.0]) * 500.0 * 4.0 / np.sqrt(100.0**2 - 4.0**2)
    assert np.allclose(uv[..., 1], v[:, None])  # edge 0 is the upper one where the shaft points right
    # The tangent lines touch the cylinder r^2 / D before the axis: at 99.84 mm instead of 100.
    assert np.allclose(uv[:, -1, 0], 320.0 + 500.0 * 10.0 / 99.84) and np.allclose(uv[:, 0, 0], 320.0 - 45000.0 / 99.84)
    drawn = shortened(uv[0], (480, 640))
    assert len(drawn) <= 24 and -0.1 * 640 <= drawn[0, 0] <= 0.0 and np.allclose(drawn[-1], uv[0, -1])


def test_what_is_behind_the_camera_is_not_drawn():
    camera = Camera.from_values(500.0, 500.0, 320.0, 240.0, image_size=(480, 640))
    rcm, end = torch.tensor([0.0, 20.0, -60.0]).double(), torch.tensor([0.0, 5.0, 90.0]).double()
    uv = in_picture(camera, shaft_edges(rcm, end, 4.0))
    behind = np.isnan(uv).any(-1)
    assert behind[:, 0].all() and not behind[:, -1].any()
    assert (np.diff(behind.astype(int), axis=1) <= 0).all()  # once in front, it stays there
