"""The site: every page is in it, it is built without a warning, and its notebooks run."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path

import matplotlib
import pytest
import yaml

ROOT = Path(__file__).parents[3]


def load():
    spec = importlib.util.spec_from_file_location("site_of_the_pages", ROOT / "tools/site.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


site = load()


def named(nav) -> list[str]:
    """Paths in a navigation."""
    if isinstance(nav, str):
        return [nav]
    return [path for item in (nav if isinstance(nav, list) else nav.values()) for path in named(item)]


def test_every_page_and_notebook_is_in_the_navigation():
    there = {str(page) for page in site.pages()} | {str(book.with_suffix(".md")) for book in site.notebooks()}
    assert there | {"reference/commands.md", "reference/python.md"} == set(named(yaml.safe_load(site.CONFIG.read_text())["nav"]))


def test_the_site_is_built_without_a_warning_and_loads_nothing_from_elsewhere(tmp_path):
    done = site.build(tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    built = list((tmp_path / "site").rglob("*.html"))
    assert len(built) >= len(site.pages()) + len(site.notebooks()) + 2
    for page in built:
        loaded = re.findall(
            r"<(?:script|img|iframe)[^>]*\ssrc=[\"']?([^\"'\s>]+)|<link[^>]*rel=[\"']?stylesheet[^>]*href=[\"']?([^\"'\s>]+)",
            page.read_text(),
        )
        assert not [one for pair in loaded for one in pair if one.startswith(("http", "//"))], page
    start = (tmp_path / "site/index.html").read_text()
    assert "scenarios/three_tracks.png" in start and "trainctl/INSTALL.html" in start


def test_a_page_is_made_fit_for_the_generator_and_its_code_stays(tmp_path):
    """Lists within lists, links to folders, files beside it."""
    page = "- a\n  - b, [plants](plants), [file](loop.py)\n\n```toml\n  x = [1](2)\n```\n"
    made = site._for_the_site(page, Path("trainctl/README.md"), tmp_path)
    assert made == "- a\n    - b, plants, [file](loop.py)\n\n```toml\n  x = [1](2)\n```\n"
    assert (tmp_path / "trainctl/loop.py").exists()


def test_commands_and_interface_come_from_the_code():
    commands, interface = site.commands(), site.interface()
    assert "## `trainctl golden make`" in commands and "`--checkpoint-every`" in commands
    assert "## `Simulation`" in interface and "### `Simulation.step`" in interface


@pytest.mark.parametrize("notebook", site.notebooks(), ids=lambda path: path.stem)
def test_the_notebook_runs_from_top_to_bottom(notebook, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "notebook"}
    with matplotlib.rc_context({"backend": "agg"}):
        for number, (kind, text) in enumerate(site.cells(ROOT / notebook)):
            if kind == "code":
                exec(compile(text, f"{notebook} cell {number}", "exec"), names)


@pytest.mark.parametrize("notebook", site.notebooks(), ids=lambda path: path.stem)
def test_a_notebook_has_no_output(notebook):
    book = json.loads((ROOT / notebook).read_text())
    assert book["nbformat"] == 4 and all(not cell.get("outputs") and cell.get("execution_count") is None for cell in book["cells"])


def test_every_picture_of_the_gallery_is_there_and_small_and_drawn_by_its_commands():
    spec = importlib.util.spec_from_file_location("gallery", ROOT / "tools/gallery.py")
    gallery = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(gallery)
    text = gallery.PAGE.read_text()
    drawn = gallery.pictures(text)
    assert len(drawn) == len(list(gallery.PAGE.parent.glob("*.png"))) >= 5
    for run, figure in drawn:
        assert 5_000 < (gallery.PAGE.parent / f"{run}-{figure}.png").stat().st_size < 120_000
        assert any(
            line.startswith(f"trainctl run {run}") for line in gallery.commands(text)
        ) and f"trainctl plot runs/{run}" in gallery.commands(text)
