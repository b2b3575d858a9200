"""Trees of recordings as a user works through them: found, done, resumed, and never anything lost."""

import csv
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest

import rmis_calib as rc
from rmis_calib.batches import JobRecord, plan, work
from rmis_calib.batches.summary import TIMES
from rmis_calib.cli import main
from rmis_calib.errors import InputError, OutputError
from rmis_calib.parallel.lock import holder_file, locked
from tests.batches import toy_tasks

ONE = rc.BatchSettings(workers=1, overlays=1)


@pytest.fixture
def tree(rendered_pairs, tmp_path) -> Path:
    """Recordings that end in every way that needs no long calculation."""
    root = tmp_path / "tree"
    for name in ("short", "deep/corrupt", "deep/short"):
        shutil.copytree(rendered_pairs, root / name)
    video = root / "deep" / "corrupt" / "right.mp4"
    video.write_bytes(video.read_bytes()[:5000])
    (root / "empty").mkdir()
    for name, text in (
        ("hostile", "!!python/object/apply:os.system ['touch /tmp/owned']"),
        ("<b>odd & name", "a: ["),
    ):
        (root / name).mkdir()
        (root / name / "recording.yaml").write_text(text)
    return root


def without_times(summary: Path) -> dict:
    raw = json.loads(summary.read_text())
    for row in raw["recordings"]:
        for key in TIMES:
            del row[key]
    return raw


@pytest.mark.slow
def test_every_recording_of_a_tree_ends_as_it_should(tree, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    assert main(["batch", str(tree), "--out", str(out), "--dry-run"]) == 0
    assert "5 to do" in capsys.readouterr().out
    assert not out.exists()
    assert main(["batch", str(tree), "--out", str(out), "--workers", "2", "--overlays", "1"]) == 1
    said = capsys.readouterr()
    rows = {row["name"]: row for row in json.loads((out / "summary.json").read_text())["recordings"]}
    assert list(rows) == ["<b>odd & name", "deep/corrupt", "deep/short", "hostile", "short"]
    assert {name: row["failure"] or row["status"] for name, row in rows.items()} == {
        "<b>odd & name": "input",
        "deep/corrupt": "input",
        "deep/short": "insufficient_data",
        "hostile": "input",
        "short": "insufficient_data",
    }
    assert rows["deep/corrupt"]["message"].startswith("right.mp4: expected a complete video")
    assert "a tag" in rows["hostile"]["message"]
    assert "short: Too few motions with a usable shaft: 4 of 4 motions" in said.out
    assert rows["short"]["motions"] == 4
    assert {path.name for path in (out / "short").iterdir()} >= {
        "result.json", "report.html", "config.yaml", "overlays", "job.json", "log.jsonl",
        "thumbnail.jpg",
    }  # fmt: skip
    assert {path.name for path in (out / "hostile").iterdir() if not path.name.startswith(".")} == {
        "job.json", "log.jsonl",
    }  # fmt: skip
    with (out / "summary.csv").open(newline="") as file:
        assert [row["name"] for row in csv.DictReader(file)] == list(rows)
    table = pyarrow.parquet.read_table(out / "summary.parquet")
    assert table.column("name").to_pylist() == list(rows)
    assert table.column("motions").to_pylist() == [row.get("motions") for row in rows.values()]
    lines = [json.loads(line) for line in (out / "short" / "log.jsonl").read_text().splitlines()]
    assert lines[0]["event"] == "started"
    assert {line.get("stage") for line in lines} >= {"reading", "detecting, right", "writing"}
    assert "short: Too few motions" in (out / "batch.log").read_text()
    page = (out / "index.html").read_text()
    assert "5 of 5 recordings need a look" in page
    assert "<b>odd" not in page and "&lt;b&gt;odd &amp; name" in page
    assert 'href="deep/short/report.html"' in page
    assert not re.findall(r'(?:src|href)="(?!data:)(?:https?:)?//', page)
    assert page.index("hostile") < page.index('data-name="short"')  # failures first


@pytest.mark.slow
def test_what_is_done_is_passed_over_and_what_has_changed_is_done_again(tree, tmp_path) -> None:
    out = tmp_path / "out"
    first = rc.batch(tree, out, task="detect", settings=ONE)
    assert not first.trustworthy
    assert first.counts == {"failed": 3, "found": 2}
    before = (out / "short" / "job.json").stat().st_mtime_ns
    again = rc.batch(tree, out, task="detect", settings=ONE)
    assert len(again.done_before) == 5
    assert again.to_dict() == first.to_dict()
    assert (out / "short" / "job.json").stat().st_mtime_ns == before
    with (tree / "short" / "joints.csv").open("a") as file:
        file.write("\n")
    orders = plan(tree, out, rc.CalibrationConfig(), "detect", ONE).orders
    assert [(order.job.name, why) for order, why in orders] == [("short", "inputs, settings or version have changed")]
    assert len(plan(tree, out, rc.CalibrationConfig(every=2), "detect", ONE).orders) == 5
    assert len(plan(tree, out, rc.CalibrationConfig(), "calibrate", ONE).orders) == 5


@pytest.mark.slow
def test_pictures_searched_together_are_searched_as_each_alone(tree, tmp_path) -> None:
    alone, together = tmp_path / "alone", tmp_path / "together"
    settings = replace(ONE, workers=2, overlays=0)
    rc.batch(tree, alone, task="detect", settings=settings)
    rc.batch(tree, together, task="detect", settings=replace(settings, device_batch=32))
    assert without_times(together / "summary.json") == without_times(alone / "summary.json")
    for name in ("short", "deep/short"):
        with np.load(alone / name / "lines.npz") as one, np.load(together / name / "lines.npz") as other:
            assert all(one[key].tobytes() == other[key].tobytes() for key in one.files)
        assert (together / name / "lines.csv").read_bytes() == (alone / name / "lines.csv").read_bytes()


@pytest.mark.slow
def test_nobodys_files_are_lost(tree, tmp_path) -> None:
    out = tmp_path / "out"
    rc.batch(tree / "deep", out, task="detect", settings=ONE)
    mine = out / "short" / "notes.txt"
    mine.write_text("mine")
    with (tree / "deep" / "short" / "joints.csv").open("a") as file:
        file.write("\n")
    summary = rc.batch(tree / "deep", out, task="detect", settings=ONE)
    record = {record.name: record for record in summary.records}["short"]
    assert record.failure == "output" and "notes.txt" in record.message
    assert mine.read_text() == "mine"
    mine.unlink()
    assert rc.batch(tree / "deep", out, task="detect", settings=ONE).records[-1].outcome == "finished"
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "summary.csv").write_text("mine")
    with pytest.raises(OutputError, match="another file"):
        rc.batch(tree, tmp_path / "other", settings=ONE)
    with pytest.raises(OutputError, match="apart from the input"):
        rc.batch(tree, tree / "short" / "out", settings=ONE)
    with pytest.raises(OutputError, match="an output folder of its own"):
        rc.batch(tree, tree, settings=ONE)
    with pytest.raises(InputError, match="none in it or below it"):
        rc.batch(tree / "empty", tmp_path / "nothing", settings=ONE)
    assert not (tmp_path / "nothing").exists()


@pytest.mark.slow
def test_a_video_that_takes_the_decoder_down_fails_alone(rendered_pairs, tmp_path, monkeypatch) -> None:
    for name in ("crash", "well"):
        shutil.copytree(rendered_pairs, tmp_path / "root" / name)
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(work, "run_job", toy_tasks.run_job_with_a_decoder_that_aborts)
        settings = rc.BatchSettings(workers=1, overlays=0, retries=1)
        crash, well = rc.batch(tmp_path / "root", out, task="detect", settings=settings).records
    assert (crash.outcome, crash.failure, well.outcome) == ("failed", "crash", "finished")
    assert crash.message == "its process crashed (a decoder, most likely), signal SIGABRT in each of 2 attempts"
    assert {path.name for path in (out / "crash").iterdir() if not path.name.startswith(".")} == {
        "job.json",
        "log.jsonl",
    }
    assert not list(out.rglob("*.tmp*"))
    orders = plan(tmp_path / "root", out, rc.CalibrationConfig(), "detect", settings).orders
    assert [order.job.name for order, _ in orders] == ["crash"]  # a machine's fault: worth another try


def test_one_batch_at_a_time_and_the_dead_do_not_count(tmp_path) -> None:
    with locked(tmp_path) as dead:
        assert dead is None
        assert json.loads(holder_file(tmp_path).read_text())["pid"] == os.getpid()
        code = (
            "from pathlib import Path\nfrom rmis_calib.parallel.lock import locked\n"
            f"with locked(Path({str(tmp_path)!r})): pass"
        )
        other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert other.returncode != 0
        assert f"process {os.getpid()}" in other.stderr
    holder_file(tmp_path).write_text(json.dumps({"host": "theatre", "pid": 7, "since": "yesterday"}))
    with locked(tmp_path) as dead:
        assert dead == "a batch on theatre, process 7, since yesterday"


@pytest.mark.slow
def test_killed_at_any_moment_a_batch_goes_on_to_the_same_summary(tree, tmp_path) -> None:
    command = [sys.executable, "-m", "rmis_calib", "batch", str(tree), "--task", "detect", "--overlays", "1"]
    command += ["--workers", "1", "--out"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    start = time.monotonic()
    assert subprocess.run([*command, str(tmp_path / "whole")], check=False, **quiet).returncode == 1
    took_s = time.monotonic() - start
    moments = random.Random(0)
    killed = 0
    for _ in range(1):
        with subprocess.Popen([*command, str(tmp_path / "killed")], **quiet) as process:
            try:
                process.wait(moments.uniform(0.4, 0.7) * took_s)
            except subprocess.TimeoutExpired:
                killed += 1
                process.send_signal(signal.SIGKILL)
        for path in (tmp_path / "killed").glob("**/job.json"):
            if ".tmp" not in str(path):  # nothing half-done looks complete
                record = JobRecord.read(path.parent)
                assert record is not None and (record.outcome == "failed" or (path.parent / "lines.csv").is_file())
    assert killed
    assert subprocess.run([*command, str(tmp_path / "killed")], check=False, **quiet).returncode == 1
    assert without_times(tmp_path / "killed" / "summary.json") == without_times(tmp_path / "whole" / "summary.json")
    assert not [path for path in (tmp_path / "killed").rglob("*.tmp*")]


@pytest.mark.slow
def test_a_watch_takes_recordings_when_they_are_complete(rendered_pairs, tmp_path) -> None:
    root, out = tmp_path / "root", tmp_path / "out"
    root.mkdir()
    shutil.copytree(rendered_pairs, root / "first")
    (root / "first" / "done").touch()
    shutil.copytree(rendered_pairs, root / "growing")
    seen: list[str] = []

    def watch(progress) -> None:
        if progress.record is not None:
            seen.append(progress.name)
            (root / "growing" / "done").touch()

    settings = rc.BatchSettings(workers=1, overlays=0, watch=True, settle_s=3600.0, poll_s=0.2)
    over = threading.Event()
    threading.Timer(100.0, over.set).start()
    summary = rc.batch(
        root, out, task="detect", settings=settings, progress=watch, stop=lambda: over.is_set() or len(seen) == 2
    )
    assert seen == ["first", "growing"]
    assert [record.name for record in summary.records] == ["first", "growing"]
    assert summary.trustworthy


@pytest.mark.slow
def test_results_of_one_set_up_are_pooled_and_shown(demo_output, tmp_path, capsys) -> None:
    root, out = tmp_path / "root", tmp_path / "out"
    for name in ("monday", "tuesday"):
        shutil.copytree(demo_output / "recording", root / name)
    manifest = tmp_path / "list.yaml"
    manifest.write_text(
        "recordings: [{recording: root/monday, config: {every: 3}}, {recording: root/tuesday, config: {every: 2}}]\n"
    )
    assert main(["batch", str(manifest), "--out", str(out), "--overlay-video", "--profile", "--overlays", "0"]) == 0
    assert "The 2 results agree within their sigmas" in capsys.readouterr().out
    raw = json.loads((out / "summary.json").read_text())
    assert raw["trustworthy"]
    setup = raw["setups"][0]
    assert setup["recordings"] == ["monday", "tuesday"]
    assert setup["camera_right_T_arm"]["matrix"][3] == [0.0, 0.0, 0.0, 1.0]
    rows = {row["name"]: row for row in raw["recordings"]}
    assert rows["monday"]["motions_used"] <= 20 < rows["tuesday"]["motions_used"] <= 30
    page = (out / "index.html").read_text()
    assert "All 2 recordings can be trusted" in page and "<svg" in page and "data:image/jpeg" in page
    import av

    with av.open(str(out / "tuesday" / "overlay_right.mp4")) as video:
        stream = video.streams.video[0]
        assert (stream.codec_context.name, stream.frames) == ("h264", 60)
        assert stream.height > 480  # the lines below the picture
    assert "run_calibration" in (out / "tuesday" / "profile.txt").read_text()
    assert main(["compare", str(out / "monday"), str(out / "tuesday")]) == 0
    assert "pooled camera_right_T_arm" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["batch", "nowhere", "--out", "out"], "nothing there"),
        (["batch", ".", "--out", "out", "--workers", "0"], "workers"),
        (["batch", ".", "--out", "out", "--task", "paint"], "detect"),
        (["batch", "."], "expected a recording"),
        (["compare", "nowhere.json"], "nothing there"),
    ],
)
def test_wrong_usage_is_one_line(arguments, words, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    said = capsys.readouterr().err.strip()
    assert words in said and "\n" not in said
    assert list(tmp_path.iterdir()) == []
