"""``python -m trainctl`` is the program ``trainctl``."""

from trainctl.cli import main

if __name__ == "__main__":
    main()
