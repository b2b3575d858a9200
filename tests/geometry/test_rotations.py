"""Rotations against SciPy, group axioms, and values and gradients at the awkward angles."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from rmis_calib import geometry as g

# Angles where closed forms divide by zero, lose digits, or where the code changes from series to closed form (1e-4
# rad).
AWKWARD = [0.0, 1e-12, 1e-9, 0.99e-4, 1.01e-4, 1e-3, 1.0, math.pi / 2, 3.0, math.pi - 1e-4, math.pi - 1e-9, math.pi]
AXES = torch.nn.functional.normalize(
    torch.tensor(
        [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [1, 1, 0], [0, -1, 1], [1, 1, 1], [0.3, -2.0, 0.7]],
        dtype=torch.float64,
    ),
    dim=-1,
)


def scipy_matrix(rotvec: Tensor) -> Tensor:
    flat = Rotation.from_rotvec(rotvec.reshape(-1, 3).numpy()).as_matrix()
    return torch.from_numpy(flat).reshape(*rotvec.shape[:-1], 3, 3)


def awkward_rotvecs() -> Tensor:
    return torch.tensor(AWKWARD, dtype=torch.float64)[:, None, None] * AXES  # (angles, axes, 3)


def assert_same_rotation(a: Tensor, b: Tensor, atol: float = 1e-14) -> None:
    torch.testing.assert_close(a, b, rtol=0, atol=atol)


def test_skew_is_the_cross_product(generator: torch.Generator) -> None:
    a, b = torch.randn(2, 5, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close((g.skew(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))


def test_every_route_to_a_matrix_agrees_with_scipy() -> None:
    rotvec = awkward_rotvecs()
    expected = scipy_matrix(rotvec)
    assert_same_rotation(g.rotvec_to_matrix(rotvec), expected)
    assert_same_rotation(g.quat_to_matrix(g.rotvec_to_quat(rotvec)), expected)


def test_quaternions_agree_with_scipy_in_wxyz_order() -> None:
    rotvec = awkward_rotvecs()
    xyzw = Rotation.from_rotvec(rotvec.reshape(-1, 3).numpy()).as_quat()
    wxyz = torch.from_numpy(np.roll(xyzw, 1, axis=-1)).reshape(*rotvec.shape[:-1], 4)
    for quat in (g.rotvec_to_quat(rotvec), g.matrix_to_quat(scipy_matrix(rotvec))):
        # q and -q are one rotation. 1e-15: a few roundings.
        assert float((1 - (quat * wxyz).sum(-1).abs()).abs().max()) < 2e-15


def test_rotation_vectors_come_back_near_zero_and_near_pi() -> None:
    rotvec = awkward_rotvecs()
    for back in (g.matrix_to_rotvec(g.rotvec_to_matrix(rotvec)), g.quat_to_rotvec(g.rotvec_to_quat(rotvec))):
        # At pi both signs of the axis are right.
        at_pi = torch.tensor(AWKWARD, dtype=torch.float64) > math.pi - 1e-15
        error = (back - rotvec).norm(dim=-1)
        flipped = (back + rotvec).norm(dim=-1)
        error = torch.where(at_pi[:, None], torch.minimum(error, flipped), error)
        assert float(error.max()) < 1e-14


def test_small_angles_keep_their_relative_accuracy() -> None:
    rotvec = 1e-12 * AXES
    for back in (g.matrix_to_rotvec(g.rotvec_to_matrix(rotvec)), g.quat_to_rotvec(g.rotvec_to_quat(rotvec))):
        assert float((back - rotvec).norm(dim=-1).max()) < 1e-26  # relative 1e-14


def test_rotation_angle_is_accurate_near_both_ends() -> None:
    rotvec = awkward_rotvecs()
    angle = g.rotation_angle(g.rotvec_to_matrix(rotvec))
    expected = torch.tensor(AWKWARD, dtype=torch.float64)[:, None].expand_as(angle)
    # 1e-15 absolute at pi; near zero relative: an arc cosine of the trace would give 0 for every angle below 1e-8.
    assert float((angle - expected).abs().max()) < 2e-15
    torch.testing.assert_close(angle[1:4], expected[1:4], rtol=1e-12, atol=0)


def test_matrix_to_quat_has_a_non_negative_real_part(generator: torch.Generator) -> None:
    quat = g.matrix_to_quat(g.quat_to_matrix(g.random_quat((1000,), generator)))
    assert bool((quat[:, 0] >= 0).all())
    torch.testing.assert_close(quat.norm(dim=-1), torch.ones(1000, dtype=torch.float64))


def test_convention_quaternions_are_wxyz() -> None:
    half = math.sqrt(0.5)
    # A quarter turn about z takes x to y.
    R = g.quat_to_matrix(torch.tensor([half, 0.0, 0.0, half], dtype=torch.float64))
    torch.testing.assert_close(R[:, 0], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    # Counter-literal: read as (x, y, z, w) the same numbers are a quarter turn about x, which leaves x where it is.
    assert not torch.allclose(R[:, 0], torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))


def test_convention_quat_multiply_is_the_hamilton_product() -> None:
    i, j, k = torch.eye(4, dtype=torch.float64)[1:]
    torch.testing.assert_close(g.quat_multiply(i, j), k)
    # Counter-literal: the JPL product would give -k.
    torch.testing.assert_close(g.quat_multiply(j, i), -k)


def test_convention_rotations_are_active_and_right_handed() -> None:
    R = g.rotvec_to_matrix(torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64))
    x = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(R @ x, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), atol=1e-15, rtol=0)
    # Counter-literal: a passive or left-handed rotation would give (0, -1, 0).


class TestGroupAxioms:
    def test_identity(self, three_quats: tuple[Tensor, Tensor, Tensor]) -> None:
        q, _, _ = three_quats
        one = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
        torch.testing.assert_close(g.quat_multiply(q, one), q)
        torch.testing.assert_close(g.quat_multiply(one, q), q)

    def test_inverse(self, three_quats: tuple[Tensor, Tensor, Tensor]) -> None:
        q, _, _ = three_quats
        product = g.quat_to_matrix(g.quat_multiply(q, g.quat_conjugate(q)))
        assert_same_rotation(product, torch.eye(3, dtype=torch.float64).expand_as(product))
        assert_same_rotation(g.quat_to_matrix(g.quat_conjugate(q)), g.quat_to_matrix(q).mT)

    def test_associativity(self, three_quats: tuple[Tensor, Tensor, Tensor]) -> None:
        a, b, c = three_quats
        left = g.quat_multiply(g.quat_multiply(a, b), c)
        torch.testing.assert_close(left, g.quat_multiply(a, g.quat_multiply(b, c)))

    def test_closure(self, three_quats: tuple[Tensor, Tensor, Tensor]) -> None:
        a, b, _ = three_quats
        R = g.quat_to_matrix(g.quat_multiply(a, b))
        assert_same_rotation(R @ R.mT, torch.eye(3, dtype=torch.float64).expand_as(R))
        torch.testing.assert_close(torch.linalg.det(R), torch.ones(R.shape[:-2], dtype=torch.float64))

    def test_product_of_quaternions_is_product_of_matrices(self, three_quats: tuple[Tensor, Tensor, Tensor]) -> None:
        a, b, _ = three_quats
        assert_same_rotation(g.quat_to_matrix(g.quat_multiply(a, b)), g.quat_to_matrix(a) @ g.quat_to_matrix(b))

    def test_round_trips(self, three_quats: tuple[Tensor, Tensor, Tensor]) -> None:
        q, _, _ = three_quats
        R = g.quat_to_matrix(q)
        assert_same_rotation(g.quat_to_matrix(g.matrix_to_quat(R)), R)
        assert_same_rotation(g.rotvec_to_matrix(g.matrix_to_rotvec(R)), R)
        assert_same_rotation(g.rotvec_to_matrix(g.quat_to_rotvec(q)), R)
        assert_same_rotation(g.quat_to_matrix(-q), R)

    def test_angle_of_inverse_is_the_same(self, three_quats: tuple[Tensor, Tensor, Tensor]) -> None:
        q, _, _ = three_quats
        R = g.quat_to_matrix(q)
        torch.testing.assert_close(g.rotation_angle(R), g.rotation_angle(R.mT))


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(-math.pi, math.pi), min_size=3, max_size=3))
def test_any_rotation_vector_agrees_with_scipy(entries: list[float]) -> None:
    rotvec = torch.tensor(entries, dtype=torch.float64)
    R = g.rotvec_to_matrix(rotvec)
    assert_same_rotation(R, scipy_matrix(rotvec))
    assert_same_rotation(g.rotvec_to_matrix(g.matrix_to_rotvec(R)), R)


def test_batched_equals_looped(three_quats: tuple[Tensor, Tensor, Tensor]) -> None:
    q, _, _ = three_quats
    for function in (g.quat_to_matrix, g.quat_to_rotvec):
        looped = torch.stack([function(one) for one in q.reshape(-1, 4)])
        torch.testing.assert_close(function(q).reshape(looped.shape), looped)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_follows_the_input(dtype: torch.dtype) -> None:
    rotvec = AXES.to(dtype)
    R = g.rotvec_to_matrix(rotvec)
    quat = g.rotvec_to_quat(rotvec)
    results = [R, quat, g.quat_to_matrix(quat), g.matrix_to_quat(R), g.matrix_to_rotvec(R), g.rotation_angle(R)]
    assert {result.dtype for result in [*results, g.project_to_so3(R), g.chordal_mean(R)]} == {dtype}


# --- gradients: https://github.com/pytorch/pytorch/issues/6394 is the trap (a NaN in the branch not taken by `where`)
# ---

TO_CHECK = {
    "rotvec_to_matrix": (g.rotvec_to_matrix, lambda rotvec: rotvec),
    "rotvec_to_quat": (g.rotvec_to_quat, lambda rotvec: rotvec),
    "quat_to_matrix": (g.quat_to_matrix, g.rotvec_to_quat),
    "quat_to_rotvec": (g.quat_to_rotvec, g.rotvec_to_quat),
    "matrix_to_quat": (g.matrix_to_quat, g.rotvec_to_matrix),
    "matrix_to_rotvec": (g.matrix_to_rotvec, g.rotvec_to_matrix),
    "project_to_so3": (g.project_to_so3, g.rotvec_to_matrix),
}


@pytest.mark.parametrize("name", TO_CHECK)
def test_gradcheck_away_from_the_switches(name: str, generator: torch.Generator) -> None:
    function, argument = TO_CHECK[name]
    rotvec = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    assert gradcheck(function, (argument(rotvec).detach().requires_grad_(),))


@pytest.mark.parametrize("name", TO_CHECK)
@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.5e-4])
def test_gradcheck_near_the_identity(name: str, angle: float) -> None:
    function, argument = TO_CHECK[name]
    assert gradcheck(function, (argument(angle * AXES).detach().requires_grad_(),), eps=1e-7, atol=1e-6)


@pytest.mark.parametrize("name", ["rotvec_to_matrix", "rotvec_to_quat", "quat_to_matrix"])
def test_second_derivatives(name: str, generator: torch.Generator) -> None:
    function, argument = TO_CHECK[name]
    rotvec = torch.cat(
        [torch.zeros(1, 3, dtype=torch.float64), torch.randn(2, 3, generator=generator, dtype=torch.float64)]
    )
    assert gradgradcheck(function, (argument(rotvec).detach().requires_grad_(),), atol=1e-4)


@pytest.mark.parametrize("name", TO_CHECK)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_and_gradients_are_finite_everywhere(name: str, dtype: torch.dtype) -> None:
    function, argument = TO_CHECK[name]
    point = argument(awkward_rotvecs().to(dtype)).detach().requires_grad_()
    value = function(point)
    (gradient,) = torch.autograd.grad(value.sum(), point)
    assert bool(torch.isfinite(value).all()) and bool(torch.isfinite(gradient).all())


def test_rotation_angle_has_a_finite_gradient_everywhere() -> None:
    R = g.rotvec_to_matrix(awkward_rotvecs()).detach().requires_grad_()
    (gradient,) = torch.autograd.grad(g.rotation_angle(R).sum(), R)
    assert bool(torch.isfinite(gradient).all())
    identity = torch.eye(3, dtype=torch.float64, requires_grad=True)
    (at_kink,) = torch.autograd.grad(g.rotation_angle(identity), identity)
    assert bool((at_kink == 0).all())


def test_gradient_along_the_group_at_pi() -> None:
    # d/ds of the angle of R exp(s axis) is 1 just below pi, whichever branch the quaternion comes from.
    s = torch.zeros(len(AXES), 1, dtype=torch.float64, requires_grad=True)
    R = g.rotvec_to_matrix((math.pi - 1e-6) * AXES) @ g.rotvec_to_matrix(s * AXES)
    (slope,) = torch.autograd.grad(g.rotation_angle(R).sum(), s)
    torch.testing.assert_close(slope, torch.ones_like(slope), atol=1e-9, rtol=0)


# --- projection and mean ---


def test_project_to_so3_is_nearest(generator: torch.Generator) -> None:
    M = torch.randn(50, 3, 3, generator=generator, dtype=torch.float64)  # half of them have a negative determinant
    R = g.project_to_so3(M)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(50, dtype=torch.float64))
    distance = (R - M).flatten(1).norm(dim=1)
    others = g.rotvec_to_matrix(0.05 * torch.randn(200, 1, 3, generator=generator, dtype=torch.float64)) @ R
    assert bool(((others - M).flatten(2).norm(dim=2) > distance).all())


def test_project_to_so3_gradient_with_a_reflection(generator: torch.Generator) -> None:
    M = torch.randn(20, 3, 3, generator=generator, dtype=torch.float64)
    assert bool((torch.linalg.det(M) < 0).any())
    assert gradcheck(g.project_to_so3, (M.requires_grad_(),))


def test_project_to_so3_stays_finite_where_the_rotation_is_not_unique() -> None:
    for M in (torch.zeros(3, 3), torch.diag(torch.tensor([1.0, 0.0, 0.0])), torch.diag(torch.tensor([1.0, 1.0, -1.0]))):
        point = M.double().requires_grad_()
        R = g.project_to_so3(point)
        (gradient,) = torch.autograd.grad((R * torch.arange(9.0).reshape(3, 3)).sum(), point)
        assert bool(torch.isfinite(R).all()) and bool(torch.isfinite(gradient).all())
        torch.testing.assert_close(torch.linalg.det(R.detach()), torch.tensor(1.0, dtype=torch.float64))


def test_chordal_mean_of_a_symmetric_spread_is_its_centre(generator: torch.Generator) -> None:
    centre = g.quat_to_matrix(g.random_quat((4,), generator))
    spread = 0.3 * torch.randn(5, 3, generator=generator, dtype=torch.float64)
    R = centre[:, None] @ g.rotvec_to_matrix(torch.cat([spread, -spread]))  # (4, 10, 3, 3)
    torch.testing.assert_close(g.chordal_mean(R), centre)


def test_chordal_mean_weights(generator: torch.Generator) -> None:
    R = g.quat_to_matrix(g.random_quat((2, 3), generator))
    torch.testing.assert_close(g.chordal_mean(R, torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64)), R[:, 1])
    # A weight of 2 is the same as counting twice.
    doubled = torch.cat([R, R[:, :1]], dim=1)
    torch.testing.assert_close(
        g.chordal_mean(R, torch.tensor([2.0, 1.0, 1.0], dtype=torch.float64)), g.chordal_mean(doubled)
    )


def test_random_quats_are_uniform_and_reproducible() -> None:
    first = g.random_quat((20000,), torch.Generator().manual_seed(3))
    torch.testing.assert_close(first, g.random_quat((20000,), torch.Generator().manual_seed(3)))
    # Mean angle of a uniform rotation is pi/2 + 2/pi = 126.5 degrees (std 37); 20000 samples: 0.26 degrees.
    mean = math.degrees(float(g.rotation_angle(g.quat_to_matrix(first)).mean()))
    assert abs(mean - math.degrees(math.pi / 2 + 2 / math.pi)) < 1.0
