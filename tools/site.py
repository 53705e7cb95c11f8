"""Gather the pages, which lie beside what they explain, and build the site into build/site: python tools/site.py.

Pages keep their places, so that their links hold; other files they link to are copied beside them. The pages on the commands and on
the Python interface are written from the code, and notebooks become pages. Needs the extra ``site``.
"""

from __future__ import annotations

import importlib.util
import inspect
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
CONFIG = ROOT / "tools/mkdocs.yml"

#: Where no page is looked for.
ELSEWHERE = {".venv", "build", "runs", ".git", ".pytest_cache"}

LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#]+)(#[^)]*)?\)")
FENCE = re.compile(r"(^```.*?^```$)", re.S | re.M)


def pages() -> list[Path]:
    """All pages of the project, as paths within it."""
    found = (path.relative_to(ROOT) for path in ROOT.rglob("*.md"))
    return sorted(path for path in found if path.parts[0] not in ELSEWHERE and "node_modules" not in path.parts)


def notebooks() -> list[Path]:
    """All notebooks, as paths within the project."""
    return sorted(path.relative_to(ROOT) for path in (ROOT / "trainctl/notebooks").glob("*.ipynb"))


def cells(notebook: Path) -> Iterator[tuple[str, str]]:
    """Kind (code or markdown) and text of the cells of a notebook."""
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        yield cell["cell_type"], "".join(cell["source"])


def gather(place: Path) -> None:
    """Put everything the site is made of into a folder."""
    shutil.rmtree(place, ignore_errors=True)
    for page in pages():
        _put(place / page, _for_the_site((ROOT / page).read_text(encoding="utf-8"), page, place))
    for notebook in notebooks():
        parts = [f"```python\n{text}\n```" if kind == "code" else text for kind, text in cells(ROOT / notebook)]
        parts.append(f"This page is a notebook: [`{notebook.name}`]({notebook.name}).")
        _put(place / notebook.with_suffix(".md"), "\n\n".join(parts) + "\n")
        shutil.copy(ROOT / notebook, place / notebook)
    _put(place / "reference/commands.md", commands())
    _put(place / "reference/python.md", interface())


def _put(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _for_the_site(text: str, page: Path, place: Path) -> str:
    """A page as the generator needs it: lists within lists by four blanks, links to folders as words, linked files beside it."""

    def link(found: re.Match[str]) -> str:
        picture, words, target, anchor = found[1], found[2], found[3], found[4] or ""
        if "://" in target:
            return found[0]
        there = (ROOT / page.parent / target).resolve()
        if there.is_dir():
            return words
        if there.suffix != ".md":
            copy = place / there.relative_to(ROOT)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(there, copy)
        return f"{picture}[{words}]({target}{anchor})"

    parts = FENCE.split(text)
    for k in range(0, len(parts), 2):
        parts[k] = re.sub(r"^ +", lambda found: 2 * found[0], LINK.sub(link, parts[k]), flags=re.M)
    return "".join(parts)


def commands() -> str:
    """Every command with its arguments and options, as ``--help`` has them."""
    import typer

    from trainctl.cli import program

    def told(name: str, command: Any) -> Iterator[str]:
        if hasattr(command, "commands"):
            for inner in command.commands.values():
                yield from told(f"{name} {inner.name}", inner)
            return
        yield f"## `{name}`\n\n{inspect.cleandoc(command.help or '')}\n"
        rows = [(_words(parameter), (parameter.help or "").replace("|", "\\|")) for parameter in command.params]
        if rows:
            yield "| | |\n| --- | --- |\n" + "".join(f"| {words} | {meaning} |\n" for words, meaning in rows)

    codes = "Exit codes: 0 done, 1 a check failed, 2 bad input, 3 the run failed, 130 interrupted."
    return "\n".join([f"# Commands\n\nWritten from the code. {codes}\n", *told("trainctl", typer.main.get_command(program.app))])


def _words(parameter: Any) -> str:
    """How a parameter is typed."""
    if parameter.param_type_name == "argument":
        return f"`{parameter.metavar or parameter.name.upper()}`"
    return ", ".join(f"`{word}`" for word in (*parameter.opts, *parameter.secondary_opts))


def interface() -> str:
    """What ``import trainctl`` offers, with its docstrings."""
    import trainctl

    parts = ["# The Python interface\n\nWritten from the code.\n"]
    for name in trainctl.__all__:
        thing = getattr(trainctl, name)
        parts.append(f"## `{name}`\n\n{_docstring(thing)}\n")
        members = inspect.getmembers_static(thing) if inspect.isclass(thing) and thing.__module__.startswith("trainctl") else ()
        for member, value in members:
            if not member.startswith("_") and inspect.getdoc(value) and (callable(value) or isinstance(value, property)):
                parts.append(f"### `{name}.{member}`\n\n{_docstring(value)}\n")
    return "\n".join(parts)


def _docstring(thing: object) -> str:
    text = f"```text\n{inspect.getdoc(thing) or ''}\n```"
    try:
        return f"```python\n{getattr(thing, '__name__', '')}{inspect.signature(thing)}\n```\n\n{text}"  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return text


def build(place: Path) -> subprocess.CompletedProcess[str]:
    """Gather and build into ``place/pages`` and ``place/site``; every warning is an error."""
    gather(place / "pages")
    config = place / "mkdocs.yml"
    text = CONFIG.read_text(encoding="utf-8")
    for key, folder in (("docs_dir", "pages"), ("site_dir", "site")):
        text = re.sub(rf"^{key}: .*$", f"{key}: {place / folder}", text, flags=re.M)
    config.write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--config-file", str(config)]
    return subprocess.run(command, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True, check=False)


if __name__ == "__main__":
    if importlib.util.find_spec("mkdocs") is None:
        sys.exit("mkdocs is not installed: pip install trainctl[site]")
    done = build(ROOT / "build")
    print(done.stdout + done.stderr or f"{ROOT / 'build/site/index.html'}")
    sys.exit(done.returncode)
