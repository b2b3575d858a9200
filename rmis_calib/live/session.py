"""`rc.Session`: add a frame and joints, get the answer so far and the next useful motion.

Between solves of all motions each new one moves the estimate by one step of an information filter. A picture that shows
no shaft where the estimate puts it is looked at again there, as `calibrate` does; each solve of all motions starts from
what was found without that. A live answer is never `ok`: it counts nominal noise and encoders without offsets. `result`
solves everything and checks it.
"""

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from rmis_calib.config import CalibrationConfig
from rmis_calib.errors import InputError
from rmis_calib.geometry.cameras import StereoRig
from rmis_calib.geometry.rigid import RigidTransform, rigid_from_rotation_translation
from rmis_calib.io import Recording, load_recording
from rmis_calib.io.robot import load_robot
from rmis_calib.kinematics import RobotKinematics
from rmis_calib.live.answer import LiveAnswer
from rmis_calib.live.collected import Collected
from rmis_calib.pipeline.answer.advice.candidates import at_found_setup
from rmis_calib.pipeline.answer.advice.next_motions import with_next_motions
from rmis_calib.pipeline.answer.guided_look import expected_contours, look_along
from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.pipeline.arms.found_offsets import with_rcm_offset, with_setup
from rmis_calib.pipeline.arms.poses import MotionPoses, poses_of
from rmis_calib.pipeline.calibration import calibrate_views
from rmis_calib.pipeline.first_answer import first_answer, quick, without_false_candidates
from rmis_calib.pipeline.motions.association import consistent_choice, read_prior
from rmis_calib.pipeline.motions.observations import DIRECTION_UNKNOWN, assemble, problem_of
from rmis_calib.pipeline.pictures.detection import View, no_progress
from rmis_calib.results import CalibrationResult
from rmis_calib.robot import Robot
from rmis_calib.solver import Problem
from rmis_calib.solver.assess.information import inverse
from rmis_calib.solver.assess.observability import assess
from rmis_calib.solver.assess.update import add_motion
from rmis_calib.solver.observability import Verdict
from rmis_calib.solver.solution import Posterior
from rmis_calib.vision import FrameReason, ShaftDetector

SOLVE_AGAIN = 1.5
"""All motions are solved again when there are this many times more than at the last solve..."""
CONTRADICTIONS, CONTRADICTING = 3, 0.1
"""...or when this many frames in a row contradict the estimate, and this share of those used."""
TRY_AGAIN = 1.2
"""Without an estimate, there must be this many times more motions than at the last attempt."""
CANDIDATES = 128
"""Random motions among which the next one is chosen: a tenth of what a calibration tries."""


class Session:
    """A calibration that grows with every still pose.

    Args:
        robot: a description, or the name of a preset.
        stereo: the cameras; `StereoRig(right)` for one.
        laparoscope_arm: name of the arm that carries the camera; None where it stands still.
        instrument_arm: name of the instrument's arm.
        shaft_diameter_mm: of the shaft.
        config: as for `calibrate`.
        picture_memory_mb: room for pictures, to look at them again along later estimates; the oldest are forgotten.
    Raises:
        RobotError: the robot cannot carry these arms.
    """

    def __init__(
        self,
        robot: Robot | str,
        stereo: StereoRig,
        *,
        laparoscope_arm: str | None = "laparoscope",
        instrument_arm: str = "instrument",
        shaft_diameter_mm: float = 8.0,
        config: CalibrationConfig | None = None,
        picture_memory_mb: float = 1000.0,
    ) -> None:
        self._config = config or CalibrationConfig()
        described = load_robot(robot) if isinstance(robot, str) else robot
        self._kinematics = RobotKinematics(described, laparoscope_arm, instrument_arm, device=self._config.device)
        self._collected = Collected(
            described, stereo, laparoscope_arm, instrument_arm, shaft_diameter_mm, picture_memory_mb
        )
        self._detectors = {
            side: ShaftDetector(self._config.detector, camera.to(torch.float64, self._config.device))
            for side, camera in self._collected.cameras().items()
        }
        self._executor = ThreadPoolExecutor(len(self._detectors) + 1, thread_name_prefix="rmis-session")
        self._run: CalibrationRun | None = None
        self._posterior: Posterior | None = None
        self._problem: Problem | None = None
        self._advising: Future[tuple[str, ...]] | None = None
        self._advice: tuple[str, ...] = ()
        # Motions that show a shaft, and those used at the last solve of all; frames that contradict it, in a row.
        self._shown, self._tried, self._used, self._solved, self._contradictions = 0, 0, 0, 0, 0
        self._prior = read_prior(self._config)
        advice = replace(self._config.solver.advice, candidates=CANDIDATES)
        self._quick = quick(replace(self._config, solver=replace(self._config.solver, advice=advice)))

    @classmethod
    def like(cls, recording: Recording | str | Path, config: CalibrationConfig | None = None) -> "Session":
        """A session with the robot and the cameras of a recording, and none of its frames."""
        known = recording if isinstance(recording, Recording) else load_recording(recording)
        return cls(
            known.robot,
            known.stereo,
            laparoscope_arm=known.laparoscope_arm,
            instrument_arm=known.instrument_arm,
            shaft_diameter_mm=known.shaft_diameter_mm,
            config=config,
        )

    @property
    def columns(self) -> tuple[str, ...]:
        """Joints that every frame needs: `<arm>.<joint>_rad` or `_mm`."""
        return self._collected.columns

    def add(
        self,
        joints: Mapping[str, float],
        right: UInt8[Tensor, "3 h w"],
        left: UInt8[Tensor, "3 h w"] | None = None,
    ) -> LiveAnswer:
        """One frame of arms at rest.

        Args:
            joints: readings of `columns`, rad and mm.
            right, left: RGB pictures of the cameras.
        Raises:
            InputError: a joint is missing or unknown, or a picture of a camera is.
            ShapeError: a picture of another size than its camera's.
        """
        readings = self._collected.readings_of(joints)
        pictures = {"right": right} | ({} if left is None else {"left": left})
        if set(pictures) != set(self._detectors):
            expected = " and ".join(f"a {side} picture" for side in self._detectors)
            raise InputError(where="pictures", expected=expected, found=" and ".join(pictures))
        jobs = {side: self._executor.submit(self._detectors[side].detect, images[None].to(self._config.device))
                for side, images in pictures.items()}  # fmt: skip
        poses = self._poses(readings)
        found = {side: job.result() for side, job in jobs.items()}
        self._collected.add(readings, poses, found, pictures)
        return self._answer(self._take(poses))

    def advice(self) -> tuple[str, ...]:
        """The motions that would help most, in words; waits for them where they are being computed."""
        if self._advising is not None:
            self._advising.result()
        return self._known_advice()

    def result(self) -> CalibrationResult:
        """Everything so far solved with all checks, as `calibrate` does; takes seconds.

        A session has no log of motion: the clock is not estimated.
        """
        if not len(self._collected):
            raise InputError(where="session", expected="frames", found="none")
        recording, poses, views = self._collected.recording(), self._collected.poses(), self._collected.views()
        return calibrate_views(recording, self._config, poses, views, self._prior).result

    def _poses(self, readings: Float[np.ndarray, " j"]) -> MotionPoses:
        values = torch.as_tensor(readings, device=self._config.device)[None]
        split = len(self._kinematics.laparoscope_joints)
        number = np.array([len(self._collected)])
        return poses_of(self._kinematics, number, values[:, :split], values[:, split:])

    def _take(self, poses: MotionPoses) -> str:
        """Let the last frame move the estimate; why it does not, else nothing."""
        views, _ = without_false_candidates(self._collected.views(), self._collected.poses())
        if self._posterior is None:
            reason = _reason(views, poses)
            self._shown += not reason
            self._used = self._shown
            due = self._shown >= max(self._config.min_motions, TRY_AGAIN * self._tried)
            return self._solve_all() if due and not reason else reason
        run = self._with_motion(poses, views)
        if self._config.look_again:
            views = look_along(run, self._quick, no_progress, self._detectors) or views
        reason = _reason(views, poses, is_expected=True)
        if reason:
            return reason
        self._shown += 1
        self._posterior, taken = add_motion(self._posterior, self._problem_of(run, views), self._quick.solver)
        if bool(taken.all()):
            self._used, self._contradictions = self._used + 1, 0
            return self._solve_all() if self._used >= SOLVE_AGAIN * self._solved else ""
        self._contradictions += 1
        if self._contradictions >= max(CONTRADICTIONS, CONTRADICTING * self._used):
            return self._solve_all()
        return "it contradicts the estimate so far: did the arms move, or is it another instrument?"

    def _solve_all(self) -> str:
        """Solve all motions so far; why the last frame is not among them, else nothing."""
        recording, poses, views = self._collected.recording(), self._collected.poses(), self._collected.views()
        run = first_answer(recording, self._quick, poses, views, self._prior, with_pictures=self._config.look_again).run
        self._run, self._contradictions, self._posterior, self._problem = run, 0, None, None
        self._tried = self._used = self._shown
        if run.solution is not None and run.observations is not None and run.result.status != "solver_failed":
            self._posterior = run.solution.posterior
            self._problem = at_found_setup(problem_of(run.observations, self._quick).flatten_batch(), run.solution)
            # Ten times as long as the solve: it goes on while the arms move to their next place.
            self._advising = self._executor.submit(_advice, run, self._quick)
            self._used = self._solved = max(int(run.result.motions.used.sum()), 1)
        return "" if run.result.motions.used[-1] else run.result.motions.reasons[-1]

    def _with_motion(self, poses: MotionPoses, views: tuple[View, ...]) -> CalibrationRun:
        """The last frame's motion alone, with the estimate so far."""
        assert self._posterior is not None and self._run is not None and self._run.solution is not None
        state, run = self._posterior.state, self._run
        right_T_arm = rigid_from_rotation_translation(state.R, state.t)[0].detach().cpu()
        known = {"camera_right_T_arm": RigidTransform("camera_right", self._run.solution.frame, right_T_arm)}
        if len(views) == 2:
            camera_left_T_camera_right = (
                rigid_from_rotation_translation(state.stereo_R, state.stereo_t)[0].detach().cpu()
            )
            known["camera_left_T_camera_right"] = RigidTransform(
                "camera_left", "camera_right", camera_left_T_camera_right
            )
        offsets = run.result.kinematic_offsets
        placed = with_rcm_offset(with_setup(poses, offsets), offsets.rcm_mm)
        return replace(run, result=replace(run.result, **known), views=views, told=poses, poses=placed, choices=())

    def _problem_of(self, run: CalibrationRun, views: tuple[View, ...]) -> Problem:
        """The last frame's measurements, of the candidate nearest to where the estimate puts the shaft."""
        assert run.solution is not None
        # Three times the same motion, of which one is kept: observations of fewer than three are refused.
        thrice = _repeated(run.told, 3)
        placed = with_setup(thrice, run.result.kinematic_offsets)
        choices = []
        for view in views:
            expected = expected_contours(run, view)
            assert expected is not None
            choices.append(consistent_choice(view.at(thrice.frames), expected.expand(3, -1, -1)))
        observations = assemble(run.recording, placed, views, tuple(choices), self._quick)
        problem = problem_of(observations, self._quick).flatten_batch().select_motions(slice(0, 1))
        return at_found_setup(problem, run.solution)

    def _known_advice(self) -> tuple[str, ...]:
        """The advice of the last solve whose advice is there."""
        if self._advising is not None and self._advising.done():
            self._advice = self._advising.result()
        return self._advice

    def _answer(self, reason: str) -> LiveAnswer:
        """What is known now; `reason` says why the last frame does not count."""
        common = (len(self._collected), self._used, not reason, reason)
        if self._posterior is None or self._run is None or self._run.solution is None or self._problem is None:
            why = f"{self._used} usable motions, {self._config.min_motions} are needed"
            if self._run is not None:
                why = self._run.result.message
            return LiveAnswer("collecting", why, *common)
        posterior, state = self._posterior, self._posterior.state
        covariance = inverse(posterior.information)[:, :6, :6]
        flags, verdict = self._run.solution.observability.degeneracy, self._quick.solver.verdict
        seen = assess(self._problem, state.R, state.t, covariance, verdict, flags)
        matrix = rigid_from_rotation_translation(state.R, state.t)[0].detach().cpu()
        return LiveAnswer(
            "ready" if Verdict.of(seen.verdict[0]) is Verdict.TRUSTWORTHY else "weak",
            seen.describe().sentences[0],
            *common,
            RigidTransform("camera_right", self._run.solution.frame, matrix),
            covariance[0].cpu().numpy(),
            self._known_advice(),
        )


def _advice(run: CalibrationRun, config: CalibrationConfig) -> tuple[str, ...]:
    return tuple(with_next_motions(run, config).result.observability.advice or ())


def _repeated(poses: MotionPoses, times: int) -> MotionPoses:
    """One motion several times."""
    tensors = {name: value.repeat_interleave(times, 0) for name, value in poses.by_motion().items()}
    return replace(poses, frames=np.repeat(poses.frames, times), **tensors)


def _reason(views: tuple[View, ...], poses: MotionPoses, is_expected: bool = False) -> str:
    """Why no camera shows a shaft in the last frame; empty where one does. Where a shaft is expected, the side of its
    tip need not be seen."""
    found = [view.at(poses.frames) for view in views]
    if any(bool((each.valid & (each.direction_known | is_expected)).any()) for each in found):
        return ""
    code = FrameReason(int(found[0].reason[0]))
    return DIRECTION_UNKNOWN if code is FrameReason.OK else code.sentence
