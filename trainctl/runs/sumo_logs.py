"""Bytes and elements of SUMO's logs, without trusting them: no document types, no entities, bounded memory, one clear line."""

from __future__ import annotations

import gzip
import os
import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, cast
from xml.parsers import expat

from trainctl.errors import InputError

CHUNK = 1 << 14  # bytes: what lives no longer than this costs the garbage collector little
#: A single element of an XML log longer than this [bytes] is not one of SUMO's.
ELEMENT_BYTES = 1 << 22

#: A gzipped log may be so many times its size when it is unpacked: SUMO's reach 150 where the same trains stand for hours, a bomb
#: 1000. Shorter ones [bytes] are not measured.
TIMES, SHORT = 500, 1 << 26

#: Byte order marks of text in two bytes per character.
UTF16 = (b"\xff\xfe", b"\xfe\xff")


def find_log(folder: Path, name: str) -> Path | None:
    """The log whose file name begins with ``name`` and that is XML, gzipped or not."""
    for path in sorted(folder.glob(f"{name}*")):
        if path.name.endswith((".xml", ".xml.gz")):
            return path
    return None


def kind_of(path: Path) -> str:
    """``xml``, ``csv`` or ``parquet``, from the content."""
    with opened(path) as stream:
        head = stream.read(512)
    if head[:4] == b"PAR1":
        with opened(path, unpack=False) as stream:
            if stream.read(4) != b"PAR1":
                raise InputError(f"{path}: a gzipped Parquet file: unpack it (Parquet is compressed itself)")
        return "parquet"
    return "xml" if decoded(head).lstrip()[:1] == "<" else "csv"


def decoded(head: bytes) -> str:
    """The beginning of a file as text, whatever is damaged in it."""
    return head.decode("utf-16" if head.startswith(UTF16) else "utf-8-sig", "replace")


@contextmanager
def opened(path: Path, unpack: bool = True) -> Iterator[BinaryIO]:
    """The file, unpacked if it is gzipped; what goes wrong while it is read becomes one line."""
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: not a file (logs are read more than once: a pipe will not do)")
    try:
        with open(path, "rb") as raw:
            packed = unpack and raw.read(2) == b"\x1f\x8b"
            raw.seek(0)
            if packed:
                with gzip.open(raw) as stream:
                    yield cast(BinaryIO, _Unpacked(path, cast(BinaryIO, stream)))
            else:
                yield raw
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise InputError(f"{path}: damaged gzip: {error}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None


class _Unpacked:
    """A gzipped log as it is read, up to the length that its size allows: so the time is bounded, too."""

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self.path, self.stream = path, stream
        self.left = max(SHORT, TIMES * path.stat().st_size)

    def read(self, count: int) -> bytes:
        """The next bytes, at most ``count``.

        Raises
        ------
        InputError
            The log unpacks to more than ``TIMES`` times its size.
        """
        found = self.stream.read(count)
        self.left -= len(found)
        if self.left < 0:
            raise InputError(f"{self.path}: unpacks to more than {TIMES} times its size: not a log of SUMO")
        return found


def elements(path: Path, root: str, wanted: set[str]) -> Iterator[tuple[str, dict[str, str]]]:
    """Tag and attributes of the wanted elements of an XML log, in order.

    Raises
    ------
    InputError
        Another root element, not well-formed, cut short, with a document type (entity bombs), or unreasonably long elements.
    """
    parser = Parser(path, root)
    with opened(path) as stream:
        while chunk := stream.read(CHUNK):
            yield from _named(parser.feed(chunk), wanted)
        yield from _named(parser.feed(b"", last=True), wanted)


def _named(found: list[Element], wanted: set[str]) -> Iterator[tuple[str, dict[str, str]]]:
    for tag, attributes, _ in found:
        if tag in wanted:
            yield tag, dict(zip(attributes[::2], attributes[1::2], strict=True))


#: Tag, attributes (name, value, name, ...), and how many elements had ended since the piece it is in begins.
Element = tuple[str, list[str], int]


#: An element no log has, to ask where the parser is.
PROBE = "trainctl.here"
_PROBE = f"<{PROBE}/>".encode()


class Parser:
    """The strict parser, fed piece by piece; parts known to be whole elements of the root may be left out (``skip``)."""

    def __init__(self, path: Path, root: str) -> None:
        self.path, self.root = path, root
        self.found: list[Element] = []
        self.ended: list[str] = []
        self.started = self.gone = 0  # elements begun and ended in earlier pieces
        self.fed, self.lines = 0, 0  # bytes; lines that were left out
        self.utf8: bool | None = None  # whether the log says so; None before its first bytes
        self.comments: _Comments | None = None
        self.parser = parser = expat.ParserCreate()
        parser.ordered_attributes = True
        parser.StartElementHandler = self._first
        parser.EndElementHandler = self.ended.append
        parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = self._refuse

    def _first(self, tag: str, attributes: list[str]) -> None:
        if tag != self.root:
            raise InputError(f"{self.path}: not a log of the kind <{self.root}>: its root is <{tag:.40}>")
        self.found.append((tag, attributes, 0))
        found, ended = self.found, self.ended

        def start(tag: str, attributes: list[str]) -> None:
            found.append((tag, attributes, len(ended)))

        self.parser.StartElementHandler = start

    def _refuse(self, *_: object) -> None:
        line = self.parser.CurrentLineNumber + self.lines
        raise InputError(f"{self.path}: line {line}: has a document type or entities, which no log of SUMO has")

    def feed(self, data: bytes, last: bool = False) -> list[Element]:
        """The elements that begin in these bytes.

        Raises
        ------
        InputError
            As ``elements`` does.
        """
        if self.comments is None:
            self.comments = _Comments(not data.startswith(UTF16))
        self._parse(self.comments.blanked(data, last), last)
        found, self.found[:] = self.found.copy(), []
        self.started += len(found)
        self.gone += len(self.ended)
        self.ended.clear()
        return found

    def _parse(self, data: bytes, last: bool) -> None:
        self.fed += len(data)
        try:
            self.parser.Parse(data, last)
        except expat.ExpatError as error:
            told = f"{expat.errors.messages[error.code]}: line {error.lineno + self.lines}, column {error.offset}"
            raise InputError(f"{self.path}: not well-formed XML: {told}") from None
        except (ValueError, LookupError) as error:  # an unknown encoding
            raise InputError(f"{self.path}: {error}") from None
        if not last and self.fed - self.parser.CurrentByteIndex > ELEMENT_BYTES:
            line = self.parser.CurrentLineNumber + self.lines
            raise InputError(f"{self.path}: line {line}: an element longer than {ELEMENT_BYTES >> 20} MiB")

    def between(self) -> bool:
        """Whether all that was fed is read, and the next byte stands in the root, outside any other element or comment."""
        if self.comments is None or self.comments.open or self.started - self.gone != 1:
            return False
        self._parse(_PROBE, False)  # in a comment, a CDATA section, an instruction it is no element
        seen = [tag for tag, *_ in self.found] == [PROBE]
        self.started, self.gone = self.started + len(self.found), self.gone + len(self.ended)
        self.found.clear()
        self.ended.clear()
        return seen and self.started - self.gone == 1

    def skip(self, data: bytes) -> None:
        """Leave out a part that is known to be well-formed."""
        self.lines += data.count(b"\n")


class _Comments:
    """Comments may be in any encoding (SUMO copies its configuration into one): blanks instead, byte by byte."""

    BLANKS = bytes(byte if byte in b"\r\n" else 0x20 for byte in range(256))

    def __init__(self, wanted: bool) -> None:
        self.wanted, self.inside, self.held = wanted, False, b""

    @property
    def open(self) -> bool:
        """Whether the bytes to come may belong to a comment."""
        return self.inside or bool(self.held)

    def blanked(self, data: bytes, last: bool) -> bytes:
        """The bytes with blanks in comments; a few may be held back until the next call."""
        if not self.wanted or (not self.open and b"<!" not in data and not data.endswith(b"<")):
            return data
        data, place, out = self.held + data, 0, []
        while True:
            end = data.find(b"-->" if self.inside else b"<!--", place)
            if end < 0:
                break
            out.append(data[place:end].translate(self.BLANKS) if self.inside else data[place:end])
            out.append(b"-->" if self.inside else b"<!--")
            place, self.inside = end + len(out[-1]), not self.inside
        rest, mark = data[place:], b"-->" if self.inside else b"<!--"
        keep = 0 if last else next(k for k in (3, 2, 1, 0) if k < len(mark) and rest.endswith(mark[:k]))
        self.held = rest[len(rest) - keep :]
        rest = rest[: len(rest) - keep]
        out.append(rest.translate(self.BLANKS) if self.inside else rest)
        return b"".join(out)


def ended(path: Path) -> bool:
    """Whether a log has its end: SUMO does not tell when it could not write on."""
    if not path.is_file() or path.stat().st_size < 4:
        return False
    with path.open("rb") as file:
        file.seek(-min(path.stat().st_size, 200), os.SEEK_END)
        end = file.read()
    return end.endswith(b"PAR1") if path.suffix == ".parquet" else re.search(rb"(</[\w-]+>|/>)\s*$", end) is not None


#: Seconds behind hours and minutes, and before them days.
_CLOCK = re.compile(r"(-?)(?:(\d{1,9}):)?(\d{1,9}):(\d\d):(\d\d(?:\.\d+)?)")


def seconds(text: str) -> str:
    """Times like 1:00:00:02.50 or 00:00:02.50 in a text as seconds; the rest as it stands."""
    if ":" not in text:
        return text
    words = text.split(" ")
    found = [_CLOCK.fullmatch(word) for word in words]
    if not any(found):
        return text
    return " ".join(word if clock is None else _told(clock) for word, clock in zip(words, found, strict=True))


def _told(clock: re.Match[str]) -> str:
    sign, days, hours, minutes, rest = clock.groups()
    whole, dot, decimals = rest.partition(".")
    return f"{sign}{((int(days or 0) * 24 + int(hours)) * 60 + int(minutes)) * 60 + int(whole)}{dot}{decimals}"
