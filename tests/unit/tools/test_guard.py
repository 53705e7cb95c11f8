"""The guard sees every change of a run and nothing else; where two runs begin to differ is told by file, column and row."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

FILE = Path(__file__).resolve().parents[3] / "tools" / "guard.py"
spec = importlib.util.spec_from_file_location("guard", FILE)
guard = importlib.util.module_from_spec(spec)
spec.loader.exec_module(guard)


def table(**changes):
    """Four rows of every kind of column."""
    columns = {
        "time_s": [0.0, 1.0, 2.0, np.nan], "train": pa.array(["a", "b", None, "a"]).dictionary_encode(), "unit": [1, 2, 3, 4],
        "heard": [True, False, True, True], "word": ["x", "y", "z", ""],
    }  # fmt: skip
    return pa.table({name: pa.array(values) for name, values in {**columns, **changes}.items()})


def run_of(folder, one, words="{}\n", name="run"):
    (folder / name / "sumo").mkdir(parents=True)
    pq.write_table(one, folder / name / "trains.parquet")
    (folder / name / "events.jsonl").write_text(words)
    (folder / name / "run.json").write_text(json.dumps({"status": "complete", "wall_time_s": len(name), "command_line": [name]}))
    log = f'<!-- generated at {name} --><log><step time="1" duration="{len(name)}"/>{folder / name}</log>'
    (folder / name / "sumo" / "summary.xml").write_text(log)
    (folder / name / "sumo" / "messages.log").write_text(
        f"Loading done ({len(name)}ms).\n Duration: {len(name)}.5s\n UPS: {len(name)}\n"
    )
    files = guard.content(folder / name, {str(folder / name): "RUN"})
    return {"case/numeric": {"exit": 0, "stderr": [], "files": files}}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"time_s": [0.0, 1.0, 2.0 + 1e-15, np.nan]}, "1 of 5 columns differ, the first is time_s, first in row 2 (1 of 4 rows)"),
        ({"time_s": [0.0, 1.0, np.nan, np.nan]}, "1 of 5 columns differ, the first is time_s, first in row 2 (1 of 4 rows)"),
        ({"time_s": [-0.0, 1.0, 2.0, np.nan]}, "1 of 5 columns differ, the first is time_s, first in row 0 (1 of 4 rows)"),
        ({"train": pa.array(["a", "b", "a", "a"]).dictionary_encode()}, "the first is train, first in row 2 (1 of 4 rows)"),
        (
            {"unit": [1, 2, 3, 5], "word": ["x", "z", "z", ""]},
            "2 of 5 columns differ, the first is unit, first in row 1 (2 of 4 rows)",
        ),
        ({"heard": [True, False, True, False]}, "the first is heard, first in row 3"),
        ({"more": [1, 2, 3, 4]}, "new column more, first in row 0 (4 of 4 rows)"),
    ],
)
def test_a_changed_table_is_told_with_its_first_column_and_row(changes, told, tmp_path):
    found = guard.differences(run_of(tmp_path, table()), run_of(tmp_path, table(**changes), name="other"))
    assert len(found) == 1
    assert found[0].startswith("case/numeric: trains.parquet: ") and told in found[0]


def test_clocks_headers_paths_and_how_a_file_is_packed_change_nothing(tmp_path):
    one, two = run_of(tmp_path, table()), run_of(tmp_path, table(), name="another")
    assert guard.differences(one, two) == []
    assert len(one["case/numeric"]["files"]) == 5
    pq.write_table(table(), tmp_path / "another" / "trains.parquet", compression="gzip", row_group_size=2)
    assert guard.content(tmp_path / "another", {})["trains.parquet"] == one["case/numeric"]["files"]["trains.parquet"]


def test_fewer_rows_other_words_and_what_is_missing_are_told(tmp_path):
    one = run_of(tmp_path, table(), "a\nb\nc\n")
    two = run_of(tmp_path, table().slice(0, 3), "a\nx\nc\n", name="other")
    three = {"case/numeric": {**two["case/numeric"], "exit": 3, "stderr": ["it broke"]}, "new/sumo": two["case/numeric"]}
    del three["case/numeric"]["files"]["run.json"]
    assert guard.differences(one, three) == [
        "case/numeric: exit code 0, then exit code 3 (it broke)",
        "case/numeric: events.jsonl: first in line 1 (1 of 3 lines)",
        "case/numeric: run.json: only in the first",
        "case/numeric: trains.parquet: 5 of 5 columns differ, the first is time_s, first in row 3 (4 and 3 rows)",
        "new/sumo: only in the second",
    ]


def test_a_run_of_this_checkout_differs_from_none_of_itself(tmp_path):
    def typed(*arguments):
        return subprocess.run([sys.executable, FILE, *map(str, arguments)], capture_output=True, text=True, check=False)

    out = tmp_path / "a.json"
    done = typed("run", "--out", out, "--only", "undisturbed/numeric", "--only", "net separate/sumo", "--at-most", "4")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count(" of 2: ") == 2
    whole = json.loads(out.read_text())
    numeric = whole["runs"]["robust_constrained_undisturbed/numeric"]["files"]
    assert {"trains.parquet", "links.parquet", "events.jsonl", "metrics.json", "run.json", "scenario.toml"} == numeric.keys()
    assert "sumo/fcd.parquet" in whole["runs"]["net separate/sumo"]["files"]
    assert typed("compare", out, out).stdout == "nothing differs in 2 runs\n"
    numeric["trains.parquet"]["sha256"] = "0"
    (tmp_path / "b.json").write_text(json.dumps(whole))
    assert typed("compare", out, tmp_path / "b.json").returncode == 1
    (tmp_path / "c.json").write_text(json.dumps(whole | {"at_most_s": 5.0}))
    for wrong in (("compare", out, tmp_path / "c.json"), ("compare", out, FILE), ("run", "--out", FILE.parent / "hashes.json")):
        done = typed(*wrong)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
