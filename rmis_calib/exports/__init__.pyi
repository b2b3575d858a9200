from .api import FORMATS as FORMATS
from .api import export as export
from .formats.dvrk import read_registration as read_registration
from .settings import ExportSettings as ExportSettings
