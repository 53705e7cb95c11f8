"""``trainctl new``: a control law of one's own, with everything around it that makes it run."""

from __future__ import annotations

import keyword
from pathlib import Path

from trainctl.errors import InputError

TEMPLATES = Path(__file__).with_name("templates")

#: Name of the law in the templates.
PLACEHOLDER = "my_law"


def controller(name: str, folder: Path) -> list[Path]:
    """Write a law, its scenario, its tests and a pyproject.toml.

    Parameters
    ----------
    name : str
        Name of the law, an identifier in lower case.
    folder : Path
        Where to; made if it does not exist, must be empty.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    InputError
        The name cannot be used, or the folder is not empty.
    """
    from trainctl.laws import laws

    found = []
    if not (name.isidentifier() and name.isascii() and name == name.lower()) or keyword.iskeyword(name):
        found.append(f"{name}: must be a Python identifier in lower case, e.g. my_law")
    elif name in laws():
        found.append(f"{name}: a law of this name exists already")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        found.append(f"{folder}: exists and is not an empty folder: choose another --out")
    if found:
        raise InputError(found)
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for template in sorted(p for p in TEMPLATES.iterdir() if p.is_file()):
        files.append(folder / template.name.replace(PLACEHOLDER, name))
        files[-1].write_text(template.read_text(encoding="utf-8").replace(PLACEHOLDER, name), encoding="utf-8")
    return files
