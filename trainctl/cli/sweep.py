"""``trainctl sweep``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from trainctl.cli.console import fill, say
from trainctl.errors import InputError

if TYPE_CHECKING:
    from trainctl.studies.sweep import SweepPlan


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command()
    def sweep(
        name: Annotated[str, typer.Argument(help="Scenario, or a ready-made sweep such as monte_carlo: name or path of a TOML.")],
        settings: Annotated[
            list[str] | None,
            typer.Option(
                "--set",
                metavar="KEY=A,B,...",
                help="Values of a key; of several --set every value is combined with every other one.",
            ),
        ] = None,
        seeds: Annotated[str | None, typer.Option(metavar="0..99", help="Seeds; each combination runs with each of them.")] = None,
        jitter: Annotated[
            list[str] | None,
            typer.Option(
                metavar="train.KEY=W", help="Change a number of every train by up to W either way, drawn by the seed. Repeatable."
            ),
        ] = None,
        out: Annotated[Path | None, typer.Option(help="Folder of the sweep; default sweeps/NAME.")] = None,
        workers: Annotated[int | None, typer.Option(min=1, help="Processes on this machine; default one per core.")] = None,
        scheduler: Annotated[
            str | None, typer.Option(metavar="ADDRESS", help="A running Dask scheduler instead: tcp://..., or its .json file.")
        ] = None,
        backend: Annotated[Literal["sumo", "numeric"], typer.Option(help="SUMO, or the same loop without a simulator.")] = "sumo",
        resume: Annotated[bool, typer.Option("--resume", help="Continue the sweep in --out; finished runs stay.")] = False,
        force: Annotated[bool, typer.Option("--force", help="Replace whatever lies at --out.")] = False,
        keep: Annotated[
            bool, typer.Option("--keep", help="Keep all run folders in OUT/runs (workers need the same file system).")
        ] = False,
        strict: Annotated[bool, typer.Option("--strict", help="Exit 1 if any run violated a bound.")] = False,
        quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar, no summary.")] = False,
        as_json: Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of a table.")] = False,
    ) -> None:
        """Run a scenario with many settings and seeds, on all cores or a cluster, into one Parquet dataset.

        OUT gets results.parquet (one row per run: parameters, status, violations, metrics), summary.png and sweep.json. Exit 3
        if runs failed or were refused; the others are there all the same. A collision is a result of its run, not a failed run.
        A law that is a file is a program: it is executed.
        """
        from trainctl.cli.console import show_json
        from trainctl.studies import sweep as sweeping

        plan = _plan(name, settings, seeds, jitter, backend)
        if resume and force:
            raise InputError("--resume and --force: one goes on with what is there, the other removes it")
        folder = out if out is not None else Path("sweeps") / Path(name).stem
        with _Progress(Path(name).stem, not quiet and not as_json) as progress:
            info = sweeping.sweep(
                plan, folder, workers=workers, scheduler=scheduler, resume=resume, force=force, keep=keep, command_line=sys.argv,
                progress=progress,
            )  # fmt: skip
        if as_json:
            show_json({"folder": str(folder), **info})
        elif not quiet:
            _summary(folder, info)
        if info["failed"] or info["refused"]:
            raise typer.Exit(3)
        if strict and info["violated"]["runs"]:
            raise typer.Exit(1)


def _plan(name: str, settings: list[str] | None, seeds: str | None, jitter: list[str] | None, backend: str) -> SweepPlan:
    """What the command line asks for, laid over a ready-made sweep."""
    from trainctl.studies import sweep as sweeping

    made = sweeping.ready_made(name) or sweeping.SweepPlan(name, {}, [], {})
    axes = {**made.settings, **dict(map(sweeping.values, settings or []))}
    if seeds is not None:
        axes.pop("run.seed", None)
    wanted = sweeping.seeds(seeds) if seeds is not None else made.seeds
    return sweeping.SweepPlan(made.scenario, axes, wanted, {**made.jitter, **dict(map(sweeping.half_width, jitter or []))}, backend)


class _Progress:
    """How far the sweep is, on stderr: a bar on a terminal, else a line every tenth."""

    def __init__(self, title: str, shown: bool) -> None:
        self.title, self.shown = title, shown
        self.bar: Any = None

    def __enter__(self) -> Any:
        if self.shown and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

            columns = (
                TextColumn(self.title), BarColumn(), MofNCompleteColumn(), TextColumn("runs{task.description}"),
                TimeRemainingColumn(),
            )  # fmt: skip
            self.bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self.bar.start()
            self.task = self.bar.add_task("", total=None)
        return self.told

    def told(self, done: int, total: int, failed: int) -> None:
        """One more run is done."""
        words = f", {failed} failed" if failed else ""
        if self.bar is not None:
            self.bar.update(self.task, completed=done, total=total, description=words)
        elif self.shown and done * 10 // total > (done - 1) * 10 // total:
            say(f"{self.title}: {done} of {total} runs{words}", error=True)

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.stop()


def _summary(folder: Path, info: dict[str, Any]) -> None:
    """How many runs there are, and in which share of them a bound was violated."""
    from trainctl.cli.console import listing, show
    from trainctl.studies.results import not_settled, shares

    told = {key: info[key] for key in ("complete", "refused", "failed") if info[key] or key == "complete"}
    say(f"{info['runs']} runs: " + ", ".join(f"{count} {word}" for word, count in told.items()))
    varied = [key for key, values in info["set"].items() if len(values) > 1]
    rows = shares(folder, varied)
    table = listing(None, *varied, "runs", "with a violated bound", "share", "95 % interval")
    for row in rows[:40]:
        low, high = row["interval_95"]
        fill(table, *map(str, row["values"]), str(row["of"]), str(row["runs"]), f"{100 * row['share']:.3g} %",
            f"{100 * low:.3g} .. {100 * high:.3g} %",
        )  # fmt: skip
    if rows:
        show(table)
    if len(rows) > 40:
        say(f"and {len(rows) - 40} more combinations")
    for key, words in (("with_collisions", "trains collided"), ("with_gridlocks", "trains waited for each other in a circle")):
        if info[key]:
            say(f"in {info[key]} of {info['complete']} runs {words}")
    if count := not_settled(folder):
        say(f"in {count} of {info['complete']} runs the formation did not settle within 1 m")
    for reason in info["reasons"]:
        say(reason)
    for why, count in info["alone"].items():
        say(f"{count} of {info['runs']} runs one by one, not side by side: {why}")
    say(f"results: {folder}/  (results.parquet, summary.png)")
