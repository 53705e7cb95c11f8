"""Where compiled code is kept, and where not."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

CODE = "import warnings; warnings.simplefilter('always'); import trainctl.signals, numba; print(numba.config.CACHE_DIR)"


def kept(**environment: str) -> tuple[Path, str]:
    """The folder of a process in that environment, and what it said."""
    known = {key: value for key, value in os.environ.items() if key not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME", "TMPDIR")}
    done = subprocess.run([sys.executable, "-c", CODE], env=known | environment, capture_output=True, text=True, check=True)
    return Path(done.stdout.strip()), done.stderr


def test_it_is_kept_where_the_user_can_write(tmp_path):
    """Also where there is no home: as in a container that runs under another user."""
    (tmp_path / "home").mkdir()
    temporary = {"TMPDIR": str(tmp_path)}
    home, said = kept(HOME=str(tmp_path / "home"), **temporary)
    assert home.parent == tmp_path / "home" / ".cache" / "trainctl" and not said
    elsewhere, said = kept(HOME="/proc/nowhere", **temporary)
    assert elsewhere.parent == tmp_path / f"trainctl-{os.getuid()}" and not said


def test_a_folder_that_others_can_write_into_is_not_trusted(tmp_path):
    planted = tmp_path / f"trainctl-{os.getuid()}"
    planted.mkdir()
    planted.chmod(0o777)
    place, said = kept(HOME="/proc/nowhere", TMPDIR=str(tmp_path))
    assert place.parent != planted and place.is_relative_to(tmp_path)
    assert "compiled again" in said


def test_linear_algebra_is_loaded_only_where_it_is_compiled():
    """Numba would import scipy.linalg, longer than itself, for whatever it compiles; products of matrices are still compiled."""
    code = (
        "import sys, trainctl.signals, numba, numpy as np\n"
        "double = numba.njit(lambda a: 2.0 * a); double(np.ones(3)); before = 'scipy.linalg' in sys.modules\n"
        "times = numba.njit(lambda a, b: a @ b); a = np.arange(9.0).reshape(3, 3)\n"
        "print(before, np.array_equal(times(a, a), a @ a))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False True"
