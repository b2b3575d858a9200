"""The strips that the search looked at, as lines of the picture."""

import numpy as np
from jaxtyping import Float

from rmis_calib.vision.coarse.search import SearchTrace
from rmis_calib.vision.image.pixel_mapping import Lens


def strip_edges(stages: SearchTrace, lens: Lens, frame: int = 0, count: int = 2) -> list[Float[np.ndarray, "2 p 2"]]:
    """Both edges of the best strips of one frame where they look like a shaft, raw px, the best first.

    Args:
        stages: from `ShaftDetector.explain`.
        lens: of that detector.
        frame: which frame of the batch.
        count: strips at most.
    """
    evidence, scores = stages.evidence, stages.scores[frame]
    strips = evidence.strips
    lateral = strips.contour(evidence.t.expand(*strips.valid.shape, len(evidence.t)))
    points = lens.to_raw(strips.points(evidence.t.expand_as(lateral[:, :, 0])[:, :, None].expand_as(lateral), lateral))
    found = []
    for index in scores.argsort(descending=True)[:count].tolist():
        on = evidence.on[frame, index]
        if float(scores[index]) > 0 and int(on.sum()) > 1:
            found.append(points[frame, index][:, on].double().cpu().numpy())
    return found
