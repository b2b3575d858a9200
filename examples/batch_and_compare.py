"""Calibrate several recordings of one set-up, and test whether they agree.

Three recordings are rendered with the same cameras and robot. `rc.batch` calibrates them side by side; start it again,
and it does only what is new. The picture shows how far each result is from the pooled one, with the uncertainty it
claims. If many bars missed zero, the uncertainties would be too small.

    python examples/batch_and_compare.py [FOLDER]
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import data_synth
import rmis_calib as rc
from rmis_calib.batches import SetupComparison
from rmis_calib.solver.settings import AdviceSettings, SolverSettings

NAMES = ("monday", "tuesday", "wednesday")


def draw(comparison: SetupComparison, picture: Path) -> None:
    """Translation of every result from the pooled one, by axis, with 1 sigma."""
    figure, ax = plt.subplots(figsize=(7, 4.4), layout="constrained")
    assert comparison.pooled is not None
    for place, (name, result) in enumerate(zip(comparison.names, comparison.results, strict=True)):
        assert result.covariance is not None  # `compare` leaves results without one out
        sigma_mm = np.sqrt(np.diag(result.covariance)[3:])
        at = np.arange(3) + 0.15 * (place - 1)
        ax.errorbar(at, comparison.pooled.deviation[place, 3:], sigma_mm, fmt="o", capsize=4, label=name)
    ax.axhline(0.0, color="black", linewidth=0.8)
    ax.set(xticks=range(3), xticklabels=["x", "y", "z"], ylabel="translation from the pooled transform, mm")
    ax.legend()
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def main(out: Path) -> tuple[SetupComparison, Path]:
    for seed, name in enumerate(NAMES):
        config = data_synth.load_synth_config({"motions": 12, "seed": seed})
        data_synth.write_recording(out / "recordings" / name, config)

    config = rc.CalibrationConfig(solver=SolverSettings(advice=AdviceSettings(motions=0)))  # no advice: saves time
    summary = rc.batch(out / "recordings", out / "answers", config, settings=rc.BatchSettings(workers=2, overlays=0))
    for record in summary.records:
        print(f"{record.name}: {record.line}")

    results = [rc.CalibrationResult.read(out / "answers" / name / "result.json") for name in NAMES]
    comparison = rc.compare(results, NAMES)
    print(*comparison.sentences(), sep="\n")
    picture = out / "agreement.png"
    draw(comparison, picture)
    print(f"drawn: {picture}")
    return comparison, picture


if __name__ == "__main__":  # the processes of a batch import this file
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example_batch"))
