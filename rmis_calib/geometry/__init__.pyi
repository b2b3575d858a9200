from . import residuals as residuals
from .cameras import Camera as Camera
from .cameras import StereoRig as StereoRig
from .lines import (
    AxisPlane as AxisPlane,
)
from .lines import (
    axis_from_contours as axis_from_contours,
)
from .lines import (
    axis_plane as axis_plane,
)
from .lines import (
    contour_planes as contour_planes,
)
from .lines import (
    is_outside_cylinder as is_outside_cylinder,
)
from .lines import (
    line_through_points as line_through_points,
)
from .lines import (
    plane_normal_from_points as plane_normal_from_points,
)
from .lines import (
    point_line_distance as point_line_distance,
)
from .rigid import (
    RigidTransform as RigidTransform,
)
from .rigid import (
    rigid_exp as rigid_exp,
)
from .rigid import (
    rigid_from_rotation_translation as rigid_from_rotation_translation,
)
from .rigid import (
    rigid_inverse as rigid_inverse,
)
from .rigid import (
    rigid_log as rigid_log,
)
from .rigid import (
    rotate_vectors as rotate_vectors,
)
from .rigid import (
    transform_points as transform_points,
)
from .rotations import (
    chordal_mean as chordal_mean,
)
from .rotations import (
    matrix_to_quat as matrix_to_quat,
)
from .rotations import (
    matrix_to_rotvec as matrix_to_rotvec,
)
from .rotations import (
    project_to_so3 as project_to_so3,
)
from .rotations import (
    quat_conjugate as quat_conjugate,
)
from .rotations import (
    quat_multiply as quat_multiply,
)
from .rotations import (
    quat_to_matrix as quat_to_matrix,
)
from .rotations import (
    quat_to_rotvec as quat_to_rotvec,
)
from .rotations import (
    random_quat as random_quat,
)
from .rotations import (
    rotation_angle as rotation_angle,
)
from .rotations import (
    rotvec_to_matrix as rotvec_to_matrix,
)
from .rotations import (
    rotvec_to_quat as rotvec_to_quat,
)
from .rotations import (
    skew as skew,
)
