"""Where the predicted edges are drawn."""

import numpy as np
import torch

from rmis_calib.geometry.cameras import Camera
from rmis_calib.geometry.lines import contour_planes
from rmis_calib.report.pictures import contour_polylines


def test_edges_stop_where_the_shaft_does():
    """A shaft at 100 mm, along +x from x = -50 to x = 10 mm: in pictures of f = 500 px its edges end near u = 370."""
    camera = Camera.from_values(500.0, 500.0, 320.0, 240.0, image_size=(480, 640))
    p, d = torch.tensor([-50.0, 0.0, 100.0]).double(), torch.tensor([1.0, 0.0, 0.0]).double()
    end = torch.tensor([10.0, 0.0, 100.0]).double()
    whole = contour_polylines(contour_planes(p, d, 4.0), camera)
    cut = contour_polylines(contour_planes(p, d, 4.0), camera, end)
    for lines, farthest in ((whole, 640.0), (cut, 370.0)):
        u = lines[..., 0]
        in_picture = np.isfinite(u) & (u >= 0) & (u <= farthest + 15.0)
        assert np.nanmax(np.where(in_picture, u, np.nan)) > farthest - 15.0
        assert np.nanmin(np.where(in_picture, u, np.nan)) < 15.0
    assert np.nanmax(cut[..., 0]) <= 370.0
    v = 240.0 + np.array([-1.0, 1.0]) * 500.0 * 4.0 / np.sqrt(100.0**2 - 4.0**2)
    assert np.allclose(np.nanmedian(cut[..., 1], axis=1), v)  # edge 0 is the upper one where the shaft points right
