"""At which borders of the picture a strip enters, by its contours or through the dark, for strips at stations."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rmis_calib.vision.image.run_length import bridge, first_on, last_on, run_any


def reached_borders(
    t: Float[Tensor, " s"], run: Bool[Tensor, "*b s"], seen: Bool[Tensor, "*b s"], width: Float[Tensor, "*b"]
) -> tuple[Bool[Tensor, "*b"], Bool[Tensor, "*b"]]:
    """Whether a stretch comes within half a width of where the field of view begins, and of where it ends.

    Args:
        t: stations, evenly spaced.
        run: those of the stretch.
        seen: those in the field of view.
        width: of the strip, in the unit of the stations.
    """
    reach = 0.5 * width + 3 * (t[1] - t[0])
    return first_on(t, run) - first_on(t, seen) < reach, last_on(t, seen) - last_on(t, run) < reach


def enters_high(
    t: Float[Tensor, " s"],
    run: Bool[Tensor, "*b s"],
    seen: Bool[Tensor, "*b s"],
    borders: tuple[Bool[Tensor, "*b"], Bool[Tensor, "*b"]],
) -> Bool[Tensor, "*b"]:
    """Whether a shaft enters on the high side: it reaches that border alone, or both or none and is nearer to that one.

    Args:
        t: stations.
        run: those of the shaft.
        seen: those in the field of view.
        borders: whether it reaches the low and the high border.
    """
    low, high = borders
    nearer_high = last_on(t, seen) - last_on(t, run) < first_on(t, run) - first_on(t, seen)
    return (high & ~low) | ((high == low) & nearer_high)


def enter(
    t: Float[Tensor, " s"],
    edged: Bool[Tensor, "b k s"],
    main: Bool[Tensor, "b k s"],
    seen: Bool[Tensor, "b k s"],
    width: Float[Tensor, "b k"],
) -> tuple[Bool[Tensor, "b k s"], tuple[Bool[Tensor, "b k"], Bool[Tensor, "b k"]]]:
    """Stretch between the shaft's plain part and the border it enters at; whether it reaches the low, the high border.

    Near the scope's light a shaft may be as bright as a wrist. On the side where its contours run out of the picture it
    is shaft all the same.
    """
    step = t[1] - t[0]
    contoured = edged & run_any(bridge(edged, 0.7 * width / step), main)
    low, high = reached_borders(t, contoured, seen, width)
    before = contoured & (t < first_on(t, main)[..., None]) & (low & ~high)[..., None]
    after = contoured & (t > last_on(t, main)[..., None]) & (high & ~low)[..., None]
    return before | after, (low, high)


def ways(t: Float[Tensor, " s"], on: Bool[Tensor, "b k s"], seen: Bool[Tensor, "b k s"]) -> Bool[Tensor, "b k 2 s"]:
    """Stations between the shaft and the low border, and between it and the high one."""
    low, high = (at(t, on)[..., None] for at in (first_on, last_on))
    return torch.stack([seen & (t < low), seen & (t > high)], 2)


def through_the_dark(
    way: Bool[Tensor, "b k 2 s"],
    closed: Bool[Tensor, "b k 2"],
    on: Bool[Tensor, "b k s"],
    borders: tuple[Bool[Tensor, "b k"], Bool[Tensor, "b k"]],
) -> tuple[Bool[Tensor, "b k"], Bool[Tensor, "b k"]]:
    """Whether the shaft reaches the low, the high border, also where its contours are lost before a dark background.

    Where neither border is reached by contours, it is one from which nothing brighter closes the shaft. Two such
    borders, or a way that is longer than what is seen of the shaft, tell nothing.
    """
    short = way.sum(-1) < on.sum(-1, keepdim=True)
    low, high = (~closed & short & ~(borders[0] | borders[1])[..., None]).unbind(-1)
    return borders[0] | (low & ~high), borders[1] | (high & ~low)
