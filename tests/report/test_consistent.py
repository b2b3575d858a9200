"""A page never contradicts itself: counts, verdict, sigmas and links of good, weak and refused results."""

import re
from pathlib import Path

import pytest

from rmis_calib.pipeline.answer.run import CalibrationRun
from rmis_calib.report import write_report
from rmis_calib.results import CalibrationResult

RUNS = ("rendered_run", "run_with_rejections", "refused_run")


def words_of(page: str) -> str:
    page = re.sub(r"<(style|script).*?</\1>", "", page, flags=re.DOTALL)
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", page))


@pytest.mark.parametrize("name", RUNS)
def test_counts_are_the_same_everywhere(pages: dict[str, tuple[Path, str]], name: str) -> None:
    text = words_of(pages[name][1]) + " ".join(re.findall(r'aria-label="([^"]*)"', pages[name][1]))
    counts = re.findall(r"(\d+) of (\d+)(?: motions)?(?: was| were| are)? (used|usable|in the failed estimate)", text)
    assert len(counts) >= 2 and len(set(counts)) == 1


def test_a_refused_report_marks_nothing_as_used(pages: dict[str, tuple[Path, str]]) -> None:
    page = pages["refused_run"][1]
    assert "strip ok" not in page and "bar used ok" not in page and '<div class="strip open"' in page
    assert not re.search(r"(^|[\s}])\.open \{[^}]*background", page)  # which would hide the strip's bars
    assert not re.search(r"\bused\b", words_of(page))
    assert "4 of 20 motions were usable; no estimate was made" in words_of(page)
    assert "usable, but there are too few" not in words_of(page)  # no reason of rejection


@pytest.mark.parametrize("name", RUNS)
def test_nothing_points_to_what_is_not_there(pages: dict[str, tuple[Path, str]], name: str) -> None:
    page = pages[name][1]
    ids = set(re.findall(r'\bid="([^"]+)"', page))
    assert set(re.findall(r'href="#([^"]+)"', page)) <= ids
    assert set(re.findall(r'aria-labelledby="([^"]+)"', page)) <= ids
    assert set(re.findall(r'\bfor="([^"]+)"', page)) <= ids
    assert not re.search(r"\b(see|sections?) (above|below)\b", words_of(page), flags=re.IGNORECASE)


@pytest.mark.parametrize("name", RUNS)
def test_checks_agree_with_the_verdict(pages: dict[str, tuple[Path, str]], name: str) -> None:
    page = pages[name][1]
    failed, passed = page.count('<li class="failed">'), page.count('<li class="passed">')
    if name == "rendered_run":
        assert "Trustworthy" in page and passed >= 2 and failed == 0
    else:
        assert "Trustworthy" not in page and (failed >= 1 or passed == 0)
        assert "To copy" not in page and "rmis-calib export" not in page


def test_advice_starts_from_the_sigma_that_the_bars_show(
    pages: dict[str, tuple[Path, str]], rendered_run: CalibrationRun
) -> None:
    text = words_of(pages["rendered_run"][1])
    weakest = re.search(r"logarithmic scale in mm\. .*? ([\d.]+) mm", text)
    assert weakest is not None
    said = re.findall(r"(?:shrinks from|mm of) ([\d.]+) mm", text)
    assert said and set(said) == {weakest.group(1)}


@pytest.mark.parametrize("name", RUNS)
def test_no_number_is_made_of_rounding_alone(pages: dict[str, tuple[Path, str]], name: str) -> None:
    text = words_of(re.sub(r"<pre.*?</pre>", "", pages[name][1], flags=re.DOTALL))
    assert re.findall(r"[\d.]+e[-−+]?(?:1[0-9]|2[0-9])\b", text) == []
    assert not re.search(r"\b(nan|None|inf)\b", text)


@pytest.mark.parametrize("status", ["weak", "unobservable", "solver_failed", "insufficient_data"])
def test_results_without_material_are_consistent_too(
    failures: dict[str, CalibrationResult], tmp_path: Path, status: str
) -> None:
    write_report(tmp_path / "r.html", failures[status], title="t", source="s")
    page = (tmp_path / "r.html").read_text("utf-8")
    ids = set(re.findall(r'\bid="([^"]+)"', page))
    assert set(re.findall(r'href="#([^"]+)"', page)) <= ids
    assert "strip ok" not in page and "<dialog" not in page and "<script" not in page


def test_pages_stay_small(pages: dict[str, tuple[Path, str]]) -> None:
    assert all(path.stat().st_size < 3_000_000 for path, _ in pages.values())


def test_every_reason_of_rejection_has_its_sheet(pages: dict[str, tuple[Path, str]]) -> None:
    page = pages["run_with_rejections"][1]
    for reason, count in (("Does not fit the other motions", "2 motions"), ("No straight edges stand out", "1 motion")):
        sheet = re.search(rf"<h3>{reason} <small>(.*?)</small>.*?</article>", page, flags=re.DOTALL)
        assert sheet is not None and sheet.group(1).startswith(count)
        assert "s-refused" in sheet.group(0)  # the candidate that contradicts is drawn
    assert len(re.findall(r'<article class="sheet">', page)) == 2
