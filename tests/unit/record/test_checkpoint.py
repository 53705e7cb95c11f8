"""Parts of a checkpoint by themselves."""

from __future__ import annotations

import json
import shutil
from contextlib import closing
from pathlib import Path

import nets
import numpy as np
import pytest
import tomli_w

from trainctl.errors import InputError
from trainctl.loop import Loop
from trainctl.numeric import Numeric
from trainctl.record import checkpoint
from trainctl.record.checkpoint import Saved, Tape, leaves, plain
from trainctl.record.folder import free, held, open_partial, ours, remove, write_info
from trainctl.runner import again, begin
from trainctl.scenario.build import open_scenario
from trainctl.signals import Demand, Start


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


def test_what_is_in_tuples_is_found_and_put_back():
    demand = Demand(np.arange(3.0), np.zeros(3, bool))
    whole = (demand, 4.0, (np.ones(2),), "word", (7, 8))
    found, values = dict(leaves("x", whole)), dict(plain("x", whole))
    assert sorted(found) == ["x.0.0", "x.0.1", "x.2.0"]
    saved = {name: array + 1 for name, array in found.items()}
    fresh = (Demand(np.zeros(3), np.ones(3, bool)), 0.0, (np.zeros(2),), "", ())
    put = checkpoint.again("x", fresh, saved, json.loads(json.dumps(values)))
    assert put[0].acceleration.tolist() == [1.0, 2.0, 3.0] and type(put[0]) is Demand
    assert (put[1], put[3], put[4]) == (4.0, "word", (7, 8))
    assert put[2][0].tolist() == [2.0, 2.0] and put[2][0] is not saved["x.2.0"]
    del saved["x.2.0"]
    with pytest.raises(InputError, match=r"x\.2\.0"):
        checkpoint.again("x", fresh, saved, values)


def test_a_file_is_replaced_whole(tmp_path):
    path = tmp_path / "file"
    checkpoint.replace(path, b"one")
    checkpoint.replace(path, b"two" * 1000)
    assert path.read_bytes() == b"two" * 1000
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


class Unheard:
    """A journal nobody reads."""

    def event(self, time, kind, **fields):
        pass

    def turned(self, p):
        pass

    def write(self, row):
        pass

    def call(self, train, call, edge):
        pass


#: The scenario, where everything is told, and what only the user sets.
OUTSIDE = {"p", "built", "world", "journal", "between"}

#: What a stage may overwrite: written anew in every step before it is read, or made of the world's ways.
WORK_SPACE = {
    "plant": {"parts", "told", "orders", "plant", "constants", "shares", "pool"},
    "traffic": {"ways", "zones"},
}  # fmt: skip


def remembered(name, thing):
    """All numbers, words and arrays an object of ours holds, and those of all objects in it, with their places."""
    if thing is None or isinstance(thing, bool | int | float | str | np.generic):
        yield name, thing
    elif isinstance(thing, np.ndarray):
        yield name, thing.copy()
    elif isinstance(thing, dict):
        yield f"{name}, keys", str(sorted(thing, key=str))
        for key, value in thing.items():
            yield from remembered(f"{name}[{key}]", value)
    elif isinstance(thing, tuple | list):
        yield f"{name}, length", len(thing)
        for key, value in zip(getattr(thing, "_fields", range(len(thing))), thing, strict=True):
            yield from remembered(f"{name}.{key}", value)
    elif type(thing).__module__.startswith("trainctl.") and hasattr(thing, "__dict__"):
        for key, value in vars(thing).items():
            if key not in OUTSIDE:
                yield from remembered(f"{name}.{key}", value)


def beside(loop):
    """What the parts of a loop hold that is no work space, and the scenario's arrays: all but the loop's state."""
    found = dict(remembered("p", (loop.p.own, loop.p.consists, loop.p.bounds, loop.p.reference, loop.p.first_links)))
    for stage, thing in vars(loop).items():
        if stage in OUTSIDE | {"state"}:
            continue
        for key, part in vars(thing).items() if hasattr(thing, "__dict__") else [("", thing)]:
            if key not in OUTSIDE | WORK_SPACE.get(stage, set()):
                found |= dict(remembered(f"{stage}.{key}", part))
    return found


def same(one, two):
    if isinstance(one, np.ndarray) and isinstance(two, np.ndarray):
        return one.dtype == two.dtype and one.shape == two.shape and one.tobytes() == two.tobytes()
    return type(one) is type(two) and (one == two or one != one)


#: Scenario, changes, and the steps after which it is busy: much is under way, or has come to be otherwise than at the start.
BUSY = {
    "units": ("three_tracks", {"supervisor.mode": "on", "topology.loss": 0.3, "run.seed": 1}, (150,)),
    "actuators": (
        "fault_tolerant_noise", {"topology.communication_period_s": 0.5, "topology.loss": 0.2, "topology.delay_s": 1.0}, (5,)
    ),
    "points": ("fully_distributed_loss", {"topology.delay_s": 2.0}, (1010,)),
    "formations, stops": ("merging", {}, (300, 600, 670, 760, 955)),
    "single track": ("", {}, (300,)),
}  # fmt: skip


#: What must have changed since the start, or nothing would be seen of it.
CHANGED = {
    "units": ("watch.acting", "commanded", "messages.heard", "plant.extremes", "alarms.tally", "demand"),
    "actuators": ("plant.sent_at", "plant.counted", "plant.heard", "plant.estimate", "messages.sent"),
    "points": ("orders.pending", "messages.ever", "rule.track", "formed.formation", "messages.sent"),
    "formations, stops": (
        "requests", "came", "left", "next_stop", "stands_since", "stands_until", "stopping", "rule.slot", "ask_at", "parted", "refused",
        "formed.ahead", "formed.led", "formed.offset", "references.position",
    ),
    "single track": ("waits_for", "requests"),
}  # fmt: skip


def lost(expected, found):
    both = expected.keys() & found.keys()
    return [place for place in expected | found if place not in both or not same(expected[place], found[place])]


def from_checkpoint(p, folder):
    """The loop that goes on from the checkpoint in a folder."""
    saved = checkpoint.read(folder, p)
    with closing(Tape(Numeric(p.line), folder, saved)) as tape:
        loop = Loop(p, tape, Unheard())
        checkpoint.restore(loop, tape, saved)
        return loop


@pytest.mark.parametrize("case", BUSY)
def test_a_loop_that_goes_on_from_a_checkpoint_remembers_all_that_one_does_which_went_on(case, tmp_path):
    name, changes, steps = BUSY[case]
    if case == "single track":
        name = str(tmp_path / "s.toml")
        up = nets.flow("up", nets.UP, 2, 60, departSpeed="0")
        nets.single_track(tmp_path, up + nets.flow("down", nets.DOWN, 2, 60, 20, departSpeed="0"))
        (tmp_path / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 900)))
    p = open_scenario(name, changes)
    with closing(Tape(Numeric(p.line), tmp_path)) as tape:
        went_on, changed = Loop(p, tape, Unheard()), set()
        begun, made = dict(remembered("state", went_on.state)), beside(went_on)
        for k in range(steps[-1]):
            if case == "units" and k == 20:
                went_on.command(slice(None), np.array([-5.0, *[5.0] * 5]))  # so that the supervisor has to act
            went_on.step()
            if went_on.k in steps:
                place = tmp_path / str(went_on.k)
                place.mkdir()
                checkpoint.write(place, went_on, {**checkpoint.identity(p), "tape": tape.save()})
                shutil.copy(tmp_path / "moves.bin", place)
                expected = dict(remembered("state", went_on.state))
                assert lost(expected, dict(remembered("state", from_checkpoint(p, place).state))) == []
                changed |= {name for name in expected if name in lost(begun, expected)}
        assert lost(made, beside(went_on)) == [], "a stage holds what changes and is in no checkpoint"
    assert len(expected) > 60
    assert [name for name in CHANGED[case] if not any(name in place for place in changed)] == []


def test_a_loop_that_goes_on_knows_which_way_round_its_trains_run(tmp_path):
    """What stages hold of units they hold as the train runs; state and stages are those of a loop that went on."""
    nets.terminals(tmp_path, nets.train("v", "ab bc -bc -ab ab", 0), scale=0.25)
    unlike = nets.LAWS["fault_tolerant"]["train_type"] | {"unit_mass_kg": [8e4, 6e4, 4e4, 5e4]}
    tables = nets.scenario("fault_tolerant", 400, train_type={"emu": unlike}, topology={"communication_period_s": 0.5})
    (tmp_path / "s.toml").write_text(tomli_w.dumps(tables))
    p = open_scenario(str(tmp_path / "s.toml"))
    with closing(Tape(Numeric(p.line), tmp_path)) as tape:
        went_on = Loop(p, tape, Unheard())
        while went_on.state.traffic.leg[0] == 0 or went_on.k % 10:
            went_on.step()
        checkpoint.write(tmp_path, went_on, {**checkpoint.identity(p), "tape": tape.save()})
        again = from_checkpoint(p, tmp_path)
        assert went_on.p.consists.mass.tolist() == [5e4, 4e4, 6e4, 8e4] == again.p.consists.mass.tolist()
        assert lost(*(dict(remembered("state", loop.state)) for loop in (went_on, again))) == []
        # Where trains may turn is made of the world's ways.
        assert [place for place in lost(beside(went_on), beside(again)) if ".yards" not in place] == []


def test_a_stage_that_keeps_something_to_itself_is_found_out():
    p = open_scenario("three_tracks")
    loop = Loop(p, Numeric(p.line), Unheard())
    made = beside(loop)
    assert {"control.clamps", "orders.length", "record.track_of", "protect.disturbing"} <= made.keys()
    for stage, thing in (("control", 3), ("driver", [1.0]), ("protect", {"x": np.zeros(2)}), ("record", None)):
        getattr(loop, stage).hidden = thing
        assert any(place.startswith(f"{stage}.hidden") for place in lost(made, beside(loop))), stage


def test_what_is_no_array_in_a_state_is_plain_json():
    p = open_scenario("merging")
    loop = Loop(p, Numeric(p.line), Unheard())
    for _ in range(3):
        loop.step()
    values = dict(plain("state", loop.state))
    assert json.loads(json.dumps(values)) == values and values["state.0"] == 3


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
    partial = open_partial(tmp_path / "run")
    (partial / "scenario.toml").write_text(prepared.scenario.toml())
    begin(partial, prepared, 2.0, {"seed": 7})
    if own_line:
        path.unlink()
    found, every, info = again(partial)
    assert (every, info) == (2.0, {"seed": 7})
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
    partial = open_partial(tmp_path / "run")
    (partial / "run.json.new").write_text("{")
    assert free(partial)
    assert open_partial(tmp_path / "run") == partial
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
