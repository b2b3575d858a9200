"""What the detector finds, misses and invents in the real frames, against labels; one row a set, then what to look at.

    python tests/benchmarks/bench_vision_real_frames.py [--overlays DIR]

Labels (tests/vision/labels.csv): two points on either contour of each shaft that shows at least one width of both.
Segments were picked by eye on the pictures (most among the proposals of a permissive detector), each then snapped to
the strongest colour gradient by code of its own and checked at three to four times magnification; what did not convince
was dropped. `soft` marks contours out of focus, good to about two pixels; the others are good to half a pixel. A
detection that no label claims counts under `others`: look at the overlay to see what it is.
"""

import argparse
import csv
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
import torch

from rmis_calib.vision import DetectorSettings, FrameReason, ShaftDetections, ShaftDetector, draw_detections

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
MATCH_PX = 8.0


def pictures() -> dict[tuple[str, str], np.ndarray]:
    """(file, half) -> RGB picture; stereo phantom frames are split in the middle."""
    found: dict[tuple[str, str], np.ndarray] = {}
    files = [*sorted((DATA / "frames").glob("*/*.png")), *sorted((DATA / "recode_recording/right").glob("*.jpg"))]
    for path in files:
        if path.name.endswith("_mask.png"):
            continue
        image = cv2.imread(str(path))[..., ::-1]
        name = str(path.relative_to(DATA))
        if "phantom_stereo" in name:
            half = image.shape[1] // 2
            found[name, "left"], found[name, "right"] = image[:, :half].copy(), image[:, half:].copy()
        else:
            found[name, ""] = image.copy()
    return found


def read_labels() -> dict[tuple[str, str], list[dict]]:
    """Labels by picture: contours (2, 2, 2) px, end (2,) or None, soft."""
    labels: dict[tuple[str, str], list[dict]] = defaultdict(list)
    with (ROOT / "tests/vision/labels.csv").open() as file:
        for row in csv.DictReader(file):
            points = [[[float(row[f"{e}{p}_{x}_px"]) for x in "uv"] for p in "12"] for e in "ab"]
            end = np.array([float(row["end_u_px"]), float(row["end_v_px"])]) if row["end_u_px"] else None
            labels[row["file"], row["half"]].append(
                {"contours": np.array(points), "end": end, "soft": row["soft"] == "1"}
            )
    return labels


def distances_px(found: ShaftDetections, rank: int, contours: np.ndarray) -> np.ndarray:
    """Distance of the four labelled points from the detected contour lines, in the better of the two orders."""
    line = found.contour_xy[0, rank].double().numpy()
    direction = line[:, 1] - line[:, 0]
    normal = np.stack([direction[:, 1], -direction[:, 0]], -1) / np.linalg.norm(direction, axis=1, keepdims=True)
    either = [np.abs(np.einsum("epi,ei->ep", c - line[:, :1], normal)) for c in (contours, contours[::-1])]
    return min(either, key=lambda d: float(d.max()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--overlays", type=Path, default=None)
    options = parser.parse_args()
    if not DATA.is_dir():
        raise SystemExit("real frames are absent (../shared/data beside the checkout)")
    labels, detector = read_labels(), ShaftDetector(DetectorSettings())
    table = defaultdict(lambda: {"shafts": 0, "found": 0, "other": 0, "px": [], "soft": [], "end": []})
    remarks = []
    for key, image in pictures().items():
        wanted = labels.get(key, [])
        if "recode" in key[0] and not wanted:
            continue
        found = detector.detect(torch.from_numpy(image).permute(2, 0, 1)[None])
        ranks = [k for k in range(found.valid.shape[1]) if bool(found.valid[0, k])]
        row = table[key[0].rsplit("/", 1)[0].removeprefix("frames/")]
        matched = set()
        for label in wanted:
            row["shafts"] += 1
            errors = {k: distances_px(found, k, label["contours"]) for k in ranks}
            best = min(errors, key=lambda k: float(errors[k].max()), default=None)
            if best is None or errors[best].max() > MATCH_PX:
                reason = FrameReason(int(found.reason[0])).name.lower() if not ranks else "not among the candidates"
                remarks.append(f"missed {key[0]} {key[1]}: {reason}")
                continue
            matched.add(best)
            row["found"] += 1
            row["soft" if label["soft"] else "px"].extend(errors[best].ravel())
            if label["end"] is not None and bool(found.end_valid[0, best]):
                row["end"].append(np.linalg.norm(found.end_uv[0, best].double().numpy() - label["end"]))
        for k in set(ranks) - matched:
            row["other"] += 1
            remarks.append(f"other  {key[0]} {key[1]}: confidence {float(found.confidence[0, k]):.2f}")
        if options.overlays:
            options.overlays.mkdir(parents=True, exist_ok=True)
            name = key[0].replace("/", "_").rsplit(".", 1)[0] + ("_" + key[1] if key[1] else "")
            cv2.imwrite(str(options.overlays / f"{name}.png"), draw_detections(image, found)[..., ::-1])
    print("| set | labelled | found | others | contour px, median | soft contours | end px, median |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, row in table.items():
        median = [f"{np.median(row[k]):.2f}" if row[k] else "-" for k in ("px", "soft", "end")]
        print(f"| {name} | {row['shafts']} | {row['found']} | {row['other']} | {' | '.join(median)} |")
    print(*remarks, sep="\n")


if __name__ == "__main__":
    main()
