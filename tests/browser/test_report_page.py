"""The page of a run in headless Chromium: nothing on the console, nothing fetched, everything there and alive."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from trainctl.report.page import report

sys.path.insert(0, str(Path(__file__).parent))
from driver import Browser

pytestmark = pytest.mark.browser

READY = "return document.documentElement.dataset.ready === 'yes'"


@pytest.fixture(scope="module")
def page(finished):
    return report(finished("three_tracks", "numeric"))


@pytest.fixture
def browser():
    with Browser() as chromium:
        yield chromium


def moved_to(browser, time):
    """Move the slider itself, as a hand would."""
    script = """
        const slider = document.getElementById('slider'), wanted = arguments[0];
        const film = JSON.parse(document.getElementById('data').textContent).animation;
        slider.value = film.time.indexOf(wanted); slider.dispatchEvent(new Event('input'));
        const rows = [...document.querySelectorAll('#rows tr')].map(row => [...row.children].map(cell => cell.textContent));
        return [document.getElementById('clock').textContent, Object.fromEntries(rows.map(([train, ...cells]) => [train, cells]))];
    """
    return browser.run(script, time)


def test_no_console_error_no_request_and_every_element(page, browser):
    browser.open(page)
    browser.until(READY)
    assert browser.complaints() == []
    assert [url for url in browser.requests() if not url.startswith(("file:", "data:", "blob:"))] == []
    plots = browser.run(
        "return [...document.querySelectorAll('.plot')].map(p => [p.id, p.querySelectorAll('svg.main-svg').length])"
    )
    assert {
        "plot-graph",
        "plot-speeds",
        "plot-spacing",
        "plot-inputs",
        "plot-forces",
        "plot-couplers",
        "plot-energy",
        "plot-events",
    } <= {p for p, _ in plots}
    assert all(count > 0 for _, count in plots)
    for name in ("theme", "view", "play", "slider", "bounds", "rows", "trains", "source"):
        assert browser.run(f"return document.getElementById('{name}') !== null"), name


def test_slider_at_1000_and_1001_shows_the_change(page, browser, tmp_path):
    browser.open(page)
    browser.until(READY)
    browser.run("document.getElementById('tracks').scrollIntoView()")
    pictures = []
    for time in (1000, 1001):
        told = moved_to(browser, time)
        browser.screenshot(tmp_path / f"{time}.png")
        pictures.append(browser.run("return document.getElementById('view').toDataURL()"))
        assert told[0] == f"{time} s"
        if time == 1000:
            assert told[1]["2"][0] == "track 1" and told[1]["5"][0] == "track 2"
            assert (told[1]["2"][3], told[1]["6"][3], told[1]["5"][3]) == ("1, 3", "4", "")
        else:
            assert told[1]["2"][0] == "crossover to track 3" and told[1]["5"][0] == "crossover to track 1"
            assert (told[1]["2"][3], told[1]["3"][3], told[1]["6"][3]) == ("", "1, 4", "5")
    assert pictures[0] != pictures[1]
    assert moved_to(browser, 1020)[1]["2"][0] == "track 3"
    assert browser.complaints() == []


def test_time_axes_are_linked_and_the_keyboard_works(page, browser):
    browser.open(page)
    browser.until(READY)
    browser.run("document.getElementById('plot-speeds').focus()")
    browser.press("+")
    spans = "return [...document.querySelectorAll('.draw')].map(d => d._fullLayout.xaxis.range.map(Math.round).join())"
    browser.until(f"const s = (() => {{ {spans} }})(); return new Set(s).size === 1 && s[0] === '600,1800'")
    browser.press("0")
    browser.until(f"const s = (() => {{ {spans} }})(); return new Set(s).size === 1 && s[0] === '0,2400'")
    browser.run("document.activeElement.blur()")
    browser.press("\ue014")  # right arrow
    assert browser.run("return document.getElementById('clock').textContent") == "1 s"
    browser.press(" ")
    browser.until("return parseFloat(document.getElementById('clock').textContent) > 60")
    browser.press(" ")
    assert browser.run("return document.getElementById('play').textContent") == "Play"
    assert browser.complaints() == []


def test_one_moment_stands_in_one_column_and_one_legend_rules_all_plots(page, browser):
    browser.open(page)
    browser.until(READY)
    columns = browser.run(
        "return [...document.querySelectorAll('.draw')].map(d => [d.offsetLeft + d._fullLayout.xaxis._offset, d._fullLayout.xaxis._length].map(Math.round).join())"
    )
    assert len(set(columns)) == 1
    assert browser.run("return [...document.querySelectorAll('.chip')].map(c => c.dataset.train).join()") == "1,2,3,4,5,6"
    drawn = """
        const p = arguments[0], data = JSON.parse(document.getElementById('data').textContent);
        const traces = data.panels.find(panel => panel.id === p).traces, full = document.querySelector(`#plot-${p} .draw`).data;
        return [...new Set(traces.filter((t, k) => t.group && full[k].visible !== false).map(t => t.group))].join();
    """
    browser.run("document.querySelector('.chip[data-train=\"3\"]').click()")
    for name in ("graph", "speeds", "inputs", "forces", "energy"):
        browser.until(f"return (function () {{ {drawn} }})('{name}') === '1,2,4,5,6'")
    browser.run("document.querySelector('.chip[data-train=\"5\"]').dispatchEvent(new MouseEvent('dblclick'))")
    browser.until(f"return (function () {{ {drawn} }})('errors') === '5'")
    browser.run("document.getElementById('everybody').click()")
    browser.until(f"return (function () {{ {drawn} }})('errors') === '2,3,4,5,6'")
    assert browser.complaints() == []


def test_a_small_map_stays_in_sight_while_plots_are_read(page, browser):
    browser.open(page)
    browser.until(READY)
    browser.run("document.getElementById('plot-inputs').scrollIntoView({block: 'end'})")
    seen = """
        const box = document.getElementById('mini').getBoundingClientRect();
        return box.top >= 0 && box.bottom <= innerHeight && box.height > 20;
    """
    browser.until(seen)
    picture = "return document.getElementById('mini').toDataURL()"
    before = browser.run(picture)
    moved_to(browser, 1001)
    assert browser.run(picture) != before
    assert browser.complaints() == []


def test_an_address_names_a_moment(page, browser):
    browser.open(page)
    browser.until(READY)
    browser.run("location.hash = '#t=1001'")
    browser.until("return document.getElementById('clock').textContent === '1001 s'")
    assert browser.run("return document.getElementById('moment').getAttribute('href')") == "#t=1001"


@pytest.mark.parametrize("dark", [False, True])
def test_follows_the_system_and_the_button(page, dark):
    background = "return getComputedStyle(document.body).backgroundColor"
    light, black = "rgb(255, 255, 255)", "rgb(20, 22, 26)"
    with Browser(dark=dark) as browser:
        browser.open(page)
        browser.until(READY)
        assert browser.run(background) == (black if dark else light)
        browser.run("document.getElementById('theme').click()")
        assert browser.run(background) == (light if dark else black)
        assert browser.complaints() == []


def test_a_million_rows_are_drawn_and_moved_quickly(tmp_path):
    sys.path.insert(0, str(Path(__file__).parents[1] / "unit" / "report"))
    from test_report import made_up

    page = report(made_up(tmp_path / "run", 250, 4000))
    with Browser() as browser:
        browser.open(page)
        browser.until(READY, 120.0)
        took = browser.run("""
            const took = [], slider = document.getElementById('slider');
            for (let k = 0; k < slider.max; k += 7) {
                const begun = performance.now();
                slider.value = k; slider.dispatchEvent(new Event('input'));
                took.push(performance.now() - begun);
            }
            return took.sort((a, b) => a - b);
        """)
        assert took[len(took) // 2] < 50.0  # ms; the median, as others may use the machine
        assert browser.complaints() == []


def test_trains_that_come_and_go_are_drawn_on_their_net(finished, browser):
    done = finished("merging")
    browser.open(report(done))
    browser.until(READY)
    stopped = next(e["time_s"] for e in done.events if e["kind"] == "stop_reached")
    pictures = []
    for time in (0.0, stopped):
        told = moved_to(browser, time)
        pictures.append(browser.run("return document.getElementById('view').toDataURL()"))
        assert told[0] == f"{time:g} s"
    assert pictures[0] != pictures[1]
    assert (told[1]["stopping"][0], told[1]["stopping"][2]) == ("trunk", "0.00")
    assert browser.complaints() == []


def test_a_page_without_animation_is_alive(browser, tmp_path):
    from trainctl.runner import run
    from trainctl.scenario.build import open_scenario

    done = run(open_scenario("merging", {"run.duration_s": 96}), tmp_path / "r", "numeric")
    browser.open(report(done))
    browser.until(READY)
    assert browser.run("return document.getElementById('view').offsetParent") is None
    browser.run("document.querySelector('button.link').click()")
    browser.press(" ")
    assert browser.run("return document.querySelectorAll('.plot').length") >= 4
    assert browser.complaints() == []


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [390, 800, 1280])
def test_nothing_lies_on_anything_else_and_everything_fits(page, width, dark):
    """What a reader of the page stumbled on: tools over bounds, names over names, columns beyond their box, keys too small to hit."""
    with Browser(1280, 900, dark) as browser:
        browser.narrow(width, 844)
        browser.open(page)
        browser.until(READY)
        assert browser.run("return document.documentElement.scrollWidth") == width
        tools = browser.run("""
            return [...document.querySelectorAll('.plot')].map(p => {
                const bar = p.querySelector('.modebar'), words = [...p.querySelectorAll('.annotation text')].map(w => w.getBoundingClientRect());
                const box = bar.getBoundingClientRect(), floor = p.querySelector('.draw')._fullLayout._size.t;
                return [p.id, box.bottom - p.querySelector('.draw').getBoundingClientRect().top - floor, words.filter(w => w.top < box.bottom - 1 && w.right > box.left).length];
            })""")
        assert [(name, over) for name, over, _ in tools if over > 0] == []
        assert [(name, words) for name, _, words in tools if words] == []
        places = browser.run(
            "return [...document.querySelectorAll('#plot-graph .annotation text')].map(t => t.getBoundingClientRect()).map(r => [r.top, r.bottom])"
        )
        (first, second) = sorted(places)
        assert second[0] >= first[1] - 2, "names of places"
        assert browser.run("const t = document.querySelector('.states'); return t.scrollWidth <= t.clientWidth")
        sizes = browser.run(
            "return [...document.querySelectorAll('button:not(.link), select')].map(b => b.getBoundingClientRect().height)"
        )
        assert min(sizes) >= 24
        units = browser.run("return [...document.querySelectorAll('.plot h3 .unit')].filter(u => u.offsetWidth > 0).length")
        assert (units > 0) == (width == 390), "the unit stands at the axis, or in the title where there is no room"
