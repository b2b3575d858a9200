"""Rotations, rigid transforms, cameras, lines and planes on plain tensors, with any leading batch and autograd.

`conventions` is the page that states every sign and order once.
"""

from rmis_calib._lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "chordal_mean": ".rotations",
        "matrix_to_quat": ".rotations",
        "matrix_to_rotvec": ".rotations",
        "project_to_so3": ".rotations",
        "quat_conjugate": ".rotations",
        "quat_multiply": ".rotations",
        "quat_to_matrix": ".rotations",
        "quat_to_rotvec": ".rotations",
        "random_quat": ".rotations",
        "rotation_angle": ".rotations",
        "rotvec_to_matrix": ".rotations",
        "rotvec_to_quat": ".rotations",
        "skew": ".rotations",
        "RigidTransform": ".rigid",
        "rigid_exp": ".rigid",
        "rigid_from_rotation_translation": ".rigid",
        "rigid_inverse": ".rigid",
        "rotate_vectors": ".rigid",
        "transform_points": ".rigid",
        "Camera": ".cameras",
        "StereoRig": ".cameras",
        "AxisPlane": ".lines",
        "axis_from_contours": ".lines",
        "axis_plane": ".lines",
        "contour_planes": ".lines",
        "is_outside_cylinder": ".lines",
        "line_through_points": ".lines",
        "plane_normal_from_points": ".lines",
        "point_line_distance": ".lines",
    },
)
