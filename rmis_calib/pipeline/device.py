"""The one device of a run."""

import torch

from rmis_calib.errors import DeviceError


def require_device(name: str) -> None:
    """Check that this machine has the device, before any work.

    Raises:
        DeviceError: it does not.
    """
    device = torch.device(name)
    count = torch.cuda.device_count()
    if device.type == "cuda" and (device.index or 0) >= count:
        raise DeviceError(where="device", expected=f"cpu, or one of {count} CUDA devices", found=name)
