from .noise import study_noise as study_noise
from .output import StudyResult as StudyResult
from .registry import method as method
from .registry import noise_source as noise_source
from .settings import NoiseStudySettings as NoiseStudySettings
from .settings import RunSettings as RunSettings
from .settings import SetupSettings as SetupSettings
