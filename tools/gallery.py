"""Draw the figures of the gallery anew, with the commands that stand under them: python tools/gallery.py.

``RUN-FIGURE.png`` is ``runs/RUN/figures/FIGURE.png`` of these commands, made small: fewer pixels, 64 colours.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

PAGE = Path(__file__).resolve().parent / "gallery/README.md"

#: Width of a figure [pixels].
WIDTH = 1000


def pictures(text: str) -> list[tuple[str, str]]:
    """Run and figure of every picture of the page that lies beside it."""
    return re.findall(r"\]\(([\w]+)-(\w+)\.png\)", text)


def commands(text: str) -> list[str]:
    """Commands of the page that make runs or figures of them."""
    blocks = re.findall(r"```sh\n(.*?)```", text, re.S)
    return [line for block in blocks for line in block.splitlines() if line.startswith(("trainctl run ", "trainctl plot "))]


def small(figure: Path, target: Path) -> None:
    """A small copy of a figure."""
    with Image.open(figure) as picture:
        size = WIDTH, round(picture.height * WIDTH / picture.width)
        picture.convert("RGB").resize(size, Image.Resampling.LANCZOS).quantize(64).save(target, optimize=True)


def main() -> None:
    """Run, draw, copy."""
    text = PAGE.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as place:
        for line in commands(text):
            subprocess.run([sys.executable, "-m", *line.split()], cwd=place, check=True, stdout=subprocess.DEVNULL)
        for run, figure in pictures(text):
            small(Path(place) / "runs" / run / "figures" / f"{figure}.png", PAGE.parent / f"{run}-{figure}.png")


if __name__ == "__main__":
    main()
