"""Rigid transforms: algebra, the frames they refuse to join, and what they accept from files."""

import json
import math

import pytest
import torch
from torch import Tensor

from rmis_calib import geometry as g
from rmis_calib.errors import FrameMismatchError, InputError, ShapeError

QUARTER_TURN_Z = [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]


def matrices(quats: Tensor, seed: int) -> Tensor:
    t = 100 * torch.randn(*quats.shape[:-1], 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return g.rigid_from_rotation_translation(g.quat_to_matrix(quats), t)


@pytest.fixture
def three_transforms(three_quats: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    return tuple(matrices(q, seed) for seed, q in enumerate(three_quats))


# 1e-11 mm: a few roundings of translations of some hundred mm.
def assert_close(a: Tensor, b: Tensor) -> None:
    torch.testing.assert_close(a, b, rtol=0, atol=1e-11)


class TestGroupAxioms:
    def test_inverse(self, three_transforms: tuple[Tensor, Tensor, Tensor]) -> None:
        a_T_b, _, _ = three_transforms
        eye = torch.eye(4, dtype=torch.float64).expand_as(a_T_b)
        assert_close(a_T_b @ g.rigid_inverse(a_T_b), eye)
        assert_close(g.rigid_inverse(a_T_b) @ a_T_b, eye)
        assert_close(g.rigid_inverse(g.rigid_inverse(a_T_b)), a_T_b)
        assert_close(g.rigid_inverse(a_T_b), torch.linalg.inv(a_T_b))

    def test_inverse_of_a_product(self, three_transforms: tuple[Tensor, Tensor, Tensor]) -> None:
        a_T_b, b_T_c, _ = three_transforms
        assert_close(g.rigid_inverse(a_T_b @ b_T_c), g.rigid_inverse(b_T_c) @ g.rigid_inverse(a_T_b))

    def test_points_follow_the_product(self, three_transforms: tuple[Tensor, Tensor, Tensor]) -> None:
        a_T_b, b_T_c, c_T_d = three_transforms
        d_p_x = torch.tensor([1.0, -20.0, 300.0], dtype=torch.float64)
        c_p_x = g.transform_points(c_T_d, d_p_x)
        a_p_x = g.transform_points(a_T_b, g.transform_points(b_T_c, c_p_x))
        assert_close(a_p_x, g.transform_points(a_T_b @ b_T_c @ c_T_d, d_p_x))

    def test_differences_of_points_rotate(self, three_transforms: tuple[Tensor, Tensor, Tensor]) -> None:
        a_T_b, _, _ = three_transforms
        p, q = torch.randn(2, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        difference = g.transform_points(a_T_b, p) - g.transform_points(a_T_b, q)
        assert_close(difference, g.rotate_vectors(a_T_b, p - q))


def test_convention_last_column_is_the_origin_of_src() -> None:
    a_T_b = torch.tensor(QUARTER_TURN_Z, dtype=torch.float64)
    b_p_x = torch.tensor([10.0, 0.0, 0.0], dtype=torch.float64)
    assert g.transform_points(a_T_b, torch.zeros(3, dtype=torch.float64)).tolist() == [1.0, 2.0, 3.0]
    # x turns to y: (1, 2 + 10, 3). Counter-literal: read as b_T_a it would be (-2, -9, -3) = R^T (x - t).
    assert g.transform_points(a_T_b, b_p_x).tolist() == [1.0, 12.0, 3.0]
    assert g.transform_points(g.rigid_inverse(a_T_b), b_p_x).tolist() == [-2.0, -9.0, -3.0]


def test_convention_rigid_exp_does_not_turn_its_translation() -> None:
    xi = torch.tensor([0.0, 0.0, math.pi / 2, 1.0, 0.0, 0.0], dtype=torch.float64)
    assert g.rigid_exp(xi)[:3, 3].tolist() == [1.0, 0.0, 0.0]
    # Counter-literal: the exponential of SE(3) gives (sin(a)/a, (1 - cos(a))/a, 0) = (0.6366, 0.6366, 0).
    assert_close(g.rigid_exp(xi)[:3, :3], g.rotvec_to_matrix(xi[:3]))


def test_rigid_exp_gradient_at_zero() -> None:
    assert torch.autograd.gradcheck(g.rigid_exp, (torch.zeros(6, dtype=torch.float64, requires_grad=True),))


def test_batches_broadcast() -> None:
    R = g.quat_to_matrix(g.random_quat((5, 1)))
    t = torch.zeros(7, 3, dtype=torch.float64)
    a_T_b = g.rigid_from_rotation_translation(R, t)
    assert a_T_b.shape == (5, 7, 4, 4)
    assert g.transform_points(a_T_b, torch.zeros(3, dtype=torch.float64)).shape == (5, 7, 3)


class TestRigidTransform:
    def make(self, dst: str = "a", src: str = "b") -> g.RigidTransform:
        return g.RigidTransform(dst, src, torch.tensor(QUARTER_TURN_Z, dtype=torch.float64))

    def test_parts(self) -> None:
        a_T_b = self.make()
        assert a_T_b.name == "a_T_b"
        assert a_T_b.t.tolist() == [1.0, 2.0, 3.0]
        assert a_T_b.R[0].tolist() == [0.0, -1.0, 0.0]
        half = math.sqrt(0.5)
        assert_close(a_T_b.quat_wxyz, torch.tensor([half, 0.0, 0.0, half], dtype=torch.float64))
        assert a_T_b.apply(torch.zeros(3, dtype=torch.float64)).tolist() == [1.0, 2.0, 3.0]
        assert a_T_b.rotate(torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)).tolist() == [0.0, 1.0, 0.0]

    def test_joins_what_meets(self) -> None:
        a_T_c = self.make("a", "b") @ self.make("b", "c")
        assert (a_T_c.dst, a_T_c.src) == ("a", "c")
        identity = self.make() @ self.make().inverse()
        assert identity.name == "a_T_a"
        assert_close(identity.matrix, torch.eye(4, dtype=torch.float64))

    def test_refuses_what_does_not_meet(self) -> None:
        with pytest.raises(FrameMismatchError, match=r"a_T_b @ c_T_d: expected a transform into 'b', found 'c'"):
            self.make("a", "b") @ self.make("c", "d")
        with pytest.raises(FrameMismatchError):
            self.make() @ self.make()

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda m: m[:3], "shape"),
            (lambda m: m.long(), "floating-point"),
            (lambda m: m.index_put((torch.tensor(0), torch.tensor(3)), torch.tensor(math.nan).double()), "finite"),
            (lambda m: m * torch.tensor([[1.001], [1.0], [1.0], [1.0]]).double(), "orthonormal"),
            (lambda m: m * torch.tensor([1.0, 1.0, -1.0, 1.0]).double(), "reflection"),
            (lambda m: m.mT, "last row"),
        ],
    )
    def test_refuses_what_is_no_rigid_transform(self, change, message: str) -> None:
        with pytest.raises((InputError, ShapeError), match=message):
            g.RigidTransform("a", "b", change(torch.tensor(QUARTER_TURN_Z, dtype=torch.float64)))

    def test_refuses_a_row_convention_matrix(self) -> None:
        row_vector_style = torch.eye(4, dtype=torch.float64)
        row_vector_style[3, :3] = torch.tensor([1.0, 2.0, 3.0])
        with pytest.raises(InputError, match="last row"):
            g.RigidTransform("a", "b", row_vector_style)

    def test_accepts_single_precision_and_batches(self) -> None:
        matrix = matrices(g.random_quat((50,)), 0).float()
        assert g.RigidTransform("a", "b", matrix).inverse().matrix.dtype == torch.float32
        assert g.RigidTransform("a", "b", matrix).to(torch.float64).matrix.dtype == torch.float64

    def test_files_round_trip(self) -> None:
        a_T_b = g.RigidTransform("camera_right", "arm", matrices(g.random_quat(()), 3))
        values = json.loads(json.dumps(a_T_b.to_dict()))
        assert set(values) == {"dst", "src", "matrix", "quat_wxyz", "translation_mm"}
        back = g.RigidTransform.from_dict(values)
        assert back.name == "camera_right_T_arm"
        assert torch.equal(back.matrix, a_T_b.matrix)
        del values["quat_wxyz"], values["translation_mm"]
        assert torch.equal(g.RigidTransform.from_dict(values).matrix, a_T_b.matrix)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"translation_mm": [1.0, 2.0, 3.1]}, "translation_mm"),
            ({"quat_wxyz": [0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)]}, "quat_wxyz"),
            ({"quat_wxyz": [1.0, 0.0, 0.0]}, "quat_wxyz"),
            ({"matrix": [["x"]]}, "numbers"),
            ({"matrix": [[1.0, 2.0], [3.0]]}, "numbers"),
            ({"units": "m"}, "units"),
        ],
    )
    def test_files_that_contradict_themselves(self, change: dict, message: str) -> None:
        with pytest.raises(InputError, match=message):
            g.RigidTransform.from_dict({**self.make().to_dict(), **change})

    def test_files_that_lack_a_frame(self) -> None:
        values = self.make().to_dict()
        del values["src"]
        with pytest.raises(InputError, match="dst, src, matrix"):
            g.RigidTransform.from_dict(values)
