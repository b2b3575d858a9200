from .run import convert as convert
from .settings import ConvertSettings as ConvertSettings
