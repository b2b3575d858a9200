"""Calls into the package are checked against their signatures in every test, also where a like call has passed."""

from dataclasses import dataclass

import pytest
import torch
from beartype import beartype
from jaxtyping import Float, TypeCheckError
from shape_checks import once_a_shape
from torch import Tensor

from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.geometry.rotations import rotvec_to_matrix


def test_a_wrong_argument_is_refused_before_and_after_a_right_one() -> None:
    for _ in range(2):
        for wrong in (torch.zeros(2, 4), torch.zeros(2, 3, dtype=torch.int64)):
            with pytest.raises(TypeCheckError, match="rotvec"):
                rotvec_to_matrix(wrong)
        assert rotvec_to_matrix(torch.zeros(2, 3)).shape == (2, 3, 3)


def test_a_wrong_field_is_refused_before_and_after_a_right_one() -> None:
    for _ in range(2):
        with pytest.raises(TypeCheckError):
            RigidTransform("camera_right", 3, torch.eye(4))
        assert RigidTransform("camera_right", "arm", torch.eye(4)).src == "arm"


def test_classes_with_equal_names_of_fields_are_told_apart() -> None:
    @once_a_shape(typechecker=beartype)
    @dataclass(frozen=True)
    class Two:
        x: Float[Tensor, "2"]

    @once_a_shape(typechecker=beartype)
    @dataclass(frozen=True)
    class Three:
        x: Float[Tensor, "3"]

    for _ in range(2):
        assert Two(torch.zeros(2)).x.shape == (2,) and Three(x=torch.zeros(3)).x.shape == (3,)
        for wrong, size in ((Two, 3), (Three, 2)):
            with pytest.raises(TypeCheckError, match="x"):
                wrong(torch.zeros(size))


def test_a_wrong_answer_to_arguments_that_have_passed_is_refused() -> None:
    answer = torch.zeros(4)

    @once_a_shape(typechecker=beartype)
    def given(x: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        return answer

    x = torch.zeros(4)
    assert given(x).shape == given(x).shape == (4,)
    for length in (5, 4, 5):
        answer = torch.zeros(length)
        if length == 4:
            assert given(x) is answer
        else:
            with pytest.raises(TypeCheckError, match="return value"):
                given(x)


def test_collections_and_texts_count_with_what_is_in_them() -> None:
    @once_a_shape(typechecker=beartype)
    def stacked(parts: tuple[Float[Tensor, "3"], ...], by: type = int) -> int:
        return len(parts)

    assert stacked((torch.zeros(3),)) == 1
    with pytest.raises(TypeCheckError, match="parts"):
        stacked((torch.zeros(2),))
    with pytest.raises(TypeCheckError, match="by"):
        stacked((torch.zeros(3),), by="int")
