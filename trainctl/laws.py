"""The modules a scenario names: laws of ours, of other packages or in a file, observers and plants."""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import importlib.util
import pkgutil
import re
import sys
import traceback
from functools import cache, partial
from pathlib import Path
from types import ModuleType
from typing import Any

from trainctl import controllers, observers, plants
from trainctl.errors import InputError

#: Where other packages offer their laws.
ENTRY_POINTS = "trainctl.controllers"


def laws() -> list[str]:
    """Names of the laws that come with the package and of those other packages offer."""
    own = [name for name in _inside(controllers) if hasattr(_module(controllers, name), "CLOCK")]
    return sorted({*own, *(e.name for e in importlib.metadata.entry_points(group=ENTRY_POINTS))})


def shipped(name: str) -> Any:
    """The module of a law that comes with the package, or None."""
    if name not in _inside(controllers):
        return None
    module = _module(controllers, name)
    return module if hasattr(module, "CLOCK") else None


def compared() -> dict[str, Any]:
    """Rows of a comparison -> the module of their law: the package's own, sampled ones first, SUMO's trains last."""
    modules = [_module(controllers, name) for name in _inside(controllers)]
    found = [module for clock in ("sampled", "continuous", "none") for module in modules if getattr(module, "CLOCK", "") == clock]
    return {row: module for module in found for row in getattr(module, "COMPARED", ())}


@cache
def _inside(package: Any) -> tuple[str, ...]:
    """Names of the modules in a package of ours: looked up once, for sweeps open thousands of scenarios."""
    return tuple(m.name for m in pkgutil.iter_modules(package.__path__))


def _module(package: Any, name: str) -> Any:
    return importlib.import_module(f"{package.__name__}.{name}")


def find_law(name: str, folder: Path = Path()) -> Any:
    """The module of a law: one of ours, an entry point of another package, or a file.

    Parameters
    ----------
    name : str
        Name, or the path of a file ending in .py.
    folder : Path
        Where a relative path starts; if there is no such file, it starts in the current directory.

    Raises
    ------
    InputError
        No such law, it cannot be imported, or it lacks something a law must have.
    """
    if name.endswith(".py"):
        file = folder / name if (folder / name).is_file() else Path(name)
        if not file.is_file():
            raise InputError(f"controller.law = {name}: no such file")
        return _complete(name, partial(_law_file, file))
    if (module := shipped(name)) is not None:
        return module
    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS, name=name):
        return _complete(name, entry.load)
    raise InputError(f"controller.law = {name}: no such law; known: {', '.join(laws())}")


def _law_file(file: Path) -> Any:
    """A law's file as a module with its text as ``SOURCE``; the same module as before if that has not changed."""
    place, source = file.resolve(), file.read_bytes()
    digest = hashlib.sha256(str(place).encode()).hexdigest()[:16]  # another file of the same name is another module
    name = re.sub(r"\W", "_", f"trainctl_law_{file.stem}_{digest}")
    known = sys.modules.get(name)
    if known is not None and source == known.SOURCE:
        return known
    spec = importlib.util.spec_from_file_location(name, place)
    assert spec is not None
    module: Any = importlib.util.module_from_spec(spec)
    module.SOURCE = source
    sys.modules[name] = module  # pydantic looks annotations up there
    try:
        exec(compile(source, place, "exec"), module.__dict__)
    except BaseException:
        del sys.modules[name]
        raise
    return module


#: What a module must have to be a law, by its clock.
PARTS = {
    "sampled": ("Params", "violations", "constants", "message", "demand"),
    "continuous": ("ORDER", "MESSAGE", "WATCHED", "Params", "violations", "constants", "message", "demand", "watch"),
}


def _complete(name: str, load: Any) -> Any:
    """A law from elsewhere, if it can be imported and has all its parts."""
    try:
        module = load()
    except Exception as error:  # whatever a module from elsewhere raises
        lines = traceback.extract_tb(error.__traceback__)
        where = f" (line {error.lineno})" if isinstance(error, SyntaxError) else f" ({lines[-1].name}, line {lines[-1].lineno})"
        raise InputError(f"controller.law = {name}: cannot be imported: {type(error).__name__}: {error}{where}") from None
    if not isinstance(module, ModuleType):
        raise InputError(f"controller.law = {name}: is a {type(module).__name__}: a law must be a module")
    clock = getattr(module, "CLOCK", None)
    if clock not in PARTS:
        raise InputError(f'controller.law = {name}: CLOCK = {clock!r}: must be "sampled" or "continuous"')
    needed = PARTS[clock] + (("watched_bounds",) if clock == "continuous" and getattr(module, "WATCHED", ()) else ())
    missing = [part for part in needed if not hasattr(module, part)]
    if missing:
        raise InputError(f"controller.law = {name}: a {clock} law needs {', '.join(missing)}")
    return module


def find_observer(name: str) -> Any:
    """The module of an observer."""
    known = _inside(observers)
    if name not in known:
        raise InputError(f"observer.kind = {name}: no such observer; known: {', '.join(known)}")
    return _module(observers, name)


def find_plant(name: str) -> Any:
    """The module of a plant; other modules of the folder are not one."""
    known = _plants()
    if name not in known:
        raise InputError(f"plant.kind = {name}: no such plant; known: {', '.join(known)}")
    return _module(plants, name)


def _plants() -> list[str]:
    return [name for name in _inside(plants) if hasattr(_module(plants, name), "relied_on")]


def moves_points(name: str) -> bool:
    """Whether a plant moves trains as points; of one that does not exist nothing is said here."""
    return name in _plants() and not find_plant(name).UNITS


def plants_of(law: Any) -> tuple[str, ...]:
    """Plants a law runs on; one that does not say runs on those without actuators of their own."""
    usual = ("coupled_units",) if law.CLOCK == "continuous" else ("point", "coupled_units")
    return tuple(getattr(law, "PLANTS", usual))


def unfit(law: Any, name: str, plant: str, observer: str) -> list[str]:
    """Plant or observer that this law does not go with."""
    found = []
    if plant not in plants_of(law):
        found.append(f"plant.kind = {plant}: law {name} runs on {', '.join(plants_of(law))}")
    known = getattr(law, "OBSERVERS", ("none",))
    if observer not in known:
        found.append(f"observer.kind = {observer}: law {name} works with {', '.join(known)}")
    return found
