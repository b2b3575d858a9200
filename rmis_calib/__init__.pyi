from . import baselines as baselines
from . import studies as studies
from .batches import BatchSettings as BatchSettings
from .batches import batch as batch
from .batches import compare as compare
from .batches import pool as pool
from .config import CalibrationConfig as CalibrationConfig
from .config import load_config as load_config
from .convert import ConvertSettings as ConvertSettings
from .convert import convert as convert
from .errors import CalibrationFailed as CalibrationFailed
from .errors import InputError as InputError
from .errors import RmisCalibError as RmisCalibError
from .exports import ExportSettings as ExportSettings
from .exports import export as export
from .geometry import RigidTransform as RigidTransform
from .geometry import residuals as residuals
from .io import Recording as Recording
from .io import ShaftObservations as ShaftObservations
from .io import load_recording as load_recording
from .live import LiveAnswer as LiveAnswer
from .live import Session as Session
from .pipeline import (
    calibrate as calibrate,
)
from .pipeline import (
    check as check,
)
from .pipeline import (
    detect as detect,
)
from .pipeline import (
    evaluate as evaluate,
)
from .pipeline import (
    run_calibration as run_calibration,
)
from .pipeline import (
    solve as solve,
)
from .results import CalibrationResult as CalibrationResult
from .solver.model.pose_refinement import Refinement as Refinement
from .solver.model.pose_refinement import refine as refine
from .solver.own_measurement import Measurement as Measurement
from .studies import study_comparison as study_comparison
from .studies import study_motions as study_motions
from .studies import study_noise as study_noise
from .studies import study_plan as study_plan
from .studies import study_reprojection as study_reprojection
from .viewer import open_viewer as open_viewer
from .vision import ShaftDetector as ShaftDetector
from .vision.fine.subpixel import edge_points as edge_points
from .vision.fine.subpixel import step_place as step_place

__version__: str
