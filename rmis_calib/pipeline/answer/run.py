"""One calibration with everything that it came from."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from rmis_calib.geometry.cameras import Camera
from rmis_calib.geometry.rigid import transform_points
from rmis_calib.io import Recording, ShaftObservations
from rmis_calib.pipeline.answer.view_edges import ViewEdges
from rmis_calib.pipeline.arms.poses import MotionPoses, predict_contours, predict_ends
from rmis_calib.pipeline.motions.association import Choice
from rmis_calib.pipeline.pictures.detection import View
from rmis_calib.results import CalibrationResult
from rmis_calib.solver import Solution


@dataclass(frozen=True, eq=False)
class CalibrationRun:
    """A result with everything it came from, for reports and for solving again.

    Attributes:
        result: the answer.
        recording: what was calibrated.
        views: frames and detections of each camera.
        told: kinematics of the motions as the recording tells them; what every solve sets out from.
        poses: kinematics of the motions at the offsets and the set-up that were found; what `result` goes with.
        choices: candidate taken in each view.
        observations: what the solver saw.
        solution: what the solver returned; None when there were too few motions to solve.
        picture_edges: what the pictures show along the predicted contours, by view; empty where nothing was looked at.
    """

    result: CalibrationResult
    recording: Recording
    views: tuple[View, ...]
    told: MotionPoses
    poses: MotionPoses
    choices: tuple[Choice, ...]
    observations: ShaftObservations | None
    solution: Solution | None
    picture_edges: tuple[ViewEdges, ...] = ()

    def with_notes(self, notes: tuple[str, ...]) -> "CalibrationRun":
        """The run with notes on what was read, before what is noted already."""
        return replace(self, result=replace(self.result, notes=notes + self.result.notes))

    @property
    def clock(self) -> tuple[float, float] | None:
        """Clock that was found, offset (s) and rate; None where it is no unknown or the data cannot tell it."""
        clock = None if self.solution is None else self.solution.nuisances.get("clock")
        return None if clock is None or bool(clock.held) else self.result.kinematic_offsets.clock

    @property
    def groups(self) -> Int[np.ndarray, " m"]:
        """Number of each motion's group of neighbours (`result.consistency`); -1 where there is none."""
        consistency = self.result.consistency
        if consistency is None or len(consistency.group_by_motion) != len(self.poses.frames):
            return np.full(len(self.poses.frames), -1)
        return np.asarray(consistency.group_by_motion, dtype=int)

    def camera(self, view: View) -> Camera | None:
        """A view's camera, corrected by what was found to be off in it."""
        return None if view.camera is None else view.camera.corrected(*self.result.intrinsic_correction(view.side))

    def predicted_contours(self, view: View) -> Float[Tensor, "m 2 3"] | None:
        """Contour planes where the result puts the shaft, in one view's camera."""
        camera_T_arm = self.camera_T_arm(view)
        if camera_T_arm is None:
            return None
        return predict_contours(
            camera_T_arm, self.poses, self.result.nuisance("radius", self.recording.shaft_diameter_mm / 2)
        )

    def predicted_ends(self, view: View) -> Float[Tensor, "m 3"] | None:
        """Where the result puts the shaft's end, mm, in one view's camera."""
        camera_T_arm = self.camera_T_arm(view)
        return (
            None
            if camera_T_arm is None
            else predict_ends(camera_T_arm, self.poses, self.result.nuisance("end_offset", 0.0))
        )

    def predicted_heads(self, view: View) -> Float[Tensor, "m 3"] | None:
        """Where the result puts the head point, mm, in one view's camera."""
        camera_T_arm = self.camera_T_arm(view)
        if camera_T_arm is None:
            return None
        return transform_points(camera_T_arm @ self.poses.arm_T_rcm, self.poses.rcm_p_head)

    def camera_T_arm(self, view: View) -> Float[Tensor, "4 4"] | None:
        """The answer in one view's camera; None without one."""
        transform = self.result.camera_right_T_arm if view.side == "right" else self.result.camera_left_T_arm
        return None if transform is None else transform.matrix.to(self.poses.arm_T_rcm.device)
