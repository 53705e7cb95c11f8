"""The command line: ``main`` is the program; the commands lie beside, below them ``console``."""

import atexit
import gc

#: Objects that are made between two searches for garbage. What is imported and compiled stays until the end: to look through all of
#: it, again and again while it comes and once more at the end, took a sixth of a short run.
GARBAGE = 50_000


def main() -> None:
    """Run the program `trainctl`."""
    before = gc.get_threshold()
    gc.set_threshold(GARBAGE)
    atexit.register(gc.freeze)
    from trainctl.cli import program

    try:
        program.main()
    finally:
        gc.set_threshold(*before)
