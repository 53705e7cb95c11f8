"""``trainctl tune``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from trainctl.cli.console import fill, say
from trainctl.errors import InputError


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command()
    def tune(
        name: Annotated[str, typer.Argument(help="Scenario, or a ready-made sweep for its seeds and jitter: name or path.")],
        gains: Annotated[
            list[str] | None, typer.Option("--gain", metavar="KEY=LOW..HIGH", help="Key of [controller] and its range. Repeatable.")
        ] = None,
        objective: Annotated[
            str, typer.Option(metavar="NAME[=WEIGHT],...", help="settling, margin, energy, jerk, or a weighted sum of them.")
        ] = "settling",
        seeds: Annotated[
            str | None, typer.Option(metavar="0..19", help="Every candidate is judged by runs with these seeds.")
        ] = None,
        jitter: Annotated[
            list[str] | None,
            typer.Option(
                metavar="train.KEY=W", help="Change a number of every train by up to W either way, drawn by the seed. Repeatable."
            ),
        ] = None,
        settings: Annotated[
            list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Another value of a key of the scenario. Repeatable.")
        ] = None,
        evaluations: Annotated[int, typer.Option(help="Maximum number of candidates.")] = 100,
        out: Annotated[Path | None, typer.Option(help="Folder of the search; default tune/NAME.")] = None,
        workers: Annotated[int | None, typer.Option(min=1, help="Processes; default one per core.")] = None,
        force: Annotated[bool, typer.Option("--force", help="Replace whatever lies at --out.")] = False,
        quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")] = False,
        as_json: Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of a table.")] = False,
    ) -> None:
        """Search for gains of a law that minimise an objective while every bound is kept in all of many disturbed runs.

        OUT gets tuned.toml (the scenario with the best gains), search.parquet and search.png (all candidates), and tune.json.
        Exit 1 if no candidate kept all bounds.

        A law that is a file is a program: it is executed.
        """
        from trainctl.cli.console import show_json
        from trainctl.studies import sweep as sweeping
        from trainctl.studies import tune as tuning

        made = sweeping.ready_made(name) or sweeping.SweepPlan(name, {}, [], {})
        fixed = {key: values[0] for key, values in made.settings.items() if len(values) == 1}
        for key, values in map(sweeping.values, settings or []):
            if len(values) != 1:
                raise InputError(f"--set {key}: one value; ranges are for --gain")
            fixed[key] = values[0]
        plan = tuning.TunePlan(
            made.scenario, tuple(map(tuning.gain, gains or [])), tuning.objective(objective), fixed,
            sweeping.seeds(seeds) if seeds is not None else made.seeds,
            {**made.jitter, **dict(map(sweeping.half_width, jitter or []))}, evaluations,
        )  # fmt: skip
        folder = out if out is not None else Path("tune") / Path(name).stem

        def told(done: int, most: int, best: tuning.Candidate) -> None:
            if not (quiet or as_json) and done * 10 // most > (done - 1) * 10 // most:
                words = f", best {best.value:.6g}" if not best.violated and not best.reason else ", none keeps all bounds yet"
                say(f"{Path(name).stem}: {done} of at most {most} candidates{words}", error=True)

        info = tuning.tune(plan, folder, workers=workers, force=force, command_line=sys.argv, progress=told)
        if as_json:
            show_json({"folder": str(folder), **info})
        elif not quiet:
            _summary(folder, info)
        if not info["bounds_kept"]:
            raise typer.Exit(1)


def _summary(folder: Path, info: dict[str, Any]) -> None:
    """The best gains beside those of the scenario, and what they come to."""
    from trainctl.cli.console import listing, show
    from trainctl.studies.tune import OBJECTIVES

    say(f"{info['candidates']} candidates, {len(info['seeds'])} runs each, law {info['law']}")
    shown = listing(None, "", "scenario", "best")
    start, best = info["start"], info["best"]
    for key in info["gains"]:
        fill(shown, key, f"{start['gains'][key]:.6g}", f"{best['gains'][key]:.6g}")
    for name, (_, _, unit) in OBJECTIVES.items():
        if name in start or name in best:
            fill(shown, f"{name} [{unit}]", *(f"{c[name]:.6g}" if name in c else "" for c in (start, best)))
    fill(shown, "runs with a violated bound", str(start["runs_violated"]), str(best["runs_violated"]))
    show(shown)
    for word, c in (("the scenario", start), ("the best", best)):
        if c["reason"]:
            say(f"{word}: {c['reason']}")
    if info["refused"]:
        say(f"{info['refused']} of {info['candidates']} candidates gave nothing, the first: {info['refusal']}")
    if info["bounds_kept"]:
        say(f"results: {folder}/  (tuned.toml, search.parquet, search.png)")
    else:
        say(f"no candidate kept all bounds in all runs: {folder}/search.png shows how far they are")
