"""The command line: ``main`` is the program; the commands lie beside, below them ``console``."""


def main() -> None:
    """Run the program `trainctl`."""
    from trainctl.cli import program

    program.main()
