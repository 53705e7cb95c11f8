"""Another program's tests: every SUMO configuration of a folder under a law and as the baseline, beside plain SUMO on these files.

``python tools/sumo_tests.py FOLDER`` runs each ``*.sumocfg`` below FOLDER three times: by ``sumo`` as it is, by a law (the scenario
is that of ``trainctl new scenario``) and as the baseline (``law = "sumo"`` on the files as they are). With ``--obey`` trains also
run by themselves and obey the signals. One row each tells

=============  ==================================================================================================================
plain          trains that arrived in plain SUMO; or that SUMO refuses the files
ran            ok, or the exit code of the run with the first line of what is wrong
arrived        trains that arrived, of those of plain SUMO
order          whether they arrived in the same order; of those that both have
stops          stops made, of those of plain SUMO
late_s         largest difference of an arrival to plain SUMO's [s]
collisions     that SUMO counted, less those of plain SUMO
named          how many lines ``check`` has of what is not followed
=============  ==================================================================================================================

The exit code is 1 if a run ends otherwise than with 0, 1 (a bound violated) or 2 (refused in words), if there are more collisions
than in plain SUMO, if a stop of plain SUMO is not made, or if a train that obeys does not arrive. A run in which fewer trains
arrive than in plain SUMO is made again, longer, and that one counts. ``--json`` prints the rows as JSON, ``--only WORD`` takes the
configurations with it in their path, ``--jobs`` runs several at once.

SUMO's own tests come with its source package (``tests/sumo/rail``), not with the wheels; its cases name their files in options, so
give each a configuration first (``sumo ... --save-configuration run.sumocfg``).
"""

from __future__ import annotations

import argparse
import json
import math
import re
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from sumo_net.build import program
from trainctl.errors import InputError
from trainctl.scenario.starter import starter

#: What a scenario is run with, by the names of the rows.
LAW: dict[str, tuple[str, ...]] = {"law": (), "baseline": ("--set", "controller.law=sumo")}
OBEY: dict[str, tuple[str, ...]] = {"obey": ("--set", "traffic.cooperate=[]", "--set", "traffic.signals=obey")}

#: No run is waited for longer [s]: in the simulation, and for a run to end.
END_S, PATIENCE_S = 6000.0, 600.0


class Result(NamedTuple):
    """What one run of a configuration came to."""

    code: int
    said: str  # its first complaint
    arrived: tuple[tuple[float, str], ...]  # s, train; by time
    stops: Counter[str]  # made, by train
    collisions: int
    named: int  # lines of what is not followed


def rows(log: Path, tag: str) -> list[dict[str, str]]:
    """Attributes of the elements of an XML log."""
    text = log.read_text(encoding="utf-8") if log.is_file() else ""
    return [dict(re.findall(r'([\w.]+)="([^"]*)"', row)) for row in re.findall(rf"<{tag} [^>]*>", text)]


def arrivals(log: Path) -> tuple[tuple[float, str], ...]:
    """Arrivals in a tripinfo log, in the order of time."""
    return tuple(sorted((float(row["arrival"]), row["id"]) for row in rows(log, "tripinfo") if float(row["arrival"]) >= 0))


def plain(sumocfg: Path, work: Path) -> Result:
    """SUMO itself."""
    sumo, environment = program("sumo")
    logs = {key: work / f"{key}.xml" for key in ("tripinfo", "stop", "collision")}
    command = [str(sumo), "-c", str(sumocfg), "--no-step-log", "--duration-log.disable", "--time-to-teleport", "-1"]
    for key, log in logs.items():
        command += [f"--{key}-output", str(log)]
    if not re.search(r"<(end|e) ", sumocfg.read_text(encoding="utf-8")):
        command += ["--end", f"{END_S:g}"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    errors = [line for line in done.stderr.splitlines() if line.startswith("Error")]
    stops = Counter(row["id"] for row in rows(logs["stop"], "stopinfo") if row.get("state") != "waypoint")
    collisions = len(rows(logs["collision"], "collision"))
    return Result(done.returncode, errors[0] if errors else "", arrivals(logs["tripinfo"]), stops, collisions, 0)


def ours(scenario: Path, out: Path, *more: str) -> Result:
    """``trainctl run`` of a scenario."""
    command = [sys.executable, "-m", "trainctl", "run", str(scenario), "--out", str(out), *more]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S, cwd=scenario.parent)
    except subprocess.TimeoutExpired:
        return Result(124, f"no end after {PATIENCE_S:g} s", (), Counter(), 0, 0)
    said = next((line for line in done.stderr.splitlines() if line.strip() and not line.startswith("Warning")), "")
    log = out / "events.jsonl"
    events: list[dict[str, Any]] = [json.loads(line) for line in log.read_text().splitlines()] if log.is_file() else []
    gone = [(float(e["time_s"]), str(e["train"])) for e in events if e["kind"] == "arrive"]
    stops = Counter(str(e["train"]) for e in events if e["kind"] == "stop_reached")
    collisions = len(rows(out / "sumo" / "collisions.xml", "collision"))
    named = sum(e["kind"] == "not_followed" for e in events)
    return Result(done.returncode, said if done.returncode else "", tuple(sorted(gone)), stops, collisions, named)


def compared(of: Result, there: Result, begin_s: float) -> dict[str, Any]:
    """One run beside plain SUMO's; its times count from the begin of the configuration."""
    if of.code not in (0, 1):
        return {"ran": f"exit {of.code}: {of.said}"}
    here, theirs = {name: t + begin_s for t, name in of.arrived}, {name: t for t, name in there.arrived}
    both = here.keys() & theirs.keys()
    order = [[name for _, name in result.arrived if name in both] for result in (of, there)]
    return {
        "ran": "ok",
        "arrived": f"{len(both)}/{len(theirs)}",
        "order": order[0] == order[1],
        "stops": f"{sum((of.stops & there.stops).values())}/{sum(there.stops.values())}",
        "late_s": round(max((here[name] - theirs[name] for name in both), key=abs, default=0.0), 1),
        "collisions": of.collisions - there.collisions,
        "named": of.named,
    }


def case(sumocfg: Path, base: Path, ran: Mapping[str, tuple[str, ...]]) -> dict[str, Any]:
    """All rows of one configuration; ``ran`` is what each is run with."""
    with tempfile.TemporaryDirectory(prefix="sumo_tests.") as name:
        work = Path(name)
        there = plain(sumocfg, work)
        found: dict[str, Any] = {"case": str(sumocfg.relative_to(base))}
        found["plain"] = f"refused: {there.said}" if there.code else len(there.arrived)
        scenario = work / "scenario.toml"
        try:
            scenario.write_text(starter(sumocfg, work), encoding="utf-8")
        except InputError as error:
            why = str(error).splitlines()[0]
            return found | {who: {"ran": f"exit 2: {why}"} for who in ran}
        begin = re.search(r'<(?:begin|b) (?:value|v)="([\d.]+)"', sumocfg.read_text(encoding="utf-8"))
        since = float(begin[1]) if begin else 0.0
        end = 1.2 * (max((t for t, _ in there.arrived), default=0.0) - since) + 300.0  # drivers brake with half the deceleration
        if end > tomllib.loads(scenario.read_text(encoding="utf-8"))["run"]["duration_s"]:  # SUMO itself is slower than thought
            longer = re.sub(r"(?m)^duration_s = \d+", f"duration_s = {math.ceil(end)}", scenario.read_text(encoding="utf-8"))
            scenario.write_text(longer, encoding="utf-8")
        for who, with_ in ran.items():
            here = ours(scenario, work / who, *with_)
            if here.code in (0, 1) and len(here.arrived) < len(there.arrived):  # trains that wait for each other may need longer
                here = ours(scenario, work / who, *with_, "--set", f"run.duration_s={math.ceil(max(END_S, end))}", "--force")
            found[who] = compared(here, there, since)
        return found


def wrong(found: dict[str, Any]) -> list[str]:
    """What of a case must not be."""
    said = []
    for key in (who for who in (*LAW, *OBEY) if who in found):
        row = found[key]
        if row["ran"] != "ok":
            said += [f"{found['case']}: {key}: {row['ran']}"] if not row["ran"].startswith("exit 2") else []
            continue
        made, all_of_them = map(int, row["stops"].split("/"))
        said += [f"{found['case']}: {key}: {row['collisions']} more collisions"] if row["collisions"] > 0 else []
        said += [f"{found['case']}: {key}: {all_of_them - made} stops not made"] if made < all_of_them else []
        here, theirs = map(int, row["arrived"].split("/"))
        said += [f"{found['case']}: {key}: {theirs - here} trains not arrived"] if key in OBEY and here < theirs else []
    return said


def table(found: list[dict[str, Any]]) -> str:
    """The rows as text."""
    heads = ("case", "plain", "who", "ran", "arrived", "order", "stops", "late_s", "collisions", "named")
    lines = [heads]
    for row in found:
        for who in (who for who in (*LAW, *OBEY) if who in row):
            lines.append(
                (row["case"], str(row["plain"])[:40], who, *(str(row[who].get(key, ""))[:100] for key in heads[3:]))  # type: ignore[arg-type]
            )
    widths = [max(len(line[k]) for line in lines) for k in range(len(heads))]
    return "\n".join("  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip() for line in lines)


def main(arguments: list[str] | None = None) -> int:
    """The command; its exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="configurations with this in their path")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--obey", action="store_true", help="run each with signals obeyed, too")
    given = parser.parse_args(arguments)
    files = sorted(p for p in given.folder.rglob("*.sumocfg") if given.only in str(p))
    if not files:
        print(f"{given.folder}: no *.sumocfg in it", file=sys.stderr)
        return 2
    with ThreadPoolExecutor(given.jobs) as pool:
        ran, found = LAW | (OBEY if given.obey else {}), []
        for row in pool.map(lambda path: case(path.resolve(), given.folder.resolve(), ran), files):
            found.append(row)
            print(f"{len(found)} of {len(files)}: {row['case']}", file=sys.stderr)
    print(json.dumps(found, indent=1) if given.json else table(found))
    complaints = [line for row in found for line in wrong(row)]
    print(*complaints, sep="\n", file=sys.stderr)
    return bool(complaints)


if __name__ == "__main__":
    sys.exit(main())
