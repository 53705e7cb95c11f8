"""The scenario format: shipped files, the page that documents every key, the schema, extension."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from trainctl.scenario.build import open_scenario
from trainctl.scenario.reading import _read, examine, load, shipped
from trainctl.scenario.tables import Scenario

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "scenarios" / "README.md").read_text()
COMPLETE = next(block for block in re.findall(r"```toml\n(.*?)```", PAGE, re.S) if "schema_version" in block)


@pytest.mark.parametrize("name", shipped())
def test_every_shipped_scenario_is_without_mistakes(name):
    assert open_scenario(name).scenario.title


@pytest.mark.parametrize("name", shipped())
def test_a_resolved_scenario_reads_back_as_itself(name):
    scenario, _ = load(name)
    again, mistakes = examine(tomllib.loads(scenario.toml()))
    assert mistakes == []
    assert again == scenario


def test_the_complete_scenario_of_the_page_is_valid(tmp_path):
    (tmp_path / "complete.toml").write_text(COMPLETE)
    assert open_scenario(str(tmp_path / "complete.toml")).scenario.ids == ("1", "2", "3")


def test_the_complete_scenario_names_every_key():
    def keys(model):
        for name, field in model.model_fields.items():
            yield name
            for inner in [field.annotation, *getattr(field.annotation, "__args__", ())]:
                if hasattr(inner, "model_fields"):
                    yield from keys(inner)

    not_for_users = {"amplitude", "std", "uncertainty"}  # they exist to say that the unit is missing
    words = set(re.findall(r"\w+", COMPLETE))
    assert set(keys(Scenario)) - not_for_users - words == set()


def test_every_shipped_scenario_stands_on_the_page():
    assert [name for name in shipped() if f"`{name}`" not in PAGE] == []


def test_the_generated_part_of_the_page_is_up_to_date():
    assert subprocess.run([sys.executable, ROOT / "tools" / "reference_pages.py", "--check"], check=False).returncode == 0


def test_extension_lays_tables_over_each_other(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('extends = "fully_distributed"\n[run]\nduration_s = 5\n[[train]]\nid = 5\nposition_m = 9950.0\n')
    mine, _ = load(str(path))
    paper, _ = load("fully_distributed")
    assert mine.run.duration_s == 5
    assert mine.run.step_s == paper.run.step_s
    assert [t.position_m for t in mine.train] == [24000, 21000, 13000, 12000, 9950, 0]
    assert mine.event == paper.event


def test_files_of_an_extended_scenario_are_found_beside_it(tmp_path):
    (tmp_path / "mine.toml").write_text('extends = "merging"\n[run]\nduration_s = 8\n')
    mine, _ = load(str(tmp_path / "mine.toml"))
    assert mine.network.sumocfg == str(ROOT / "scenarios" / "merging" / "merging.sumocfg")
    (tmp_path / "other.toml").write_text('extends = "merging"\n[network]\nline = "single_track"\n')
    data, mistakes = examine(_read(tmp_path / "other.toml"))
    assert data is None and not any("exactly one of" in line for line in mistakes)


def test_a_resolved_scenario_names_the_trains_of_its_configuration_and_a_users_file_does_not():
    prepared = open_scenario("merging")
    resolved = tomllib.loads(prepared.scenario.toml())
    again, mistakes = examine(resolved, resolved=True)
    assert mistakes == [] and again.ids == prepared.scenario.ids
    assert examine(resolved)[1] == ["train: not with network.sumocfg, whose own trains run"]
