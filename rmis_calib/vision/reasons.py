"""Why a frame gave no shaft, as data that travels with the batch."""

from enum import IntEnum


class FrameReason(IntEnum):
    """Outcome of one frame; `sentence` is what a report prints."""

    OK = 0
    BAD_PIXELS = 1
    NO_PICTURE = 2
    NO_STRAIGHT_EDGES = 3
    NOT_A_CYLINDER = 4
    TOO_SHORT = 5
    EDGES_UNCLEAR = 6
    AMBIGUOUS = 7
    LEFT_OUT = 8

    @property
    def sentence(self) -> str:
        """The reason in words."""
        return _SENTENCES[self]


_SENTENCES = {
    FrameReason.OK: "a shaft was found",
    FrameReason.BAD_PIXELS: "the frame has values that are not finite numbers",
    FrameReason.NO_PICTURE: "the frame is black, white or of one tone: nothing can be told apart in it",
    FrameReason.NO_STRAIGHT_EDGES: "no straight edges stand out",
    FrameReason.NOT_A_CYLINDER: "no two edges enclose a strip that differs from both sides, as a shaft does",
    FrameReason.TOO_SHORT: "what looks like a shaft is too short, or never reaches the border of the picture",
    FrameReason.EDGES_UNCLEAR: "too few sub-pixel edge points agree on two straight lines",
    FrameReason.AMBIGUOUS: "a strip was found, but its confidence is below the accepted minimum",
    FrameReason.LEFT_OUT: "the frame was left out: only every n-th was to be searched",
}
