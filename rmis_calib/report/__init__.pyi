from .detection_pictures import DetectionPictures as DetectionPictures
from .detection_pictures import PictureChoice as PictureChoice
from .folder import write_calibration_folder as write_calibration_folder
from .folder import write_lines as write_lines
from .overlays import DETECTED_RGB as DETECTED_RGB
from .overlays import PREDICTED_RGB as PREDICTED_RGB
from .overlays import Overlay as Overlay
from .page import write_report as write_report
