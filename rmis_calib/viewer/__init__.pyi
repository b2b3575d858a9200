from .server import Viewer as Viewer
from .server import open_viewer as open_viewer
