"""Settings of the solver. Importing this module imports neither torch nor anything heavy."""

from typing import Annotated, Literal

from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Count = Annotated[int, Field(ge=1)]
Method = Literal["paper", "global", "joint"]
_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, config=_STRICT)
class NoiseSettings:
    """Noise levels: what is assumed when the observations name none, and whether they are estimated."""

    estimate: Literal["auto", "always", "never"] = "auto"
    """Variance components from the data: `auto` estimates those levels that the observations leave open."""
    image: Positive = 7e-4
    """Assumed 1 sigma of an image point across its line, normalised units (0.7 px at f = 1000 px)."""
    kinematics_mm: Positive = 0.3
    """Assumed 1 sigma per axis of the position of `arm_T_rcm`."""
    kinematics_deg: Positive = 0.1
    """Assumed 1 sigma per axis of its orientation."""
    prior_factor: Positive = 3.0
    """An estimated level lies within this factor of the assumed one, 1 sigma of its logarithm."""
    stereo_mm: NotNegative = 0.1
    """Assumed 1 sigma per axis of the stereo translation."""
    stereo_deg: NotNegative = 0.1
    """Assumed 1 sigma per axis of the stereo rotation."""


@dataclass(frozen=True, config=_STRICT)
class UnknownSettings:
    """Unknowns beside the transform. Each has a Gaussian prior; a prior of zero holds the value."""

    stereo: bool = True
    """Refine `camera_left_T_camera_right` within the stereo noise."""
    radius: bool = True
    """Refine the shaft radius, where contours are measured."""
    radius_sigma_relative: NotNegative = 0.03
    """Prior of the radius, as a part of it. 8.0 to 8.5 mm are all in use for "8 mm" shafts."""
    end_offset: bool = True
    """Estimate one constant offset of the shaft's end along the axis, where ends are measured."""
    end_offset_sigma_mm: NotNegative = 30.0
    """Prior of that offset."""
    end_gap_sigma_mm: Positive = 15.0
    """Prior of the distance between two places of the instrument at which ends are measured (the ring of the tube in
    some pictures, the metal's tip in others), about zero; estimated where the ends are clearly at two places."""
    rcm_offset: Literal["never", "auto", "always"] = "auto"
    """Estimate by how much the shaft's axis misses the nominal RCM, two components across the axis, fixed to `rcm`
    (that of the laparoscope is part of the transform); `auto`: where the data ask for it."""
    rcm_offset_sigma_mm: NotNegative = 1.0
    """Prior of each component."""
    joint_offsets: Literal["auto", "always", "never"] = "auto"
    """Estimate constant joint offsets, where the derivatives of the kinematics are in the problem. With `auto` the data
    tell how large they are, from none to twice the prior: the covariance of `calibrate` and `solve` counts all sizes,
    and offsets are part of the answer where there is strong evidence of them. `always`: within the prior."""
    joint_offset_belief: Annotated[float, Field(ge=0.0, le=1.0)] = 1.0
    """With `auto`: probability, before the data speak, that the encoders have offsets of any size; 0 trusts the
    encoders."""
    joint_offset_sigma_deg: NotNegative = 0.5
    """Prior of the offset of a revolute joint."""
    joint_offset_sigma_mm: NotNegative = 1.0
    """Prior of the offset of a prismatic joint."""
    clock: bool = True
    """Estimate the clock offset between video and joints, where the velocities are in the problem (a continuous
    log)."""
    clock_sigma_s: NotNegative = 2.0
    """Prior of the clock offset about zero. Public recordings are off by up to 2.4 s; data that see the clock at all
    see it to milliseconds."""
    clock_rate: Literal["never", "auto", "always"] = "auto"
    """Estimate by how much the clock of the joints runs faster than that of the video (a frame rate that is written
    wrong), beside the offset; `auto`: where the data ask for it."""
    clock_rate_sigma: NotNegative = 0.02
    """Prior of that rate about zero: 29.97 for 30 frames a second is 0.001, 24 for 25 is 0.04."""
    readout: Literal["never", "auto", "always"] = "auto"
    """Estimate how long the camera takes from row to row (rows read one after the other see a moving shaft at different
    instants), where the velocities are in the problem and the observations name its prior (`sigma_readout`); `auto`:
    where the data ask for it."""
    edge_bias: bool = True
    """Estimate the shift across its line that each line point has in every motion alike (an error of the lens model or
    of the edge detector does not average out), where the observations name its prior (`sigma_edge_bias`)."""
    intrinsics: bool = True
    """Correct each camera's focal length, principal point and radial distortion, where the observations name their
    priors (`sigma_focal`, `sigma_centre`, `sigma_lens`). A camera that stands still absorbs wrong ones without a trace:
    there only the priors enter the covariance."""
    setup: Literal["known", "prior", "free"] = "known"
    """The pose of the instrument's base in the laparoscope's: believed as stated, estimated within a prior about that,
    or estimated with no prior. Where nothing states it, it is always `free`. A `known` one is estimated within a prior
    where the robot (`setup_sigma_mm`) or the observations (`sigma_setup_mm`) say how well it is known, and where the
    data contradict it, which the result says."""
    setup_sigma_mm: Positive = 50.0
    """Prior of the stated set-up's translation, per axis, where the observations name none: what passive joints
    without good encoders tell."""
    setup_sigma_deg: Positive = 5.0
    """Prior of its orientation, likewise."""
    setup_doubt_mm: NotNegative = 2.0
    """How far a stated set-up may be off, 1 sigma per axis, that is believed and for which nobody states a sigma. It
    enters the covariance as far as the data cannot tell: in full where the laparoscope stands still."""
    setup_doubt_deg: NotNegative = 0.5
    """The same of its orientation."""
    doubt: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.2
    """Probability, before the data speak, that a believed set-up is off by about its doubt, and that the instrument's
    arm gives way by about its prior. It decides how much the covariance allows for that, not the estimate; 0 trusts
    both, the RCM and the principal points."""
    compliance: Literal["never", "auto", "always"] = "auto"
    """Estimate by how much the instrument's arm gives way: a bend and a shift of the shaft that change smoothly with
    its pose (a flexing cannula, a remote centre that moves, joints that wind up). `auto`: where the
    laparoscope moves, its own kinematics are told, and the data ask for it."""
    compliance_sigma_deg: Positive = 0.1
    """Prior of the bend's mean and of its linear terms; half of it of the second order, and so on."""
    compliance_sigma_mm: Positive = 0.3
    """The same of the shift."""
    held_ratio: Annotated[float, Field(gt=0.0, le=1.0)] = 0.95
    """An unknown whose sigma the data do not bring below this part of its prior is reported as held."""


@dataclass(frozen=True, config=_STRICT)
class VerdictSettings:
    """When a calibration is trustworthy: the predicted error (1 sigma, root of the trace) where the instrument
    works."""

    working_point_mm: tuple[float, float, float] | None = None
    """Point in the right camera's frame at which the error counts; default: the mean measured shaft end or head
    point."""
    trustworthy_mm: Positive = 2.5
    """Predicted error at the working point below which the result is `trustworthy`."""
    unobservable_mm: Positive = 10.0
    """Predicted error above which the transform is `unobservable`; between the two it is `weak`."""
    trustworthy_deg: Positive = 2.0
    """Predicted rotation error below which the result is `trustworthy`."""
    unobservable_deg: Positive = 8.0
    """Predicted rotation error above which it is `unobservable`."""
    lever_mm: Positive = 50.0
    """Length that turns a rotation into a displacement when directions are ranked: about the visible part of the
    shaft."""

    @model_validator(mode="after")
    def _in_order(self) -> "VerdictSettings":
        """`trustworthy` must not reach past `unobservable`: there would be answers that are both."""
        for unit in ("mm", "deg"):
            name, other = f"trustworthy_{unit}", f"unobservable_{unit}"
            least, most = getattr(self, name), getattr(self, other)
            if least > most:
                raise ValueError(f"expected {name} at most {other}, found {least:g} and {most:g}")
        return self


@dataclass(frozen=True, config=_STRICT)
class AdviceSettings:
    """Which further motions are proposed."""

    motions: Annotated[int, Field(ge=0, le=20)] = 3
    """Motions proposed, each chosen with the ones before it counted in; 0 for no advice."""
    candidates: Count = 1024
    """Random motions of several joints among which to choose, beside those of one and of two joints."""
    reach_deg: Positive = 15.0
    """Farthest that a revolute joint may go outside of the range that the recording shows; always within its limits."""
    reach_mm: Positive = 30.0
    """The same for a prismatic joint."""
    nearest_mm: Positive = 25.0
    """Motions that bring a visible part of the shaft nearer to a camera than this are not proposed."""


@dataclass(frozen=True, config=_STRICT)
class SolverSettings:
    """Everything the solver can be told."""

    method: Method = "joint"
    """`paper`: as published; `global`: covering grid on SO(3), then translation; `joint`: weighted estimate of
    everything."""
    unknowns: UnknownSettings = UnknownSettings()
    """What is estimated beside the transform (`joint`)."""
    noise: NoiseSettings = NoiseSettings()
    """Noise levels (`joint`)."""
    verdict: VerdictSettings = VerdictSettings()
    """Thresholds of the verdict."""
    advice: AdviceSettings = AdviceSettings()
    """Further motions that are proposed."""
    derivatives: Literal["analytic", "autograd"] = "analytic"
    """Where `joint` takes the derivatives of the residuals from. Both give the same answer; the analytic ones are
    six to eight times faster (1,728 motions), autograd needs no formula."""
    robust: Literal["auto", "on", "off"] = "auto"
    """Outlier rejection by graduated non-convexity: `auto` where the first fit shows measurements that noise does not
    explain."""
    outlier_probability: Annotated[float, Field(gt=0.0, lt=0.5)] = 1e-4
    """Chance of rejecting a good measurement (of one camera in one motion)."""
    bias_correction: bool = True
    """Subtract the second-order bias of errors in variables, from antithetic simulations at the estimate."""
    bias_motions: Count = 512
    """Least number of simulated pairs that the bias is averaged over (a sixteenth of the motions where that is more).
    Antithetic pairs know it from 512 to a few per cent of sigma at realistic noise."""
    grid: Annotated[int, Field(ge=24, le=20000)] = 576
    """Rotations of the covering grid."""
    minima: Annotated[int, Field(ge=1, le=64)] = 8
    """Distinct minima of the rotation cost that compete."""
    max_iterations: Count = 50
    """Steps of each refinement."""
    tolerance_sigma: Positive = 1e-3
    """Converged when the proposed step is below this part of the standard error in every direction: step^T H step <
    tolerance^2."""
    start_motions: Count = 96
    """Motions that the starts compete on; all motions refine the winner."""
    thin_to: Count | None = None
    """Keep only this many most informative motions (D-optimal); the loss in information is stated."""
    chunk: Annotated[int, Field(ge=256)] = 4096
    """Motions (times trials) that are in work at once: bounds memory."""
    groups: Annotated[int, Field(ge=0, le=32)] = 8
    """Groups of neighbouring motions that are left out in turn; the covariance of `joint` grows where the answer moves
    by more than noise allows. 0: no such check."""
    seed: int = 0
    """Seed of the simulations of the bias correction."""
