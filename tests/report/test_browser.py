"""The page in a browser: it prints on four sheets, its scene turns, its pictures open; skipped without a browser."""

import html
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="no chromium to look with")]
MOST_SHEETS = 4


def browse(page: Path, *options: str) -> str:
    profile = f"--user-data-dir={page.parent / 'profile'}"
    command = [str(CHROMIUM), "--headless=new", "--no-sandbox", "--disable-gpu", profile, *options, page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout


def page_that(tmp_path: Path, written: str, script: str, *options: str) -> str:
    """The report after a script ran in it, as the browser writes it down."""
    page = tmp_path / "report.html"
    page.write_text(written.replace("</body>", f"<script>{script}</script></body>"), "utf-8")
    return browse(page, "--virtual-time-budget=2000", "--dump-dom", *options)


@pytest.mark.parametrize("name", ["rendered_run", "run_with_rejections", "refused_run"])
def test_it_prints_on_four_sheets(pages: dict[str, tuple[Path, str]], name: str, tmp_path: Path) -> None:
    browse(pages[name][0], f"--print-to-pdf={tmp_path / 'report.pdf'}", "--no-pdf-header-footer")
    sheets = re.findall(rb"/Type\s*/Page\b(?!s)", (tmp_path / "report.pdf").read_bytes())
    assert 1 <= len(sheets) <= MOST_SHEETS


def shapes_of(dom: str) -> list[tuple[str, np.ndarray]]:
    """Class and points of every shape of the scene, in the order in which they are drawn."""
    scene = re.search(r'<svg id="scene-view".*?</svg>', dom, flags=re.DOTALL)
    assert scene is not None
    found = []
    for kind, points in re.findall(r'<poly(?:line|gon) class="([^"]*)" points="([^"]*)"', scene.group(0)):
        found.append((kind, np.array([[float(x) for x in pair.split(",")] for pair in points.split()])))
    return found


def test_the_script_draws_what_the_page_was_written_with(pages: dict[str, tuple[Path, str]], tmp_path: Path) -> None:
    page = pages["rendered_run"][1]
    dom = page_that(tmp_path, page, "")
    drawn, written = shapes_of(dom), shapes_of(page)
    assert 'class="scene-bar" hidden' in page and 'class="scene-bar" hidden' not in dom
    assert [kind for kind, _ in drawn] == [kind for kind, _ in written] and len(drawn) > 8
    for (kind, mine), (_, first) in zip(drawn, written, strict=True):
        if kind.startswith("o-"):  # an ellipse may begin at another point: compare its box
            assert np.allclose([mine.min(0), mine.max(0)], [first.min(0), first.max(0)], atol=0.6)
        else:
            assert np.allclose(mine, first, atol=0.11)  # one decimal is written
    labels = [re.findall(r"<text [^>]*>(?:camera|base|RCM|arm|head)[^<]*</text>", text) for text in (dom, page)]
    assert len(labels[0]) == 6
    places = [[re.findall(r' (d[xy]|text-anchor)="([^"]*)"', label) for label in found] for found in labels]
    assert places[0] == places[1]


@pytest.mark.parametrize(("window", "size"), [("--window-size=1280,900", "15px"), ("--window-size=500,900", "30px")])
def test_no_view_of_the_scene_has_labels_on_each_other(
    pages: dict[str, tuple[Path, str]], tmp_path: Path, window: str, size: str
) -> None:
    """As the browser measures its own letters, turned all around and from near and far."""
    script = """
    const s = document.getElementById('scene-view'), met = new Set();
    const press = (key) => s.dispatchEvent(new KeyboardEvent('keydown', { key }));
    let views = 0;
    const look = () => {
      const texts = [...s.querySelectorAll('text')], boxes = texts.map((text) => text.getBBox());
      views += boxes.length > 1;
      boxes.forEach((a, i) => boxes.slice(0, i).forEach((b, k) => {
        // A box has the font's whole line: letters are at most from 0.15 below its top to 0.05 above its end.
        const gap = 0.2 * Math.min(a.height, b.height);
        if (a.x < b.x + b.width && b.x < a.x + a.width && a.y + gap < b.y + b.height && b.y + gap < a.y + a.height)
          met.add(texts[i].textContent + ' on ' + texts[k].textContent);
      }));
    };
    for (const zooms of ['', '+++', '---', '----------']) {
      press('0'); [...zooms].forEach(press);
      for (let turn = 0; turn < 63; turn += 1) { press('ArrowLeft'); if (turn % 9 == 0) press('ArrowUp'); look(); }
    }
    const size = getComputedStyle(s.querySelector('text')).fontSize;
    document.body.dataset.looked = [views, size, ...met].join('; ');
    """
    dom = page_that(tmp_path, pages["rendered_run"][1], script, window)
    looked = re.search(r'data-looked="([^"]*)"', dom)
    assert looked is not None and looked.group(1) == f"252; {size}"


def test_the_scene_turns_and_steps_and_a_picture_opens(pages: dict[str, tuple[Path, str]], tmp_path: Path) -> None:
    page = pages["rendered_run"][1]
    script = (
        # A pointer that the browser did not make cannot be captured.
        "Element.prototype.setPointerCapture = () => {}; const s = document.getElementById('scene-view');"
        "for (const [name, x] of [['pointerdown', 100], ['pointermove', 300], ['pointerup', 300]])"
        " s.dispatchEvent(new PointerEvent(name, {pointerId: 1, clientX: x, clientY: 200, isPrimary: true}));"
        "const m = document.getElementById('scene-motion'); m.value = 7; m.dispatchEvent(new Event('input'));"
        "document.querySelectorAll('button.enlarge')[1].click();"
        "document.querySelector('[data-zoom=in]').click(); document.querySelector('[data-zoom=lines]').click();"
    )
    dom = page_that(tmp_path, page, script)
    turned, before = dict(shapes_of(dom)), dict(shapes_of(page))
    assert not np.allclose(turned["l-shaft"], before["l-shaft"], atol=5.0)
    upright = [shapes["l-axis-z"][1] - shapes["l-axis-z"][0] for shapes in (turned, before)]
    assert np.allclose(*upright, atol=0.3)  # turned about base's z, seen from the same height
    assert "frame 7," in dom
    dialog = re.search(r'<dialog id="zoom".*?</dialog>', dom, flags=re.DOTALL)
    assert dialog is not None and "open" in dialog.group(0).split(">")[0]
    assert re.search(r"2 of \d+\. Frame", html.unescape(dialog.group(0)))
    box = re.search(r'viewBox="([^"]*)"', dialog.group(0))
    assert box is not None  # the middle of a picture of 640 x 480, 1.5 times as large
    assert np.allclose(
        [float(value) for value in box.group(1).split()], [640 / 6, 480 / 6, 640 / 1.5, 480 / 1.5], atol=0.1
    )
    assert 'class="zoom-view no-lines"' in dialog.group(0)
