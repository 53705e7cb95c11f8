"""What differs between two runs, or between two logs of SUMO's: where first, where most, and which rows stand in only one.

``report = diff("runs/a", "runs/b")``; ``report.same``, ``report.first``, ``report.tables``, ``report.as_dict()``. The first one is
the reference: a column that only it has is a difference, one that only the other has is a note. Versions are notes, and SUMO's
headers, clocks and durations are not compared.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from trainctl.diff.causes import causes
from trainctl.diff.findings import Finding, merged, short
from trainctl.diff.golden import golden_of_logs, thinned
from trainctl.diff.rows import Place, TableDiff, compare
from trainctl.diff.sources import KINDS, our_events, our_table, sumo_log, sumo_logs_in
from trainctl.diff.tolerance import EXACT, Tolerance, Tolerances, parse_tolerances, read_tolerances
from trainctl.errors import InputError, printable
from trainctl.record.folder import INFO, plain
from trainctl.runs.run import Run

__all__ = ["EXACT", "Report", "Tolerance", "Tolerances", "diff", "parse_tolerances", "read_tolerances"]


@dataclass
class Report:
    """All differences between A and B."""

    a: str
    b: str
    tables: list[TableDiff] = field(default_factory=list)
    #: key, value in A, value in B: what differs in the scenario and in how the run ended
    settings: list[tuple[str, Any, Any]] = field(default_factory=list)
    renamed: dict[str, str] = field(default_factory=dict)  # name in A -> name in B
    files: list[str] = field(default_factory=list)  # logs that only one has
    notes: list[str] = field(default_factory=list)  # what is not a difference
    tolerances: Tolerances = field(default_factory=Tolerances)

    @property
    def same(self) -> bool:
        """Whether nothing differs beyond the tolerances."""
        return not (self.settings or self.renamed or self.files) and all(t.same for t in self.tables)

    @cached_property
    def findings(self) -> list[Finding]:
        """The differences by train and cause, in the order of time."""
        out = [Finding("setting", printable(f"{key}: {x} -> {y}")) for key, x, y in self.settings]
        out += [Finding("file", f"log {text}", tables=[text.partition(":")[0]]) for text in self.files]
        out += [Finding("renamed", f"train {short(old)} is called {short(new)}", [old, new]) for old, new in self.renamed.items()]
        return merged([*out, *(f for t in self.tables for f in causes(t, self.tolerances))])

    @property
    def first(self) -> str | None:
        """The first difference of the logs in words, None if there is none."""
        found = [(t.table, *t.first) for t in self.tables if t.first is not None]
        if not found:
            return None
        table, time, who, column = min(found, key=lambda item: item[1])
        where = ", ".join(part for part in ("" if time == math.inf else f"{time:.10g} s", who and short(who)) if part)
        text = f"{table}: {where}" if where else table
        return text if column is None or column.first is None else f"{text}: {short(column.column)} {told(column.first)}"

    def as_dict(self) -> dict[str, Any]:
        """Everything in what JSON knows."""
        return {
            "same": self.same, "a": self.a, "b": self.b, "first": self.first, "renamed": self.renamed, "files": self.files,
            "settings": [{"key": key, "a": _json(x), "b": _json(y)} for key, x, y in self.settings], "notes": self.notes,
            "findings": [plain(f.as_dict()) for f in self.findings], "tables": [_table(t) for t in self.tables],
        }  # fmt: skip

    def lines(self, most: int = 20) -> list[str]:
        """The differences, one line each: the first, the findings, then table by table."""
        out = [f"first: {self.first}"] if self.first else []
        out += [f"{f.words} [{f.where}]" if f.where else f.words for f in self.findings[:most]]
        for t in self.tables:
            out += [f"{t.table}: {rows.count} rows only in {side}, first {at(rows.first_time_s, rows.first_who)}"
                    for rows, side in ((t.missing, "A"), (t.extra, "B")) if rows.count]  # fmt: skip
            for c in t.columns.values():
                worst = c.largest or c.first
                assert worst is not None
                where = at(worst.time_s, worst.who)
                out.append(f"{t.table}.{c.column}: {c.differing} of {t.rows} rows differ, most at {where}: {told(worst)}")
        return out if len(out) <= 2 * most else [*out[: 2 * most], f"... and {len(out) - 2 * most} lines more"]


def at(time_s: float | None, who: str) -> str:
    """Time and names in words."""
    return ", ".join(part for part in ("" if time_s is None else f"{time_s:.10g} s", who and short(who)) if part) or "the only row"


def told(place: Place) -> str:
    """A difference in words."""
    text = f"{value_told(place.a)} -> {value_told(place.b)}"
    if place.difference is None:
        return text
    tube = [f"tube {value_told(place.lower)} .. {value_told(place.upper)}"] if place.lower is not None else []
    by = [f"by {place.difference:.3g}"] if math.isfinite(place.difference) else []  # one of them is no number
    said = "; ".join(by + tube)
    return f"{text} ({said})" if said else text


def value_told(value: float | str | None) -> str:
    """A value of a log in words."""
    if isinstance(value, float):
        return "no number" if math.isnan(value) else f"{value:.10g}"
    return "nothing" if value in (None, "") else short(str(value))


def _json(value: Any) -> Any:
    """A value of a scenario in what JSON knows: dates, which TOML has, as text."""
    if isinstance(value, list):
        return [_json(item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): _json(item) for key, item in value.items()}
    return plain(value) if value is None or isinstance(value, str | bool | int | float) else str(value)


def _table(t: TableDiff) -> dict[str, Any]:
    columns = [{
        "column": c.column, "absolute": c.tolerance.absolute, "relative": c.tolerance.relative, "tolerance": c.tolerance.told(),
        "differing": c.differing,
        "first": None if c.first is None else dataclasses.asdict(c.first),
        "largest": None if c.largest is None else dataclasses.asdict(c.largest),
    } for c in t.columns.values()]  # fmt: skip
    shown: dict[str, Any] = plain({
        "table": t.table, "same": t.same, "rows": t.rows, "missing": dataclasses.asdict(t.missing),
        "extra": dataclasses.asdict(t.extra), "lost_columns": t.lost_columns, "new_columns": t.new_columns, "columns": columns,
    })  # fmt: skip
    return shown


def diff(a: Path | str, b: Path | str, tolerances: Tolerances | None = None) -> Report:
    """Compare two run folders, two folders of SUMO's logs, or two of SUMO's logs, in whatever format each is; or with a golden.

    Parameters
    ----------
    a, b : Path
        The reference, and what is compared with it.
    tolerances : Tolerances, optional
        Default: 1e-6 absolute, 2e-9 relative, wider for forces and energies, and never finer than the decimals of a log.

    Raises
    ------
    InputError
        One of them is missing, damaged, or no log, or they are of different kinds.
    """
    a, b, chosen = Path(a), Path(b), tolerances or Tolerances()
    for path in (a, b):
        if not path.exists():
            raise InputError(f"{path}: no such file or directory")
    report = Report(str(a), str(b), tolerances=chosen)
    names: dict[str, str] = {}  # in B -> in A
    if golden_of_logs(a):
        _of_golden(report, a, b, chosen, names)
    elif a.is_dir() != b.is_dir():
        raise InputError(f"{a}, {b}: one is a folder, the other a file: give two run folders or two logs")
    elif not a.is_dir():
        _logs(report, a, b, chosen, names)
    elif (a / INFO).exists() and (b / INFO).exists():
        _runs(report, Run(a), Run(b), chosen, names)
    else:
        _folders(report, a, b, chosen, names)
        if not report.tables and not report.files:
            raise InputError(f"{a}, {b}: neither run folders nor folders with logs of SUMO")
    report.renamed = {old: new for new, old in names.items()}
    if b.is_dir() and thinned(b) and not thinned(a):
        _note(report, f"{short(str(b))} is a golden, which holds some instants only: give it first")
    met = {(t.table, c) for t in report.tables for c in t.compared}
    report.notes += [f"tolerance of {name}: no such column was compared" for name in chosen.unused(met)]
    report.notes += [f"{t.table}.{name}: only in B" for t in report.tables for name in t.new_columns]
    return report


def _logs(
    report: Report, a: Path, b: Path, tolerances: Tolerances, names: dict[str, str], part: bool = False, name: str = ""
) -> None:
    """Compare two logs of SUMO's."""
    logs = []
    for path in (a, b):
        log = sumo_log(path)
        if log is None:
            raise InputError(
                f"{path}: not a log that can be compared: known are {', '.join(k.name for k in KINDS)}, and run folders"
            )
        logs.append(log)
    one, two = logs
    if one.name and two.name and one.name != two.name:
        raise InputError(f"{a} is a log of {one.name}, {b} of {two.name}: they cannot be compared")
    if one.version and two.version and one.version != two.version:
        _note(report, f"SUMO {one.version} -> {two.version}")
    kind = next((k for k in KINDS if k.name == (one.name or two.name or name)), None)
    if kind is not None:  # an empty log is one of any kind
        one, two = (dataclasses.replace(log, name=kind.name, time=kind.time, keys=kind.keys) for log in (one, two))
    report.tables.append(compare(one, two, tolerances, names, part))


def _note(report: Report, text: str) -> None:
    if text not in report.notes:
        report.notes.append(text)


def _folders(report: Report, a: Path, b: Path, tolerances: Tolerances, names: dict[str, str], some: Collection[str] = ()) -> None:
    """Compare all logs of SUMO's in two folders."""
    in_a, in_b = sumo_logs_in(a), sumo_logs_in(b)
    for kind in (k.name for k in KINDS):
        if kind in in_a and kind in in_b:
            _logs(report, in_a[kind], in_b[kind], tolerances, names, kind in some, kind)
        elif kind in in_a:
            report.files.append(f"{kind}: only in A")
        elif kind in in_b and not some:
            report.files.append(f"{kind}: only in B")


def _of_golden(report: Report, a: Path, b: Path, tolerances: Tolerances, names: dict[str, str]) -> None:
    """Compare logs with their golden."""
    if b.is_dir():
        _folders(report, a, b, tolerances, names, thinned(a))
        return
    log, kept = sumo_log(b), sumo_logs_in(a)
    if log is None or log.name not in kept:
        raise InputError(f"{b}: the golden {a} has {', '.join(kept) or 'no log'}, not {log.name if log else 'this'}")
    _logs(report, kept[log.name], b, tolerances, names, log.name in thinned(a))


def _runs(report: Report, a: Run, b: Run, tolerances: Tolerances, names: dict[str, str]) -> None:
    """Compare two run folders."""
    kept = thinned(a.folder)
    for package in sorted({*_versions(a), *_versions(b)}):
        x, y = _versions(a).get(package), _versions(b).get(package)
        if x != y:
            _note(report, f"{package} {x} -> {y}")
    for key in ("status", "seed"):
        if a.info.get(key) != b.info.get(key):
            report.settings.append((key, a.info.get(key), b.info.get(key)))
    _scenarios(report, a.scenario, b.scenario)
    for table in ("trains", "units", "links", "stops"):
        if a.files(table) and b.files(table):
            report.tables.append(compare(our_table(a, table), our_table(b, table), tolerances, names, table in kept))
        elif a.files(table) or (b.files(table) and not kept):
            report.files.append(f"{table}: only in {'A' if a.files(table) else 'B'}")
    report.tables.append(compare(our_events(a, {}), our_events(b, dict(names)), tolerances, {}))
    if a.info.get("backend") == b.info.get("backend"):
        _folders(report, a.folder / "sumo", b.folder / "sumo", tolerances, names, kept)
    else:
        _note(report, f"backend {a.info.get('backend')} -> {b.info.get('backend')}: SUMO's logs are not compared")


def _versions(run: Run) -> Mapping[str, Any]:
    versions = run.info.get("versions")
    return versions if isinstance(versions, dict) else {}


def _scenarios(report: Report, a: Mapping[str, Any], b: Mapping[str, Any]) -> None:
    """Values both scenarios state and that differ; a key that one version writes and another does not is a note."""
    x, y = _flat(a, "scenario"), _flat(b, "scenario")
    for key in x:
        if key in y and x[key] != y[key] and not (x[key] != x[key] and y[key] != y[key]):
            if key == "scenario.title":
                _note(report, f"{key}: {x[key]} -> {y[key]}")
            elif key != "scenario.run.seed" or all(s[0] != "seed" for s in report.settings):
                report.settings.append((key, x[key], y[key]))
    for one, two, side in ((x, y, "A"), (y, x, "B")):
        for key in one:
            if key not in two:
                _note(report, f"{key} = {short(str(one[key]))}: only in {side}")


def _flat(value: Any, key: str) -> dict[str, Any]:
    if isinstance(value, Mapping):
        return {k: v for name, item in value.items() for k, v in _flat(item, f"{key}.{name}").items()}
    if isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
        items = {f"{key}: entries": len(value)}
        return items | {k: v for n, item in enumerate(value, 1) for k, v in _flat(item, f"{key}[{n}]").items()}
    return {key: value}
