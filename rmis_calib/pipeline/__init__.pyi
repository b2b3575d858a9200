from .calibration import calibrate as calibrate
from .calibration import run_calibration as run_calibration
from .detection import detect as detect
from .estimation import solve as solve
from .evaluation import Evaluation as Evaluation
from .evaluation import evaluate as evaluate
from .run import CalibrationRun as CalibrationRun
