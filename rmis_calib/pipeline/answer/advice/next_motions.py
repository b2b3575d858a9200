"""Advice on the next motion, in words: the candidates that shrink the uncertainty most while the shaft stays in view.

The estimate that predicts all this is the present one.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.geometry.cameras import Camera
from rmis_calib.pipeline.answer.advice.candidates import Candidates, at_found_setup
from rmis_calib.pipeline.answer.advice.joint_candidates import joint_candidates, limits_in_words
from rmis_calib.pipeline.answer.result import used_motions
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.arms.kinematic_unknowns import KinematicUnknowns
from rmis_calib.pipeline.motions.observations import problem_of
from rmis_calib.solver import Problem, Solution, SolveStatus
from rmis_calib.solver.assess.next_motion import Advice, advise
from rmis_calib.solver.observability import NextMotion, Observability, Verdict

VIEW_MARGIN = 0.05
"""Part of the picture's width and height that is left free on every side: the estimate is not exact."""
_BORDER_SAMPLES = 33
_PREDICTS = (SolveStatus.CONVERGED, SolveStatus.SINGULAR, SolveStatus.MAX_ITERATIONS, SolveStatus.STALLED)
"""How a solve must have ended for its estimate to predict anything."""


def may_advise(solution: Solution, config: CalibrationConfig) -> bool:
    """Whether there is an estimate that predicts what a motion would tell, and advice is wanted."""
    predicts = solution.posterior is not None and SolveStatus(int(solution.status)) in _PREDICTS
    return predicts and config.solver.advice.motions > 0


def with_next_motions(run: CalibrationRun, config: CalibrationConfig) -> CalibrationRun:
    """The run with the motions in its result that would help most."""
    if run.observations is None or run.solution is None or not may_advise(run.solution, config):
        return run
    problem = at_found_setup(problem_of(run.observations, config).flatten_batch(), run.solution)
    used, _ = used_motions(run.solution)
    unknowns = KinematicUnknowns(run.recording, run.poses.frames, config.device)
    settings, seed = config.solver.advice, config.solver.seed
    candidates = joint_candidates(run.recording, unknowns, problem, run.solution, used, settings, seed=seed)
    stereo = run.recording.stereo
    cameras = [camera for camera in (stereo.right, stereo.left) if camera is not None][: problem.n_cameras]
    view = torch.stack([camera_view(camera) for camera in cameras]).to(config.device)
    limits = limits_in_words(settings)
    observability = with_advice(run.result.observability, run.solution, candidates, view, config, limits)
    return replace(run, result=replace(run.result, observability=observability))


def with_advice(
    observability: Observability,
    solution: Solution,
    candidates: Candidates,
    view: Float[Tensor, "c 4"],
    config: CalibrationConfig,
    where: str,
) -> Observability:
    """With `advice` (sentences) and `next_motions` (the same as values).

    Args:
        observability: of the result.
        solution: one trial of which `may_advise` is true.
        candidates: motions to choose from.
        view: field of view of each camera (`advise`).
        config: of the estimate.
        where: to what the candidates were limited, to end the advice with.
    """
    if solution.posterior is None:
        return observability
    point = solution.observability.working_point_mm[0]
    reported = solution.covariance.reshape(6, 6)
    advice = advise(candidates.problem, solution.posterior, point, view, config.solver, candidates.effort, reported)
    trusted = observability.verdict is Verdict.TRUSTWORTHY
    general = () if trusted else solution.observability.remedies()
    return replace(
        observability,
        advice=(*_sentences(solution, candidates, advice, where), *(f"In general: {words}." for words in general)),
        next_motions=tuple(_next_motion(candidates, advice, step) for step in range(len(advice.chosen))),
    )


def _sentences(solution: Solution, candidates: Candidates, advice: Advice, where: str) -> list[str]:
    if not len(advice.chosen):
        return [f"The present estimate predicts no motion {where} that would keep the shaft in view."]
    name = solution.observability.describe().directions[0].words
    sigma = [_mm(value) for value in advice.weakest_mm.tolist()]
    out = []
    for step, index in enumerate(advice.chosen.tolist()):
        what = candidates.words[index]
        if step == 0:
            out.append(
                f"First {what}. Predicted: the weakest direction, {name}, shrinks from {sigma[0]} to "
                f"{sigma[1]} (1 sigma at the working point)."
            )
        else:
            out.append(f"Then {what}: {sigma[step + 1]} in the weakest direction.")
    return [*out, f"These motions stay {where}, with the shaft in view as far as the present estimate can tell."]


def _mm(value: float) -> str:
    """Two digits, as in the report."""
    if value > 1e3:
        return "more than 1 m"
    return f"{value:.{max(1 - math.floor(math.log10(max(value, 1e-4))), 0)}f} mm"


def _next_motion(candidates: Candidates, advice: Advice, step: int) -> NextMotion:
    index = int(advice.chosen[step])
    joints = None
    if candidates.joints is not None:
        joints = dict(zip(candidates.columns, candidates.joints[index].tolist(), strict=True))
    return NextMotion(
        words=candidates.words[index],
        joints=joints,
        weakest_sigma_mm=float(advice.weakest_mm[step + 1]),
        working_point_sigma_mm=float(advice.point_mm[step + 1]),
    )


def camera_view(camera: Camera) -> Float[Tensor, "4"]:
    """Least x, least y, greatest x, greatest y of the upright rectangle inside of the undistorted picture, less a
    margin."""
    height, width = camera.image_size
    size = torch.tensor([width - 1.0, height - 1.0], dtype=torch.float64)
    part = torch.linspace(VIEW_MARGIN, 1.0 - VIEW_MARGIN, _BORDER_SAMPLES, dtype=torch.float64)
    least, greatest = [], []
    for axis in (0, 1):
        uv = (part[:, None] * size).repeat(2, 1, 1)  # (side, samples, 2): both sides across this axis
        uv[0, :, axis], uv[1, :, axis] = VIEW_MARGIN * size[axis], (1.0 - VIEW_MARGIN) * size[axis]
        xy, valid = camera.undistort_points(uv)
        least.append(torch.where(valid, xy[..., axis], -torch.inf)[0].amax())
        greatest.append(torch.where(valid, xy[..., axis], torch.inf)[1].amin())
    return torch.stack([*least, *greatest])


def seen_view(problem: Problem) -> Float[Tensor, "c 4"]:
    """The same of each camera, as far as measured points of lines, ends and heads reach; for observations without
    cameras."""
    kinds = (problem.axis_xy, problem.contour_xy, problem.end_xy, problem.head_xy)
    points = torch.cat([xy[0].flatten(1, -2) for xy in kinds], dim=1)  # (c, points, 2)
    known = torch.isfinite(points)
    least = torch.where(known, points, torch.inf).amin(1)
    return torch.cat((least, torch.where(known, points, -torch.inf).amax(1)), dim=-1)
