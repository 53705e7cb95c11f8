"""Where compiled kernels are kept between runs.

Numba notices a change of the file a function stands in, but not of the constants and functions it took in from other files: an
edit there would leave old kernels at work, silently. So the cache is keyed by all sources that can be compiled.
"""

from __future__ import annotations

import hashlib
import os
from functools import partial
from pathlib import Path
from typing import Any

import numba
from numba.core import caching

config: Any = numba.config
Index: Any = caching.IndexDataCacheFile

#: ``njit`` without numba's run time, its allocation and reference counts, for what is called in every Runge-Kutta stage.
bare: Any = partial(numba.njit, cache=True, _nrt=False)

#: The same for the functions of laws, observers and plants, with numpy's rules of division: put into the stage that calls them.
inlined: Any = partial(bare, error_model="numpy", forceinline=True)


def _load_index(file: Any, load: Any = Index._load_index) -> Any:
    """An index of compiled code names types; where one of them is no longer to be found, numba would fail for ever."""
    try:
        return load(file)
    except (ImportError, AttributeError):
        return {}


Index._load_index = _load_index


def keep_by_sources() -> None:
    """Point numba's cache at a folder of this version of the sources, unless NUMBA_CACHE_DIR says otherwise."""
    if os.environ.get("NUMBA_CACHE_DIR"):
        return
    here = Path(__file__).parent
    digest = hashlib.sha256(numba.__version__.encode())
    compiled = [p for part in ("plants", "controllers", "observers", "topology", "railway") for p in (here / part).glob("*.py")]
    for path in sorted([*(here / f"{name}.py" for name in ("signals", "davis", "draws", "kernels")), *compiled]):
        digest.update(path.read_bytes())
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    config.CACHE_DIR = str(base / "trainctl" / f"kernels-{digest.hexdigest()[:16]}")
