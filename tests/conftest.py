"""Fixtures that every test may use."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from filelock import FileLock
from shape_checks import check_calls_into

check_calls_into("rmis_calib")  # before any test imports it
# Threads that wait by spinning take the cores from the tests, and the programs, that run beside them.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# One thread: the tests' tensors are small, and two cores are shared with decoding threads.
torch.set_num_threads(int(os.environ.get("RMIS_CALIB_TEST_THREADS", "1")))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with slow tests first: workers take one file after the other, and then end together."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], object]], Path]:
    """`made_once(name, make)`: a folder that `make(folder)` fills, once for all workers of a run."""
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def folder_of(name: str, make: Callable[[Path], object]) -> Path:
        folder, is_made = base / f"made_once_{name}", base / f"made_once_{name}.done"
        with FileLock(base / f"made_once_{name}.lock"):
            if not is_made.exists():
                folder.mkdir()
                make(folder)
                is_made.touch()
        return folder

    return folder_of


SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings and frames that lies beside a checkout, where there is one."""
    if not SHARED_DATA.is_dir():
        pytest.skip("real recordings are absent (../shared/data beside the checkout)")
    return SHARED_DATA
