"""Check sums of files, so that damage is noticed before anything is built on it."""

from __future__ import annotations

import json
import os
import zlib
from pathlib import Path
from typing import Any

from trainctl.errors import InputError

#: Files are read in pieces of this size [bytes].
PIECE = 1 << 20

#: Length [bytes] and CRC-32 of a file, as JSON has it.
Sum = list[int]


def sum_of(path: Path, size: int | None = None) -> Sum:
    """Length and check sum of a file, or of its first ``size`` bytes.

    Raises
    ------
    InputError
        It is missing, no plain file, or cannot be read.
    """
    if path.is_symlink() or not path.is_file():
        raise InputError(f"{path}: {'not a plain file' if os.path.lexists(path) else 'missing'}")
    read, crc = 0, 0
    try:
        with path.open("rb") as file:
            while piece := file.read(PIECE if size is None else min(PIECE, size - read)):
                read, crc = read + len(piece), zlib.crc32(piece, crc)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    return [read, crc]


def verify(path: Path, expected: Sum, beginning: bool = False) -> None:
    """Whether a file, or its beginning, is what it was when the check sum was made.

    Raises
    ------
    InputError
        It is not.
    """
    if sum_of(path, expected[0] if beginning else None) != list(expected):
        raise InputError(f"{path}: damaged, or changed since the checkpoint was written")


def sealed(content: Any) -> bytes:
    """JSON with its check sum before it, in a line of its own."""
    text = json.dumps(content).encode()
    return b"%08x\n%s" % (zlib.crc32(text), text)


def unsealed(path: Path) -> Any:
    """The content of a file that ``sealed`` made.

    Raises
    ------
    InputError
        It is missing or damaged.
    """
    crc, _, text = _whole(path).partition(b"\n")
    if crc != b"%08x" % zlib.crc32(text):
        raise InputError(f"{path}: damaged")
    return json.loads(text)


def _whole(path: Path) -> bytes:
    sum_of(path, 0)  # a plain file
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
