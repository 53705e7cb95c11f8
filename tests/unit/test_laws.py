"""Finding the modules a scenario names, and what they must say of themselves."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from trainctl.controllers import emu_finite_time, fault_tolerant, sumo
from trainctl.errors import InputError
from trainctl.laws import compared, find_law, find_plant, plants_of, shipped, unfit

BIN = Path(sys.executable).parent / "trainctl"
HOSTILE = Path(__file__).parents[1] / "laws" / "hostile_units.py"


def test_a_plant_is_found_by_its_name_and_its_helpers_are_none():
    assert find_plant("point").__name__ == "trainctl.plants.point"
    for name in ("disturbance", "integrate", "shared", "pint", ""):
        with pytest.raises(InputError) as error:
            find_plant(name)
        assert error.value.mistakes == [
            f"plant.kind = {name}: no such plant; known: actuated_units, coupled_units, point",
        ]


def test_a_law_names_the_plants_it_runs_on():
    assert plants_of(emu_finite_time) == ("coupled_units",)
    assert plants_of(fault_tolerant) == ("actuated_units",)
    assert plants_of(find_law("fully_distributed")) == ("point", "coupled_units")
    assert unfit(fault_tolerant, "fault_tolerant", "actuated_units", "intermediate") == []
    assert unfit(fault_tolerant, "fault_tolerant", "point", "none") == [
        "plant.kind = point: law fault_tolerant runs on actuated_units",
        "observer.kind = none: law fault_tolerant works with asymptotic, intermediate",
    ]


def test_rows_of_a_comparison_are_those_the_laws_name():
    rows = compared()
    assert list(rows) == [
        "fully_distributed", "model_predictive", "relative_braking", "robust_constrained", "sliding_mode", "time_headway",
        "time_headway_cooperative", "emu_finite_time", "ordinary_consensus", "fault_tolerant", "sumo_fixed_block", "sumo_moving_block",
    ]  # fmt: skip
    assert rows["ordinary_consensus"] is emu_finite_time and rows["sumo_fixed_block"] is sumo
    assert shipped("powers") is None and shipped("no such law") is None and shipped("sumo") is sumo


def watching(folder: Path, more: str = "") -> Path:
    """The hostile law, which watches a quantity besides."""
    text, line = HOSTILE.read_text(), "WATCHED: tuple[str, ...] = ()"
    assert line in text
    (folder / "watching.py").write_text(text.replace(line, 'WATCHED: tuple[str, ...] = ("nearness_m",)') + more)
    return folder / "watching.py"


def test_a_law_that_watches_something_must_say_its_bounds(tmp_path):
    with pytest.raises(InputError, match="a continuous law needs watched_bounds"):
        find_law(str(watching(tmp_path)))
    bounds = """

def watched_bounds(params, scene):
    return tuple([[x] * len(scene.trains)] for x in (0.0, 1.0))
"""
    assert find_law(str(watching(tmp_path, bounds))).WATCHED == ("nearness_m",)


def test_a_law_on_actuated_units_needs_no_observer(tmp_path):
    """What nobody estimates is not known in the log."""
    (tmp_path / "s.toml").write_text(
        f'extends = "fault_tolerant"\n[controller]\nlaw = "{HOSTILE}"\nstyle = "late"\n[observer]\nkind = "none"\n'
        "[run]\nduration_s = 1.0\nsub_step_s = 0.05\n"
    )
    command = [BIN, "run", "s.toml", "--backend", "numeric", "--out", "r", "-q"]
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=tmp_path, check=False, env=os.environ | {"NUMBA_DISABLE_JIT": "1"}
    )
    assert done.returncode == 0, done.stderr
    units = pq.read_table(tmp_path / "r" / "units.parquet").to_pandas()
    assert units["fault_estimate_mps3"].isna().all() and units["acceleration_estimate_mps2"].isna().all()
    assert units[units["time_s"] == 0.0]["acceleration_mps2"].notna().all()
