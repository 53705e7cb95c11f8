"""Where compiled kernels are kept between runs.

Numba notices a change of the file a function stands in, but not of the constants and functions it took in from other files: an
edit there would leave old kernels at work, silently. So the cache is keyed by all sources that can be compiled.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import warnings
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

import numba
from numba.core import caching
from numba.np import linalg

config: Any = numba.config
Index: Any = caching.IndexDataCacheFile

#: ``njit`` without numba's run time, its allocation and reference counts, for what is called in every Runge-Kutta stage; it
#: leaves Python's lock to other threads.
bare: Any = partial(numba.njit, cache=True, _nrt=False, nogil=True)

#: The same for the functions of laws, observers and plants, with numpy's rules of division: put into the stage that calls them.
inlined: Any = partial(bare, error_model="numpy", forceinline=True)


def _load_index(file: Any, load: Any = Index._load_index) -> Any:
    """An index of compiled code names types; where one of them is no longer to be found, numba would fail for ever."""
    try:
        return load(file)
    except (ImportError, AttributeError):
        return {}


Index._load_index = _load_index


def _know_of_blas() -> None:
    """Tell numba that there is a BLAS, which comes with scipy.

    It imports ``scipy.linalg`` in each process to find out, 0.14 s; code that calls BLAS still has it imported when it is compiled.
    """
    asked, linalg.ensure_blas = linalg.ensure_blas, lambda: None
    try:
        from numba.np import arraymath  # noqa: F401  asks while it is imported
    finally:
        linalg.ensure_blas = asked


_know_of_blas()


@cache
def _base() -> Path:
    """A folder for kernels that can be written: the user's cache, else one in the folder for temporary files.

    What is kept there is run, so a folder that others could have written into is not used.
    """
    try:
        places = [Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "trainctl"]
    except RuntimeError:  # a user without a home
        places = []
    places.append(Path(tempfile.gettempdir()) / f"trainctl-{os.getuid()}")
    for place in places:
        try:
            place.mkdir(mode=0o700, parents=True, exist_ok=True)
            about = place.stat()
            shared = place is places[-1] and (about.st_uid != os.getuid() or about.st_mode & 0o022)
            if os.access(place, os.W_OK | os.X_OK) and not shared:
                return place
        except OSError:
            continue
    place = Path(tempfile.mkdtemp(prefix="trainctl-"))
    warnings.warn(f"compiled code cannot be kept in {places[0]}: it is compiled again in {place}", stacklevel=2)
    return place


def sources() -> list[Path]:
    """Files of which something is compiled into code that stands in another file."""
    here = Path(__file__).parent
    folders, files = ("plants", "controllers", "observers", "topology", "railway"), ("signals", "davis", "draws", "kernels")
    # Constants of what is counted of stacked runs.
    constants = ("ensemble/count", "metrics/driving", "metrics/run", "metrics/traffic", "monitors/on_track", "runs/schema")
    return sorted([*(p for f in folders for p in (here / f).glob("*.py")), *(here / f"{f}.py" for f in (*files, *constants))])


def keep_by_sources() -> None:
    """Point numba's cache at a folder of this version of the sources, unless NUMBA_CACHE_DIR names one that can be written."""
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        with suppress(OSError):
            Path(given).mkdir(parents=True, exist_ok=True)
        if os.access(given, os.W_OK | os.X_OK):
            return
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sources():
        digest.update(path.read_bytes())
    config.CACHE_DIR = str(_base() / f"kernels-{digest.hexdigest()[:16]}")
