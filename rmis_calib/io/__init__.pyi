from .atomic import (
    atomic_directory as atomic_directory,
)
from .atomic import (
    atomic_write as atomic_write,
)
from .atomic import (
    write_json as write_json,
)
from .atomic import (
    write_yaml as write_yaml,
)
from .configs import config_names as config_names
from .configs import config_path as config_path
from .configs import load_yaml as load_yaml
from .description import RecordingDescription as RecordingDescription
from .description import read_description as read_description
from .dvrk_robot import import_dvrk as import_dvrk
from .joints import JointLog as JointLog
from .observations import ShaftObservations as ShaftObservations
from .recording import Recording as Recording
from .recording import load_recording as load_recording
from .robot import Arm as Arm
from .robot import HeadPoint as HeadPoint
from .robot import Joint as Joint
from .robot import Robot as Robot
from .robot import load_robot as load_robot
from .robot import robot_to_dict as robot_to_dict
from .stereo import read_camera_pair as read_camera_pair
from .stereo import read_stereo as read_stereo
from .tables import HeadPoints as HeadPoints
from .video import FrameBatch as FrameBatch
from .video import FrameSource as FrameSource
from .video import open_source as open_source
