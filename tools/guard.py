"""Whether two checkouts compute the same: every shipped scenario and the nets of the tests, hashed and compared.

``python tools/guard.py run --checkout DIR --out FILE`` runs everything with the code in DIR and writes hashes to FILE;
``python tools/guard.py compare A B`` names what differs: file, first column and row. A change that only moves code must not change
one. Hashes hold for one machine alone, since rounding differs between processors: FILE must lie outside of any checkout.

Hashed are the content of all tables (columns, not the Parquet file), events.jsonl, metrics.json, scenario.toml, what run.json says
of the run, and SUMO's logs without headers, clocks and paths. Runs are processes of their own, as many at a time as processors.
Nets and their scenarios are made with the code of this checkout, shipped scenarios are those of DIR.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import tomllib
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

HERE = Path(__file__).resolve().parent.parent

BACKENDS = ("sumo", "numeric")

#: Runs end here at the latest [s]: behind the switches at 1000 s of the shipped scenarios.
AT_MOST_S = 1060.0

#: Sub-steps make these laws some ten times slower; theirs end earlier, unless they change tracks [s].
UNITS_AT_MOST_S = 250.0
OF_UNITS = ("emu_", "fault_tolerant")

#: Nothing happens under SUMO's own drivers that takes longer [s].
BASELINE_AT_MOST_S = 400.0

#: What tells headers, clocks and durations of the computer in SUMO's logs.
CLOCKS = re.compile(
    r'<\?xml.*?\?>|<!--.*?-->|<performance [^>]*/>|\bduration="\d+"(?=\s*/>)|\b[\d.]+ms\b|(Duration|Real time factor|UPS): \S+',
    re.DOTALL,
)

#: What run.json says beside the run.
OF_THE_COMPUTER = ("wall_time_s", "command_line", "versions")

#: Ours, and SUMO's that are text.
TEXTS = (".jsonl", ".json", ".toml", ".xml", ".log", ".sumocfg", ".add", ".txt")


class Job(NamedTuple):
    """One run."""

    name: str  # case/backend
    scenario: str  # name, or path
    backend: str
    settings: tuple[str, ...]


# What is run


def shipped(checkout: Path, at_most_s: float) -> Iterator[Job]:
    """Every scenario that comes with the checkout; three_tracks also supervised, both railways also under SUMO's own drivers."""
    for path in sorted((checkout / "scenarios").glob("*.toml")):
        name = path.stem
        units = name.startswith(OF_UNITS) and not name.endswith("_reroute")
        end = min(own_duration_s(path), at_most_s, UNITS_AT_MOST_S if units else at_most_s)
        for backend in BACKENDS:
            yield Job(f"{name}/{backend}", name, backend, (f"run.duration_s={end:g}",))
    end = min(at_most_s, BASELINE_AT_MOST_S)
    for backend in BACKENDS:
        settings = (f"run.duration_s={at_most_s:g}", "supervisor.mode=on")
        yield Job(f"three_tracks, supervised/{backend}", "three_tracks", backend, settings)
    for name in ("three_tracks", "merging"):
        yield Job(f"{name}, baseline/sumo", name, "sumo", (f"run.duration_s={end:g}", "controller.law=sumo"))


def own_duration_s(path: Path) -> float:
    """``run.duration_s`` of a scenario, or of the one it extends."""
    tables = tomllib.loads(path.read_text(encoding="utf-8"))
    if "duration_s" in tables.get("run", {}):
        return float(tables["run"]["duration_s"])
    return own_duration_s((path.parent / tables["extends"]).with_suffix(".toml"))


def asked(name: str, only: list[str]) -> bool:
    """Whether a run is asked for: its name contains one of these, or there are none."""
    return not only or any(word in name for word in only)


def of_nets(folder: Path) -> Iterator[Job]:
    """Every kind of net of tests/nets.py, under its law and the supervisor; needs the folder ``nets`` has written."""
    for path in sorted(folder.glob("*/s.toml")):
        case = path.parent.name
        for backend in BACKENDS[:1] if case.endswith("baseline") else BACKENDS:
            yield Job(f"net {case}/{backend}", str(path), backend, ())


def write_nets(folder: Path, at_most_s: float, only: list[str]) -> None:
    """Write the nets asked for, their traffic and scenarios; the code and the tests of this checkout must be on Python's path."""
    import nets
    import tomli_w

    meeting = nets.flow("up", nets.UP, 3, 60, departSpeed="0") + nets.flow("down", nets.DOWN, 3, 60, 20, departSpeed="0")
    baseline = {"controller": {"law": "sumo", "block": "moving"}}
    both = ("emu", "long")
    cases: list[tuple[str, Callable[[Path], None], str, float, dict[str, Any]]] = [
        *((f"branches, {law}", lambda f: nets.branches(f, number=2), law, 420.0, {}) for law in nets.LAWS),
        ("branches, plain", lambda f: nets.branches(f, "--no-internal-links"), "robust_constrained", 900.0, {}),
        ("branches, baseline", nets.branches, "robust_constrained", 900.0, baseline),
        ("three joins", nets.three_joins, "robust_constrained", 2000.0, {}),
        ("single track", lambda f: nets.single_track(f, meeting), "robust_constrained", 1500.0, {}),
        ("diamond", nets.diamond, "robust_constrained", 700.0, {}),
        ("station", nets.station, "robust_constrained", 1500.0, {}),
        ("station, units", nets.station, "fault_tolerant", 420.0, {}),
        ("ring", nets.ring, "robust_constrained", 1500.0, {}),
        ("limits", nets.limits, "fully_distributed", 1200.0, {}),
        ("limits, units", nets.limits, "emu_finite_time", 700.0, {}),
        ("crowd", lambda f: nets.crowd(f, 16), "robust_constrained", 1500.0, {"types": both}),
        ("separate", nets.separate, "robust_constrained", 700.0, {}),
        ("monitor", nets.three_joins, "fully_distributed", 900.0, {"supervisor": {"mode": "monitor"}}),
        *((f"random {seed}", lambda f, seed=seed: nets.at_random(f, seed), "robust_constrained", 1200.0, {}) for seed in range(3)),  # type: ignore[misc]
    ]
    for case, make, law, duration, changes in cases:
        place = folder / case.replace(", ", "_").replace(" ", "_")
        if not any(asked(f"net {place.name}/{backend}", only) for backend in BACKENDS):
            continue
        make(place)
        tables = nets.scenario(law, min(duration, at_most_s), **changes)
        if case.endswith("baseline"):
            tables["controller"] = baseline["controller"]
        if "long" in tables["train_type"]:
            tables["train_type"]["long"] |= {"unit_length_m": 250.0}
        (place / "s.toml").write_text(tomli_w.dumps(tables), encoding="utf-8")
    if any(asked(f"net hilly/{backend}", only) for backend in BACKENDS):
        hilly(folder / "hilly", at_most_s)


def hilly(place: Path, at_most_s: float) -> None:
    """The line with slopes and limits: trains of units that obey them."""
    import nets
    import tomli_w

    place.mkdir(parents=True)
    (place / "hilly.toml").write_text(tomli_w.dumps(nets.HILLY), encoding="utf-8")
    tables = nets.scenario("emu_finite_time", min(120.0, at_most_s))
    tables["network"] = {"line": "hilly.toml"}
    tables["train"] = [
        {"id": k, "type": "emu", "track": track, "position_m": 3500.0 - 1200.0 * (k - 1) + 3.0 * k, "speed_mps": 35.0 + 0.2 * k}
        for k, track in ((1, "left"), (2, "left"), (3, "right"))
    ]
    tables["topology"] |= {"desired": "slots"}
    (place / "s.toml").write_text(tomli_w.dumps(tables), encoding="utf-8")


# Hashes


def content(folder: Path, replaced: dict[str, str]) -> dict[str, Any]:
    """Hashes of every file of a run folder; ``replaced`` are paths that may differ, and what stands for them."""
    found: dict[str, Any] = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        name = path.relative_to(folder).as_posix()
        if path.suffix == ".parquet":
            found[name] = of_table(pq.read_table(path))
        elif path.suffix in TEXTS:
            text = path.read_text(encoding="utf-8")
            if name == "run.json":
                told = {k: v for k, v in json.loads(text).items() if k not in OF_THE_COMPUTER}
                text = json.dumps(told, indent=2, sort_keys=True)
            elif name.startswith("sumo/"):
                text = CLOCKS.sub("", text)
            for old, new in replaced.items():
                text = text.replace(old, new)
            found[name] = of_text(text)
        else:
            found[name] = {"sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    return found


def of_text(text: str) -> dict[str, Any]:
    """Hash of a text and check sums of its lines."""
    lines = [zlib.crc32(line.encode()) for line in text.splitlines()]
    return {"sha256": hashlib.sha256(text.encode()).hexdigest(), "rows": packed(np.array(lines, np.uint32))}


def of_table(table: pa.Table) -> dict[str, Any]:
    """Hashes of a table, of every column by itself, and check sums of its rows."""
    whole, columns, rows = hashlib.sha256(), {}, np.zeros(table.num_rows, np.uint64)
    for name in table.column_names:
        column = table.column(name).combine_chunks()
        kind = str(column.type)
        if pa.types.is_dictionary(column.type):
            column = column.cast(column.type.value_type)
        missing = np.asarray(column.is_null().to_numpy(zero_copy_only=False), bool)
        if pa.types.is_primitive(column.type):
            filled = column.fill_null(pa.scalar(False if pa.types.is_boolean(column.type) else 0, column.type))
            values = np.ascontiguousarray(filled.to_numpy(zero_copy_only=False))
            raw = values.tobytes()
            bits = np.frombuffer(raw, np.uint8).reshape(len(values), values.itemsize)
        else:
            texts = [json.dumps(value, default=str).encode() for value in column.to_pylist()]
            raw = b"\n".join(texts)
            bits = np.array([zlib.crc32(text) for text in texts], np.uint32).view(np.uint8).reshape(len(texts), 4)
        digest = hashlib.sha256(f"{name} {kind} {table.num_rows}\n".encode() + missing.tobytes() + raw)
        columns[name] = digest.hexdigest()
        whole.update(digest.digest())
        eight = np.zeros((table.num_rows, 8), np.uint8)
        eight[:, : bits.shape[1]] = bits
        with np.errstate(over="ignore"):
            rows = (rows ^ eight.view(np.uint64)[:, 0] ^ missing) * np.uint64(0x9E3779B97F4A7C15)
            rows ^= rows >> np.uint64(29)
    return {"sha256": whole.hexdigest(), "columns": columns, "rows": packed((rows >> np.uint64(32)).astype(np.uint32))}


def packed(sums: np.ndarray[Any, Any]) -> str:
    """Check sums as text."""
    return base64.b85encode(zlib.compress(sums.astype("<u4").tobytes())).decode()


def unpacked(text: str) -> np.ndarray[Any, Any]:
    """Check sums of text."""
    return np.frombuffer(zlib.decompress(base64.b85decode(text)), "<u4")


# Running


def environment(*paths: Path) -> dict[str, str]:
    """These first on the path of Python; nothing of ours from elsewhere."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}


#: ``trainctl`` of the checkout, whichever is installed.
TRAINCTL = """
import pathlib, sys, trainctl
at = pathlib.Path(trainctl.__file__).resolve().parent.parent
if at != pathlib.Path(sys.argv[1]):
    sys.exit(f"trainctl comes from {at}, not from {sys.argv[1]}")
del sys.argv[1]
from trainctl.cli.program import main
main()
"""


def done(job: Job, checkout: Path, folder: Path) -> dict[str, Any]:
    """Run one job in ``folder`` and hash what it leaves."""
    place = folder / re.sub(r"\W+", "_", job.name)
    place.mkdir(parents=True)
    command = [sys.executable, "-c", TRAINCTL, str(checkout), "run", job.scenario, "--backend", job.backend, "-q", "--out", "run"]
    for setting in job.settings:
        command += ["--set", setting]
    began = time.perf_counter()
    ended = subprocess.run(command, cwd=place, env=environment(checkout), capture_output=True, text=True, check=False)
    said = {str(place.resolve()): "RUN", str(place): "RUN", str(folder.resolve()): "ALL", str(folder): "ALL", str(checkout): "CODE"}
    stderr = ended.stderr
    for old, new in said.items():
        stderr = stderr.replace(old, new)
    left = next((p for p in (place / "run", place / "run.partial") if p.exists()), None)
    return {
        "exit": ended.returncode, "stderr": stderr.splitlines(), "seconds": round(time.perf_counter() - began, 1),
        "files": content(left, said) if left else {},
    }  # fmt: skip


def run_all(checkout: Path, at_most_s: float, only: list[str], at_a_time: int, folder: Path) -> dict[str, Any]:
    """Run what is asked for in ``folder``."""
    nets = folder / "nets"
    command = [sys.executable, __file__, "nets", str(nets), str(at_most_s), *only]
    subprocess.run(command, env=environment(HERE, HERE / "tests"), check=True)
    jobs = [job for job in (*shipped(checkout, at_most_s), *of_nets(nets)) if asked(job.name, only)]
    if not jobs:
        raise SystemExit(wrong(f"--only {' '.join(only)}: no run has such a name"))
    runs: dict[str, Any] = {}
    with ThreadPoolExecutor(at_a_time) as pool:
        waiting = {pool.submit(done, job, checkout, folder / "runs"): job.name for job in jobs}
        try:
            for number, future in enumerate(as_completed(waiting), 1):
                name, run = waiting[future], future.result()
                failed = f", exit code {run['exit']}: {' / '.join(run['stderr'][-3:])}" if run["exit"] else ""
                print(f"{number} of {len(jobs)}: {name}, {run['seconds']:g} s{failed}", file=sys.stderr, flush=True)
                runs[name] = run
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return {"at_most_s": at_most_s, "runs": dict(sorted(runs.items()))}


# Comparing


def first_column(one: dict[str, Any], two: dict[str, Any]) -> list[str]:
    """Which columns of two tables differ, in words."""
    p, q = one.get("columns", {}), two.get("columns", {})
    changed = [c for c in p if c in q and p[c] != q[c]]
    found = [f"no column {c} any more" for c in p if c not in q] + [f"new column {c}" for c in q if c not in p]
    found += [f"{len(changed)} of {len(p)} columns differ, the first is {changed[0]}"] if changed else []
    return found if found or list(p) == list(q) else ["another order of columns"]


def first_row(one: dict[str, Any], two: dict[str, Any]) -> str:
    """Where two files begin to differ, in words."""
    if "rows" not in one or "rows" not in two:
        return "other bytes"
    words = "line" if "columns" not in one else "row"
    a, b = unpacked(one["rows"]), unpacked(two["rows"])
    n = min(len(a), len(b))
    other = np.flatnonzero(a[:n] != b[:n])
    counts = f"{len(a)} and {len(b)} {words}s" if len(a) != len(b) else f"{len(other)} of {n} {words}s"
    return f"first in {words} {other[0] if len(other) else n} ({counts})"


def differences(a: dict[str, Any], b: dict[str, Any]) -> list[str]:
    """What differs between the runs of two checkouts, a line per file."""
    found = []
    for name in sorted(a.keys() | b.keys()):
        if name not in a or name not in b:
            found.append(f"{name}: only in the {'second' if name not in a else 'first'}")
            continue
        one, two = a[name], b[name]
        if (one["exit"], one["stderr"]) != (two["exit"], two["stderr"]):
            told = [f"exit code {r['exit']}" + (f" ({r['stderr'][-1]})" if r["stderr"] else "") for r in (one, two)]
            found.append(f"{name}: {told[0]}, then {told[1]}")
        for file in sorted(one["files"].keys() | two["files"].keys()):
            if file not in one["files"] or file not in two["files"]:
                found.append(f"{name}: {file}: only in the {'second' if file not in one['files'] else 'first'}")
                continue
            x, y = one["files"][file], two["files"][file]
            if x["sha256"] == y["sha256"]:
                continue
            found.append(f"{name}: {file}: {', '.join([*first_column(x, y), first_row(x, y)])}")
    return found


def read(path: Path) -> dict[str, Any]:
    """What ``run`` wrote."""
    try:
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return {"at_most_s": found["at_most_s"], "runs": found["runs"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SystemExit(wrong(f"{path}: not written by tools/guard.py run: {error}")) from None


def wrong(line: str) -> int:
    """Tell one mistake; the exit code for it."""
    print(line, file=sys.stderr)
    return 2


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    options = commands.add_parser("run", help="run everything and write hashes")
    options.add_argument("--checkout", type=Path, default=HERE, help="whose code runs; default this one")
    options.add_argument("--out", type=Path, required=True, help="JSON file, outside of any checkout")
    options.add_argument(
        "--at-most", type=float, default=AT_MOST_S, metavar="S", help=f"end of the runs [s]; default {AT_MOST_S:g}"
    )
    options.add_argument("--only", action="append", default=[], help="runs whose name contains this; repeatable; default all")
    options.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs at a time; default one per processor")
    options.add_argument("--keep", type=Path, help="an empty folder for the runs; default they are thrown away")
    options = commands.add_parser("compare", help="show what differs; exit code 1 if anything does")
    options.add_argument("files", type=Path, nargs=2, metavar="FILE")
    options = commands.add_parser("nets")  # of a process of its own
    options.add_argument("folder", type=Path)
    options.add_argument("at_most", type=float)
    options.add_argument("only", nargs="*")
    arguments = parser.parse_args()
    if arguments.command == "nets":
        write_nets(arguments.folder, arguments.at_most, arguments.only)
        return 0
    if arguments.command == "compare":
        one, two = map(read, arguments.files)
        if one["at_most_s"] != two["at_most_s"]:
            return wrong(f"{arguments.files[1]}: at_most_s = {two['at_most_s']:g}: must be {one['at_most_s']:g}, as in the first")
        told = differences(one["runs"], two["runs"])
        print("\n".join(told) if told else f"nothing differs in {len(one['runs'])} runs")
        return 1 if told else 0
    checkout, out = arguments.checkout.resolve(), arguments.out.resolve()
    if not (checkout / "trainctl").is_dir():
        return wrong(f"--checkout = {arguments.checkout}: no checkout: it has no folder trainctl")
    if any((place / ".git").exists() for place in out.parents):
        return wrong(f"--out = {arguments.out}: must lie outside of any checkout: hashes hold for one machine alone")
    if not out.parent.is_dir():
        return wrong(f"--out = {arguments.out}: no such folder")
    if arguments.keep and arguments.keep.exists() and any(arguments.keep.iterdir()):
        return wrong(f"--keep = {arguments.keep}: not empty")
    with tempfile.TemporaryDirectory(prefix="trainctl-guard-") as scratch:
        folder = (arguments.keep or Path(scratch)).resolve()
        found = run_all(checkout, arguments.at_most, arguments.only, arguments.jobs, folder)
    out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 1 if any(r["exit"] for r in found["runs"].values()) else 0


if __name__ == "__main__":
    sys.exit(main())
