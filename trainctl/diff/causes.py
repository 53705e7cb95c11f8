"""From the figures and the evidence of one table to findings: what explains which differences."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from trainctl.diff.closer import PLACES, Course, Kept, Shift, alike, shifted, stood, way
from trainctl.diff.findings import UNITS, Difference, Finding, counted, named, scaled, seconds, short, since
from trainctl.diff.rows import Place, TableDiff
from trainctl.diff.tolerance import Tolerance, Tolerances
from trainctl.signals import Bools, Floats

#: So many trains, those that differ first, are looked at one by one.
CLOSER = 200
#: More trains than this that begin to differ at one instant have not been exchanged.
EXCHANGED = 20
#: A constant needs so many values to be believed.
BELIEVED = 3
#: What scatters by more than this share of a column's values is no noise.
NOISE = 1e-3
#: What differs up to so long before a train leaves its way belongs to that [s].
BEFORE_S = 60.0
#: Columns of a log of whole trips that say when.
TRIP_TIMES = {"depart", "departDelay", "arrival", "duration", "waitingTime", "timeLoss", "stopTime", "started", "ended"}


@dataclass
class _Open:
    """What is not explained yet: columns by train, rows by train."""

    t: TableDiff
    columns: dict[int, set[str]] = field(default_factory=dict)
    only_a: set[int] = field(default_factory=set)
    only_b: set[int] = field(default_factory=set)

    @classmethod
    def of(cls, t: TableDiff) -> _Open:
        """All differences of a table."""
        out = cls(t, {}, {int(k) for k in t.only_a.trains()}, {int(k) for k in t.only_b.trains()})
        for name, tally in t.tallies.items():
            for train in tally.trains():
                out.columns.setdefault(int(train), set()).add(name)
        return out

    def first_s(self, train: int) -> float:
        """When a train differs first, infinite if it does not; where it is counts more than what else is said of it."""
        own = self.columns.get(train, set())
        places = own & {*PLACES, "lane", "edge", "track"}
        times = [float(self.t.tallies[c].figures["first_s"][train]) for c in places or own]
        times += [self.t.only_a.of("first_s", train)] if train in self.only_a else []
        times += [self.t.only_b.of("first_s", train)] if train in self.only_b else []
        return min(times, default=math.inf)

    def close(
        self, cause: str, words: str, trains: list[int], columns: set[str] | None, rows: bool, **more: float | None
    ) -> Finding:
        """A finding that explains these columns (None: all) of these trains, and their rows if said so."""
        t = self.t
        f = Finding(cause, words, [t.trains[k] for k in trains], [t.table], **more)  # type: ignore[arg-type]
        f.codes = {t.table: trains}
        starts: list[Difference] = []
        ends: list[Difference] = []
        for train in trains:
            own = self.columns.get(train, set())
            closed = own if columns is None else own & columns
            for name in sorted(closed):
                f.values += int(t.tallies[name].figures["count"][train])
                f.columns += [name] if name not in f.columns else []
                starts.append(_difference(t, name, train, "first"))
                ends.append(_difference(t, name, train, "most"))
            self.columns[train] = own - closed
            if rows:
                f.rows += int(t.only_a.of("count", train)) * (train in self.only_a) + int(t.only_b.of("count", train)) * (
                    train in self.only_b
                )
                self.only_a.discard(train)
                self.only_b.discard(train)
        if starts:
            f.first = min(starts, key=lambda d: math.inf if d.place.time_s is None else d.place.time_s)
            sized = [d for d in ends if d.place.difference is not None]
            f.largest = max(sized, key=lambda d: d.place.difference or 0.0, default=None)
        return f


def _difference(t: TableDiff, name: str, train: int, which: str) -> Difference:
    """First or largest difference of a train in a column."""
    tally = t.tallies[name]
    f = tally.figures
    who = f"{t.keys[0]} {t.trains[train]}" if t.keys else ""
    time = float(f[f"{which}_s"][train])
    timed = time if t.time is not None and math.isfinite(time) else None
    if not tally.numbers:
        first = float(f["first_s"][train])
        a, b = tally.texts.get(train, (None, None))
        return Difference(name, Place(first if t.time is not None else None, who, a, b, None))
    lower, upper = float(f["low"][train]), float(f["high"][train])
    cut = (None, None) if which == "first" or math.isnan(lower) else (lower, upper)
    return Difference(
        name, Place(timed, who, float(f[f"{which}_a"][train]), float(f[f"{which}_b"][train]), float(f[f"{which}_gap"][train]), *cut)
    )


def causes(t: TableDiff, tolerances: Tolerances) -> list[Finding]:
    """All findings of one table."""
    with np.errstate(over="ignore", invalid="ignore"):  # a damaged log may hold any number
        return [] if t.same else _causes(t, tolerances)


def _causes(t: TableDiff, tolerances: Tolerances) -> list[Finding]:
    todo, out = _Open.of(t), []
    told = {name: tolerances.of(t.table, name) for name in {*t.compared, *t.tallies}}
    for name in sorted(t.tallies):
        found = _constant(todo, name)
        out += [found] if found else []
    kept = Kept.of(t.rows_a, t.rows_b, t.keys, t.time)
    out += _ends(todo)
    out += _gone(todo, kept, told)
    trains = sorted((k for k in {*todo.only_a, *todo.only_b, *(k for k, c in todo.columns.items() if c)}), key=todo.first_s)[
        :CLOSER
    ]
    if t.time is None:
        out += _trips(todo, trains)
    else:
        out += _exchanged(todo, kept, trains, told)
        out += _ways(todo, kept, trains)
        shifts = _shifts(todo, kept, trains, told)
        out += _orders(todo, kept, trains, shifts)
        out += _late(todo, kept, shifts)
    out += _rows(todo)
    for name in sorted(t.tallies):
        out += _of_column(todo, name)
    out += [Finding("column", f"column {short(name)} is missing", [], [t.table], [name]) for name in t.lost_columns]
    return out


def _key(t: TableDiff) -> str:
    return t.keys[0] if t.keys else ""


def _constant(todo: _Open, name: str, most: bool = True) -> Finding | None:
    """A column that is the reference's plus or times a constant: of all trains, of most, or (``most`` not asked for) of some.

    Whether it is plus or times is decided by how many trains agree: a train that never changes its speed fits both.
    """
    t, tally = todo.t, todo.t.tallies[name]
    trains = np.array([k for k, columns in sorted(todo.columns.items()) if name in columns], np.int64)
    if not tally.numbers or not len(trains):
        return None
    f = {key: values[trains] for key, values in tally.figures.items()}
    low, high = f["shift_low"], f["shift_high"]
    plus = _agreed(low, high, (low <= high) & (f["count"] == f["rows"]) & (np.sign(low) * np.sign(high) > 0))
    low, high = f["scale_low"], f["scale_high"]
    with np.errstate(invalid="ignore"):
        narrow = np.isfinite(low) & np.isfinite(high) & (high - low < 1e-2 * np.abs(low + high)) & ~((low <= 1.0) & (high >= 1.0))
        times = _agreed(low, high, (low <= high) & (narrow | ~np.isfinite(low + high)))
    cause, agreed = ("shift", plus) if plus.sum() >= times.sum() else ("units", times)
    count = int(agreed.sum())
    if f["count"][agreed].sum() < BELIEVED or (most and count < len(trains) and (count < 2 or 2 * count <= len(trains))):
        return None
    own = [int(k) for k in trains[agreed]]
    first = float(f["first_s"][agreed].min()) if t.time is not None else None
    every = count == len(np.intersect1d(t.all_a.trains(), t.all_b.trains()))
    if most and name in PLACES and (count == 1 or not every):
        return None  # of a train at a steady speed the place is shifted if it is late
    who = "" if every or not t.keys else f" of {named((t.trains[k] for k in own), _key(t))}"
    side = "shift" if cause == "shift" else "scale"
    low_, high_ = float(f[f"{side}_low"][agreed].max()), float(f[f"{side}_high"][agreed].min())
    if not math.isfinite(low_ + high_):
        return None
    if cause == "shift":
        by = _neat(low_, high_)
        words = f"{short(name)}{who} shifted by {by:+.6g}{since(first)}"
    else:
        by = next((factor for factor in UNITS if low_ <= factor <= high_), _neat(low_, high_))
        words = f"{short(name)}{who} {scaled(by)}{since(first)}"
    return todo.close(cause, words, own, {name}, False, from_s=first, by=by)


def _agreed(low: Floats, high: Floats, possible: Bools) -> Bools:
    """The largest set of trains whose intervals have a constant in common."""
    ends = np.unique(low[possible & np.isfinite(low)])[:CLOSER]
    best = np.zeros(len(low), np.bool_)
    for end in ends:
        inside = possible & (low <= end) & (end <= high)
        best = inside if inside.sum() > best.sum() else best
    return best


def _neat(low: float, high: float) -> float:
    """The shortest number within an interval."""
    middle = 0.5 * (low + high)
    return next((x for digits in range(1, 16) if low <= (x := float(f"{middle:.{digits}g}")) <= high), middle)


def _ends(todo: _Open) -> list[Finding]:
    """A log that ends before the other, or begins after it."""
    t, out = todo.t, []
    if t.time is None or not len(t.all_a.trains()) or not len(t.all_b.trains()):
        return []
    for only, other, name, verb in (
        (todo.only_a, t.all_b, "only_a", "ends earlier than"), (todo.only_b, t.all_a, "only_b", "ends later than"),
    ):  # fmt: skip
        presence = t.only_a if name == "only_a" else t.only_b
        end = float(other.figures["last_s"].max())
        late = [k for k in sorted(only) if presence.of("first_s", k) > end and not presence.of("doubled", k)]
        if late:
            last = max(presence.of("last_s", k) for k in late)
            words = f"the log {verb} the reference: at {seconds(end if name == 'only_a' else last)} instead of "
            f = Finding(
                "ends", words + seconds(last if name == "only_a" else end), [t.trains[k] for k in late], [t.table], from_s=end
            )
            f.rows, f.codes = sum(int(presence.of("count", k)) for k in late), {t.table: late}
            only.difference_update(late)
            out.append(f)
    return out


def _gone(todo: _Open, kept: Kept, told: dict[str, Tolerance]) -> list[Finding]:
    """Trains that are missing, new, or under another name, from the beginning or from some time on."""
    t, out = todo.t, []
    new = [k for k in sorted(todo.only_b) if not t.all_a.of("count", k)]
    for other in new:
        for train in sorted(todo.only_a - set(new)):
            a, b = kept.a.get(train, []), kept.b.get(other, [])
            n, m = t.only_a.of("count", train), t.only_b.of("count", other)
            if n != m or not a or len(a) != len(b) or todo.columns.get(train):
                continue
            begin = t.only_a.of("first_s", train)
            pairs = zip(a, b, strict=True)
            if all(alike(x.take(x.time >= begin - 1e-7), y.take(y.time >= begin - 1e-7), told, kept.decimals) for x, y in pairs):
                whole = n == t.all_a.of("count", train)
                first = None if whole else begin
                words = f"{named([t.trains[train]], _key(t))} is called {short(t.trains[other])}{since(first)}"
                out.append(todo.close("renamed", words, [train, other], set(), True, from_s=first))
                break
    for only, all_there, elsewhere, cause in (
        (todo.only_a, t.all_a, t.all_b, "missing"), (todo.only_b, t.all_b, t.all_a, "added"),
    ):  # fmt: skip
        trains = [k for k in sorted(only) if not elsewhere.of("count", k)]
        if trains and t.keys:
            first = min(all_there.of("first_s", k) for k in trains) if t.time is not None else None
            words = f"{named((t.trains[k] for k in trains), _key(t))} {'missing' if cause == 'missing' else 'not in the reference'}"
            out.append(todo.close(cause, words, trains, set(), True, from_s=first))
    return out


def _trips(todo: _Open, trains: list[int]) -> list[Finding]:
    """In logs with a row per train: another route; later by the same in whatever says when."""
    t, out = todo.t, []
    for train in trains:
        who, own = named([t.trains[train]], _key(t)), todo.columns.get(train, set())
        routes = {name for name in own if name.startswith("route") and name.endswith("edges")}
        if routes:
            a, b = (str(text or "").split() for text in t.tallies[min(routes)].texts.get(train, ("", "")))
            out.append(todo.close("route", f"{who} takes another route: {_instead(a, b)}", [train], routes, False))
        times = own & TRIP_TIMES
        gaps = {name: _difference(t, name, train, "most").place for name in times if t.tallies[name].numbers}
        late = {name: (p.b - p.a) for name, p in gaps.items() if isinstance(p.a, float) and isinstance(p.b, float)}
        if len(late) == len(times) and times & {"arrival", "ended", "depart", "duration"}:
            sizes = np.abs(list(late.values()))
            by = late.get("arrival", late.get("ended", late.get("depart", late.get("duration", 0.0))))
            if np.ptp(sizes) <= 0.02 and abs(by) > 0:
                word = "late" if by > 0 else "early"
                out.append(todo.close(word, f"{who} {word} by {seconds(abs(by))}", [train], times, False, by=abs(by)))
    return out


def _instead(a: list[str], b: list[str]) -> str:
    """Two ways in words: where they part."""
    k = next((k for k, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))
    return f"{' '.join(map(short, b[k : k + 3])) or 'nothing'} instead of {' '.join(map(short, a[k : k + 3])) or 'nothing'}"


def _ways(todo: _Open, kept: Kept, trains: list[int]) -> list[Finding]:
    """Trains on another way, or another track of the same."""
    t, out = todo.t, []
    for train in trains:
        pair = kept.pairs(train)[:1]
        if not pair or not {"edge", "lane", "track"} & todo.columns.get(train, set()):
            continue
        (a, b), who = pair[0], named([t.trains[train]], _key(t))
        for tracks in (False, True):
            x, y = way(a, kept.words, tracks), way(b, kept.words, tracks)
            in_a, in_b = {e for e, _ in x}, {e for e, _ in y}
            strange = [(e, time) for e, time in y if e not in in_a]
            left = [(e, time) for e, time in x if e not in in_b]
            # where both have the same edges the other log may only have ended before
            if strange and (left or strange[0][1] <= a.time[-1]):
                at = min(time for _, time in [*strange[:1], *left[:1]])
                what = "another track" if tracks else "another route"
                words = f"{who} takes {what}{since(at)}: {_instead([e for e, _ in x], [e for e, _ in y])}"
                # what differs long before is no consequence
                begins = {c: float(t.tallies[c].figures["first_s"][train]) for c in todo.columns[train]}
                columns = {c for c, first in begins.items() if first >= at - BEFORE_S}
                out.append(todo.close("route", words, [train], columns, True, from_s=at))
                break
    return out


def _shifts(todo: _Open, kept: Kept, trains: list[int], told: dict[str, Tolerance]) -> dict[int, Shift]:
    """Trains that are late or early."""
    out = {}
    for train in trains:
        if todo.columns.get(train) or train in todo.only_a or train in todo.only_b:
            found = shifted(kept.pairs(train), todo.columns.get(train, set()), todo.first_s(train), told, kept.decimals)
            if found is not None:
                out[train] = found
    return out


def _exchanged(todo: _Open, kept: Kept, trains: list[int], told: dict[str, Tolerance]) -> list[Finding]:
    """Pairs of trains each of which goes on as the other does in the reference: they came to a switch in another order."""
    t, out = todo.t, []
    begins = {k: todo.first_s(k) for k in trains}
    at_once = Counter(begins.values())
    begins = {k: time if at_once[time] <= EXCHANGED else math.inf for k, time in begins.items()}
    for k, one in enumerate(trains):
        for two in trains[k + 1 :]:
            at = begins[one]
            if at == math.inf or abs(begins[two] - at) > 1e-6 or not _swapped(kept, one, two, at, told):
                continue
            a, b = (way(kept.a[train][0], kept.words) for train in (one, two))
            shared = [(max(time, dict(b)[edge]), edge) for edge, time in a if edge in dict(b)]
            where = f" at {short(min(shared)[1])}" if shared else ""
            names = short(t.trains[one]), short(t.trains[two])
            words = f"another order{where}{since(at)}: {names[1]} runs as {names[0]} did, and {names[0]} as {names[1]}"
            out.append(todo.close("order", words, [one, two], None, True, from_s=at))
            begins[one] = begins[two] = math.inf
            break
    return out


def _orders(todo: _Open, kept: Kept, trains: list[int], shifts: dict[int, Shift]) -> list[Finding]:
    """Pairs of trains that enter an edge in another order than in the reference."""
    t, out = todo.t, []
    ways: dict[int, tuple[dict[str, float], dict[str, float]]] = {}
    for train in trains:
        pair = kept.pairs(train)[:1]
        if pair and (todo.columns.get(train) or train in todo.only_a or train in todo.only_b):
            x, y = way(pair[0][0], kept.words), way(pair[0][1], kept.words)
            ways[train] = dict(reversed(x)), dict(reversed(y))
    done: set[int] = set()
    for k, one in enumerate(trains):
        for two in trains[k + 1 :]:
            if one in done or two in done or one not in ways or two not in ways:
                continue
            switch = _switch(ways[one], ways[two])
            if switch is None:
                continue
            done |= {one, two}
            first, second = (one, two) if switch[2] else (two, one)
            a, b = short(t.trains[first]), short(t.trains[second])
            words = f"another order at {short(switch[0])}{since(switch[1])}: {b}, {a} instead of {a}, {b}"
            if not (one in shifts and two in shifts):
                words += "; what else differs of these two is counted with it"
            at = min(todo.first_s(one), todo.first_s(two))
            out.append(todo.close("order", words, [first, second], None, True, from_s=at))
    return out


def _switch(
    one: tuple[dict[str, float], dict[str, float]], two: tuple[dict[str, float], dict[str, float]]
) -> tuple[str, float, bool] | None:
    """The first edge two trains enter in another order: its name, when in A, and whether the first of them was first in A."""
    found = []
    for edge in one[0].keys() & two[0].keys() & one[1].keys() & two[1].keys():
        x, y = one[0][edge] - two[0][edge], one[1][edge] - two[1][edge]
        if x * y < 0:
            found.append((min(one[0][edge], two[0][edge]), edge, x < 0))
    if not found:
        return None
    time, edge, before = min(found)
    return edge, time, before


def _swapped(kept: Kept, one: int, two: int, since_s: float, told: dict[str, Tolerance]) -> bool:
    """Whether each of two trains goes as the other did."""
    sides = [(kept.a.get(one, []), kept.b.get(two, [])), (kept.a.get(two, []), kept.b.get(one, []))]
    for a, b in sides:
        if not a or len(a) != len(b):
            return False
        for x, y in zip(a, b, strict=True):
            if not alike(x.take(x.time >= since_s - 1e-7), y.take(y.time >= since_s - 1e-7), told, kept.decimals):
                return False
    return True


def _late(todo: _Open, kept: Kept, shifts: dict[int, Shift]) -> list[Finding]:
    """Trains that are late or early, and stops left out."""
    t, out = todo.t, []
    for train, found in shifts.items():
        if not (todo.columns.get(train) or train in todo.only_a or train in todo.only_b):
            continue
        who, by, at = named([t.trains[train]], _key(t)), abs(found.by_s), found.from_s
        a, b = kept.pairs(train)[0]
        cause, words = ("late", f"{who} late by {seconds(by)}") if found.by_s > 0 else ("early", f"{who} early by {seconds(by)}")
        why = ""
        if found.by_s < 0 and stood(a, at, at + by) and not stood(b, at, at + by):
            cause, words = "stop", f"{who} leaves out a stop of {seconds(by)}{_at(a, at, kept)}, and is early by that"
        elif found.by_s > 0 and stood(b, at, at + by) and not stood(a, at, at + by):
            why = f": it is at a standstill{_at(b, at, kept)}"
        out.append(todo.close(cause, words + since(at) + why, [train], found.columns, True, from_s=at, by=by))
    return out


def _at(course: Course, time: float, kept: Kept) -> str:
    before = [edge for edge, when in way(course, kept.words) if when <= time + 1.0]
    return f" on {short(before[-1])}" if before else ""


def _rows(todo: _Open) -> list[Finding]:
    """Rows that are dropped or doubled, or of trains that begin or end at another time."""
    t, out = todo.t, []
    groups: dict[tuple[str, str], list[int]] = {}
    for train in sorted(todo.only_a | todo.only_b):
        for only, presence, there, other, side in (
            (todo.only_a, t.only_a, t.all_a, t.all_b, "A"), (todo.only_b, t.only_b, t.all_b, t.all_a, "B"),
        ):  # fmt: skip
            if train not in only:
                continue
            n, doubled = presence.of("count", train), presence.of("doubled", train)
            kind = "rows"
            if doubled == n:
                kind = "doubled"
            elif t.time is not None and presence.of("first_s", train) > other.of("last_s", train):
                kind = "ends later" if side == "B" else "ends earlier"
            elif t.time is not None and presence.of("last_s", train) < other.of("first_s", train):
                kind = "begins earlier" if side == "B" else "begins later"
            elif n < there.of("count", train) and side == "A":
                kind = "dropped"
            groups.setdefault((kind, side), []).append(train)
    for (kind, side), trains in groups.items():
        presence = t.only_a if side == "A" else t.only_b
        count = sum(int(presence.of("count", k)) for k in trains)
        first = min(presence.of("first_s", k) for k in trains)
        last = max(presence.of("last_s", k) for k in trains)
        who = named((t.trains[k] for k in trains), _key(t))
        when = "" if t.time is None else f" at {seconds(first)}" if first == last else f" from {seconds(first)} to {seconds(last)}"
        rows = counted(count, "row")
        verb = kind.replace("s ", " ") if len(trains) > 1 else kind
        words = {"doubled": f"{rows} doubled", "dropped": f"{rows} dropped", "rows": f"{rows} only in {side}"}.get(
            kind, f"{verb} than in the reference: {rows}"
        )
        cause = kind if kind in ("doubled", "dropped", "rows") else "ends"
        of = f"{who} " if cause == "ends" else ""
        text = f"{of}{words}{f' of {who}' if who and not of else ''}{when}"
        f = Finding(cause, text, [t.trains[k] for k in trains], [t.table], from_s=first if t.time is not None else None, rows=count)
        f.codes = {t.table: trains}
        out.append(f)
    return out


def _of_column(todo: _Open, name: str) -> list[Finding]:
    """What is left of a column: trains shifted or in other units by themselves, and the rest as one finding."""
    t, out = todo.t, []
    for _ in range(2):
        found = _constant(todo, name, most=False)
        out += [found] if found is not None else []
    trains = [k for k, columns in sorted(todo.columns.items()) if name in columns]
    if not trains:
        return out
    f = todo.close("values", "", trains, {name}, False)
    tally = t.tallies[name]
    figures = {key: values[trains] for key, values in tally.figures.items()}
    f.from_s = float(figures["first_s"].min()) if t.time is not None else None
    who = named((t.trains[k] for k in trains), _key(t)) if t.keys else ""
    amount = "differs"
    if f.largest is not None and f.largest.place.difference is not None:
        most, size = f.largest.place.difference, float(figures["size"].max())
        amount = f"differs by up to {most:.3g}" if math.isfinite(most) else "differs"
        scatters = np.all(np.abs(figures["sum"]) <= 0.3 * figures["sum_abs"])  # of each train, to both sides
        if f.values >= 10 and scatters and most <= NOISE * size:
            f.cause, amount = "noise", f"scatters within {most:.3g}"
    f.words = f"{short(name)}{f' of {who}' if who else ''} {amount}{since(f.from_s)}"
    return [*out, f]
