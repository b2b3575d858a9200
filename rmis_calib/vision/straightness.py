"""How straight contours are, by place in the picture: what is left of a lens after its model."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.vision.detections import ShaftDetections

_LEAST_EIGENVALUE = 0.15
"""Of the mean of n n^T: where contours of one direction alone were seen, half of the displacement is not known."""


@dataclass(frozen=True, eq=False)
class StraightnessTable:
    """Normal equations of the displacement of contour points from their lines, in cells of one view's pictures.

    Tables of batches, or of recordings of one camera, are merged by adding them.
    """

    information: Float[Tensor, "rows columns 2 2"]
    """Sum of n n^T over stretches of contour, n their unit normal in raw pixels."""
    weighted_px: Float[Tensor, "rows columns 2"]
    """Sum of n d, d the signed distance from the line along n, px."""
    image_size: tuple[int, int]
    """(height, width)."""

    @classmethod
    def of(
        cls,
        found: ShaftDetections,
        image_size: tuple[int, int],
        cells: tuple[int, int] = (6, 8),
        least_confidence: float = 0.9,
    ) -> "StraightnessTable":
        """The table of one view's detections.

        Args:
            found: of any number of pictures.
            image_size: (height, width), px.
            cells: rows and columns of the table.
            least_confidence: of the shafts that count.
        """
        sure = found.valid & (found.confidence >= least_confidence)
        uv, off = found.straight_uv[sure].double(), found.straight_px[sure].double()  # (m, edge, n, 2), (m, edge, n)
        along = torch.nn.functional.normalize(uv[:, :, -1] - uv[:, :, 0], dim=-1)
        normal = torch.stack([along[..., 1], -along[..., 0]], -1)[:, :, None].expand_as(uv)
        known = torch.isfinite(off) & torch.isfinite(uv).all(-1)
        rows, columns = cells
        height, width = image_size
        size = uv.new_tensor([width, height])
        at = ((uv[known] + 0.5) / size * uv.new_tensor([columns, rows])).long()
        cell = at[:, 1].clamp(0, rows - 1) * columns + at[:, 0].clamp(0, columns - 1)
        n, d = normal[known], off[known]
        information = n.new_zeros(rows * columns, 2, 2).index_add_(0, cell, n[:, :, None] * n[:, None])
        weighted = n.new_zeros(rows * columns, 2).index_add_(0, cell, n * d[:, None])
        return cls(information.unflatten(0, cells), weighted.unflatten(0, cells), image_size)

    def __add__(self, other: "StraightnessTable") -> "StraightnessTable":
        return StraightnessTable(
            self.information + other.information, self.weighted_px + other.weighted_px, self.image_size
        )

    @property
    def count(self) -> Float[Tensor, "rows columns"]:
        """Stretches of contour in each cell."""
        return self.information.diagonal(dim1=-2, dim2=-1).sum(-1)

    def displacement_px(self) -> Float[Tensor, "rows columns 2"]:
        """Where points of straight contours lie relative to straight lines, (u, v) px; NaN where a cell does not know.

        A lens that is modelled right leaves noise; barrel distortion that is not modelled bows contours outwards in the
        middle of the picture's sides, against their ends.
        """
        mean = self.information / self.count.clamp(min=1.0)[..., None, None]
        known = torch.linalg.eigvalsh(mean)[..., 0] > _LEAST_EIGENVALUE
        safe = torch.where(known[..., None, None], self.information, torch.eye(2, dtype=mean.dtype, device=mean.device))
        solved = torch.linalg.solve(safe, self.weighted_px[..., None])[..., 0]
        return torch.where(known[..., None], solved, torch.nan)
