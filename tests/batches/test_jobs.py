"""What a batch finds to do, what it calls it, and when it counts as changed."""

import os
from pathlib import Path

import pytest

from rmis_calib.batches.fingerprint import fingerprint
from rmis_calib.batches.jobs import ITSELF, Job, find_jobs
from rmis_calib.config import CalibrationConfig
from rmis_calib.errors import ConfigError, FileError, InputError

CONFIG = CalibrationConfig()


def touch(path: Path, content: bytes = b"") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def names(root: Path, task="calibrate", skip=None) -> list[str]:
    return [job.name for job in find_jobs(root, task, CONFIG, skip)[0]]


def test_every_recording_below_a_folder_is_found_in_natural_order(tmp_path: Path) -> None:
    for name in ("case_10", "case_9", "deep/er/case", "case_9/no_recording_here"):
        touch(tmp_path / name / ("recording.yaml" if "no_" not in name else "notes.txt"))
    touch(tmp_path / ".hidden" / "recording.yaml")
    touch(tmp_path / "out" / "recording.yaml")
    assert names(tmp_path, skip=tmp_path / "out") == ["case_9", "case_10", "deep/er/case"]


def test_no_output_lies_in_another_one(tmp_path: Path) -> None:
    for name in ("a", "a/b", "a/b/c"):
        touch(tmp_path / name / "recording.yaml")
    assert names(tmp_path) == [f"a/{ITSELF}", f"a/b/{ITSELF}", "a/b/c"]
    assert names(tmp_path / "a" / "b" / "c") == ["c"]
    assert names(tmp_path / "a") == [ITSELF, f"b/{ITSELF}", "b/c"]


def test_links_are_followed_once(tmp_path: Path) -> None:
    touch(tmp_path / "data" / "case" / "recording.yaml")
    os.symlink(tmp_path / "data", tmp_path / "data" / "case" / "loop")
    (tmp_path / "root").mkdir()
    os.symlink(tmp_path / "data" / "case", tmp_path / "root" / "linked")
    assert names(tmp_path / "data") == ["case"]
    assert names(tmp_path / "root") == ["linked"]


def test_detect_takes_videos_and_folders_of_pictures_that_are_no_part_of_a_recording(tmp_path: Path) -> None:
    touch(tmp_path / "rec" / "recording.yaml")
    touch(tmp_path / "rec" / "right.mp4")
    touch(tmp_path / "rec" / "right" / "0001.png")
    touch(tmp_path / "loose.MKV")
    touch(tmp_path / "frames" / "0001.jpg")
    touch(tmp_path / "mixed" / "0001.jpg")
    touch(tmp_path / "mixed" / "notes.txt")
    jobs, left_out = find_jobs(tmp_path, "detect", CONFIG)
    assert [(job.name, job.why) for job in jobs] == [
        ("frames", "folder of pictures"),
        ("loose.MKV", "video"),
        ("rec", "recording.yaml"),
    ]
    assert [item.path.name for item in left_out] == ["mixed"]
    assert "notes.txt" in left_out[0].why
    assert names(tmp_path) == ["rec"]


@pytest.mark.parametrize(
    "name, text",
    [
        ("list.txt", "# the good ones\ncases/one\n\ncases/two  # again\n"),
        ("list.csv", "recording,name,solver.method,every\ncases/one,one,global,2\ncases/two,two,,\n"),
        (
            "list.yaml",
            "recordings:\n  - {recording: cases/one, name: one, config: {solver: {method: global}, every: 2}}\n"
            "  - cases/two\n",
        ),
    ],
)
def test_manifests_name_recordings_and_their_settings(tmp_path: Path, name: str, text: str) -> None:
    manifest = touch(tmp_path / name, text.encode())
    jobs, _ = find_jobs(manifest, "calibrate", CONFIG)
    assert [job.name for job in jobs] == ["one", "two"]
    assert [job.source for job in jobs] == [tmp_path / "cases" / "one", tmp_path / "cases" / "two"]
    changed = name != "list.txt"
    assert jobs[0].config.solver.method == ("global" if changed else "joint")
    assert jobs[0].config.every == (2 if changed else 1)
    assert jobs[1].config == CONFIG


@pytest.mark.parametrize(
    "name, text, words",
    [
        ("list.csv", "path\na\n", "a column called recording"),
        ("list.csv", "recording,solver.method\na,wild\n", "line 2"),
        ("list.csv", "recording,name\na\n", "2 values"),
        ("list.csv", "recording,name,name\na,b,c\n", "columns of different names"),
        ("list.csv", "recording,solver,solver.method\na,3,joint\n", "solver and settings below it"),
        ("list.csv", "recording,solver.method,solver\na,joint,3\n", "solver and settings below it"),
        ("list.yaml", "recordings: [{recording: a, name: 3}]\n", "words, not numbers"),
        ("list.yaml", "recordings: [{name: a}]\n", "entry 1"),
        ("list.yaml", "- a\n", "mapping"),
        ("list.yaml", "recordings: 3\n", "a list"),
        ("list.yaml", "recordings: [{path: a}]\n", "entry 1"),
        ("list.yaml", "recordings: [{recording: a, name: ../a}]\n", "relative path"),
        ("list.yaml", "recordings: [{recording: a, config: {everi: 2}}]\n", "everi"),
        ("list.txt", "a\nb/../a\n", "names that differ"),
        ("list.doc", "a\n", "manifest"),
    ],
)
def test_mistakes_in_manifests_are_named(tmp_path: Path, name: str, text: str, words: str) -> None:
    with pytest.raises((InputError, ConfigError), match=words):
        find_jobs(touch(tmp_path / name, text.encode()), "calibrate", CONFIG)


def test_a_root_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="nothing there"):
        find_jobs(tmp_path / "no", "calibrate", CONFIG)


def test_fingerprints_follow_what_the_answer_depends_on(tmp_path: Path) -> None:
    recording = tmp_path / "rec"
    touch(recording / "recording.yaml", b"right: ../right.mp4\nrobot: dvrk-classic\n")
    joints = touch(recording / "joints.csv", b"timestamp_s\n0\n")
    video = touch(tmp_path / "right.mp4", bytes(3 * 2**20))
    job = Job("rec", recording, "calibrate", CONFIG, "")
    first = fingerprint(job, "")
    os.utime(joints, (0, 0))
    touch(recording / ".lock")
    touch(recording / "inner" / "recording.yaml")
    assert fingerprint(job, "") == first
    assert fingerprint(Job("other", recording, "calibrate", CONFIG, "manifest"), "") == first

    def differs(job: Job = job, effect: str = "") -> bool:
        return fingerprint(job, effect) != first

    assert differs(effect="video")
    assert differs(Job("rec", recording, "detect", CONFIG, ""))
    assert differs(Job("rec", recording, "calibrate", CalibrationConfig(every=2), ""))
    touch(joints, b"timestamp_s\n1\n")
    assert differs()
    touch(joints, b"timestamp_s\n0\n")
    assert not differs()
    status = video.stat()
    with video.open("r+b") as file:  # the same size and time of change, another content
        file.write(b"x" * 100)
    os.utime(video, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert differs()


def test_a_pipe_in_a_recording_does_not_hang_the_search(tmp_path: Path) -> None:
    touch(tmp_path / "rec" / "recording.yaml")
    os.mkfifo(tmp_path / "rec" / "joints.csv")
    job = find_jobs(tmp_path / "rec", "calibrate", CONFIG)[0][0]
    assert len(fingerprint(job, "")) == 32
