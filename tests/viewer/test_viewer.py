"""The page in a browser, and what the command makes of its arguments."""

import shutil
import socket
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import data_synth
from rmis_calib.cli import main
from rmis_calib.cli.view import sorted_paths
from rmis_calib.errors import FileError, InputError

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("viewed") / "case"
    data_synth.write_recording(path, data_synth.load_synth_config({"motions": 3, "seed": 7}))
    return path


def test_the_recording_is_found_among_the_paths(recording, tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "result.json").write_text("{}")
    a, b = tmp_path / "a", tmp_path / "b" / "result.json"
    folder, results = sorted_paths((a, recording, b), None)
    assert folder == recording
    assert results == {"a": a, "b": b}
    beside = recording.parent / "case_calibration"
    beside.mkdir()
    (beside / "result.json").write_text("{}")
    assert sorted_paths((beside,), None)[0] == recording
    with pytest.raises(InputError, match="name their recording"):
        sorted_paths((a,), None)
    with pytest.raises(FileError, match="neither"):
        sorted_paths((tmp_path / "nothing",), None)


def test_a_missing_recording_is_one_line(tmp_path, capfd):
    assert main(["view", str(tmp_path / "nothing")]) == 2
    assert len(capfd.readouterr().err.strip().splitlines()) == 1


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium to look with")
def test_a_browser_draws_the_scene(recording, tmp_path):
    pytest.importorskip("viser")
    from rmis_calib.viewer import open_viewer

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]  # the system's choice
    viewer = open_viewer(recording, port=port)
    try:
        assert viewer.url.startswith("http://127.0.0.1:")
        viewer.show(2)
        picture = tmp_path / "page.png"
        command = [CHROMIUM, "--headless", "--no-sandbox", "--use-gl=swiftshader", "--enable-unsafe-swiftshader"]
        options = ["--window-size=1000,700", "--virtual-time-budget=20000", f"--screenshot={picture}"]
        with subprocess.Popen([*command, *options, viewer.url], stderr=subprocess.DEVNULL) as browser:
            connected, deadline = 0, time.monotonic() + 60
            while browser.poll() is None and time.monotonic() < deadline:
                connected = max(connected, viewer.watchers)
                time.sleep(0.1)
            browser.kill()
        assert connected == 1
        assert (
            len(np.unique(np.asarray(Image.open(picture).convert("RGB").resize((100, 70))).reshape(-1, 3), axis=0)) > 50
        )
    finally:
        viewer.close()
