"""Run the shipped scenarios and renew their goldens; before one is overwritten, print what moved and by how much.

Usage: python tools/update_golden.py [NAME ...] [--dry-run]        (all scenarios without a name)
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from trainctl.diff.runs import EXACT, diff
from trainctl.record.folder import remove
from trainctl.runner import run
from trainctl.scenario.build import open_scenario
from trainctl.scenario.reading import shipped
from trainctl.testing import make_golden

GOLDENS = Path(__file__).resolve().parent.parent / "tests" / "regression" / "goldens"
#: Kept instants of one run.
INSTANTS = 40


def every_s(duration_s: float, step_s: float) -> float:
    """Time between kept instants: a whole number of steps, about ``INSTANTS`` of them in a run."""
    return max(1, round(duration_s / INSTANTS / step_s)) * step_s


def update(name: str, dry: bool) -> bool:
    """Renew one golden; True if anything moved."""
    place = GOLDENS / name
    with tempfile.TemporaryDirectory() as scratch:
        model = open_scenario(name)
        done = run(model, Path(scratch) / name)
        time = model.scenario.run
        new = make_golden(done, Path(scratch) / "golden", every_s(time.duration_s, time.step_s))
        if place.exists():
            report = diff(place, new, EXACT)
            if report.same and not report.notes:
                print(f"{name}: nothing moved")
                return False
            print(f"{name}: moved")
            for line in [*report.lines(most=200), *report.notes]:
                print(f"    {line}")
        else:
            print(f"{name}: new")
        if not dry:
            remove(place)
            make_golden(done, place, every_s(time.duration_s, time.step_s))
    return True


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", help="scenarios; default all that are shipped")
    parser.add_argument("--dry-run", action="store_true", help="only print; exit 1 if anything moved")
    arguments = parser.parse_args()
    moved = [update(name, arguments.dry_run) for name in arguments.names or shipped()]
    for stale in sorted({p.name for p in GOLDENS.iterdir() if p.is_dir()} - set(shipped())):
        print(f"{stale}: no such scenario any more" + ("" if arguments.dry_run else "; removed"))
        if not arguments.dry_run:
            remove(GOLDENS / stale)
    return 1 if arguments.dry_run and any(moved) else 0


if __name__ == "__main__":
    sys.exit(main())
