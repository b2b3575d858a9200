"""Fixtures of the io tests."""

from pathlib import Path

import pytest
from recording_files import RecordingFolder


@pytest.fixture
def folder(tmp_path: Path) -> RecordingFolder:
    """A valid stereo recording, to be broken by the test."""
    return RecordingFolder(tmp_path / "recording")
