"""Where compiled code is kept, and where not."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

from trainctl import kernels

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


def test_whatever_is_compiled_into_code_of_another_file_is_among_the_sources():
    """Numba sees that a file was changed, not that a constant or a function that the code took from another one was."""
    package, known, taken = Path(kernels.__file__).parent, set(kernels.sources()), set[Path]()
    for path in package.rglob("*.py"):
        tree = ast.parse(path.read_text())
        modules = {}
        for line in ast.walk(tree):
            if isinstance(line, ast.ImportFrom) and (line.module or "").startswith("trainctl."):
                file = package.parent / Path(*line.module.split(".")).with_suffix(".py")
                modules |= {alias.asname or alias.name: file for alias in line.names}
        for function in tree.body:
            if isinstance(function, ast.FunctionDef) and any(
                word in ast.unparse(mark) for mark in function.decorator_list for word in ("bare", "inlined", "njit")
            ):
                taken |= {modules[n.id] for n in ast.walk(function) if isinstance(n, ast.Name) and n.id in modules}
    taken = {path for path in taken if path.exists()}
    assert len(taken) > 10
    assert not taken - known
