"""A study on a dask cluster: processes of their own, which load the user's file themselves."""

from pathlib import Path

import pytest

import rmis_calib as rc
from rmis_calib.errors import InputError
from rmis_calib.studies.settings import NoiseStudySettings, RunSettings

pytest.importorskip("distributed", reason="dask.distributed is absent (the extra `cluster`)")

OWN = Path(__file__).with_name("own_things.py")


def settings(**run) -> NoiseStudySettings:
    return NoiseStudySettings(
        methods=("global", "nothing"), sources=("kinematics", "stiff"), coefficients=(0.5, 1.0),
        positions_laparoscope=2, positions_instrument=2, run=RunSettings(trials=3, extensions=(OWN,), **run),
    )  # fmt: skip


@pytest.mark.slow
def test_a_cluster_comes_to_the_same_trials(tmp_path) -> None:
    rc.study_noise(tmp_path / "here", settings(workers=1))
    rc.study_noise(tmp_path / "there", settings(workers=2, cluster="local"))
    trials = (tmp_path / "here/trials.csv").read_text()
    assert trials.count("\n") == 1 + 2 * 2 * 2 * 2 * 3  # sources, coefficients, mono and stereo, methods, trials
    assert (tmp_path / "there/trials.csv").read_text() == trials
    seen = []
    rc.study_noise(tmp_path / "there", settings(workers=2, cluster="local"), progress=seen.append)
    assert (seen[-1].done, seen[-1].total, seen[-1].stored) == (0, 0, 4)  # all of it was stored by the workers


def test_a_scheduler_that_is_not_there_is_told(tmp_path, monkeypatch) -> None:
    import distributed

    def refuse(*_, **__):
        raise OSError("timed out")

    monkeypatch.setattr(distributed, "Client", refuse)
    with pytest.raises(InputError, match="a dask scheduler that answers"):
        rc.study_noise(tmp_path / "out", settings(cluster="tcp://host:1"))
