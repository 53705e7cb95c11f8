"""The page of a comparison in headless Chromium: nothing on the console, nothing fetched, curves drawn, the cursor says values."""

from __future__ import annotations

import sys
from pathlib import Path

import mutations
import pytest

from trainctl.diff.page import page
from trainctl.diff.runs import diff
from trainctl.diff.tolerance import parse_tolerances

sys.path.insert(0, str(Path(__file__).parent))
from driver import Browser

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def written(finished, tmp_path_factory):
    place, frame = tmp_path_factory.mktemp("pages"), mutations.read(finished("merging").folder)
    other = mutations.one_late_one_missing(frame, 20.0)
    a, b = mutations.write(frame, place / "a.xml"), mutations.write(other, place / "<b>&.xml")
    told = parse_tolerances({"absolute": 1.0, "time_s": 5.0})
    (place / "page.html").write_text(page(diff(a, b, told)), encoding="utf-8")
    how = {"run.duration_s": 40}
    runs = [finished("three_tracks", "numeric", **how, **{"controller.eta": eta}) for eta in ("own_speed", "printed")]
    (place / "runs.html").write_text(page(diff(*(run.folder for run in runs))), encoding="utf-8")
    (place / "same.html").write_text(page(diff(a, a)), encoding="utf-8")
    return place


@pytest.mark.parametrize("dark", [False, True])
def test_no_console_error_no_request_and_every_curve(written, dark, tmp_path):
    with Browser(dark=dark) as browser:
        browser.open(written / "page.html")
        browser.until("return document.documentElement.dataset.ready === 'yes'")
        assert browser.complaints() == []
        assert [url for url in browser.requests() if not url.startswith(("file:", "data:"))] == []
        plots = browser.run(
            "return [...document.querySelectorAll('svg')].map(s => ['a', 'b', 'tube'].map(c =>"
            " { const box = s.querySelector('path.' + c).getBBox(); return box.width > 100 && box.height >= 0; }))"
        )
        assert plots
        assert all(all(drawn) for drawn in plots)
        assert browser.run("return document.body.scrollWidth <= window.innerWidth")
        browser.screenshot(tmp_path / "page.png")


@pytest.mark.parametrize("name", ["page", "runs"])
def test_numbers_stay_readable_on_a_small_screen(written, name):
    with Browser(width=500) as browser:
        browser.open(written / f"{name}.html")
        browser.until("return document.documentElement.dataset.ready === 'yes'")
        assert browser.run("return document.documentElement.scrollWidth <= window.innerWidth")
        sizes = browser.run(
            "return [...document.querySelectorAll('svg')].map(s => s.getBoundingClientRect().width / s.viewBox.baseVal.width)"
        )
        assert sizes
        assert min(sizes) * 11 > 8.5  # letters [px]


def test_the_cursor_says_both_values_and_the_tube(written):
    with Browser() as browser:
        browser.open(written / "page.html")
        told = browser.run("""
            const svg = document.querySelector('svg'), box = svg.getBoundingClientRect();
            svg.dispatchEvent(new PointerEvent('pointermove', {clientX: box.left + box.width / 2, clientY: box.top + 20}));
            return svg.closest('figure').querySelector('output').textContent;
        """)
        assert "A " in told
        assert ", B " in told
        assert " .. " in told
        assert browser.complaints() == []


def test_a_page_without_findings(written):
    with Browser() as browser:
        browser.open(written / "same.html")
        browser.until("return document.documentElement.dataset.ready === 'yes'")
        assert "No difference in 5143 rows" in browser.run("return document.body.textContent")
        assert browser.complaints() == []
