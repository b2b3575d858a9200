"""Against other programs' solutions of the same data: KinHEC, and OpenCV where its build has the functions."""

import cv2
import numpy as np
import pytest
import torch
from scenes import Scene, errors, noisy, scene

from rmis_calib.baselines.adjoint import ata
from rmis_calib.baselines.closed_form import andreff, daniilidis, horaud, park, tsai
from rmis_calib.baselines.motions import Motions, Samples, relative_motions
from rmis_calib.baselines.robot_world import li, shah

HAS_HAND_EYE = hasattr(cv2, "calibrateHandEye")
NOISE = {"camera": (0.003, 0.4), "robot": (0.001, 0.1)}
SEEDS = (1, 2, 3)
CLOSED_FORM = {"tsai": tsai, "park": park, "horaud": horaud, "andreff": andreff, "daniilidis": daniilidis}


def small_mounting(seed: int) -> Scene:
    """A camera turned by less than 90 degrees: beyond, our Tsai changes its frame and theirs do not."""
    exact = scene(seed, 10, angle=0.5)
    X = exact.flange_T_camera.copy()
    X[:3, :3] = cv2.Rodrigues(np.array([0.2, -0.4, 0.3]))[0]
    board = np.linalg.inv(exact.base_T_flange @ X) @ exact.base_T_board
    return noisy(Scene(exact.base_T_flange, board, X, exact.base_T_board), seed, **NOISE)


def motions_of(data: Scene) -> Motions:
    return relative_motions(
        Samples(torch.from_numpy(data.base_T_flange)[None], torch.from_numpy(data.camera_T_board)[None])
    )


def both_senses(motions: Motions) -> tuple[np.ndarray, np.ndarray]:
    """Motions and their inverses as 4x4 matrices: what the translations here are the least-squares solution of."""
    from scipy.spatial.transform import Rotation

    stacks = []
    for q, t in ((motions.qa[0], motions.ta[0]), (motions.qb[0], motions.tb[0])):
        poses = np.tile(np.eye(4), (len(q), 1, 1))
        poses[:, :3, :3] = Rotation.from_quat(q.numpy()[:, [1, 2, 3, 0]]).as_matrix()
        poses[:, :3, 3] = t.numpy()
        stacks.append(np.concatenate([poses, np.linalg.inv(poses)]))
    return stacks[0], stacks[1]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    ("name", "peer"),
    [
        ("tsai", "tsai_lenz"),
        ("park", "park_martin"),
        ("horaud", "horaud_dornaika"),
        ("andreff", "andreff"),
        ("daniilidis", "daniilidis"),
    ],
)
def test_closed_forms_equal_kinhec_on_noisy_motions(name: str, peer: str, seed: int) -> None:
    axxb = pytest.importorskip("kinhec.solvers.axxb", reason="kinhec is not installed (pip install kinhec)")
    motions = motions_of(small_mounting(seed))
    A, B = both_senses(motions)
    length = float(motions.length())  # KinHEC's dual quaternions depend on the unit; ours measure in this
    for values in (A, B):
        values[:, :3, 3] /= length
    theirs = axxb.AXXB_SOLVERS[peer](A, B)
    theirs[:3, 3] *= length
    ours = CLOSED_FORM[name](motions)[0].numpy()
    np.testing.assert_allclose(ours, theirs, atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_shah_equals_kinhec_on_noisy_poses(seed: int) -> None:
    axyb = pytest.importorskip("kinhec.solvers.axyb", reason="kinhec is not installed (pip install kinhec)")
    data = small_mounting(seed)
    theirs = axyb.shah(data.base_T_flange, np.linalg.inv(data.camera_T_board))
    ours = shah(Samples(torch.from_numpy(data.base_T_flange)[None], torch.from_numpy(data.camera_T_board)[None]))
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(mine[0].numpy(), other, atol=1e-9)


@pytest.mark.skipif(not HAS_HAND_EYE, reason=f"OpenCV {cv2.__version__} has no calibrateHandEye in Python")
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", list(CLOSED_FORM))
def test_closed_forms_equal_opencv(name: str, seed: int) -> None:
    data = small_mounting(seed)
    A, C = data.base_T_flange, data.camera_T_board
    flag = getattr(cv2, f"CALIB_HAND_EYE_{name.upper()}")
    R, t = cv2.calibrateHandEye(A[:, :3, :3], A[:, :3, 3], C[:, :3, :3], C[:, :3, 3], method=flag)
    theirs = np.eye(4)
    theirs[:3, :3], theirs[:3, 3] = R, t[:, 0]
    ours = CLOSED_FORM[name](motions_of(data))[0].numpy()
    apart, error = (
        np.abs(errors(ours, theirs)),
        np.linalg.norm(errors(theirs, data.flange_T_camera).reshape(2, 3), axis=1),
    )
    if name in ("park", "horaud"):
        # The rotations are the same. OpenCV takes each motion in one sense only for the translation, we in both.
        np.testing.assert_allclose(apart[:3], 0.0, atol=1e-9)
        assert np.linalg.norm(apart[3:]) < error[1]
    else:
        # OpenCV's Tsai does not weight all motions alike, and it solves the other two in the unit of the input, so that
        # radians and millimetres mix: the results are close to each other, within a few errors.
        assert np.linalg.norm(apart[:3]) < 3 * error[0] + 1e-3 and np.linalg.norm(apart[3:]) < 3 * error[1] + 0.2


@pytest.mark.skipif(not HAS_HAND_EYE, reason=f"OpenCV {cv2.__version__} has no calibrateRobotWorldHandEye in Python")
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["shah", "li"])
def test_robot_world_equals_opencv(name: str, seed: int) -> None:
    data = small_mounting(seed)
    A, B = data.base_T_flange.copy(), np.linalg.inv(data.camera_T_board)
    length = 1.0
    if name == "li":  # OpenCV's depends on the unit; ours measures in the size of the motion
        spread = [np.var(poses[:, :3, 3], axis=0).sum() for poses in (A, B)]
        length = np.sqrt(sum(spread))
    flag = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name.upper()}")
    # OpenCV names its A and B after eye-in-hand poses of another direction; the equation A X = Z B is the same.
    RX, tX, RZ, tZ = cv2.calibrateRobotWorldHandEye(
        A[:, :3, :3], A[:, :3, 3] / length, B[:, :3, :3], B[:, :3, 3] / length, method=flag
    )
    solve = {"shah": shah, "li": li}[name]
    X, Z = solve(Samples(torch.from_numpy(A)[None], torch.from_numpy(data.camera_T_board)[None]))
    for ours, R, t in ((X, RX, tX), (Z, RZ, tZ)):
        np.testing.assert_allclose(ours[0, :3, :3].numpy(), R, atol=1e-8)
        np.testing.assert_allclose(ours[0, :3, 3].numpy(), t[:, 0] * length, atol=1e-6)


def dense_ata(A: np.ndarray, B: np.ndarray, length: float) -> np.ndarray:
    """The published iteration as it stands: the null vector of the stacked 8M x 4 system, then least squares."""
    from scipy.linalg import logm
    from scipy.spatial.transform import Rotation

    def left(q):
        w, x, y, z = q
        return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])

    def right(q):
        w, x, y, z = q
        return np.array([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])

    def quat(R):
        x, y, z, w = Rotation.from_matrix(R).as_quat(canonical=True)
        return np.array([w, x, y, z])

    twists = [[logm(T) for T in motions] for motions in (A, B)]
    vA, vB = (np.array([twist[:3, 3].real / length for twist in group]) for group in twists)
    omega = np.array([[twist[2, 1], twist[0, 2], twist[1, 0]] for twist in twists[0]]).real
    t = np.zeros(3)
    for _ in range(200):
        rows = [left(quat(a[:3, :3])) - right(quat(b[:3, :3])) for a, b in zip(A, B, strict=True)]
        rows += [left([0, *(v - np.cross(t, w))]) - right([0, *u]) for v, w, u in zip(vA, omega, vB, strict=True)]
        w, x, y, z = np.linalg.svd(np.concatenate(rows))[2][-1]
        R = Rotation.from_quat([x, y, z, w]).as_matrix()
        skews = np.cross(omega[:, None], np.eye(3)[None]).transpose(0, 2, 1).reshape(-1, 3)
        t = np.linalg.lstsq(skews, (vB @ R.T - vA).ravel(), rcond=None)[0]
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, t * length
    return X


def test_ata_equals_the_published_iteration() -> None:
    motions = motions_of(small_mounting(1))
    flange, camera = both_senses(motions)
    half = len(flange) // 2
    camera_T_flange = dense_ata(camera[:half], flange[:half], float(motions.length()))
    ours, settled = ata(motions)
    assert settled.all()
    np.testing.assert_allclose(ours[0].numpy(), np.linalg.inv(camera_T_flange), atol=1e-8)


def rcm_costs(data: Scene, base_p: np.ndarray, board_p: np.ndarray):
    """The two costs of the RCM method, written out: of the rotation alone, and of the translation at a rotation."""
    homogeneous = lambda p: np.append(p, 1.0)  # noqa: E731
    seen = (data.camera_T_board @ homogeneous(board_p))[:, :3]
    held = (np.linalg.inv(data.base_T_flange) @ homogeneous(base_p))[:, :3]
    flange, camera = both_senses(motions_of(data))
    weight = len(seen) / len(camera)

    def asked(R):
        return camera[:, :3, :3] - np.eye(3), flange[:, :3, 3] @ R.T - camera[:, :3, 3]

    def of_rotation(R):
        slopes, rhs = asked(R)
        t = np.linalg.lstsq(slopes.reshape(-1, 3), rhs.ravel(), rcond=None)[0]
        centred = (seen - seen.mean(0)) - (held - held.mean(0)) @ R.T
        return np.linalg.norm((seen - held @ R.T).mean(0) - t) + np.linalg.norm(centred, axis=1).sum()

    def of_translation(R, t):
        slopes, rhs = asked(R)
        motions = np.linalg.norm((slopes @ t) - rhs, axis=1).sum()
        return np.linalg.norm(t - (seen - held @ R.T), axis=1).sum() + weight * motions

    return of_rotation, of_translation


@pytest.mark.parametrize("seed", SEEDS)
def test_rcm_is_at_the_minimum_of_the_published_costs(seed: int) -> None:
    from scipy.spatial.transform import Rotation

    data = small_mounting(seed)
    extra = data.inputs("rcm")
    of_rotation, of_translation = rcm_costs(data, extra["base_p_rcm"], extra["board_p_rcm"])
    X = np.linalg.inv(data.solve("rcm", covariance=False).flange_T_camera.numpy())
    R, t = X[:3, :3], X[:3, 3]
    rng = np.random.default_rng(seed)
    for scale in (1e-2, 1e-3, 1e-4):
        for step in rng.normal(size=(20, 3)) * scale:
            assert of_rotation(Rotation.from_rotvec(step).as_matrix() @ R) >= of_rotation(R) - 1e-6
            assert of_translation(R, t + 100 * step) >= of_translation(R, t) - 1e-6
