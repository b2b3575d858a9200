"""Ends of the shaft that are not measured at one and the same place of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from mixed_ends import GAP_MM, with_ends

from rmis_calib.geometry.rotations import matrix_to_rotvec
from rmis_calib.solver import Problem, SolverSettings, solve
from rmis_calib.solver.estimate.end_places import shortest_half
from rmis_calib.solver.settings import UnknownSettings
from tests.benchmarks.bench_solver_nuisance import record

TRIALS, MOTIONS = 8, 48
CHI_3_SIGMA_2 = 20.1
"""Square of the 3-sigma bound of 6 unknowns."""


@pytest.fixture(scope="module")
def scene(realistic, unknown_noise):
    """`scene(tip, anywhere, **more)`: problem of unknown noise, truth, and which ends are the tip (b, c, n)."""

    def build(tip, anywhere, trials=TRIALS, laparoscope=1, kinds=None, **more):
        arrays = with_ends(
            tip, anywhere, seed=5, trials=trials, motion="random", positions_laparoscope=laparoscope,
            random_motions=MOTIONS, **realistic, **more,
        )  # fmt: skip
        truth = torch.as_tensor(arrays.pop("truth")["camera_right_T_arm"])
        is_tip = torch.stack([torch.as_tensor(arrays.pop(f"is_tip_{side}")) for side in ("right", "left")], 1)
        problem = Problem.from_arrays(arrays).only("contours", "ends")
        if kinds is not None:
            kind, sureness = kinds(is_tip)
            problem = replace(problem, end_kind=kind.double(), end_sureness=sureness.double())
        return unknown_noise(problem), truth, is_tip & problem.end_measured

    return build


def squared_sigmas(solution, truth):
    found = solution.camera_right_T_arm
    turn = matrix_to_rotvec(truth[:, :3, :3] @ found[:, :3, :3].mT)
    off = torch.cat((turn, truth[:, :3, 3] - found[:, :3, 3]), -1)
    return (off * torch.linalg.solve(solution.covariance, off[..., None])[..., 0]).sum(-1)


@pytest.mark.parametrize(("tip", "laparoscope"), [(0.3, 1), (0.5, 1), (0.3, 2)])
def test_ends_at_two_places_are_both_used(scene, tip, laparoscope):
    problem, truth, is_tip = scene(tip, 0.0, laparoscope=laparoscope)
    clean = solve(scene(0.0, 0.0, laparoscope=laparoscope)[0])
    mixed = solve(problem)
    assert bool(mixed.converged.all()) and bool((squared_sigmas(mixed, truth) < CHI_3_SIGMA_2).all())
    gap = mixed.nuisances["end_gap"]
    first_is_tip = gap.value[:, 0] < 0
    assert bool(((gap.value[:, 0].abs() - GAP_MM).abs() < 4.0 * gap.sigma[:, 0]).all())
    tips = is_tip.sum((1, 2))
    others = problem.end_measured.sum((1, 2)) - tips
    assert mixed.ends[:, 0, 0].tolist() == torch.where(first_is_tip, tips, others).tolist()
    assert mixed.ends[:, 0, 1].tolist() == torch.where(first_is_tip, others, tips).tolist()
    assert mixed.ends_elsewhere.tolist() == [0] * TRIALS
    assert bool(mixed.translation_sigma_mm.median() < 1.03 * clean.translation_sigma_mm.median())
    assert clean.ends_elsewhere.tolist() == [0] * TRIALS and "end_gap" not in clean.nuisances


@pytest.mark.parametrize("noise_is_told", [False, True])
def test_ends_that_are_nowhere_in_particular_are_left_out(scene, realistic, noise_is_told):
    problem, truth, _ = scene(0.25, 0.2)
    plain, _, _ = scene(0.0, 0.0)
    if noise_is_told:
        levels = replace(
            problem.noise, image=problem.noise.image.nan_to_num(realistic["pixel_noise_px"] / 800.0),
            kinematics_mm=problem.noise.kinematics_mm.nan_to_num(0.3),
            kinematics_rad=problem.noise.kinematics_rad.nan_to_num(0.1 * torch.pi / 180.0),
        )  # fmt: skip
        problem, plain = replace(problem, noise=levels), replace(plain, noise=levels)
    mixed, clean = solve(problem), solve(plain)
    assert bool(mixed.converged.all()) and bool((squared_sigmas(mixed, truth) < CHI_3_SIGMA_2).all())
    assert bool(
        ((mixed.nuisances["end_gap"].value.abs() - GAP_MM).abs() < 4.0 * mixed.nuisances["end_gap"].sigma).all()
    )
    share = mixed.ends_elsewhere / problem.end_measured.sum((1, 2))
    assert 0.15 < float(share.mean()) < 0.3  # of 0.2, and of good ones in the other camera few
    assert bool(mixed.translation_sigma_mm.median() < 1.12 * clean.translation_sigma_mm.median())


def test_a_wrong_kind_changes_nothing(scene):
    """All ends are the tube's, and the detector is sure that they are rings; then it calls them by chance."""

    def all_rings(is_tip):
        return torch.ones_like(is_tip), torch.full(is_tip.shape, 0.95)

    def by_chance(is_tip):
        generator = torch.Generator().manual_seed(1)
        return torch.rand(is_tip.shape, generator=generator) < 0.5, torch.full(is_tip.shape, 0.8)

    plain = solve(scene(0.0, 0.0)[0])
    for kinds in (all_rings, by_chance):
        problem, _, _ = scene(0.0, 0.0, kinds=kinds)
        wrong = solve(problem)
        torch.testing.assert_close(wrong.camera_right_T_arm, plain.camera_right_T_arm)
        assert int(wrong.ends[:, 2, 0].sum()) == int((problem.end_measured & (problem.end_kind == 1)).sum())
        assert "end_gap" not in wrong.nuisances


def test_kinds_are_counted_where_they_are(scene):
    """The detector calls all tips rings and a fifth of the tube's ends too: places follow from where they are."""

    def kinds(is_tip):
        generator = torch.Generator().manual_seed(2)
        return is_tip | (torch.rand(is_tip.shape, generator=generator) < 0.2), torch.full(is_tip.shape, 0.8)

    problem, truth, is_tip = scene(0.3, 0.0, trials=4, kinds=kinds)
    mixed = solve(problem)
    assert bool((squared_sigmas(mixed, truth) < CHI_3_SIGMA_2).all())
    ring = problem.end_measured & (problem.end_kind == 1)
    assert mixed.ends[:, 2].tolist() == [[int((ring & ~is_tip)[b].sum()), int(is_tip[b].sum()), 0] for b in range(4)]
    assert mixed.ends[:, 0].sum() == 0 and mixed.ends[:, 1, 1].sum() == 0


@pytest.mark.parametrize("tip", [0.3, 0.5])
def test_two_places_do_not_look_like_a_joint_offset(tip):
    recorded, truth = record(4, 100, 4)
    shorter, _ = record(4, 100, 4, wrist_mm=10.0 - GAP_MM)  # the same noise
    generator = np.random.default_rng(7)
    for side in ("right", "left"):
        is_tip = generator.random(recorded.arrays[f"valid_{side}"].shape) < tip
        recorded.arrays[f"end_{side}"][is_tip] = shorter.arrays[f"end_{side}"][is_tip]
    kinematics = lambda joints, clock: recorded.kinematics(joints, clock).only("contours", "ends")  # noqa: E731
    start = kinematics(torch.zeros(4, 6, dtype=torch.float64), torch.zeros(4, 2, dtype=torch.float64))
    unknowns = UnknownSettings(radius_sigma_relative=0.0, stereo=False, joint_offsets="always")
    mixed = solve(start, SolverSettings(unknowns=unknowns), kinematics=kinematics)
    assert bool((squared_sigmas(mixed, truth) < CHI_3_SIGMA_2).all())
    assert bool(((mixed.nuisances["end_gap"].value.abs() - GAP_MM).abs() < 0.3).all())
    offset = mixed.nuisances["joint_offset"]
    assert bool((offset.value.abs() < 4.0 * offset.sigma).all())


def test_ends_without_a_common_place_are_left_out_altogether(scene):
    problem, _, _ = scene(0.0, 1.0, trials=3)
    mixed, without = solve(problem), solve(problem.only("contours"))
    assert mixed.ends_elsewhere.tolist() == problem.end_measured.sum((1, 2)).tolist()
    away = torch.linalg.vector_norm((mixed.camera_right_T_arm - without.camera_right_T_arm)[:, :3, 3], dim=-1)
    assert bool((away < 0.05 * without.translation_sigma_mm).all())
    assert "end_offset" not in mixed.nuisances


def test_trials_do_not_depend_on_their_neighbours(scene):
    problem, _, _ = scene(0.3, 0.0, trials=2)
    plain, _, _ = scene(0.0, 0.0, trials=2)
    end_xy = torch.stack((problem.end_xy[0], plain.end_xy[1]))
    both = solve(replace(problem, end_xy=end_xy))
    alone = solve(plain.take_trials(slice(1, 2)))
    torch.testing.assert_close(both.camera_right_T_arm[1], alone.camera_right_T_arm[0], atol=1e-6, rtol=1e-6)
    assert float(both.nuisances["end_gap"].value[1]) == 0.0


def test_shortest_half_ignores_fewer_others():
    """Of 0..6 and five far ones more than half lie within 0..6: the shortest interval of seven is 0 to 6."""
    value = torch.tensor([[0.0, 1, 2, 3, 4, 5, 6, 100, 200, 300, 400, 500, 0, 0]], dtype=torch.float64)
    known = torch.tensor([[True] * 12 + [False] * 2])
    centre, sigma = shortest_half(value, known)
    assert float(centre) == pytest.approx(3.0)
    assert float(sigma) == pytest.approx(6.0 / 1.349)
    few = shortest_half(value, (torch.arange(14) < 3)[None])
    assert bool(torch.isnan(few[0]).all())
