"""Disturbances as scenario data, shared by all laws.

They are the w1, w2, w3 of robust_constrained eqs. (1) and (4), an error of the resistance, and noise of the measured positions.

A disturbance is a pure function of the step, the time and the positions, so a resumed run continues with the same numbers. Random
shapes are counter-based (``draws``): the number of a train in a step depends on the seed, the entry, the train's id and the
step, on nothing drawn before and not on which other trains there are.

Amplitudes of ``position`` and ``speed`` are per simulator step T, as in the paper: 0.1 m each 0.8 s is not 0.1 m each second.

Symbols: w1 position [m], w2 speed [m/s], w3 input [m/s2], k step, T step [s].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Annotated, Literal, NamedTuple, get_args

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator
from pydantic.json_schema import SkipJsonSchema
from pydantic_core import PydanticCustomError

from trainctl import draws
from trainctl.draws import gauss, uniforms, word
from trainctl.kernels import bare
from trainctl.signals import Disturbed, Floats, Ints, Table

#: What a disturbance acts on; the rows of every array of shape (5, n) here.
CHANNELS = ("position", "speed", "input", "resistance", "measurement")
POSITION, SPEED, INPUT, RESISTANCE, MEASUREMENT = range(5)

#: Unit of the keys that carry one, per channel: ``amplitude_<unit>``, ``std_<unit>``; a resistance error is ``error_percent``.
UNITS = ("m", "mps", "mps2", "percent", "m")

Shape = Literal["constant", "alternating", "sine", "square", "uniform", "gaussian", "step", "gust", "table", "worst_case"]
SHAPES: tuple[str, ...] = get_args(Shape)
CONSTANT, ALTERNATING, SINE, SQUARE, UNIFORM, GAUSSIAN, STEP, GUST, TABLE, WORST_CASE = range(10)

#: Keys that only some shapes take, with these shapes; the first shape listed with ``needed`` true also needs it.
ONLY: dict[str, tuple[str, ...]] = {
    "period_s": ("sine", "square"),
    "phase_rad": ("sine", "square"),
    "seed": ("uniform", "gaussian"),
    "values": ("table",),
    "pair": ("worst_case",),
    "peak_s": ("worst_case",),
}
NEEDED: dict[str, tuple[str, ...]] = {
    "sine": ("period_s",),
    "square": ("period_s",),
    "step": ("from_s",),
    "gust": ("from_m", "to_m"),
    "table": ("values",),
    "worst_case": ("pair", "peak_s"),
}

#: Gives, for a pair of trains (receives +, -) and a number of steps, the signs (5, steps, n) of the disturbance that drives the
#: difference of their position errors highest at the end of these steps: each law has its own.
Worst = Callable[[int, int, int], Floats]


def _no_unit(value: object) -> float:
    raise PydanticCustomError(
        "unit_missing",
        "the key must carry the unit: amplitude_m or std_m (position, measurement), amplitude_mps (speed), amplitude_mps2 (input), "
        "error_percent (resistance)",
    )


Id = Annotated[int | str, AfterValidator(str)]
PerTrain = float | tuple[float, ...]
WithoutUnit = SkipJsonSchema[Annotated[float | None, BeforeValidator(_no_unit)]]


class Disturbance(Table):
    """[[disturbance]]: one signal on one channel of some trains. Several entries on one channel add up."""

    on: Literal["position", "speed", "input", "resistance", "measurement"] = Field(
        description="position: w1 [m] per step; speed: w2 [m/s] per step; input: w3 [m/s2], before the clamp; resistance: true "
        "over believed resistance; measurement: what the trains believe their position to be. robust_constrained eqs. (1), (4)"
    )
    train: Id | tuple[Id, ...] = Field("all", description='Train, list of trains, or "all".')
    shape: Shape = Field(
        description="constant; alternating: sign changes every step; sine; square; uniform within the amplitude; gaussian; "
        "step: from from_s on; gust: between from_m and to_m; table: values times the amplitude, one per step; worst_case: the "
        "signs that drive the error of the pair highest at peak_s (l1 gain of the law's loop)."
    )
    amplitude_m: PerTrain | None = Field(None, description="position, measurement: amplitude [m], one number or one per train.")
    amplitude_mps: PerTrain | None = Field(None, description="speed: amplitude [m/s], one number or one per train.")
    amplitude_mps2: PerTrain | None = Field(None, description="input: amplitude [m/s2], one number or one per train.")
    error_percent: PerTrain | None = Field(None, description="resistance: true less believed one [%], one number or one per train.")
    std_m: PerTrain | None = Field(None, description="gaussian on position, measurement: standard deviation [m].")
    std_mps: PerTrain | None = Field(None, description="gaussian on speed: standard deviation [m/s].")
    std_mps2: PerTrain | None = Field(None, description="gaussian on input: standard deviation [m/s2].")
    std_percent: PerTrain | None = Field(None, description="gaussian on resistance: standard deviation [%].")
    amplitude: WithoutUnit = None
    std: WithoutUnit = None
    period_s: float | None = Field(None, gt=0, description="sine, square: period [s].")
    phase_rad: float | None = Field(None, description="sine, square: phase at from_s [rad]; default 0.")
    from_s: float | None = Field(None, ge=0, description="Acts from this time on [s]; default 0.")
    to_s: float | None = Field(None, gt=0, description="Acts before this time [s]; default always.")
    from_m: float | None = Field(None, description="Acts on trains at or beyond this position [m]; default everywhere.")
    to_m: float | None = Field(None, description="Acts on trains before this position [m]; default everywhere.")
    values: tuple[Annotated[float, Field(ge=-1, le=1)], ...] | None = Field(
        None, min_length=1, description="table: factors in [-1, 1], one per step of T from from_s on; 0 after the last."
    )
    pair: tuple[Id, Id] | None = Field(None, description="worst_case: the two trains whose relative error it drives up.")
    peak_s: float | None = Field(None, gt=0, description="worst_case: when the error peaks [s]; 1000 s or more reach the bound.")
    seed: int | None = Field(None, ge=0, lt=2**64, description="uniform, gaussian: own seed instead of [run] seed.")

    @property
    def channel(self) -> int:
        """Row of ``CHANNELS``."""
        return CHANNELS.index(self.on)

    @property
    def amplitude_key(self) -> str:
        """The key of the amplitude on this channel."""
        return "error_percent" if self.channel == RESISTANCE else f"amplitude_{UNITS[self.channel]}"

    @property
    def std_key(self) -> str:
        """The key of the standard deviation on this channel."""
        return f"std_{UNITS[self.channel]}"

    @property
    def trains(self) -> tuple[str, ...]:
        """Trains named; ("all",) for all."""
        return tuple(str(t) for t in self.train) if isinstance(self.train, tuple) else (str(self.train),)

    def maximum(self, trains: Sequence[str], deviations: float = math.inf) -> Floats:
        """Maximum magnitude on each channel of each of all ``trains``, shape (5, n).

        Windows in time and place are ignored. A Gaussian that no amplitude cuts off has no bound: it is taken to stay within so
        many standard ``deviations``. The row of the resistance is a relative error, not a factor.
        """
        given = getattr(self, self.amplitude_key)
        if given is None:
            given = math.inf if math.isinf(deviations) else deviations * np.asarray(getattr(self, self.std_key), float)
        return self._spread(trains, given, np.abs)

    def steady(self, trains: Sequence[str]) -> Floats | None:
        """Value on each channel of each of all ``trains``, shape (5, n), if it never changes; else None."""
        if self.shape != "constant" or any(x is not None for x in (self.from_s, self.to_s, self.from_m, self.to_m)):
            return None
        return self._spread(trains, getattr(self, self.amplitude_key), np.positive)

    def _spread(self, trains: Sequence[str], value: PerTrain | Floats, kind: Callable[[Floats], Floats]) -> Floats:
        index = {name: i for i, name in enumerate(trains)}
        places = [index[name] for name in (trains if self.trains == ("all",) else self.trains)]
        out = np.zeros((len(CHANNELS), len(trains)))
        out[self.channel, places] = kind(np.asarray(value, float)) * (0.01 if self.channel == RESISTANCE else 1.0)
        return out

    @model_validator(mode="after")
    def _keys_of_this_shape(self) -> Disturbance:
        """All mistakes of the table at once."""
        wrong = []
        gaussian = self.shape == "gaussian"
        main = self.std_key if gaussian else self.amplitude_key
        if getattr(self, main) is None:
            wrong.append(f"{main}: missing, on = {self.on} with shape = {self.shape} needs it")
        for key in ("amplitude_m", "amplitude_mps", "amplitude_mps2", "error_percent"):
            if getattr(self, key) is not None and key != self.amplitude_key:
                wrong.append(f"{key}: wrong unit, on = {self.on} takes {self.amplitude_key}")
        for key in ("std_m", "std_mps", "std_mps2", "std_percent"):
            if getattr(self, key) is not None and (key != self.std_key or not gaussian):
                wrong.append(f"{key}: on = {self.on} with shape = {self.shape} takes {main}")
        for key, shapes in ONLY.items():
            if getattr(self, key) is not None and self.shape not in shapes:
                wrong.append(f"{key}: shape = {self.shape} does not take it, only {', '.join(shapes)}")
        for key in NEEDED.get(self.shape, ()):
            if getattr(self, key) is None:
                wrong.append(f"{key}: missing, shape = {self.shape} needs it")
        if gaussian:
            minimum = [key for key in (self.std_key, self.amplitude_key) if np.min(getattr(self, key) or 0.0) < 0]
            wrong += [f"{key} = {getattr(self, key)}: must not be negative with shape = gaussian" for key in minimum]
        if self.to_s is not None and self.to_s <= (self.from_s or 0.0):
            wrong.append(f"to_s = {self.to_s:g}: must be after from_s = {self.from_s or 0.0:g}")
        if self.from_m is not None and self.to_m is not None and self.to_m <= self.from_m:
            wrong.append(f"to_m = {self.to_m:g}: must be beyond from_m = {self.from_m:g}")
        if self.pair is not None and self.pair[0] == self.pair[1]:
            wrong.append(f"pair = {list(self.pair)}: names one train twice")
        counted = {key for key in (self.amplitude_key, self.std_key) if isinstance(getattr(self, key), tuple)}
        if self.trains != ("all",):
            for key in sorted(counted):
                if len(getattr(self, key)) != len(self.trains):
                    wrong.append(f"{key} = {list(getattr(self, key))}: one value for each of train = {list(self.trains)} is needed")
        if wrong:
            raise ValueError("; ".join(wrong))
        return self


class Signals(NamedTuple):
    """All disturbances of a run as arrays, one row per entry and train; the columns are named below."""

    whole: Ints  # (R, 10)
    number: Floats  # (R, 8)
    table: Floats  # the tables of all rows, one after the other
    channels: tuple[int, ...]  # that rows act on
    trains: int  # n


# Columns of Signals.whole. The steps of a row count from BEGIN, its table is table[START:END]; the rest are words of the generator.
ON, SHAPE, TRAIN, BEGIN, START, END, KEY_LOW, KEY_HIGH, WHO, STREAM = range(10)
# Columns of Signals.number.
AMPLITUDE, STD, FROM_S, TO_S, FROM_M, TO_M, PERIOD, PHASE = range(8)

ROUNDING = 1e-9  # s, of k T


def violations(entries: Sequence[Disturbance], trains: Sequence[str], seed: int | None, worst: bool) -> list[str]:
    """Mistakes that need more than the table itself, all of them, as ``disturbance[1].key = value: rule``.

    Parameters
    ----------
    entries : sequence of Disturbance
        In the order of the scenario.
    trains : sequence of str
        Ids of all trains.
    seed : int or None
        ``[run] seed``.
    worst : bool
        Whether the law of the run gives its worst disturbance.
    """
    found = []
    for number, entry in enumerate(entries, 1):
        here = f"disturbance[{number}]"
        for name in entry.trains:
            if name not in trains and entry.trains != ("all",):
                found.append(f"{here}.train = {name}: no such train; there are: {', '.join(trains)}")
        for name in map(str, entry.pair or ()):
            if name not in trains:
                found.append(f"{here}.pair = {name}: no such train; there are: {', '.join(trains)}")
        for key in (entry.amplitude_key, entry.std_key):
            value = getattr(entry, key)
            if isinstance(value, tuple) and entry.trains == ("all",) and len(value) != len(trains):
                found.append(f"{here}.{key} = {list(value)}: has {len(value)} values for {len(trains)} trains")
        if entry.shape in ONLY["seed"] and entry.seed is None and seed is None:
            found.append(f"{here}.shape = {entry.shape}: random, so it needs a seed, [run] seed or its own, to be repeatable")
        if entry.shape == "worst_case" and not worst:
            found.append(f"{here}.shape = worst_case: this law does not give its worst disturbance; use another shape or a table")
    return found


def signals(
    entries: Sequence[Disturbance], trains: Sequence[str], step: float, seed: int | None, worst: Worst | None = None
) -> Signals:
    """Arrays of all disturbances of a run.

    Parameters
    ----------
    entries : sequence of Disturbance
        Free of ``violations``.
    trains : sequence of str
        Ids of all trains, length n.
    step : float
        T [s].
    seed : int or None
        ``[run] seed``, for random entries without their own.
    worst : callable, optional
        See ``Worst``; needed for ``worst_case``.

    Returns
    -------
    Signals
    """
    whole, number, tables, start = [], [], [], 0
    index = {name: i for i, name in enumerate(trains)}
    for ordinal, entry in enumerate(entries, 1):
        named = trains if entry.trains == ("all",) else entry.trains
        amplitude, std = (_per_train(getattr(entry, key), len(named)) for key in (entry.amplitude_key, entry.std_key))
        if entry.shape == "gaussian" and getattr(entry, entry.amplitude_key) is None:
            amplitude = np.full(len(named), np.inf)
        scale = 0.01 if entry.channel == RESISTANCE else 1.0
        low, high = draws.key(entry.seed if entry.seed is not None else seed or 0)
        stream = entry.channel + len(CHANNELS) * (ordinal if entry.seed is None else 0)
        begin, signs = round((entry.from_s or 0.0) / step), None
        if entry.pair is not None and entry.peak_s is not None and worst is not None:
            signs = worst(index[str(entry.pair[0])], index[str(entry.pair[1])], max(1, round(entry.peak_s / step)))
            begin = 0
        for name, a, s in zip(named, amplitude, std, strict=True):
            column = np.asarray(entry.values or (), float) if signs is None else signs[entry.channel, :, index[name]]
            whole.append((
                entry.channel, SHAPES.index(entry.shape), index[name], begin, start, start + len(column),
                low, high, word(name), stream,
            ))  # fmt: skip
            number.append((
                scale * a, scale * s, entry.from_s or 0.0, _or(entry.to_s, math.inf), _or(entry.from_m, -math.inf),
                _or(entry.to_m, math.inf), _or(entry.period_s, 1.0), entry.phase_rad or 0.0,
            ))  # fmt: skip
            tables.append(column)
            start += len(column)
    return Signals(
        whole=np.array(whole, np.int64).reshape(-1, 10),
        number=np.array(number, float).reshape(-1, 8),
        table=np.concatenate([np.zeros(0), *tables]),
        channels=tuple(sorted({entry.channel for entry in entries})),
        trains=len(trains),
    )


def reseeded(like: Signals, seed: int | None) -> Signals:
    """The same disturbances in a run with another ``[run] seed``."""
    whole = like.whole.copy()
    whole[whole[:, STREAM] >= len(CHANNELS), KEY_LOW : KEY_HIGH + 1] = draws.key(seed or 0)
    return like._replace(whole=whole)


def _or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value


def _per_train(value: PerTrain | None, count: int) -> Floats:
    return np.broadcast_to(np.asarray(0.0 if value is None else value, float), count)


def at(signals: Signals, k: int, t: float, position: Floats) -> Disturbed:
    """Disturbances of one step.

    Parameters
    ----------
    signals : Signals
        From ``signals``.
    k : int
        Number of the step, 0 for the first of the run.
    t : float
        Time at its start [s].
    position : ndarray, shape (n,)
        Of every train at its start [m].

    Returns
    -------
    Disturbed
        Not to be written into.
    """
    calm, channels = _calm(signals.trains), signals.channels
    if not channels:
        return calm
    out, place = np.zeros((len(channels), signals.trains)), np.zeros(len(CHANNELS), np.int64)
    place[list(channels)] = range(len(channels))
    _evaluate(signals.whole, signals.number, signals.table, k, t, position, place, out)
    if RESISTANCE in channels:
        out[place[RESISTANCE]] += 1.0
    return Disturbed(*(out[place[c]] if c in channels else calm[c] for c in range(len(CHANNELS))))


@cache
def _calm(trains: int) -> Disturbed:
    """Nothing acts."""
    nothing = np.zeros(trains)
    return Disturbed(nothing, nothing, nothing, np.ones(trains), nothing)


@bare
def _evaluate(
    whole: Ints, number: Floats, table: Floats, k: int, t: float, position: Floats, place: Ints, out: Floats
) -> None:  # fmt: skip
    """Add every row's value to ``out``, a row (n,) for each channel: that at its ``place`` (5,)."""
    for r in range(len(whole)):
        row, real = whole[r], number[r]
        i = row[TRAIN]
        if t < real[FROM_S] - ROUNDING or t >= real[TO_S] - ROUNDING or not real[FROM_M] <= position[i] < real[TO_M]:
            continue
        a = real[AMPLITUDE]
        shape = row[SHAPE]
        if shape in (CONSTANT, STEP, GUST):
            value = a
        elif shape == ALTERNATING:
            value = a if (k - row[BEGIN]) % 2 == 0 else -a
        elif shape == SINE:
            value = a * math.sin(2.0 * math.pi * (t - real[FROM_S]) / real[PERIOD] + real[PHASE])
        elif shape == SQUARE:
            turn = (t - real[FROM_S]) / real[PERIOD] + real[PHASE] / (2.0 * math.pi) + ROUNDING
            value = a if turn % 1.0 < 0.5 else -a
        elif shape in (TABLE, WORST_CASE):
            at = row[START] + k - row[BEGIN]
            value = a * table[at] if row[START] <= at < row[END] else 0.0
        else:
            first, second = uniforms(int(k), int(k) >> 32, int(row[WHO]), int(row[STREAM]), int(row[KEY_LOW]), int(row[KEY_HIGH]))
            if shape == UNIFORM:
                value = a * (2.0 * first - 1.0)
            else:
                value = min(max(real[STD] * gauss(first, second), -a), a)
        out[place[row[ON]], i] += value
