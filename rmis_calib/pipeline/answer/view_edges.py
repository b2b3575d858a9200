"""What the pictures of one camera show along predicted contours."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

STRETCHES = 6
"""Stretches of a shaft of which medians are taken."""


@dataclass(frozen=True, eq=False)
class ViewEdges:
    """What the pictures of one camera show along the predicted contours of m motions, at s stations of either contour
    [left, right] from the picture's border to the shaft's end, and in b stretches of it; NaN where there is no edge.

    Attributes:
        side: `right` or `left`.
        motions: numbers of the motions, among those with known joints.
        px: of the edge at every station, positive outwards.
        looked: whether the picture could show one: it is in view.
        uv: the stations, raw px.
        right_px: of the shaft in each stretch, positive to the right of who looks towards the tip.
        outward_px: of its contours, positive where it is wider than predicted.
        of_k1_px: how far to the right radial distortion of k1 = 1 moves the shaft in each stretch.
    """

    side: str
    motions: Int[np.ndarray, " m"]
    px: Float[np.ndarray, "m 2 s"]
    looked: Bool[np.ndarray, "m 2 s"]
    uv: Float[np.ndarray, "m 2 s 2"]
    right_px: Float[np.ndarray, "m b"]
    outward_px: Float[np.ndarray, "m b"]
    of_k1_px: Float[np.ndarray, "m b"]

    @property
    def stretch_uv(self) -> Float[np.ndarray, "m b 2"]:
        """Middle of each stretch, on the axis, raw px."""
        return self.uv.mean(1).reshape(len(self.uv), STRETCHES, -1, 2).mean(2)

    @property
    def right_uv(self) -> Float[np.ndarray, "m 2"]:
        """Direction in the picture that is right of someone who looks towards the tip, unit."""
        along = (self.uv[:, :, -1] - self.uv[:, :, 0]).sum(1)
        right = np.stack([-along[:, 1], along[:, 0]], axis=-1)
        return right / np.linalg.norm(right, axis=-1, keepdims=True)
