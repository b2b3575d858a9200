"""Several calibrations of one set-up against each other: pooled, tested for agreement, searched for a change.

A result is a normal distribution of x = [rotation vector, translation] in the tangent space at a common transform:
R_i = exp(x_i) R_0, t_i = t_0 + x_i. Information adds: what the recordings
share beside the transform (stereo extrinsics, shaft radius, end of the shaft, bias of the edges) is one unknown for all
of them, with one prior, so that its error does not average out. What a covariance allows beyond that (encoders that may
be off) is shared too, and is not averaged either.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.stats import chi2

from rmis_calib.errors import InputError
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.geometry.rotations import matrix_to_rotvec, rotvec_to_matrix
from rmis_calib.results import CalibrationResult, covariance_of

SIGNIFICANT = 0.01
"""Probability of a disagreement by chance below which it is called one."""
_ROUNDS = 3
"""Times that the tangent space is moved to the pooled transform: errors fall with the square of the angle."""
_LEVER_MM = 50.0
"""Length that makes a rotation and a translation comparable."""

Vectors = Float[np.ndarray, "n 6"]
Covariances = Float[np.ndarray, "n 6 6"]


@dataclass(frozen=True)
class Agreement:
    """Whether results are of one transform: squared distances from the pooled one, in their own covariances.

    What their reported covariances allow beyond these, for all recordings of a robot alike, does not count: results
    that differ by more than their own noise are a reason to look for it.
    """

    chi2: float
    degrees_of_freedom: int
    probability: float
    """Of at least this much by chance."""

    @property
    def holds(self) -> bool:
        return self.probability >= SIGNIFICANT


@dataclass(frozen=True)
class Change:
    """The transform is another one from a result on.

    Attributes:
        index: of the first result after the change.
        rotation_deg, translation_mm: size of the change.
        probability: of as much by chance, at any place.
    """

    index: int
    rotation_deg: float
    translation_mm: float
    probability: float


@dataclass(frozen=True, eq=False)
class Pooled:
    """One transform from several results.

    Attributes:
        camera_right_T_arm: the transform, mm.
        covariance: (6, 6), rotation first; R = exp(dphi) R^, t = t^ + dt; rad and mm.
        deviation: (n, 6) of each result from it: rotation vector in rad, translation in mm.
        agreement: of the results with each other; None for one.
        kept: (n,) whether a result counts; the others disagree with the rest.
    """

    camera_right_T_arm: RigidTransform
    covariance: Float[np.ndarray, "6 6"]
    deviation: Vectors
    agreement: Agreement | None
    kept: np.ndarray

    @property
    def rotation_sigma_deg(self) -> float:
        return float(np.degrees(np.sqrt(np.trace(self.covariance[:3, :3]))))

    @property
    def translation_sigma_mm(self) -> float:
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))


def can_be_pooled(result: CalibrationResult) -> bool:
    """Whether there is a transform with a covariance, of data that tell it."""
    return result.status in ("ok", "weak") and result.camera_right_T_arm is not None and result.covariance is not None


def pool(results: Sequence[CalibrationResult], drop_outliers: bool = True) -> Pooled:
    """One transform from several results of one set-up, and whether they agree.

    Args:
        results: with transform and covariance (`can_be_pooled`).
        drop_outliers: where they do not agree, leave out the result whose absence helps most, and so on while two
            thirds are left; what remains may still disagree.

    Raises:
        InputError: none, or one without transform or covariance.
    """
    if not results or not all(can_be_pooled(result) for result in results):
        expected = "results with a transform and its covariance, one or more"
        found = next((result.status for result in results if not can_be_pooled(result)), "none")
        raise InputError(where="pool", expected=expected, found=found)
    covariances = own_covariances(results)
    kept = np.ones(len(results), dtype=bool)
    least = -(-2 * len(results) // 3)
    while True:
        chosen = [result for result, keep in zip(results, kept, strict=True) if keep]
        R, t, covariance = _combined(chosen)
        deviation = _tangent(results, R, t)
        agreement = _agreement(deviation[kept], covariances[kept])
        if agreement is None or agreement.holds or not drop_outliers or kept.sum() <= max(2, least):
            break
        kept[_worst(deviation, covariances, kept)] = False
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = R, t
    return Pooled(RigidTransform("camera_right", "arm", matrix), covariance, deviation, agreement, kept)


def own_covariances(results: Sequence[CalibrationResult]) -> Covariances:
    """What the noise of each recording alone makes uncertain; the reported covariance where nothing more is known."""
    told = [(result.information, result) for result in results]
    return np.stack([_covariance(result) if own is None else own.transform_covariance() for own, result in told])


def changes(deviation: Vectors, covariances: Covariances) -> list[Change]:
    """Where a series of results, in their order, begins to be of another transform: the clearest place first searched,
    then both sides of it (binary segmentation).

    Args:
        deviation: of each result in a common tangent space (`Pooled.deviation`).
        covariances: of each result (`own_covariances`).
    """
    found: list[Change] = []
    parts = [(0, len(deviation))]
    while parts:
        start, stop = parts.pop()
        change = _clearest(deviation[start:stop], covariances[start:stop])
        if change is not None:
            at = start + change.index
            found.append(Change(at, change.rotation_deg, change.translation_mm, change.probability))
            parts += [(start, at), (at, stop)]
    return sorted(found, key=lambda change: change.index)


def drift(values: Float[np.ndarray, " n"], sigmas: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Slope of a series a step, weighted by its sigmas, and the probability of as much by chance."""
    weight = sigmas**-2.0
    step = np.arange(len(values)) - np.average(np.arange(len(values)), weights=weight)
    information = float(np.sum(weight * step**2))
    slope = float(np.sum(weight * step * values)) / information
    return slope, float(chi2.sf(slope**2 * information, 1))


def _clearest(deviation: Vectors, covariances: Covariances) -> Change | None:
    """The change of a series that is least likely by chance; None where none is significant."""
    count = len(deviation)
    if count < 2:
        return None
    weights = np.linalg.inv(covariances)
    before_W = np.cumsum(weights, axis=0)
    before_b = np.cumsum((weights @ deviation[..., None])[..., 0], axis=0)
    after_W, after_b = before_W[-1] - before_W[:-1], before_b[-1] - before_b[:-1]
    before_C, after_C = np.linalg.inv(before_W[:-1]), np.linalg.inv(after_W)
    gap = (after_C @ after_b[..., None] - before_C @ before_b[:-1, :, None])[..., 0]
    distance = np.einsum("ni,nij,nj->n", gap, np.linalg.inv(before_C + after_C), gap)
    best = int(distance.argmax())
    probability = min(1.0, (count - 1) * float(chi2.sf(distance[best], 6)))
    if probability >= SIGNIFICANT:
        return None
    turned, moved = np.linalg.norm(gap[best, :3]), np.linalg.norm(gap[best, 3:])
    return Change(best + 1, float(np.degrees(turned)), float(moved), probability)


def _combined(results: Sequence[CalibrationResult]) -> tuple[torch.Tensor, torch.Tensor, np.ndarray]:
    """Rotation, translation and covariance that the information of all results gives."""
    covariances = np.stack([_covariance(result) for result in results])
    scale = np.array([_LEVER_MM] * 3 + [1.0] * 3)
    surest = results[int(np.einsum("nii,i->n", covariances, scale**2).argmin())].camera_right_T_arm
    assert surest is not None
    R, t = surest.matrix[:3, :3].double(), surest.matrix[:3, 3].double()
    names = list(dict.fromkeys(n for r in results if r.information is not None for n in r.information.shared_names))
    place = {name: 6 + i for i, name in enumerate(names)}
    size = 6 + len(names)
    beyond, weight = np.zeros((6, 6)), 0.0
    for _ in range(_ROUNDS):
        A, b = np.zeros((size, size)), np.zeros(size)
        beyond, weight = np.zeros((6, 6)), 0.0
        priors = np.full(size, np.inf)
        for result, x, covariance in zip(results, _tangent(results, R, t), covariances, strict=True):
            told = result.information
            sureness = 1.0 / float(np.sum(np.diagonal(covariance) * scale**2))
            if told is None:
                W = np.linalg.inv(covariance)
                A[:6, :6] += W
                b[:6] += W @ x
            else:
                index = np.array([*range(6), *(place[name] for name in told.shared_names)])
                A[np.ix_(index, index)] += told.matrix
                b[index] += told.vector + told.matrix[:, :6] @ x
                priors[index[6:]] = told.shared_prior_sigma
                beyond += sureness * _positive_part(covariance - told.transform_covariance())
            weight += sureness
        A[np.diag_indices(size)] += np.where(np.isfinite(priors), priors, np.inf) ** -2.0
        covariance = covariance_of(A)
        step = torch.from_numpy(covariance @ b)
        R, t = rotvec_to_matrix(step[:3]) @ R, t + step[3:6]
    return R, t, covariance[:6, :6] + beyond / weight


def _agreement(deviation: Vectors, covariances: Covariances) -> Agreement | None:
    if len(deviation) < 2:
        return None
    distance = np.einsum("ni,nij,nj->", deviation, np.linalg.inv(covariances), deviation)
    freedom = 6 * (len(deviation) - 1)
    return Agreement(float(distance), freedom, float(chi2.sf(distance, freedom)))


def _worst(deviation: Vectors, covariances: Covariances, kept: np.ndarray) -> int:
    """Index of the kept result without which the others agree best."""
    weights = np.where(kept[:, None, None], np.linalg.inv(covariances), 0.0)
    total_W, total_b = weights.sum(0), np.einsum("nij,nj->i", weights, deviation)
    rest = np.linalg.solve(total_W - weights, (total_b - (weights @ deviation[..., None])[..., 0])[..., None])[..., 0]
    gap = deviation[None] - rest[:, None]  # (left out, result, 6)
    distances = np.einsum("kni,nij,knj->kn", gap, weights, gap)
    without = distances.sum(1) - np.diagonal(distances)
    return int(np.where(kept, without, np.inf).argmin())


def _tangent(results: Sequence[CalibrationResult], R: torch.Tensor, t: torch.Tensor) -> Vectors:
    """Each result as a displacement from a transform."""
    transforms = [result.camera_right_T_arm for result in results]
    matrices = torch.stack([transform.matrix.double() for transform in transforms if transform is not None])
    turned = matrix_to_rotvec(matrices[:, :3, :3] @ R.mT)
    return torch.cat([turned, matrices[:, :3, 3] - t], dim=-1).numpy()


def _covariance(result: CalibrationResult) -> Float[np.ndarray, "6 6"]:
    assert result.covariance is not None
    return np.asarray(result.covariance, dtype=float)


def _positive_part(matrix: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """The matrix without its negative eigenvalues, in units in which rotations and translations are comparable."""
    scale = np.array([_LEVER_MM] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(matrix * scale[:, None] * scale)
    return (vectors * values.clip(0.0)) @ vectors.T / scale[:, None] / scale
