"""Parts of a checkpoint by themselves."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from trainctl import checkpoint
from trainctl.checkpoint import Saved, Tape, leaves, refill
from trainctl.errors import InputError
from trainctl.prepare import open_scenario
from trainctl.record.folder import claim, free, held, ours, remove, write_info
from trainctl.runner import again, begin, opened
from trainctl.signals import Demand
from trainctl.world import Numeric, Start


class Deaf(Numeric):
    """A world that keeps what it was told."""

    def __init__(self, line):
        super().__init__(line)
        self.told = []

    def route(self, train, edges):
        self.told.append((train, edges))

    def insert(self, train, speed):
        self.told.append(("enters", train, speed))

    def move(self, displacement, step):
        self.told.append((displacement.tolist(), step))


@pytest.fixture
def line():
    return open_scenario("three_tracks").line


def started(world, folder, saved=None):
    tape = Tape(world, folder, saved)
    one = np.zeros(2)
    tape.start(Start(("a", "b"), one.astype(int), one, one, one, [one, one], [world.line.edges[:1]] * 2, one == 0, ["rail"] * 2))
    return tape


def test_a_tape_tells_the_same_again_and_drops_what_came_later(line, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "PIECE", 100)  # several pieces
    first = Deaf(line)
    tape = started(first, tmp_path)
    for k in range(30):
        if k in (0, 7, 12):
            tape.route(k % 2, (f"e{k}", "f"))
            tape.route(0, ("g",))
            tape.insert(1, 1 / 3 + k)
        tape.move(np.array([0.1 * k, 1 / 3]), 0.5)
        if k == 19:
            saved = json.loads(json.dumps(tape.save()))
            told = list(first.told)
    tape.close()
    second = Deaf(line)
    tape = started(second, tmp_path, Saved({"tape": saved}, {}))
    tape.replay(0.5)
    assert second.told == told
    assert (tmp_path / "moves.bin").stat().st_size == 20 * 2 * 8
    tape.move(np.array([5.0, 6.0]), 0.5)
    again = tape.save()
    tape.close()
    assert again["steps"] == 21
    assert np.fromfile(tmp_path / "moves.bin").reshape(21, 2)[-1].tolist() == [5.0, 6.0]


@pytest.mark.parametrize("spoil", [lambda c: c[:-1], lambda c: b"\1" + c[1:]])
def test_a_spoiled_tape_is_refused(line, tmp_path, spoil):
    tape = started(Deaf(line), tmp_path)
    tape.move(np.array([1.0, 2.0]), 1.0)
    saved = tape.save()
    tape.close()
    path = tmp_path / "moves.bin"
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(InputError, match="damaged"):
        Tape(Deaf(line), tmp_path, Saved({"tape": saved}, {}))


def test_arrays_in_tuples_are_found_and_refilled_in_place():
    demand = Demand(np.arange(3.0), np.zeros(3, bool))
    whole = (demand, 4.0, (np.ones(2),), "word")
    found = dict(leaves("x", whole))
    assert sorted(found) == ["x.0.0", "x.0.1", "x.2.0"]
    saved = {name: array + 1 for name, array in found.items()}
    refill("x", whole, saved)
    assert demand.acceleration.tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(InputError, match=r"x\.2\.0"):
        refill("x", whole, {**saved, "x.2.0": np.ones(3)})


def test_a_file_is_replaced_whole(tmp_path):
    path = tmp_path / "file"
    checkpoint.replace(path, b"one")
    checkpoint.replace(path, b"two" * 1000)
    assert path.read_bytes() == b"two" * 1000
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_every_array_of_the_loop_is_in_a_checkpoint(tmp_path):
    """Whoever adds an array to the loop or to the motion of units has to say whether it changes."""
    fixed = {"p", "line_track", "gradient", "breaks", "masses", "plant", "signals", "parts", "lag"}
    fixed |= {"orders"}  # written anew in every step before they are read
    prepared = open_scenario("fault_tolerant_noise", {"run.duration_s": 3})
    with opened(prepared, tmp_path / "run", "numeric") as simulation:
        simulation.step()
        values, arrays = checkpoint.state(simulation)
        simulation.run()
        known = {
            "own",
            "track",
            "formation",
            "ahead",
            "links",
            "demand",
            "relinked",
            "constants",
            "estimate",
            "extremes",
            "work",
            "air",
            "loop",
            "heard",
            "ever",
            "outside",
        }
        for thing in (simulation, simulation.motion, simulation.exchange):
            found = {name for name, value in vars(thing).items() if list(leaves("x", value))}
            assert found - known - fixed == set()
        assert {"alarms", "sent", "heard", "ever", "seen"} <= arrays.keys()
        assert json.loads(json.dumps(values)) == values


def test_every_array_of_trains_that_come_and_go_is_in_a_checkpoint(tmp_path):
    """Whoever adds an array to the service has to say whether it changes."""
    with opened(open_scenario("merging", {"run.duration_s": 3}), tmp_path / "run", "numeric") as simulation:
        simulation.run()
        service = simulation.service
        kept = {id(array) for _, array in leaves("x", checkpoint.state(simulation)[1]["service"])}
        lost = {name for name, value in vars(service).items() if any(id(array) not in kept for _, array in leaves("x", value))}
        assert lost == {"roster", "cruise", "assumed"}  # as they were read
        lookout = {name for name, value in vars(simulation.lookout).items() if list(leaves("x", value))}
        assert lookout == {"net", "length", "factor", "ways", "zones", "waits_for", "assumed", "rate"}


@pytest.mark.parametrize("own_line", [False, True])
def test_a_folder_knows_its_scenario_and_network(own_line, tmp_path):
    """Also where the line came from a file that is gone."""
    import sumo_net

    settings = {"run.duration_s": 3}
    if own_line:
        path = tmp_path / "mine.toml"
        path.write_bytes(sumo_net.shipped()["three_tracks"].read_bytes())
        settings["network.line"] = str(path)
    prepared = open_scenario("three_tracks", settings)
    partial = claim(tmp_path / "run")
    (partial / "scenario.toml").write_text(prepared.scenario.toml())
    begin(partial, prepared, 2.0)
    if own_line:
        path.unlink()
    found, every = again(partial)
    assert every == 2.0
    assert found.scenario.toml() == prepared.scenario.toml()
    assert checkpoint.identity(found) == checkpoint.identity(prepared)


def test_other_sources_are_another_identity(monkeypatch, tmp_path):
    prepared = open_scenario("three_tracks")
    before = checkpoint.sources(prepared)
    law = tmp_path / "law.py"
    law.write_text("GAIN = 1.0\n")
    monkeypatch.setattr(prepared.law, "__file__", str(law))
    first = checkpoint.sources(prepared)
    law.write_text("GAIN = 1.01\n")
    assert len({before, first, checkpoint.sources(prepared)}) == 3


def test_a_run_killed_at_its_first_word_is_no_obstacle(tmp_path):
    partial = claim(tmp_path / "run")
    (partial / "run.json.new").write_text("{")
    assert free(partial)
    assert claim(tmp_path / "run") == partial
    (partial / "thesis.tex").write_text("x")
    assert not free(partial)


def test_removing_a_run_leaves_it_ours_to_the_last(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    (folder / "a").mkdir(parents=True)
    (folder / "z").write_text("x")
    write_info(folder, {"format": "trainctl run"})
    monkeypatch.setattr("trainctl.record.folder.shutil.rmtree", lambda place: None)
    monkeypatch.setattr(Path, "unlink", lambda self: None)
    remove(folder)
    assert ours(folder)


def test_one_writer_at_a_time(tmp_path):
    with held(tmp_path), pytest.raises(InputError, match="another process"), held(tmp_path):
        pass
    with held(tmp_path), held(tmp_path / "nothing"):
        pass
