"""A batch of 50 recordings that end in every way: outcomes, speed, memory, kills; and the page of 1,000 recordings.

    python tests/benchmarks/bench_batch.py [--kills 20] [--only-kills] [--keep FOLDER]

Prints one line a measurement. Each part makes its own outputs; nothing is read but what is rendered here.
"""

import argparse
import contextlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import cv2
import numpy as np

import data_synth
from rmis_calib.batches.summary import TIMES

BASES = {"good": "demo", "mono": "demo", "static": "static", "two": "two_instruments"}
"""Preset of each recording that the zoo is made of."""


def render(root: Path) -> dict[str, Path]:
    """Each base recording once, 24 motions."""
    made = {}
    for name, preset in BASES.items():
        config = replace(data_synth.load_synth_config(preset), motions=24)
        if name == "mono":
            config = replace(config, camera=replace(config.camera, left=None))
        made[name] = root / name
        data_synth.write_recording(made[name], config)
    return made


def zoo(root: Path, bases: dict[str, Path]) -> dict[str, str]:
    """50 recordings below `root`; how each must end."""
    expected = {}

    def copy(base: str, name: str, end: str) -> Path:
        expected[name] = end
        return Path(shutil.copytree(bases[base], root / name))

    for i in range(24):
        copy("good", f"good/case_{i:02d}", "ok")
    for i in range(6):
        copy("mono", f"mono/case_{i}", "*")
    for i in range(4):
        copy("static", f"static/case_{i}", "*")
    for i in range(4):
        copy("two", f"two/case_{i}", "*")
    for i in range(3):
        video = copy("good", f"bad/cut_{i}", "failed: input") / "right.mp4"
        video.write_bytes(video.read_bytes()[: 9000 + i])
    for i in range(2):
        (copy("good", f"bad/hostile_{i}", "failed: input") / "recording.yaml").write_text("a: !!python/name:os.system")
    (copy("good", "bad/no_joints", "failed: input") / "joints.csv").unlink()
    joints = copy("good", "bad/rests", "*") / "joints.csv"
    lines = joints.read_text().splitlines()
    joints.write_text(
        "\n".join([lines[0], *(f"{line.split(',')[0]},{lines[1].partition(',')[2]}" for line in lines[1:])])
    )
    swapped = copy("good", "bad/swapped", "not ok")
    (swapped / "right.mp4").rename(swapped / "x.mp4")
    (swapped / "left.mp4").rename(swapped / "right.mp4")
    (swapped / "x.mp4").rename(swapped / "left.mp4")
    os.symlink("right.mp4", copy("good", "bad/linked", "*") / "again.mp4")
    empty = root / "bad" / "empty"
    empty.mkdir()
    (empty / "recording.yaml").write_text("")
    expected["bad/empty"] = "failed: input"
    (copy("good", "bad/garbage", "failed: input") / "left.mp4").write_bytes(np.random.default_rng(0).bytes(50_000))
    huge(copy("good", "bad/huge", "failed: memory"))
    assert len(expected) == 50, len(expected)
    return expected


def huge(recording: Path) -> None:
    """Pictures that need more memory than a worker may take."""
    import yaml

    side = 14_000
    raw = yaml.safe_load((recording / "stereo.yaml").read_text())
    width, height = raw["image_size"]
    scale = side / width
    raw["image_size"] = [side, round(height * scale)]
    for camera in ("right", "left"):
        for key in ("fx", "fy", "cx", "cy"):
            raw[camera][key] *= scale
    (recording / "stereo.yaml").write_text(yaml.safe_dump(raw))
    picture = np.zeros((round(height * scale), side, 3), np.uint8)
    count = len((recording / "frame_times.csv").read_text().splitlines()) - 1
    text = (recording / "recording.yaml").read_text()
    for eye in ("right", "left"):
        folder = recording / eye
        folder.mkdir()
        cv2.imwrite(str(folder / "0000.png"), picture)
        for i in range(1, count):
            os.link(folder / "0000.png", folder / f"{i:04d}.png")
        text = text.replace(f"{eye}: {eye}.mp4", f"{eye}: {eye}")
    (recording / "recording.yaml").write_text(text)


def run(root: Path, out: Path, *flags: str) -> tuple[float, int]:
    """Seconds and exit code of a batch."""
    command = [sys.executable, "-m", "rmis_calib", "batch", str(root), "--out", str(out), *flags]
    start = time.perf_counter()
    code = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False).returncode
    return time.perf_counter() - start, code


def without_times(out: Path) -> dict:
    raw = json.loads((out / "summary.json").read_text())
    for row in raw["recordings"]:
        for key in TIMES:
            row.pop(key, None)
    return raw


def check_outcomes(out: Path, expected: dict[str, str]) -> None:
    rows = {row["name"]: row for row in json.loads((out / "summary.json").read_text())["recordings"]}
    wrong = []
    for name, end in expected.items():
        row = rows[name]
        found = f"failed: {row['failure']}" if row["outcome"] == "failed" else row["status"]
        rights = {"*": row["outcome"] == "finished", "not ok": found != "ok"}
        if not rights.get(end, found == end):
            wrong.append(f"{name}: expected {end}, found {found}: {row['message']}")
        if end in ("*", "not ok"):
            print(f"  {name}: {found}: {row['message'][:150]}")
    print(f"outcomes: {len(expected) - len(wrong)} of {len(expected)} as expected")
    print(*wrong, sep="\n")


def overhead(out: Path) -> None:
    """Time of a recording beyond its own stages, but for the first of each worker, which loads the libraries."""
    beyond = []
    for path in sorted(out.glob("good/*/job.json"), key=lambda path: path.stat().st_mtime)[2:]:
        record = json.loads(path.read_text())
        seconds = dict(record["stages"])
        detecting = max(value for key, value in seconds.items() if key.startswith("detecting"))
        own = detecting + sum(value for key, value in seconds.items() if not key.startswith("detecting"))
        beyond.append(record["seconds"] - own)
    print(f"beyond its own stages, a recording: median {np.median(beyond):.2f} s, largest {max(beyond):.2f} s")


def throughput(bases: dict[str, Path], work: Path) -> None:
    root = work / "speed"
    for i in range(12):
        shutil.copytree(bases["good"], root / f"case_{i:02d}")
    took = {}
    for workers in (1, 2):
        out = work / f"speed_{workers}"
        took[workers], code = run(root, out, "--workers", str(workers))
        assert code == 0, code
    one_thread = work / "one_thread"
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "rmis_calib", "calibrate", str(root / "case_00"), "--out", str(one_thread)]
    start = time.perf_counter()
    subprocess.run(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)
    single = time.perf_counter() - start
    print(
        f"12 recordings: 1 worker (all cores) {took[1]:.1f} s, 2 workers {took[2]:.1f} s, {took[1] / took[2]:.2f} x "
        f"as fast; `calibrate` of one {single:.1f} s"
    )


def kills(root: Path, work: Path, whole: Path, count: int, took_s: float) -> None:
    """Batches killed at random moments: the parent, a worker or both; then resumed to the end."""
    moments = random.Random(0)
    same = 0
    for done in range(1, count + 1):
        out = work / "killed"
        shutil.rmtree(out, ignore_errors=True)
        rounds = 0
        while True:
            rounds += 1
            command = [sys.executable, "-m", "rmis_calib", "batch", str(root), "--out", str(out), "--workers", "2"]
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            if rounds > 3:
                process.wait()
                break
            try:
                process.wait(moments.uniform(0.2, 0.7) * took_s)
                break
            except subprocess.TimeoutExpired:
                whom = moments.choice(["parent", "worker", "both"])
                children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
                if whom in ("worker", "both") and children:
                    kill(int(moments.choice(children)))
                if whom in ("parent", "both"):
                    kill(process.pid)
                process.wait()
        same += without_times(out) == without_times(whole)
        print(f"  {same} of {done} so far, {rounds} starts for the last", flush=True)
    print(f"killed at random moments: {same} of {count} batches ended in the summary of the one that was not killed")


def kill(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def page_of_many(out: Path, work: Path) -> None:
    """The page of 1,000 recordings: written, and opened and sorted in headless Chromium where there is one."""
    from rmis_calib.batches.page import write_index
    from rmis_calib.batches.summary import BatchSummary
    from rmis_calib.batches.task import JobRecord

    folder = work / "many"
    records = [record for record in map(JobRecord.read, sorted((out / "good").iterdir())) if record is not None]
    many = []
    for i in range(1000):
        name = f"case_{i:04d}"
        (folder / name).mkdir(parents=True)
        shutil.copy(out / records[i % len(records)].name / "thumbnail.jpg", folder / name)
        many.append(replace(records[i % len(records)], name=name))
    start = time.perf_counter()
    write_index(folder, BatchSummary(tuple(many), ()), "many")
    size = (folder / "index.html").stat().st_size / 2**20
    print(f"page of 1,000 recordings: {size:.1f} MB, written in {time.perf_counter() - start:.1f} s")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        print("page: not opened, since there is no Chromium")
        return
    probe = (
        "<script>addEventListener('load', () => { const t = performance.now();"
        "document.querySelector('[data-column=\"0\"]').click(); document.body.offsetHeight;"
        "const s = performance.now() - t; document.title = `loaded ${Math.round(t)} ms, sorted ${Math.round(s)} ms`;"
        "});</script></body>"
    )
    page = folder / "probe.html"
    page.write_text((folder / "index.html").read_text().replace("</body>", probe))
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=8000", "--dump-dom"]
    dom = subprocess.run([chromium, *flags, page.as_uri()], capture_output=True, text=True, check=False).stdout
    print(f"page: {dom.partition('<title>')[2].partition('</title>')[0]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--only-kills", action="store_true", help="nothing but the killed batches of four recordings")
    parser.add_argument("--keep", type=Path)
    arguments = parser.parse_args()
    work = arguments.keep or Path(tempfile.mkdtemp(prefix="bench_batch_"))
    work.mkdir(parents=True, exist_ok=True)
    bases = render(work / "bases")
    if not arguments.only_kills:
        whole_zoo(bases, work)
    few = work / "few"
    for i in range(3):
        shutil.copytree(bases["good"], few / f"case_{i}")
    (few / "cut").mkdir()
    shutil.copy(bases["good"] / "recording.yaml", few / "cut")
    took, _ = run(few, work / "few_whole", "--workers", "2")
    kills(few, work, work / "few_whole", arguments.kills, took)
    if arguments.keep is None:
        shutil.rmtree(work)


def whole_zoo(bases: dict[str, Path], work: Path) -> None:
    """Speed, then 50 recordings of every outcome, and the page of 1,000."""
    throughput(bases, work)
    expected = zoo(work / "zoo", bases)
    took, code = run(work / "zoo", work / "out", "--workers", "2", "--memory-gb", "2.5")
    print(f"50 recordings, 2 workers: {took:.0f} s, exit code {code}")
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
    print(f"peak memory of a process: {peak:.2f} GB")
    check_outcomes(work / "out", expected)
    overhead(work / "out")
    page_of_many(work / "out", work)


if __name__ == "__main__":
    main()
