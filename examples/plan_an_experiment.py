"""Plan a recording before you make it: how many motions reach 2 mm, and does it help to move the laparoscope?

Two studies simulate recordings of a da Vinci with its noise, once with a laparoscope that moves and once with one that
stands still. Each finds the smallest number of motions that reaches the wanted error in 90 % of recordings.

    python examples/plan_an_experiment.py [FOLDER]

With `trials` at its default of 200 the numbers are reliable, and the studies take minutes.
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.ticker import FixedLocator, NullLocator

import rmis_calib as rc
from rmis_calib.studies.settings import PlanSettings, RunSettings, SetupSettings

WANTED_MM = 2.0


def plan(out: Path, laparoscope: str, trials: int) -> rc.studies.StudyResult:
    """Recordings of up to 128 random motions."""
    settings = PlanSettings(
        wanted_mm=WANTED_MM,
        laparoscope=laparoscope,  # type: ignore[arg-type]
        most_motions=128,
        kinematics_noise_mm=0.5,
        kinematics_noise_deg=0.2,
        setup=SetupSettings(robot="dvrk-classic"),
        run=RunSettings(trials=trials, workers=1),
    )
    return rc.study_plan(out, settings)


def main(out: Path, trials: int = 12) -> tuple[dict[str, rc.studies.StudyResult], Path]:
    studies = {how: plan(out / how, how, trials) for how in ("moves", "still")}
    figure, ax = plt.subplots(figsize=(7, 4.4), layout="constrained")
    for how, study in studies.items():
        print(f"laparoscope {how}: {study.sentences[0]}")
        rows = sorted(study.summary, key=lambda row: row["motions"])
        ax.loglog([row["motions"] for row in rows], [row["working_point_q90_mm"] for row in rows], "o-", label=how)
    ax.axhline(WANTED_MM, color="black", linestyle=":", label="wanted")
    ax.set(xlabel="motions", ylabel="error at the working point, mm (90 % of recordings)")
    ax.set_title(f"{trials} simulated recordings a point")
    for axis, ticks in ((ax.xaxis, (4, 8, 16, 32, 64, 128)), (ax.yaxis, (0.5, 1, 2, 5, 10))):
        axis.set_major_locator(FixedLocator(ticks))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(NullLocator())
    ax.legend(title="laparoscope")
    picture = out / "plan.png"
    figure.savefig(picture, dpi=110)
    plt.close(figure)
    print(f"drawn: {picture}")
    return studies, picture


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example_plan"))
