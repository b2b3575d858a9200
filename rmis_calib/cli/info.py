"""`rmis-calib info`: what a bug report needs."""

import os
import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files

from rmis_calib import __version__
from rmis_calib.cli import EXIT_OK
from rmis_calib.cli.console import print_table

PACKAGES = ("torch", "kornia", "pytorch-kinematics", "opencv-python-headless", "numpy", "scipy", "av", "pydantic")
EXTRAS = {
    "bags": ("rosbags",),
    "cluster": ("distributed",),
    "view": ("viser",),
    "onnx": ("onnxruntime",),
    "docs": ("mkdocs-material",),
}
"""What each optional part needs, as in pyproject.toml."""


@dataclass(frozen=True, kw_only=True)
class Info:
    """Print versions, devices and paths: please paste this into a bug report."""

    def run(self) -> int:
        import torch

        gpus = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
        print_table("rmis_calib", [("version", __version__), ("shipped files", str(files("rmis_calib")))])
        rows = [
            ("Python", f"{platform.python_version()} ({platform.python_implementation()})"),
            ("system", f"{platform.system()} {platform.release()}, {platform.machine()}"),
            ("cores", f"{os.cpu_count()}, torch uses {torch.get_num_threads()}"),
            ("GPUs", ", ".join(gpus) or "none that torch can use"),
        ]
        print_table("machine", rows)
        print_table("packages", [(name, _version(name)) for name in PACKAGES])
        print_table(
            "extras", [(extra, ", ".join(f"{name} {_version(name)}" for name in EXTRAS[extra])) for extra in EXTRAS]
        )
        return EXIT_OK


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
