"""What the detector finds, misses and invents in the real frames, against labels; one row a set, then what to look at.

    python tests/benchmarks/bench_vision_real_frames.py [--overlays DIR]

Labels (tests/vision/labels.csv): two points on either contour and the shaft's end on the axis, of every dark shaft in
every frame of the data set and in 10 to 15 frames of each real recording. They owe nothing to any detector: picked by
eye on enlarged pictures, each point then moved across the edge to half-way between the brightness of the shaft and that
of the background (by eye where a highlight, a shadow or the picture's border spoils that; in colour difference for the
defocused in-vivo shafts, whose own shadow darkens the tissue beside them), and each drawn on the enlarged picture and
looked at again. `sigma_px` and `end_sigma_px` say how well each could be placed; up to 1 px counts as sharp. Pixel
centres are integers. In `recode_recording` the points lie above the first ball. The end is where the metal wrist
begins, or the near rim of the steel ring that closes the dark tube (`cwru_jul23`, `ucsd_easy`, `berkeley_b_psm2_mono`).

Kinds: `shaft` is to be found; `stub` is a shaft of which one contour shows for less than half a width, and its points
lie on the metal tube of the same cylinder; `sleeve` is the tube around the shaft between the two balls of the
recording, thicker than the shaft; `strut` is a black leg of furniture, which no single picture tells from a shaft.

Found is a label whose four points lie within 8 px of a detection's contours (of a frame 1920 px wide: 12), closest
pairs first, a detection for one label only. `first` counts it only when it is the detection of highest confidence. Of
the other detections, `off` lies on a shaft that is not found (it is counted as missed), and `false` is where there is
nothing to find; `sure false` counts those above a confidence of 0.5. The end's distance is taken along the axis;
`within 2 px` is the share of the labelled ends of found shafts that were found so, and an end that was not given counts
as missed. A last table says what a confidence is worth.
"""

import argparse
import csv
from collections import defaultdict
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch

from rmis_calib.vision import DetectorSettings, FrameReason, ShaftDetections, ShaftDetector, draw_detections

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT.parent / "shared" / "data"
MATCH_PX = 8.0
SHARP_PX = 1.0
COUNTS = (
    "shaft",
    "shaft found",
    "stub",
    "stub found",
    "sleeve",
    "sleeve found",
    "strut",
    "strut found",
    "off",
    "false",
    "sure false",
    "first",
    "ends",
    "ends within",
)
SURE = 0.5
END_PX = 2.0
BINS = (0.0, 0.5, 0.7, 0.8, 0.9, 1.001)


def pictures() -> dict[tuple[str, str], np.ndarray]:
    """(file, half) -> RGB picture, of the frames and of the labelled pictures of recordings; stereo phantom frames are
    split in the middle."""
    found: dict[tuple[str, str], np.ndarray] = {}
    labelled = {DATA / name for name, _ in read_labels()}
    for path in sorted({*(DATA / "frames").glob("*/*.png"), *labelled}):
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
    """Labels by picture: kind, contours (2, 2, 2) px, end (2,) or None, sigma_px of the contours."""
    labels: dict[tuple[str, str], list[dict]] = defaultdict(list)
    with (ROOT / "tests/vision/labels.csv").open() as file:
        for row in csv.DictReader(file):
            points = [[[float(row[f"{e}{p}_{x}_px"]) for x in "uv"] for p in "12"] for e in "ab"]
            end = np.array([float(row["end_u_px"]), float(row["end_v_px"])]) if row["end_u_px"] else None
            label = {"kind": row["kind"], "contours": np.array(points), "end": end}
            label |= {name: float(row[name] or "nan") for name in ("sigma_px", "end_sigma_px")}
            labels[row["file"], row["half"]].append(label)
    return labels


def distances_px(found: ShaftDetections, rank: int, contours: np.ndarray) -> np.ndarray:
    """Distance of the four labelled points from the detected contour lines, in the better of the two orders."""
    line = found.contour_xy[0, rank].double().numpy()
    direction = line[:, 1] - line[:, 0]
    normal = np.stack([direction[:, 1], -direction[:, 0]], -1) / np.linalg.norm(direction, axis=1, keepdims=True)
    either = [np.abs(np.einsum("epi,ei->ep", c - line[:, :1], normal)) for c in (contours, contours[::-1])]
    return min(either, key=lambda d: float(d.max()))


def match(found: ShaftDetections, labels: list[dict], within_px: float) -> dict[int, tuple[int, np.ndarray]]:
    """Label -> (rank of the detection, distances of the labelled points); closest pairs first, each used once."""
    ranks = torch.nonzero(found.valid[0]).flatten().tolist()
    pairs = [(i, k, distances_px(found, k, label["contours"])) for i, label in enumerate(labels) for k in ranks]
    claimed: dict[int, tuple[int, np.ndarray]] = {}
    for i, k, px in sorted(pairs, key=lambda pair: float(pair[2].max())):
        if px.max() <= within_px and i not in claimed and k not in {rank for rank, _ in claimed.values()}:
            claimed[i] = (k, px)
    return claimed


def end_error_px(found: ShaftDetections, rank: int, label: dict) -> float:
    """Distance of the detected end from the labelled one along the labelled axis."""
    direction = (label["contours"][:, 1] - label["contours"][:, 0]).sum(0)
    offset = found.end_uv[0, rank].double().numpy() - label["end"]
    return abs(float(offset @ direction)) / float(np.linalg.norm(direction))


def lies_on(found: ShaftDetections, rank: int, label: dict) -> bool:
    """Whether the middle of a detection lies between the labelled contours."""
    contours, centre = label["contours"], found.contour_xy[0, rank].double().numpy().mean((0, 1))
    direction = contours[:, 1] - contours[:, 0]
    normal = np.stack([direction[:, 1], -direction[:, 0]], -1)
    sides = np.einsum("ei,ei->e", centre - contours[:, 0], normal) * np.einsum(
        "ei,ei->e", contours[::-1].mean(1) - contours[:, 0], normal
    )
    return bool((sides > 0).all())


def score(key: tuple[str, str], found: ShaftDetections, labels: list[dict], row: dict, width_px: int) -> list[str]:
    """Count one picture into its set's row; what a reader should look at."""
    claimed, name, remarks = match(found, labels, match_px(width_px)), " ".join(key).strip(), []
    missed = [label for i, label in enumerate(labels) if label["kind"] == "shaft" and i not in claimed]
    for i, label in enumerate(labels):
        kind = label["kind"]
        row[kind] += 1
        if i not in claimed:
            if kind in ("shaft", "stub"):
                reason = (
                    FrameReason(int(found.reason[0])).name.lower() if not found.valid.any() else "no candidate fits"
                )
                remarks.append(f"missed {name}: {kind} at {label['contours'].mean((0, 1)).round()}, {reason}")
            continue
        rank, px = claimed[i]
        row[f"{kind} found"] += 1
        row["graded"].append((float(found.confidence[0, rank]), True))
        if kind == "shaft":
            row["first"] += rank == 0
            row["px" if label["sigma_px"] <= SHARP_PX else "soft px"].extend(px.ravel())
            if label["end"] is not None:
                remarks += score_end(name, found, rank, label, row)
    for k in set(torch.nonzero(found.valid[0]).flatten().tolist()) - {rank for rank, _ in claimed.values()}:
        verdict, confidence = "off" if any(lies_on(found, k, label) for label in missed) else "false", found.confidence
        row[verdict] += 1
        row["sure false"] += verdict == "false" and float(confidence[0, k]) > SURE
        row["graded"].append((float(confidence[0, k]), False))
        centre = found.contour_xy[0, k].double().numpy().mean((0, 1)).round()
        remarks.append(f"{verdict:6} {name}: at {centre}, confidence {float(confidence[0, k]):.2f}")
    return remarks


def match_px(width_px: int) -> float:
    """Largest distance of a found label's points from the contours, in a picture of this width."""
    return MATCH_PX * max(1.0, width_px / 1280)


def score_end(name: str, found: ShaftDetections, rank: int, label: dict, row: dict) -> list[str]:
    """Count one labelled end into its set's row; what a reader should look at."""
    row["ends"] += 1
    if not bool(found.end_valid[0, rank]):
        return [f"end    {name}: none"]
    error = end_error_px(found, rank, label)
    row["end px"].append(error)
    row["ends within"] += error <= max(END_PX, label["end_sigma_px"])
    return [f"end    {name}: {error:.1f} px off"] if error > 3 * max(END_PX, label["end_sigma_px"]) else []


def print_confidence(graded: list[tuple[float, bool]]) -> None:
    """What a confidence is worth: of all detections that lie on a label, or on nothing."""
    print("\n| confidence | detections | mean | right |\n| --- | --- | --- | --- |")
    table = np.array(graded, dtype=float).reshape(-1, 2)
    for low, high in pairwise(BINS):
        part = table[(table[:, 0] >= low) & (table[:, 0] < high)]
        if len(part):
            mean, right = part.mean(0)
            print(f"| {low:.1f} to {min(high, 1.0):.1f} | {len(part)} | {mean:.2f} | {100 * right:.1f} % |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--overlays", type=Path, default=None)
    options = parser.parse_args()
    if not DATA.is_dir():
        raise SystemExit("real frames are absent (../shared/data beside the checkout)")
    labels, detector = read_labels(), ShaftDetector(DetectorSettings())
    lists = ("px", "soft px", "end px", "graded")
    table: dict[str, dict] = defaultdict(lambda: {**dict.fromkeys(COUNTS, 0), **{name: [] for name in lists}})
    remarks = []
    for key, image in pictures().items():
        found = detector.detect(torch.from_numpy(image).permute(2, 0, 1)[None])
        row = table[key[0].rsplit("/", 1)[0].removeprefix("frames/").removesuffix("/right")]
        remarks += score(key, found, labels.get(key, []), row, image.shape[1])
        if options.overlays:
            options.overlays.mkdir(parents=True, exist_ok=True)
            name = key[0].replace("/", "_").rsplit(".", 1)[0] + ("_" + key[1] if key[1] else "")
            cv2.imwrite(str(options.overlays / f"{name}.png"), draw_detections(image, found)[..., ::-1])
    table["all"] = {k: sum((row[k] for row in table.values()), start=type(v)()) for k, v in table["all"].items()}
    head = "set | shafts | found | first | off | false | sure false | contour px | soft | end px | within 2 px | struts"
    print(f"| {head} |")
    print("|" + " --- |" * 12)
    for name, row in table.items():
        median = " | ".join(f"{np.median(row[k]):.2f}" if row[k] else "-" for k in ("px", "soft px", "end px"))
        shafts = f"{row['shaft']} | {row['shaft found']} | {row['first']}"
        others = f"{row['off']} | {row['false']} | {row['sure false']}"
        ends = f"{row['ends within']} of {row['ends']} | {row['strut found']} of {row['strut']}"
        print(f"| {name} | {shafts} | {others} | {median} | {ends} |")
    print_confidence(table["all"]["graded"])
    print(*remarks, sep="\n")


if __name__ == "__main__":
    main()
