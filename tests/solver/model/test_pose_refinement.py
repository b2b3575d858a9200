"""`rc.refine` and the public residuals: against closed forms, the solver's own rows, and the answer of `joint`."""

import pytest
import torch

import rmis_calib as rc
from rmis_calib.errors import InputError, ShapeError
from rmis_calib.geometry import matrix_to_quat, quat_to_matrix, random_quat, rotation_angle, rotvec_to_matrix
from rmis_calib.solver import Problem, SolverSettings, SolveStatus
from rmis_calib.solver.model.packing import pack
from rmis_calib.solver.model.parameters import NuisancePriors, initial_state
from rmis_calib.solver.model.residuals import residual_rows
from rmis_calib.solver.start.candidates import solve_translation
from rmis_calib.solver.start.line_statistics import LineStatistics, plane_normals
from rmis_calib.solver.start.paper import linear_rotation


def points(trials=3, count=12, seed=1):
    """Points before and after a known pose: (trials, count, 3) twice, quaternion, translation."""
    generator = torch.Generator().manual_seed(seed)
    q = random_quat((trials,), generator=generator)
    t = 10.0 * torch.randn(trials, 3, generator=generator, dtype=torch.float64)
    x = 20.0 * torch.randn(trials, count, 3, generator=generator, dtype=torch.float64)
    y = x @ quat_to_matrix(q).mT + t[:, None]
    return x, y, q, t


def alignment(x, y):
    return lambda q, t: (x @ quat_to_matrix(q).mT + t[..., None, :] - y).flatten(-2)


def test_points_are_aligned_as_the_closed_form_does():
    """Kabsch's closed form is the other code."""
    x, y, q, t = points()
    y = y + 0.5 * torch.randn(y.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    start = matrix_to_quat(rotvec_to_matrix(torch.full((3, 3), 0.4, dtype=torch.float64)) @ quat_to_matrix(q))
    found = rc.refine(alignment(x, y), start, torch.zeros_like(t))
    mean_x, mean_y = x.mean(1, keepdim=True), y.mean(1, keepdim=True)
    U, _, Vh = torch.linalg.svd((y - mean_y).mT @ (x - mean_x))
    U[:, :, 2] *= torch.linalg.det(U @ Vh)[:, None]
    R = U @ Vh
    assert bool(found.converged.all())
    torch.testing.assert_close(quat_to_matrix(found.quaternion), R, rtol=0, atol=1e-8)
    torch.testing.assert_close(found.translation, (mean_y - mean_x @ R.mT)[:, 0], rtol=0, atol=1e-7)
    torch.testing.assert_close(torch.linalg.vector_norm(found.quaternion, dim=-1), torch.ones(3, dtype=torch.float64))


def test_a_pose_does_not_depend_on_its_batch_mates():
    x, y, q, t = points()
    start = q + 0.1
    together = rc.refine(alignment(x, y), start, t + 3.0)
    for i in range(3):
        alone = rc.refine(alignment(x[i], y[i]), start[i], t[i] + 3.0)
        torch.testing.assert_close(alone.quaternion, together.quaternion[i], rtol=0, atol=1e-12)
        torch.testing.assert_close(alone.translation, together.translation[i], rtol=0, atol=1e-10)
        assert int(alone.iterations) == int(together.iterations[i])


@pytest.mark.parametrize("free", ["rotation", "translation"])
def test_what_is_held_stays(free):
    x, y, q, t = points()
    found = rc.refine(alignment(x, y), q, t + 1.0, free=free)
    assert torch.equal(found.translation, t + 1.0) == (free == "rotation")
    assert torch.allclose(found.quaternion, q, rtol=0, atol=1e-15) == (free == "translation")
    assert found.information.shape == (3, 3, 3)


@pytest.mark.parametrize("free", ["rotation", "translation", "both"])
def test_gradients_pass_through_the_minimum(free):
    """Against finite differences of the whole refinement, with residuals that do not vanish."""
    x, y, q, t = points(trials=2, count=5)
    generator = torch.Generator().manual_seed(3)
    y = y + 2.0 * torch.randn(y.shape, generator=generator, dtype=torch.float64)

    def answer(x, y, differentiable=True):
        found = rc.refine(alignment(x, y), q, t, free=free, tolerance=1e-12, differentiable=differentiable)
        return torch.cat((quat_to_matrix(found.quaternion).flatten(-2), found.translation), dim=-1)

    torch.testing.assert_close(answer(x, y), answer(x, y, False), rtol=0, atol=1e-7)
    weight = torch.randn((2, 12), generator=generator, dtype=torch.float64)
    x, y = x.requires_grad_(True), y.requires_grad_(True)
    gradients = torch.autograd.grad((weight * answer(x, y)).sum(), (x, y))
    for which, gradient in enumerate(gradients):
        direction = torch.randn(gradient.shape, generator=generator, dtype=torch.float64)
        ends = []
        for sign in (1e-4, -1e-4):
            moved = [x.detach(), y.detach()]
            moved[which] = moved[which] + sign * direction
            ends.append((weight * answer(*moved, False)).sum())
        expected = float(ends[0] - ends[1]) / 2e-4
        assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-4)


def test_every_ending_has_its_status():
    x, y, q, t = points()
    start = q + 0.3
    assert (rc.refine(alignment(x, y), start, t, max_iterations=1).status == SolveStatus.MAX_ITERATIONS).all()
    y[1, 0, 0] = torch.nan
    status = rc.refine(alignment(x, y), start, t).status.tolist()
    assert status == [SolveStatus.CONVERGED, SolveStatus.NON_FINITE, SolveStatus.CONVERGED]
    one = x[:, :1] * 0.0  # a single point at the pivot: no rotation shows
    assert (rc.refine(alignment(one, one), start, t).status == SolveStatus.SINGULAR).all()


def test_mistakes_are_named():
    _, _, q, t = points()
    with pytest.raises(ShapeError, match="residuals"):
        rc.refine(lambda q, t: (q * q)[..., 0, :], q, t)
    with pytest.raises(InputError, match="constants"):
        rc.refine(lambda q, t: torch.ones(*q.shape[:-1], 2), q, t)


def test_the_translation_of_the_paper_is_the_refined_one(simulate, realistic):
    """Eqs. 22 and 23 are linear: their solution in closed form and the optimiser must agree."""
    problem, _, _ = simulate(**realistic)
    problem = problem.only("axis").cameras(1)
    statistics = LineStatistics.from_problem(problem)
    R = linear_rotation(torch.linalg.eigh(statistics.rotation_gram.sum(1)).eigenvectors)
    expected, _ = solve_translation(statistics, R[:, None])
    n, _, ok = plane_normals(problem)
    n = torch.where(ok[..., None], n, 0.0)
    p = problem.arm_T_rcm[..., :3, 3]
    found = rc.refine(
        lambda q, t: rc.residuals.axis_translation(quat_to_matrix(q)[..., None, :, :], t[..., None, :], p, n[:, 0]),
        matrix_to_quat(R),
        torch.zeros_like(expected[:, 0]),
        free="translation",
    )
    torch.testing.assert_close(found.translation, expected[:, 0], rtol=0, atol=1e-6)


@pytest.fixture(scope="module")
def scene(simulate, realistic):
    problem, truth, _ = simulate(trials=1, **realistic)
    X = torch.as_tensor(truth["camera_right_T_arm"])
    problem = problem.cameras(1)
    state = initial_state(NuisancePriors.of(problem), X[:, :3, :3], X[:, :3, 3])
    return problem, X, residual_rows(pack(problem, SolverSettings().noise), state)[:, 0]


def public(problem: Problem, X: torch.Tensor) -> torch.Tensor:
    """The solver's rows from the public functions: contours (two edges, two points), end, head."""
    R, t = X[0, :3, :3], X[0, :3, 3]
    T = problem.arm_T_rcm[0]
    p, v = T[:, :3, 3], (T[:, :3, :3] @ problem.rcm_v_axis[0, ..., None])[..., 0]
    r = problem.radius_mm[0]
    rows = [
        rc.residuals.contour(R, t, p, v, r, problem.contour_xy[0, 0, :, edge, point], side)
        for edge, side in ((0, 1.0), (1, -1.0))
        for point in (0, 1)
    ]
    rows.append(rc.residuals.end(R, t, p, v, problem.rcm_s_end_mm[0], problem.end_xy[0, 0]))
    arm_p_head = p + (T[:, :3, :3] @ problem.rcm_p_head[0, ..., None])[..., 0]
    return torch.stack([*rows, *rc.residuals.head(R, t, arm_p_head, problem.head_xy[0, 0]).unbind(-1)])


def test_public_residuals_are_those_of_the_solver(scene):
    problem, X, rows = scene
    seen = problem.valid[0, 0]
    torch.testing.assert_close(public(problem, X)[:, seen], rows[:, seen], rtol=0, atol=1e-12)


def test_gradients_pass_through_every_public_residual(scene):
    problem, X, _ = scene
    few = problem.select_motions(slice(0, 2))
    assert torch.autograd.gradcheck(lambda T: public(few, T), X.clone().requires_grad_(True))


def test_contours_alone_give_the_transform(simulate):
    """One camera, contours of a known radius, no noise: what a user writes in a dozen lines."""
    problem, truth, _ = simulate(trials=1)
    X = torch.as_tensor(truth["camera_right_T_arm"])
    problem = problem.select_motions(problem.valid[0, 0])
    T, r = problem.arm_T_rcm, problem.radius_mm[:, None]
    p, v = T[..., :3, 3], (T[..., :3, :3] @ problem.rcm_v_axis[..., None])[..., 0]
    xy = problem.contour_xy[:, 0]

    def residual(q, t):
        R, t = quat_to_matrix(q)[..., None, :, :], t[..., None, :]
        return torch.cat(
            [
                rc.residuals.contour(R, t, p, v, r, xy[:, :, edge, point], side)
                for edge, side in ((0, 1.0), (1, -1.0))
                for point in (0, 1)
            ],
            dim=-1,
        )

    start = rotvec_to_matrix(torch.full((1, 3), 0.05, dtype=torch.float64)) @ X[:, :3, :3]
    found = rc.refine(residual, matrix_to_quat(start), X[:, :3, 3] + 5.0)
    gap = rotation_angle(quat_to_matrix(found.quaternion).mT @ X[:, :3, :3])
    assert bool(found.converged.all())
    assert float(gap) < 1e-7
    torch.testing.assert_close(found.translation, X[:, :3, 3], rtol=0, atol=1e-5)
