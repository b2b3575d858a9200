"""The frame names of the package meet; and the lint that says so sees what it should."""

from pathlib import Path

import pytest
from frame_names import Framed, check_source, iterate_violations, parse_name

PACKAGE = Path(__file__).resolve().parents[2] / "rmis_calib"


def test_names_of_the_package_meet() -> None:
    sources = {str(path.relative_to(PACKAGE.parent)): path.read_text() for path in sorted(PACKAGE.rglob("*.py"))}
    assert len(sources) > 10
    violations = list(iterate_violations(sources))
    assert not violations, "\n" + "\n".join(violations)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("camera_right_T_arm", Framed("T", "camera_right", "arm")),
        ("_base_T_arm_base", Framed("T", "base", "arm_base")),
        ("base_R_arm", Framed("R", "base", "arm")),
        ("camera_right_q_arm", Framed("q", "camera_right", "arm")),
        ("rcm_v_axis", Framed("v", "rcm")),
        ("camera_right_t_arm", Framed("v", "camera_right")),
        ("rcm_s_end_mm", None),
        ("uv_camera_left", None),
        ("pose", None),
        ("T", None),
    ],
)
def test_parse_name(name: str, expected: Framed | None) -> None:
    assert parse_name(name) == expected


GOOD = {
    "product": "a_T_c = a_T_b @ b_T_c",
    "three": "a_T_d = a_T_b @ b_T_c @ c_T_d",
    "inverse method": "b_T_a = a_T_b.inverse()",
    "inverse function": "a_T_c = rigid_inverse(b_T_a) @ b_T_c",
    "numpy inverse": "b_T_a = np.linalg.inv(a_T_b)",
    "attribute": "self.a_T_c = self.a_T_b @ other.b_T_c",
    "matrix of a RigidTransform": "a_T_c = a_T_b.matrix @ b_T_c.matrix",
    "indexing a batch": "a_T_c = a_T_b[..., None, :, :] @ b_T_c[mask]",
    "rotation block": "a_R_b = a_T_b[..., :3, :3]",
    "rotation property": "a_R_c = a_T_b.R @ b_R_c",
    "transposed rotation": "b_R_a = a_T_b[:3, :3].mT",
    "translation": "a_t_b = a_T_b[..., :3, 3]",
    "column of a rotation": "a_v_axis = a_T_b[..., :3, 2]",
    "points": "a_p_x = transform_points(a_T_b, b_p_x)",
    "method apply": "a_p_x = a_T_b.apply(b_p_x)",
    "vectors": "a_v_x = (a_R_b @ b_v_x[..., None])[..., 0]",
    "affine": "a_p_x = (a_R_b @ b_p_x[..., None])[..., 0] + a_t_b",
    "einsum": "a_v_x = torch.einsum('...ij,...j->...i', a_R_b, b_v_x)",
    "einsum of the transpose": "b_v_x = torch.einsum('ji,...j->...i', a_R_b, a_v_x)",
    "difference": "a_v_x = a_p_x - a_t_b",
    "call that is named by its frames": "a_T_c = robot.a_T_b(joints) @ b_T_c",
    "dictionary": "a_T_c = data['a_T_b'] @ data['b_T_c']",
    "conversions": "a_T_b = torch.from_numpy(a_T_b).to(dtype)",
    "unknown factor": "a_T_b = a_T_b @ rigid_exp(noise)",
    "quaternions": "a_q_c = quat_multiply(a_q_b, quat_conjugate(c_q_b))",
    "assembled": "a_T_b = rigid_from_rotation_translation(a_R_b, a_t_b)",
    "named": "x = RigidTransform('a', 'b', a_T_b)",
    "returned": "def a_T_c(x):\n    return a_T_b @ b_T_c",
    "keyword": "Pose(a_T_c=a_T_b @ b_T_c)",
    "tuple": "a_T_c, b_T_a = a_T_b @ b_T_c, a_T_b.inverse()",
    "stated alias": "a_T_d = a_T_b @ c_T_d  # frames: b = c",
    "not a frame": "result = weights @ values",
    "unit normal of the same frame": "residual = (camera_n_axis * camera_v_axis).sum(-1)",
}
BAD = {
    "frames that do not meet": ("a_T_d = a_T_b @ c_T_d", "b does not meet c"),
    "in the middle": ("a_T_e = a_T_b @ b_T_c @ d_T_e", "c does not meet d"),
    "inside a call": ("f(a_T_b @ c_T_d)", "b does not meet c"),
    "name is not the product's": ("a_T_d = a_T_b @ b_T_c", "a_T_d is given a_T_c"),
    "name is the inverse": ("a_T_b = a_T_b.inverse()", "a_T_b is given b_T_a"),
    "forgotten inverse": ("arm_T_rcm = base_T_arm @ base_T_rcm", "arm does not meet base"),
    "wrong side inverted": ("arm_T_rcm = base_T_arm @ rigid_inverse(base_T_rcm)", "arm does not meet rcm"),
    "numpy inverse": ("a_T_b = np.linalg.inv(a_T_b)", "is given b_T_a"),
    "attribute": ("self.a_T_c = self.a_T_b @ self.c_T_d", "b does not meet c"),
    "indexed": ("a_T_c = a_T_b[..., None, :, :] @ c_T_b[i]", "b does not meet c"),
    "rotation named as transform": ("a_T_b = a_T_b[..., :3, :3]", "a_T_b is given a_R_b"),
    "forgotten transpose": ("b_R_c = a_R_b @ a_R_c", "b does not meet a"),
    "transpose named as itself": ("a_R_b = a_T_b.R.mT", "a_R_b is given b_R_a"),
    "vector of another frame": ("a_v_x = a_R_b @ a_v_x", "b does not meet a"),
    "points of another frame": ("a_p_x = transform_points(a_T_b, c_p_x)", "b does not meet c"),
    "result in another frame": ("b_p_x = transform_points(a_T_b, b_p_x)", "b_p_x is given a_v_..."),
    "rotated into another frame": ("c_v_x = rotate_vectors(a_T_b, b_v_x)", "c_v_x is given a_v_..."),
    "method apply": ("a_p_x = a_T_b.apply(a_p_x)", "b does not meet a"),
    "translation in the wrong frame": ("b_t_a = a_T_b[..., :3, 3]", "b_t_a is given a_v_..."),
    "sum across frames": ("x = a_p_x + b_t_c", "vectors of a and of b"),
    "dot product across frames": ("x = (camera_n_axis * rcm_v_axis).sum(-1)", "vectors of camera and of rcm"),
    "cross product across frames": ("x = torch.linalg.cross(a_p_x, b_v_x)", "vectors of a and of b"),
    "einsum": ("a_v_x = torch.einsum('...ij,...j->...i', a_R_b, a_v_x)", "b does not meet a"),
    "einsum of the transpose": ("b_v_x = torch.einsum('ji,...j->...i', a_R_b, b_v_x)", "a does not meet b"),
    "quaternions": ("a_q_c = quat_multiply(a_q_b, c_q_b)", "b does not meet c"),
    "assembled": ("a_T_b = rigid_from_rotation_translation(a_R_b, b_t_a)", "joined with a translation"),
    "named": ("x = RigidTransform('b', 'a', a_T_b)", "RigidTransform b_T_a is given a_T_b"),
    "returned": ("def a_T_c(x):\n    return a_T_b @ c_T_b", "b does not meet c"),
    "returned under another name": ("def c_T_a(x):\n    return a_T_b @ b_T_c", "c_T_a is given a_T_c"),
    "keyword": ("Pose(c_T_a=a_T_b @ b_T_c)", "c_T_a is given a_T_c"),
    "tuple": ("x, a_T_b = y, a_T_b.inverse()", "a_T_b is given b_T_a"),
    "dictionary": ("a_T_c = data['a_T_b'] @ data['c_T_d']", "b does not meet c"),
    "call that is named by its frames": ("a_T_c = robot.a_T_b(joints) @ c_T_b", "b does not meet c"),
    "nameless": ("extrinsics = a_T_b @ b_T_c", "a transform is named by its frames"),
    "alias for something else": ("a_T_d = a_T_b @ c_T_d  # frames: b = e", "b does not meet c"),
    "alias that nothing needs": ("a_T_c = a_T_b @ b_T_c  # frames: b = c", "nothing needs"),
}


@pytest.mark.parametrize("case", GOOD)
def test_lint_accepts(case: str) -> None:
    assert check_source(GOOD[case]) == []


@pytest.mark.parametrize("case", BAD)
def test_lint_reports(case: str) -> None:
    source, message = BAD[case]
    violations = check_source(source)
    assert any(message in violation.message for violation in violations), violations


def test_lint_reports_the_line_once() -> None:
    violations = check_source("x = 1\n\ny = a_T_b @ c_T_d @ d_T_e\n")
    assert [violation.line for violation in violations if "does not meet" in violation.message] == [3]
