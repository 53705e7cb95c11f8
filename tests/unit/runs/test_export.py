"""Tables for other programs."""

from __future__ import annotations

import csv
import json
import re
import shutil

import numpy as np
import pandas as pd
import pytest
import tomli_w
from scipy.io import loadmat

import trainctl
from trainctl.errors import InputError
from trainctl.runs import export
from trainctl.runs.export import to_csv, to_mat
from trainctl.runs.run import Run
from trainctl.scenario.reading import read


@pytest.fixture(scope="module")
def run(finished):
    return finished("three_tracks", "numeric", **{"run.duration_s": 48})


def test_csv_gives_every_number_back_bit_by_bit(run, tmp_path, monkeypatch):
    monkeypatch.setattr(export, "ROWS", 100)  # several pieces
    files = to_csv(run, tmp_path / "out")
    assert [f.name for f in files] == ["trains.csv", "units.csv", "links.csv", "events.csv"]
    for name in ("trains", "units", "links"):
        table = getattr(run, name)
        text = dict.fromkeys(("train", "track", "sender", "receiver"), str)
        read = pd.read_csv(tmp_path / "out" / f"{name}.csv", dtype=text)
        assert list(read.columns) == list(table.columns)
        for column in table.columns:
            if table[column].dtype == np.float64:
                np.testing.assert_array_equal(read[column].to_numpy(float), table[column].to_numpy())
            else:
                assert read[column].astype(str).tolist() == table[column].astype(str).tolist()
    events = pd.read_csv(files[-1])
    assert len(events) == len(run.events)
    edges = events.loc[events["kind"] == "topology", "edges"].iloc[0]
    assert json.loads(edges) == next(e["edges"] for e in run.events if e["kind"] == "topology")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["events.csv", "links.csv", "trains.csv", "units.csv"]


def test_mat_has_structs_with_units_in_their_names(run, tmp_path):
    m = loadmat(to_mat(run, tmp_path / "deep" / "run.mat"), simplify_cells=True)
    trains = m["trains"]
    np.testing.assert_array_equal(trains["position_m"], run.trains["position_m"])
    names = trains["train_names"][trains["train"].astype(int) - 1]
    assert names.tolist() == run.trains["train"].astype(str).tolist()
    assert m["metrics"]["bounds_broken"] == 0
    assert m["run"]["status"] == "complete"
    assert {"coupler_m", "force_n", "coupler_max_m"} <= set(m["units"])


def test_a_run_that_broke_off_is_exported_as_far_as_it_went(run, tmp_path):
    folder = tmp_path / "r.partial"
    shutil.copytree(run.folder, folder)
    (folder / "metrics.json").unlink()
    (folder / "units.parquet").unlink()
    m = loadmat(to_mat(Run(folder), tmp_path / "run.mat"), simplify_cells=True)
    assert {"trains", "links"} == {k for k in m if not k.startswith("__")} - {"run"}


def test_bad_input(run, tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="needs a folder"):
        to_csv(run, tmp_path / "file")
    with pytest.raises(InputError, match="needs a file name"):
        to_mat(run, tmp_path)
    folder = tmp_path / "r"
    shutil.copytree(run.folder, folder)
    cut = (folder / "trains.parquet").read_bytes()[:-50]
    (folder / "trains.parquet").write_bytes(cut)
    for write, where in ((to_csv, tmp_path / "out"), (to_mat, tmp_path / "out.mat")):
        with pytest.raises(InputError, match=r"trains\.parquet"):
            write(Run(folder), where)
    assert (tmp_path / "file").read_text() == "mine"


def test_what_a_mat_file_cannot_hold_is_told(run, tmp_path, monkeypatch):
    monkeypatch.setattr(export, "MAT_BYTES", 1000)
    with pytest.raises(InputError, match="use csv"):
        to_mat(run, tmp_path / "run.mat")
    assert not list(tmp_path.iterdir())


def test_names_are_no_formulas_for_a_spreadsheet(tmp_path):
    """Ids come from other people's files; numbers stay numbers, negative ones too."""
    scenario = read("fully_distributed", {"run.duration_s": 10.0})[0]
    name = '=HYPERLINK("http://x")'
    scenario["train"][0]["id"] = name
    for link in scenario["link"]:
        link["between"] = [name if train == 1 else train for train in link["between"]]
    (tmp_path / "s.toml").write_text(tomli_w.dumps(scenario))
    done = trainctl.run(tmp_path / "s.toml", backend="numeric", out=tmp_path / "run")
    files = to_csv(Run(done.folder), tmp_path / "csv")
    cells = [cell for file in files for row in csv.reader(file.read_text().splitlines()) for cell in row]
    assert f"'{name}" in cells and name not in cells
    assert any(re.fullmatch(r"-[\d.e-]+", cell) for cell in cells)
