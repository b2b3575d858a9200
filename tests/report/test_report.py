"""The page says what the result says, loads nothing, escapes everything and is whole or absent."""

import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from rmis_calib.errors import InputError, OutputError, ShapeError
from rmis_calib.geometry.rigid import RigidTransform
from rmis_calib.report import Mark, Overlay, ReportMaterial, write_report
from rmis_calib.report.detection_pictures import write_picture
from rmis_calib.report.drawing.rejections import RejectionSheet
from rmis_calib.results import CalibrationResult, EndCounts, Motions, ShaftEnds

VOID = {"meta", "img", "br", "link", "input", "hr"}
MakeResult = Callable[..., CalibrationResult]


class Page(HTMLParser):
    """Reads a page strictly: every element is closed, ids are unique, and no attribute leads outside."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.elements: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []
        assert len(self.ids) == len(set(self.ids))
        assert all(reference.startswith(("#", "data:image/jpeg;base64,")) for reference in self.references)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append(tag)
        values = dict(attrs)
        self.ids += [value for name, value in attrs if name == "id" and value]
        self.references += [values[name] or "" for name in ("src", "href", "xlink:href", "srcset") if name in values]
        assert not any(name.startswith("on") for name in values)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not {"style", "script"} & set(self.open):
            self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))


@pytest.fixture
def page_of(tmp_path: Path) -> Callable[..., Page]:
    def write_and_read(result: CalibrationResult, material: ReportMaterial | None = None, **texts: object) -> Page:
        path = tmp_path / "report.html"
        write_report(path, result, material, **({"title": "A recording", "source": "folder"} | texts))  # type: ignore[arg-type]
        raw = path.read_text(encoding="utf-8")
        assert not [at for at in re.findall(r"https?:[^ \"']*", raw) if at != "http://www.w3.org/2000/svg"]
        assert "@import" not in raw
        assert re.findall(r"url\((?!#)", raw) == []
        return Page(raw)

    return write_and_read


def overlay(width: int = 64, height: int = 48, used: bool = True, caption: str = "both edges found") -> Overlay:
    image = np.full((height, width, 3), (200, 30, 60), dtype=np.uint8)
    marks = (Mark("refused", np.array([[1.0, 2.0], [30.0, 40.0]]), caption), Mark("end", np.array([[7.0, 9.0]])))
    return Overlay(frame=17, camera="left", image=image, caption=caption, used=used, marks=marks)


def test_page_states_the_answer_with_frames_units_and_uncertainty(
    result_with: MakeResult, page_of: Callable[..., Page]
) -> None:
    page = page_of(result_with(), notes={"Error against truth": "0.041 deg"})
    assert "Trustworthy" in page.text and "Research software, not a medical device." in page.text
    assert "Maps coordinates in arm to coordinates in camera_right" in page.text
    assert "-38.214" in page.text
    assert "camera_left_T_arm" in page.text and "arm_T_camera_right" in page.text
    assert "0.041 deg" in page.text
    assert "56 of 60" in page.text and "0.24 mm" in page.text
    assert "shaft_radius" in page.text and "4.011" in page.text


def test_page_states_where_the_shaft_ends(result_with: MakeResult, page_of: Callable[..., Page]) -> None:
    ends = ShaftEnds({"ring": EndCounts(30, 2, 1)}, gap_mm=9.03, gap_sigma_mm=0.06, not_measured={"hidden": 5})
    text = page_of(result_with(ends=ends)).text
    assert "ring that closes it" in text and "second place lies 9.030 ± 0.060 mm beyond the first one" in text
    assert "Not measured: something covers the end (5)." in text
    assert "Where the shaft's end was measured" not in page_of(result_with(ends=None)).text


def test_per_axis_sigmas_are_the_roots_of_the_diagonal(result_with: MakeResult, page_of: Callable[..., Page]) -> None:
    # 1 mrad = 0.0573 deg; root of the trace of (1, 2, 2) mrad is 3 mrad = 0.1719 deg; (0.3, 0.4, 1.2) mm gives 1.3 mm.
    covariance = np.diag(np.array([1e-3, 2e-3, 2e-3, 0.3, 0.4, 1.2]) ** 2)
    text = page_of(result_with(covariance=covariance)).text
    assert "0.17 deg" in text and "1.3 mm" in text
    assert "x, right 0.057 0.30" in text and "y, down 0.11 0.40" in text and "z, forward 0.11 1.2" in text


def test_block_to_copy_is_python_that_gives_the_transform_back(result_with: MakeResult, tmp_path: Path) -> None:
    result = result_with()
    write_report(tmp_path / "report.html", result, title="t", source="s")
    page = (tmp_path / "report.html").read_text("utf-8")
    blocks = re.findall(r'<pre class="copy">(.*?)</pre>', page, flags=re.DOTALL)
    assert len(blocks) == 2
    there: dict[str, list[float]] = {}
    back: dict[str, list[float]] = {}
    exec(blocks[0], {}, there)
    exec(blocks[1], {}, back)
    expected = result.camera_right_T_arm
    assert expected is not None
    # nine decimals are printed
    np.testing.assert_allclose(there["camera_right_T_arm"], expected.matrix.numpy(), atol=1e-9)
    np.testing.assert_allclose(there["quat_wxyz"], expected.quat_wxyz.numpy(), atol=1e-9)
    np.testing.assert_allclose(there["translation_mm"], expected.t.numpy(), atol=1e-6)
    both = np.array(there["camera_right_T_arm"]) @ np.array(back["arm_T_camera_right"])
    np.testing.assert_allclose(both, np.eye(4), atol=1e-6)


@pytest.mark.parametrize(
    ("status", "words"),
    [
        ("weak", ("Weak: do not rely on it", "Not for use", "13.9 deg: too loose")),
        (
            "unobservable",
            ("Not observable: do not use", "No covariance was computed", "One camera only", "not bounded"),
        ),
        ("solver_failed", ("No solution", "There is no transform to report", "no estimate was reached")),
        ("insufficient_data", ("Not enough data", "0 of 3 motions were usable", "no dark region")),
    ],
)
def test_failed_results_are_shown_as_failed(
    failures: dict[str, CalibrationResult], page_of: Callable[..., Page], status: str, words: tuple[str, ...]
) -> None:
    page = page_of(failures[status])
    assert "Trustworthy" not in page.text and "To copy" not in page.text
    for expected in words:
        assert expected in page.text


def test_unknown_numbers_read_unknown_and_never_nan(result_with: MakeResult, page_of: Callable[..., Page]) -> None:
    broken = np.diag([np.nan, -1.0, 1e-6, np.inf, 0.01, 0.01])
    nothing = {"unit": "px", "median": None, "rms": None, "by_motion": [None] * 60}
    result = result_with(
        covariance=broken,
        residuals={"contour_right": nothing},
        nuisances={"offset": {"value": None, "sigma": np.nan, "unit": "mm"}},
    )
    text = page_of(result).text
    assert "unknown" in text
    assert re.search(r"\b(nan|inf|None)\b", text, flags=re.IGNORECASE) is None


def test_every_text_is_escaped(result_with: MakeResult, page_of: Callable[..., Page]) -> None:
    hostile = '"><script>alert(1)</script><img src=x onerror=alert(1)>'
    pose = result_with().camera_right_T_arm
    assert pose is not None
    result = result_with(
        message=hostile,
        camera_right_T_arm=RigidTransform("camera_right", hostile, pose.matrix),
        observability={key: [hostile] for key in ("sentences", "named_cases", "advice")}
        | {
            "directions": [{"words": hostile, "sigma_at_working_point_mm": 1.0}],
        },
        motions=Motions(np.array([True, False]), ("", hostile)),
        residuals={hostile: {"unit": hostile, "median": 1.0, "rms": 1.0, "by_motion": [1.0, -2.0]}},
        nuisances={hostile: {"value": 1.0, "sigma": 1.0, "unit": hostile}},
        head_point_error_px={hostile: {"median": 1.0, "rms": 1.0, "max": 1.0, "count": 1}},
        config={hostile: hostile},
        versions={hostile: hostile},
    )
    material = ReportMaterial(
        worst=(overlay(used=False, caption=hostile),), sheets=(RejectionSheet(hostile, 1, (overlay(caption=hostile),)),)
    )
    page = page_of(result, material, title=hostile, source=hostile, notes={hostile: hostile})
    assert page.elements.count("script") == 1  # the page's own
    assert page.elements.count("img") == 0 and page.elements.count("image") == 2
    assert page.text.count("<script>alert(1)</script>") > 15


def test_recordings_longer_than_the_page_are_grouped(result_with: MakeResult, page_of: Callable[..., Page]) -> None:
    n = 20_000
    rng = np.random.default_rng(0)
    used = rng.random(n) > 0.1
    values = np.where(used, rng.normal(size=n), np.nan)
    result = result_with(
        motions=Motions(used, tuple("" if one else "no dark region" for one in used), np.arange(n) / 30.0),
        residuals={"end_right": {"unit": "px", "median": 0.67, "rms": 1.0, "by_motion": values}},
    )
    page = page_of(result)
    assert page.elements.count("i") == 240
    assert "each mark: up to 84 motions" in page.text
    assert f"and {int((~used).sum()) - 500} more" in page.text


def test_no_motion_at_all(result_with: MakeResult, page_of: Callable[..., Page]) -> None:
    text = page_of(
        result_with(status="insufficient_data", motions=Motions(np.zeros(0, dtype=bool), ()), residuals={})
    ).text
    assert "There were no motions." in text


def test_wide_pictures_are_scaled_with_their_marks_and_narrow_ones_kept(
    result_with: MakeResult, tmp_path: Path
) -> None:
    material = ReportMaterial(worst=(overlay(1440, 810), overlay(64, 48)))
    write_report(tmp_path / "r.html", result_with(), material, title="t", source="s")
    page = (tmp_path / "r.html").read_text("utf-8")
    assert re.findall(r'<image href="[^"]*" width="(\d+)" height="(\d+)"', page) == [("720", "405"), ("64", "48")]
    # Pixel (1, 2) is centred at (1.5, 2.5) of an SVG, at half of that in the smaller picture.
    assert re.findall(r'points="0.8,1.2 15.2,20.2 "', page) and re.findall(r'points="1.5,2.5 30.5,40.5 "', page)


def test_same_result_gives_the_same_page(result_with: MakeResult, tmp_path: Path) -> None:
    for name in ("a.html", "b.html"):
        write_report(tmp_path / name, result_with(), ReportMaterial(worst=(overlay(),)), title="t", source="s")
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_marks_are_drawn_into_a_copy_of_the_picture() -> None:
    plain = overlay(200, 150)
    drawn = plain.drawn()
    assert (plain.image == (200, 30, 60)).all()
    # half-way along the refused line from (1, 2) to (30, 40), smoothed at its border
    assert np.abs(drawn[21, 15].astype(int) - (255, 64, 129)).max() < 40
    assert not (drawn[9, 5:12] == (200, 30, 60)).all()


def test_overlays_that_are_not_pictures_are_refused() -> None:
    with pytest.raises(ShapeError, match="uint8 RGB"):
        Overlay(frame=0, camera="right", image=np.zeros((4, 4)), caption="", used=True)
    with pytest.raises(InputError, match='"right" or "left"'):
        Overlay(frame=0, camera="top", image=overlay().image, caption="", used=True)


def test_nothing_is_left_or_replaced_when_writing_fails(
    result_with: MakeResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "report.html"
    write_report(target, result_with(), title="the old page", source="s")
    old = target.read_text(encoding="utf-8")

    def full_disk(*_args: object, **_kwargs: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full_disk)
    with pytest.raises(OutputError, match="No space left"):
        write_report(target, result_with(), title="t", source="s")
    monkeypatch.undo()
    assert target.read_text(encoding="utf-8") == old
    assert list(tmp_path.iterdir()) == [target]


def test_a_picture_that_cannot_be_written_says_why(tmp_path: Path) -> None:
    picture = np.zeros((8, 8, 3), dtype=np.uint8)
    with pytest.raises(OutputError, match=r"expected a place that can be written, found No such file"):
        write_picture(tmp_path / "absent" / "overlay.jpg", picture)


def test_absent_folder_is_an_output_error(result_with: MakeResult, tmp_path: Path) -> None:
    with pytest.raises(OutputError):
        write_report(tmp_path / "absent" / "report.html", result_with(), title="t", source="s")
