"""Every convention of the package, once, with a line of Python that would fail if it were otherwise.

The examples below are run by the tests.

>>> import math
>>> import torch
>>> from rmis_calib import geometry as g
>>> def vector(*entries): return torch.tensor(entries, dtype=torch.float64)
>>> def show(tensor): return [round(x, 4) + 0.0 for x in tensor.flatten().tolist()]

**Units** are millimetres, radians, pixels and seconds inside the package. Files and printed numbers carry their unit in
their name. Estimation is float64.

**Frames.** `camera_right` and `camera_left` are optical frames: +x right, +y down, +z forward, seen from behind the
camera. `arm` is the end-effector frame of the arm that carries the laparoscope, `base` the robot base that both arms
share, `rcm` a frame at the instrument's remote centre of motion, with its origin on the shaft axis. Where the camera
stands still and no arm is logged, `arm` is `base`.

**Transforms.** `a_T_b` maps coordinates in b to coordinates in a, so neighbours match: `a_T_c = a_T_b @ b_T_c`. Its
last column is where the origin of b is, in a. The other reading would give (-2, 1, -3) here:

>>> quarter_turn = g.rotvec_to_matrix(vector(0, 0, math.pi / 2))
>>> a_T_b = g.rigid_from_rotation_translation(quarter_turn, vector(1, 2, 3))
>>> show(g.transform_points(a_T_b, vector(0, 0, 0)))
[1.0, 2.0, 3.0]
>>> show(g.transform_points(g.rigid_inverse(a_T_b), vector(0, 0, 0)))
[-2.0, 1.0, -3.0]

Other names carry the frame they are expressed in the same way: `a_p_x` a point, `a_v_x` a unit direction, `a_n_x` a
unit plane normal, `a_t_b` where b's origin is, `a_R_b` a rotation matrix, `a_q_b` a quaternion. At boundaries a
transform is a `RigidTransform(dst, src, matrix)`, which refuses to be joined to one that does not meet it.

>>> g.RigidTransform("a", "b", a_T_b).inverse().name
'b_T_a'

**Rotations** are active and right-handed: a quarter turn about z takes x to y, not to -y.

>>> show(g.rotate_vectors(a_T_b, vector(1, 0, 0)))
[0.0, 1.0, 0.0]

**Quaternions** are unit and ordered (w, x, y, z); the same numbers as (x, y, z, w) would be a half turn about x here.
q and -q are one rotation.

>>> show(g.quat_to_matrix(vector(1, 0, 0, 0)).diagonal())
[1.0, 1.0, 1.0]

**Perturbation.** An error of a rigid transform is (dphi, dt), rotation first, with R = exp(dphi) R^ and t = t^ + dt:
the rotation error is expressed in the destination frame, and the translation is not turned by it. Covariances are of
this 6-vector, rad and mm. The kinematic noise is a right perturbation instead: `arm_T_rcm @ rigid_exp(xi)`, so that it
is expressed at the RCM. `rigid_exp` puts the translation in directly; the exponential of SE(3) would give (0.6366,
0.6366, 0).

>>> show(g.rigid_exp(vector(0, 0, math.pi / 2, 1, 0, 0))[:3, 3])
[1.0, 0.0, 0.0]

**Pixels.** uv = (column, row), and (0, 0) is the centre of the top-left pixel; sizes are (height, width). Normalised
coordinates are xy = (x/z, y/z), undistorted unless said otherwise. Distortion is Brown-Conrady, in the order k1, k2,
p1, p2, k3. To the right in the scene is to the right in the picture, and down is down:

>>> camera = g.Camera.from_values(100.0, 100.0, 50.0, 40.0, image_size=(81, 101))
>>> uv, valid = camera.project(vector(1, 2, 10))
>>> show(uv), bool(valid)
([60.0, 60.0], True)

**Lines and planes.** A line through normalised points a and b, and the plane that it spans with the optical centre, is
(xa, ya, 1) x (xb, yb, 1): positive right of the directed line from a to b, where y is down. Shaft
lines are given by two points, the one on the RCM's side first.

>>> line = g.line_through_points(vector(0, 0), vector(1, 0))
>>> float(g.point_line_distance(vector(0.5, 0.25), line))
0.25

**The two edges of a shaft.** Edge 0 is left of the axis, directed in the picture from the RCM to the tip,
and edge 1 is right of it: edge 0 is the upper one where the tip is on the right. Here the axis is 100 mm
ahead and the radius 60 mm, so that the edges are at y = -3/4 and y = 3/4:

>>> planes = g.contour_planes(vector(0, 0, 100), vector(1, 0, 0), 60.0)
>>> show(-planes[:, 2] / planes[:, 1])
[-0.75, 0.75]

**The shaft axis** is the z axis of the robot's shaft frame, and `rcm_v_axis` points from the RCM to the tip. A place
on the shaft is its signed distance from the RCM along that direction (`rcm_s_end_mm`).

**Denavit-Hartenberg tables.** Modified (Craig): T = Rx(alpha) Tx(a) Rz(theta) Tz(d). Standard: T = Rz(theta) Tz(d)
Tx(a) Rx(alpha). The joint's reading plus its offset is added to theta (revolute) or d (prismatic). Frame 0 is the arm's
base and frame k follows the k-th row.
"""
