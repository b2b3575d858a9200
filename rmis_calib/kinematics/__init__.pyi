from .arms import (
    InstrumentPose as InstrumentPose,
)
from .arms import (
    RobotKinematics as RobotKinematics,
)
from .dh import build_chain as build_chain
from .dh import dh_matrix as dh_matrix
from .dh import frame_poses as frame_poses
from .robot_check import ArmReport as ArmReport
from .robot_check import check_robot as check_robot
from .urdf import robot_from_urdf as robot_from_urdf
