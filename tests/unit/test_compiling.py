"""What is compiled is told once and counted; what is compiled already is neither."""

from __future__ import annotations

import time

import pytest
from numba import njit

from trainctl import compiling
from trainctl.compiling import OF_LAW, OF_REST


def test_seconds_of_the_compiler_are_counted_and_each_word_comes_once() -> None:
    @njit
    def inner(x: float) -> float:
        return 2.0 * x

    @njit
    def advance_kernel(x: float) -> float:
        return inner(x) + 1.0

    said: list[str] = []
    began = time.perf_counter()
    with compiling.compiling(said.append) as found:
        assert inner(1.0) == 2.0 and said == [OF_REST]
        assert advance_kernel(1.0) == 3.0 and said == [OF_REST, OF_LAW]
        inner(1)  # for other types: nothing new to say
    took = time.perf_counter() - began
    assert 0.0 < found.seconds < took and said == [OF_REST, OF_LAW]
    with compiling.compiling(said.append) as again:
        advance_kernel(2.0)
    assert again.seconds == 0.0 and len(said) == 2


def test_a_run_does_not_count_what_it_compiled(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    from trainctl import runner
    from trainctl.scenario.build import open_scenario

    real = runner.loop_of

    def slow(*arguments: object) -> object:
        @njit
        def anew(x: float) -> float:
            return x

        with compiling.compiling() as told:
            anew(1.0)
        compiled.append(told.seconds)
        return real(*arguments)  # type: ignore[arg-type]

    compiled: list[float] = []
    monkeypatch.setattr(runner, "loop_of", slow)
    began = time.perf_counter()
    done = runner.run(open_scenario("fully_distributed", {"run.duration_s": 16}), tmp_path / "r", "numeric")
    took = time.perf_counter() - began
    assert 0.0 < done.info["wall_time_s"] <= took - compiled[0] + 0.001
