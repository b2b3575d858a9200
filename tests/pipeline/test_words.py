"""Codes of motions and frames in words."""

import pytest
import torch

from rmis_calib.pipeline.words import words_of
from rmis_calib.solver import MotionReason
from rmis_calib.vision import FrameReason


def test_each_motion_has_the_sentence_of_its_code() -> None:
    codes = torch.tensor([MotionReason.OUTLIER, MotionReason.USED, MotionReason.OUTLIER])
    words = ["does not fit the other motions", "used", "does not fit the other motions"]
    assert words_of(codes, [reason.sentence for reason in MotionReason]).tolist() == words


@pytest.mark.parametrize("kind", [MotionReason, FrameReason])
def test_members_are_found_by_their_codes(kind) -> None:
    assert [int(member) for member in kind] == list(range(len(kind)))
