"""A folder from a stranger is looked at: what stands in it is text, nothing of it is executed, and what is wrong is said in words."""

from __future__ import annotations

import gzip
import json
import pickle
import re
import shutil
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from limits import bounded

from sumo_net import LineError
from trainctl.cli import program as cli
from trainctl.errors import InputError
from trainctl.runner import run
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario

#: Ids of trains as somebody might choose them who wishes no good.
IDS = (
    "<script>hacked()</script>",
    '=HYPERLINK("http://x.invalid")',
    "\x1b]0;owned\x07\x1b[31m",
    "../../etc/passwd",
    "[/red] [bold]b[/bold]",
    r"$\frac{1$ $x$ %s {0}",
)
TITLE = "</title><script>hacked()</script> \x1b[2J [/red] $\\frac{1$ \u202eevil"


class Planted:
    """Executed by whoever unpickles it."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return (open, (str(self.marker), "w"))


def renamed(value, names):
    """Names of trains in what JSON or TOML gave."""
    if isinstance(value, dict):
        return {key: renamed(item, names) for key, item in value.items()}
    if isinstance(value, list):
        return [renamed(item, names) for item in value]
    return names.get(value, value) if isinstance(value, str) else value


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A run of trains that come and stop, not yet hostile."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    run(open_scenario("merging", {"run.duration_s": 240, "run.record_every_s": 4.0}), folder, "sumo", command_line=["x"])
    return folder


@pytest.fixture
def hostile(whole, tmp_path) -> Path:
    """The run with names, title, files and modules that do harm if they are taken for more than text."""
    import tomllib

    import tomli_w

    folder, marker = tmp_path / "run", tmp_path / "executed"
    shutil.copytree(whole, folder)
    tables = tomllib.loads((folder / "scenario.toml").read_text())
    names = dict(zip([train["id"] for train in tables["train"]], IDS, strict=False))
    tables = renamed(tables, names) | {"title": TITLE}
    tables["controller"] = {**tables["controller"], "law": "planted.py"}
    (folder / "scenario.toml").write_text(tomli_w.dumps(tables))
    events = [renamed(json.loads(line), names) for line in (folder / "events.jsonl").read_text().splitlines()]
    events.append({"time_s": 239.0, "kind": "<img src=x onerror=hacked()>", "note": "</script><script>hacked()</script>\x1b[2J"})
    (folder / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))
    for path in folder.glob("*.parquet"):
        table = pq.read_table(path)
        for k, field in enumerate(table.schema):
            if field.name in ("train", "sender", "receiver"):
                texts = [names.get(name, name) for name in table[field.name].to_pylist()]
                table = table.set_column(k, field.name, pa.array(texts, pa.string()).dictionary_encode())
        pq.write_table(table, path)
    info = json.loads((folder / "run.json").read_text())
    info |= {"command_line": ["\x1b[2J", "<script>hacked()</script>"], "backend": "<script>hacked()</script>"}
    info["versions"] = {"trainctl": "<script>hacked()</script>", "sumo": "\x1b[2J"}
    (folder / "run.json").write_text(json.dumps(info))
    code = f"open({str(marker)!r}, 'w')\n"
    for name in ("planted", "numpy", "sitecustomize", "matplotlib", "conftest", "pandas", "fully_distributed"):
        (folder / f"{name}.py").write_text(code)
    for name in ("trains.pickle", "state.npz", "checkpoint.pkl"):
        (folder / name).write_bytes(pickle.dumps(Planted(marker)))
    (folder / "matplotlibrc").write_text("backend: module://planted\n")
    return folder


#: What only looks, with the exit codes it may end with.
LOOKS = {
    "metrics RUN": (0,),
    "metrics RUN --all --json": (0,),
    "plot RUN --out out": (0,),
    "plot RUN --out out --caption --format svg": (0,),
    "report RUN --out page.html": (0,),
    "export RUN --out out": (0,),
    "cite RUN": (0,),
    "diff RUN WHOLE --html page.html --junit junit.xml": (1,),
    "diff RUN RUN --rows": (0,),
    "compare RUN WHOLE --out out": (0,),
    "golden make RUN kept": (0,),
    "golden check RUN WHOLE": (1,),
    "film RUN --out film.gif --seconds 1": (0, 2),
    "replay RUN --gui-program sumo": (0, 2),
    "resume RUN": (0,),
}


def typed(line: str, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", ["trainctl", *line.split()])
    with pytest.raises(SystemExit) as end:
        cli.main()
    return int(end.value.code or 0)


@pytest.mark.parametrize("line", LOOKS)
def test_a_hostile_folder_is_only_looked_at(line, hostile, whole, monkeypatch, capsys):
    monkeypatch.chdir(hostile)
    place = hostile.parent
    (place / "inside").mkdir()
    before = set(hostile.rglob("*"))
    words = {"RUN": str(hostile), "WHOLE": str(whole)} | {
        w: str(place / "inside" / w) for w in ("out", "page.html", "junit.xml", "kept", "film.gif")
    }
    code = typed(" ".join(words.get(word, word) for word in line.split()), monkeypatch)
    told = capsys.readouterr()
    assert code in LOOKS[line], told.err
    assert not (place / "executed").exists(), "something of the folder was executed"
    assert "\x1b" not in told.out + told.err and "\x07" not in told.out + told.err
    assert set(hostile.rglob("*")) == before
    assert {path.name for path in place.iterdir()} <= {"run", "inside"}, "something was written beside"
    for page in (place / "inside").rglob("*.html"):
        assert "<script>hacked" not in page.read_text() and "<img src=x" not in page.read_text()
    for page in (place / "inside").rglob("*.svg"):
        assert "<script>hacked" not in page.read_text()
    for sheet in (place / "inside").rglob("*.csv"):
        assert not re.search(r'(^|,)"?=', sheet.read_text(), re.M)


WRONG = {
    "run.json": [
        ("violations", "many"), ("violations", None), ("versions", ["x"]), ("checks_failed", 5), ("collisions", "x"), ("status", ["complete"]),
        ("first_violation", "x"), ("worst", 7), ("scenario_sha256", 5), ("backend", {}), ("collisions", 3), ("gridlocks", 1),
        ("waited_long", 2), ("overspeeds", 1), ("not_entered", 2),
    ],
    "events.jsonl": [
        ("violation", {}), ("violation", {"bound": "gap_m", "who": "a-b", "value": "x", "limit": 0}), ("depart", {}),
        ("gridlock", {"waits": 4}), ("waiting", {"train": 4}), ("not_entered", {}), ("not_followed", {}),
        ("stop_reached", {"train": ["x"], "stop": 4}), ("stop_reached", {"train": {}}), ("topology", {"links": 4}), ("x", {"train": []}),
    ],
}  # fmt: skip
CASES = [(file, key, value) for file, all_of in WRONG.items() for key, value in all_of]


@pytest.mark.parametrize(("file", "key", "value"), CASES)
def test_wrong_fields_are_refused_in_words_by_every_reader(file, key, value, whole, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    if file == "run.json":
        info = json.loads((folder / file).read_text())
        (folder / file).write_text(json.dumps({**info, key: value}))
    else:
        with (folder / file).open("a") as events:
            events.write(json.dumps({"time_s": 239.0, "kind": key, **value}) + "\n")
    for line in (
        "metrics {}",
        "report {} --out page.html",
        "plot {} --out out",
        "cite {}",
        f"diff {whole} {{}}",
        "export {} --out sheets",
    ):
        monkeypatch.chdir(tmp_path)
        code = typed(line.format(folder), monkeypatch)
        told = capsys.readouterr().err
        assert code in (0, 1, 2), line
        assert code != 2 or (told.count("\n") == 1 and str(folder) in told), f"{line}: {told}"


@pytest.mark.parametrize("damage", ["cut", "text", "columns", "none"])
def test_a_damaged_log_of_sumo_is_refused_or_left_out_by_the_page(damage, whole, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    log = folder / "sumo/fcd.parquet"
    if damage == "cut":
        log.write_bytes(log.read_bytes()[:-100])
    elif damage == "none":
        pq.write_table(pq.read_table(log).slice(0, 0), log)
    else:
        table = pq.read_table(log)
        k = table.column_names.index("vehicle_x")
        table = (
            table.remove_column(k) if damage == "columns" else table.set_column(k, "vehicle_x", pa.array(["x"] * table.num_rows))
        )
        pq.write_table(table, log)
    monkeypatch.chdir(tmp_path)
    code, told = typed(f"report {folder} --out page.html", monkeypatch), capsys.readouterr().err
    assert (code, told.count("\n")) == ((0, 0) if damage == "none" else (2, 1)), told


# Bombs


def bomb(path: Path, root: bytes) -> Path:
    """512 MiB of blanks in an element, in 512 kB: one gzip member again and again."""
    path.write_bytes(gzip.compress(b"<%s>" % root) + 32 * gzip.compress(b" " * (1 << 24)) + gzip.compress(b"</%s>" % root))
    return path


def read_by(name: str, path: Path) -> None:
    """One of the readers of what comes from outside."""
    from sumo_net.netfile import read_net
    from trainctl.diff.golden import make_golden
    from trainctl.metrics.traffic import metrics_of_fcd
    from trainctl.traffic.files import parse

    if name == "net":
        read_net(path)
    elif name == "sumo":
        parse(path)
    elif name == "fcd":
        metrics_of_fcd(path)
    elif name == "golden":
        make_golden(path, path.parent / "golden", 60.0)


@pytest.mark.parametrize(
    ("reader", "root"), [("net", b"net"), ("sumo", b"additional"), ("golden", b"tripinfos"), ("fcd", b"fcd-export")]
)
def test_a_gzip_bomb_takes_neither_memory_nor_time(reader, root, tmp_path):
    path = bomb(tmp_path / "bomb.xml.gz", root)
    refused = []
    with bounded(1 << 28):
        try:
            read_by(reader, path)
        except (InputError, LineError) as error:
            refused = error.mistakes
            raise
    assert len(refused) == 1 and "times its size" in refused[0]


def test_a_log_of_trains_that_stand_for_hours_is_no_bomb(tmp_path):
    """Nothing that SUMO writes is packed better."""
    from trainctl.metrics.traffic import metrics_of_fcd
    from trainctl.runs.sumo_logs import TIMES

    rows = "".join(f'<vehicle id="t{k}" x="{k}.00" y="-1.60" speed="0.00" pos="{k}.00" lane="e{k}_0"/>\n' for k in range(20))
    text = "".join(f'<timestep time="{t}.00">\n{rows}</timestep>\n' for t in range(4000)).encode()
    path = tmp_path / "fcd.xml.gz"
    path.write_bytes(gzip.compress(b"<fcd-export>\n" + text + b"</fcd-export>\n"))
    assert 100 < len(text) / path.stat().st_size < TIMES / 2
    assert metrics_of_fcd(path)["fcd.standing_share"] == 1.0


@pytest.mark.parametrize("reader", ["net", "sumo", "fcd"])
def test_deep_nesting_is_refused_or_passed_over(reader, tmp_path):
    root = {"net": "net", "sumo": "additional"}.get(reader, "fcd-export")
    path = tmp_path / "deep.xml"
    path.write_text(f"<{root}>" + "<a>" * 200_000 + "</a>" * 200_000 + f"</{root}>")
    with bounded(1 << 28):
        read_by(reader, path)


def test_a_table_that_unpacks_to_more_than_it_can_hold_is_refused(whole, tmp_path):
    """One row sixty million times, in half a megabyte."""
    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    piece = pa.table(
        {"time_s": pa.array([0.0]).take(pa.array([0] * (1 << 20))), "train": pa.array(["a"] * (1 << 20)).dictionary_encode()}
    )
    with pq.ParquetWriter(folder / "trains.parquet", piece.schema, compression="zstd") as writer:
        for _ in range(60):
            writer.write_table(piece)
    assert (folder / "trains.parquet").stat().st_size < 1_000_000
    with bounded(1 << 28), pytest.raises(InputError, match="unpacks to"):
        Run(folder).table("trains")


@pytest.mark.parametrize("name", ["run.json", "events.jsonl", "scenario.toml", "metrics.json"])
@pytest.mark.parametrize("content", [b"[" * 5_000_000, b'{"a":' * 1_000_000, b"1" * 10_000_000])
def test_deep_and_long_text_files_are_refused(name, content, whole, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(whole, folder)
    (folder / name).write_bytes(content + b"\n")
    with bounded(), pytest.raises(InputError):
        found = Run(folder)
        _ = {"events.jsonl": lambda: found.events, "scenario.toml": lambda: found.scenario}.get(name, lambda: found.metrics)()
