"""Whole files in memory, as far as they are what they seem: a gzip bomb, or a file without end, is refused before it is there."""

from __future__ import annotations

import gzip
from pathlib import Path

#: No net and no demand is longer [bytes], nor a text that people write.
MOST_BYTES, MOST_TEXT = 1 << 30, 1 << 24

#: What is packed may be so many times its size when it is unpacked (SUMO's XML: 5 to 30); shorter content [bytes] is not measured.
TIMES, SHORT = 100, 1 << 22

PIECE = 1 << 20


class TooLong(ValueError):
    """A file is longer than anything of its kind, or unpacks to more than it can hold."""


def content(path: Path) -> bytes:
    """What is in a file, unpacked if it is gzipped.

    Raises
    ------
    TooLong
        It is longer than a gigabyte, or unpacks to more than a hundred times its size.
    OSError, EOFError, zlib.error
        It cannot be read, or is damaged.
    """
    with path.open("rb") as raw:
        packed = raw.read(2) == b"\x1f\x8b"
        raw.seek(0)
        most = max(SHORT, TIMES * path.stat().st_size) if packed else MOST_BYTES
        stream, found = gzip.open(raw) if packed else raw, bytearray()  # noqa: SIM115  reads from what is closed here
        while piece := stream.read(PIECE):
            found += piece
            if len(found) > min(most, MOST_BYTES):
                raise TooLong(f"unpacks to more than {TIMES} times its size" if packed else f"longer than {MOST_BYTES >> 20} MiB")
    return bytes(found)


def short_text(path: Path) -> str:
    """A short text, in UTF-8.

    Raises
    ------
    TooLong
        It is longer than 16 MiB.
    OSError, UnicodeDecodeError
        It cannot be read, or is no text.
    """
    with path.open("rb") as file:
        found = file.read(MOST_TEXT + 1)
    if len(found) > MOST_TEXT:
        raise TooLong(f"longer than {MOST_TEXT >> 20} MiB")
    return found.decode()


def reason(error: Exception) -> str:
    """Why a text cannot be read, in words."""
    return "nested too deeply" if isinstance(error, RecursionError) else str(error)
