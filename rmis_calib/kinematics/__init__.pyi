from .arms import (
    ArmTable as ArmTable,
)
from .arms import (
    HeadPointTable as HeadPointTable,
)
from .arms import (
    InstrumentPose as InstrumentPose,
)
from .arms import (
    RobotKinematics as RobotKinematics,
)
from .arms import (
    RobotTable as RobotTable,
)
from .dh import JointRow as JointRow
from .dh import build_chain as build_chain
from .dh import dh_matrix as dh_matrix
from .dh import frame_poses as frame_poses
