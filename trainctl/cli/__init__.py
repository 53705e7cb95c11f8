"""The command line: ``main`` is the program; the commands lie beside, below them ``console``."""

import gc


def main() -> None:
    """Run the program `trainctl`.

    What is imported and compiled stays until the end. To look through all of it for garbage, again and again while it comes and
    once more at the end, took a sixth of a short run.
    """
    gc.set_threshold(50_000)
    from trainctl.cli import program

    try:
        program.main()
    finally:
        gc.freeze()
