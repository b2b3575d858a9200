"""Fixtures that every test may use."""

import os
from pathlib import Path

import pytest
import torch
from shape_checks import check_calls_into

check_calls_into("rmis_calib")  # before any test imports it
# Threads that wait by spinning take the cores from the tests, and the programs, that run beside them.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# One thread: the tests' tensors are small, and two cores are shared with decoding threads.
torch.set_num_threads(int(os.environ.get("RMIS_CALIB_TEST_THREADS", "1")))

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings and frames that lies beside a checkout, where there is one."""
    if not SHARED_DATA.is_dir():
        pytest.skip("real recordings are absent (../shared/data beside the checkout)")
    return SHARED_DATA
