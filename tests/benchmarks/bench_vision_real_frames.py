"""What the detector finds, misses and invents in the real frames, against labels; one row a set, then what to look at.

    python tests/benchmarks/bench_vision_real_frames.py [--overlays DIR]

Labels (tests/vision/labels.csv): two points on either contour and the shaft's end on the axis, of every dark shaft in
every frame of the data set and in 15 frames of the real recording. They owe nothing to any detector: picked by eye on
enlarged pictures, each point then moved across the edge to half-way between the brightness of the shaft and that of the
background (by eye where a highlight, a shadow or the picture's border spoils that; in colour difference for the
defocused in-vivo shafts, whose own shadow darkens the tissue beside them), and each drawn on the enlarged picture and
looked at again. `sigma_px` and `end_sigma_px` say how well each could be placed; up to 1 px counts as sharp. Pixel
centres are integers. In the recording the points lie above the first ball and the end is where the metal wrist begins.

Kinds: `shaft` is to be found; `stub` is a shaft of which one contour shows for less than half a width, and its points
lie on the metal tube of the same cylinder; `sleeve` is the tube around the shaft between the two balls of the
recording, thicker than the shaft; `strut` is a black leg of furniture, which no single picture tells from a shaft.

Found is a label whose four points lie within 8 px of a detection's contours, closest pairs first, a detection for one
label only. Of the other detections, `off` lies on a shaft that is not found (it is counted as missed), and `false` is
where there is nothing to find. The end's distance is taken along the axis.
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
)


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
    """Labels by picture: kind, contours (2, 2, 2) px, end (2,) or None, sigma_px of the contours."""
    labels: dict[tuple[str, str], list[dict]] = defaultdict(list)
    with (ROOT / "tests/vision/labels.csv").open() as file:
        for row in csv.DictReader(file):
            points = [[[float(row[f"{e}{p}_{x}_px"]) for x in "uv"] for p in "12"] for e in "ab"]
            end = np.array([float(row["end_u_px"]), float(row["end_v_px"])]) if row["end_u_px"] else None
            label = {"kind": row["kind"], "contours": np.array(points), "end": end, "sigma_px": float(row["sigma_px"])}
            labels[row["file"], row["half"]].append(label)
    return labels


def distances_px(found: ShaftDetections, rank: int, contours: np.ndarray) -> np.ndarray:
    """Distance of the four labelled points from the detected contour lines, in the better of the two orders."""
    line = found.contour_xy[0, rank].double().numpy()
    direction = line[:, 1] - line[:, 0]
    normal = np.stack([direction[:, 1], -direction[:, 0]], -1) / np.linalg.norm(direction, axis=1, keepdims=True)
    either = [np.abs(np.einsum("epi,ei->ep", c - line[:, :1], normal)) for c in (contours, contours[::-1])]
    return min(either, key=lambda d: float(d.max()))


def match(found: ShaftDetections, labels: list[dict]) -> dict[int, tuple[int, np.ndarray]]:
    """Label -> (rank of the detection, distances of the labelled points); closest pairs first, each used once."""
    ranks = torch.nonzero(found.valid[0]).flatten().tolist()
    pairs = [(i, k, distances_px(found, k, label["contours"])) for i, label in enumerate(labels) for k in ranks]
    claimed: dict[int, tuple[int, np.ndarray]] = {}
    for i, k, px in sorted(pairs, key=lambda pair: float(pair[2].max())):
        if px.max() <= MATCH_PX and i not in claimed and k not in {rank for rank, _ in claimed.values()}:
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


def score(key: tuple[str, str], found: ShaftDetections, labels: list[dict], row: dict) -> list[str]:
    """Count one picture into its set's row; what a reader should look at."""
    claimed, name, remarks = match(found, labels), " ".join(key).strip(), []
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
        if kind == "shaft":
            row["px" if label["sigma_px"] <= SHARP_PX else "soft px"].extend(px.ravel())
            if label["end"] is not None and bool(found.end_valid[0, rank]):
                row["end px"].append(end_error_px(found, rank, label))
    for k in set(torch.nonzero(found.valid[0]).flatten().tolist()) - {rank for rank, _ in claimed.values()}:
        verdict = "off" if any(lies_on(found, k, label) for label in missed) else "false"
        row[verdict] += 1
        centre = found.contour_xy[0, k].double().numpy().mean((0, 1)).round()
        remarks.append(f"{verdict:6} {name}: at {centre}, confidence {float(found.confidence[0, k]):.2f}")
    return remarks


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--overlays", type=Path, default=None)
    options = parser.parse_args()
    if not DATA.is_dir():
        raise SystemExit("real frames are absent (../shared/data beside the checkout)")
    labels, detector = read_labels(), ShaftDetector(DetectorSettings())
    table: dict[str, dict] = defaultdict(lambda: {**dict.fromkeys(COUNTS, 0), "px": [], "soft px": [], "end px": []})
    remarks = []
    for key, image in pictures().items():
        if "recode" in key[0] and key not in labels:
            continue
        found = detector.detect(torch.from_numpy(image).permute(2, 0, 1)[None])
        row = table[key[0].rsplit("/", 1)[0].removeprefix("frames/")]
        remarks += score(key, found, labels.get(key, []), row)
        if options.overlays:
            options.overlays.mkdir(parents=True, exist_ok=True)
            name = key[0].replace("/", "_").rsplit(".", 1)[0] + ("_" + key[1] if key[1] else "")
            cv2.imwrite(str(options.overlays / f"{name}.png"), draw_detections(image, found)[..., ::-1])
    table["all"] = {k: sum((row[k] for row in table.values()), start=type(v)()) for k, v in table["all"].items()}
    print("| set | shafts | found | missed | off | false | contour px | soft contours | end px | stubs | struts |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, row in table.items():
        median = " | ".join(f"{np.median(row[k]):.2f}" if row[k] else "-" for k in ("px", "soft px", "end px"))
        shafts, others = f"{row['shaft']} | {row['shaft found']}", f"{row['off']} | {row['false']}"
        cut = f"{row['stub found']} of {row['stub']} | {row['strut found']} of {row['strut']}"
        print(f"| {name} | {shafts} | {row['shaft'] - row['shaft found']} | {others} | {median} | {cut} |")
    print(*remarks, sep="\n")


if __name__ == "__main__":
    main()
