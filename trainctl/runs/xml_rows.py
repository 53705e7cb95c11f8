"""Rows of an XML log: regular blocks at full speed, everything else through the strict parser, both to the same tables."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from trainctl.errors import InputError
from trainctl.runs.kinds import Kind
from trainctl.runs.regular import in_order, regular_rows
from trainctl.runs.sumo_logs import CHUNK, UTF16, Element, Parser, opened

BATCH_ROWS = 1 << 15
#: A log with more columns than this is not one of SUMO's.
MOST_COLUMNS = 1000
#: A batch ends before it has rows of more different forms than this, or more values.
FORMS, VALUES = 64, 1 << 22

BLOCK = 1 << 21  # bytes
#: A time step longer than this [bytes] is left to the strict parser.
STEP_BYTES = 1 << 25


def xml_rows(path: Path, kind: Kind, rows: Sequence[str] = (), strict: bool = False) -> Iterator[pa.Table]:
    """Rows of a log as tables of texts.

    Parameters
    ----------
    path : Path
        The log, gzipped or not.
    kind : Kind
        What it is.
    rows : sequence of str, optional
        Only these of the kind's elements are rows; default: all.
    strict : bool
        Read everything with the strict parser; the tables hold the same.

    Raises
    ------
    InputError
        Not well-formed, cut short, with a document type, of another kind.
    """
    gathered = _Gathered(path, kind, frozenset(rows or kind.rows))
    parser = Parser(path, kind.root)
    with opened(path) as stream:
        pieces = iter(lambda: stream.read(CHUNK), b"") if strict or not kind.step else _blocks(stream.read, kind)
        regular = False  # whether the next piece stands between elements of the root, in an encoding that is known
        for piece in pieces:
            found = regular_rows(piece, kind, gathered.wanted) if regular else None
            if found is not None:
                parser.skip(piece)
                yield from gathered.rest()
                yield found
                continue
            for part in range(0, len(piece), CHUNK):
                gone = parser.gone
                yield from gathered.put(parser.feed(piece[part : part + CHUNK]), gone)
            if kind.step and not strict:
                regular = _ascii_like(parser, piece) and parser.between()
        gone = parser.gone
        yield from gathered.put(parser.feed(b"", last=True), gone)
        yield from gathered.rest()


def _ascii_like(parser: Parser, piece: bytes) -> bool:
    """Whether the log is UTF-8; what else it says stands in its first piece."""
    if parser.utf8 is None:
        declared = re.match(rb"(?:\xef\xbb\xbf)?<\?xml[^>]*?encoding\s*=\s*[\"']([\w.-]+)", piece)
        parser.utf8 = not piece.startswith(UTF16) and (declared is None or declared[1].lower() in (b"utf-8", b"us-ascii"))
    return parser.utf8


def _blocks(read: Callable[[int], bytes], kind: Kind) -> Iterator[bytes]:
    """What stands before the first step, then pieces of whole steps, as far as they can be told from others."""
    end, rest, begun = f"</{kind.step}>".encode(), b"", False
    while chunk := read(BLOCK):
        if not begun:
            begun = True
            root = chunk.find(f"<{kind.root}".encode())
            head = chunk.find(b">", root) + 1 if root >= 0 else 0
            if head:
                yield chunk[:head]
                chunk = chunk[head:]
        cut = chunk.rfind(end)  # an end across two chunks is found with the next one
        cut = cut + len(end) if cut >= 0 else len(chunk) if len(rest) > STEP_BYTES else 0
        if cut:
            yield b"".join((rest, memoryview(chunk)[:cut]))
            rest = chunk[cut:]
        else:
            rest += chunk
    if rest:
        yield rest


class _Form:
    """Rows with the same attributes."""

    def __init__(self) -> None:
        self.rows: list[int] = []  # their numbers
        self.outer: list[int] = []  # numbers of what stands around them
        self.values: list[list[str]] = []  # those of the last rows
        self.columns: list[list[str]] = []  # those of the rows before, by column

    def fold(self) -> None:
        """Rows into columns: few long lists instead of many short ones."""
        if self.columns:
            for column, texts in zip(self.columns, zip(*self.values, strict=True), strict=False):
                column += texts
        else:
            self.columns = [list(texts) for texts in zip(*self.values, strict=True)]
        self.values = []


class _Gathered:
    """Rows as they come, sorted by their form: which attributes they have."""

    def __init__(self, path: Path, kind: Kind, wanted: frozenset[str]) -> None:
        self.path, self.kind, self.wanted = path, kind, wanted
        self.begun = self.row_depth = self.outer_depth = 0  # elements begun, depths of the open row and the innermost around it
        self.around: list[tuple[int, dict[str, str]]] = []  # elements around rows: depth, columns
        self.outer: list[dict[str, str]] = [{}]  # all their columns, as they were for the rows so far and are now
        self.names: set[str] = set()
        self.forms: dict[tuple[str, ...], _Form] = {}
        self.count = self.values = 0
        self.open: list[str] | None = None  # the row begun last: name, value, name, ...
        self.inside: dict[str, int] = {}  # elements in it -> how many
        self.last_names: list[str] | None = None  # the form of the row before
        self.last_form = _Form()

    def put(self, found: list[Element], gone: int) -> Iterator[pa.Table]:
        """Take elements, when so many have ended before them; yield a table whenever enough rows have come."""
        rows, around, step = frozenset(self.kind.rows), self.kind.around, self.kind.step
        for begun, (tag, attributes, ended) in enumerate(found, self.begun + 1):
            depth = begun - gone - ended
            if self.open is not None and (depth <= self.row_depth or tag in rows):
                self._close()
                if self.count >= BATCH_ROWS or self.values > VALUES or len(self.forms) >= FORMS:
                    yield self._table()
            if depth <= self.outer_depth:
                self._leave(depth)
            if tag in rows:
                if step and "time" not in self.outer[-1]:
                    raise InputError(f"{self.path}: a {tag} outside any {step} with a time")
                if tag in self.wanted:
                    self.open, self.row_depth = attributes, depth
            elif tag in around:
                told = dict(zip(attributes[::2], attributes[1::2], strict=True))
                self.around.append((depth, {column: told[name] for name, column in around[tag].items() if name in told}))
                self._leave(depth + 1)
            elif self.open is not None:
                self._inner(tag, attributes)
        self.begun += len(found)
        for form in self.forms.values():
            form.fold()

    def _leave(self, depth: int) -> None:
        """Elements around rows at least as deep have ended."""
        self.around = [(d, columns) for d, columns in self.around if d < depth]
        self.outer.append({name: value for _, columns in self.around for name, value in columns.items()})
        self.outer_depth = self.around[-1][0] if self.around else 0

    def _inner(self, tag: str, attributes: list[str]) -> None:
        assert self.open is not None
        number = self.inside[tag] = self.inside.get(tag, 0) + 1
        if len(self.open) + len(attributes) > 4 * MOST_COLUMNS:
            self._too_many()
        for place in range(0, len(attributes), 2):
            self.open += (f"{tag}_{attributes[place]}{number if number > 1 else ''}", attributes[place + 1])

    def _close(self) -> None:
        assert self.open is not None
        names, values = self.open[::2], self.open[1::2]
        if names != self.last_names:  # the parser has one object for one name: this is quick
            self.last_names, self.last_form = names, self._form(tuple(names))
        form = self.last_form
        form.rows.append(self.count)
        form.outer.append(len(self.outer) - 1)
        form.values.append(values)
        self.count, self.values, self.open = self.count + 1, self.values + len(values), None
        if self.inside:
            self.inside = {}

    def _form(self, names: tuple[str, ...]) -> _Form:
        form = self.forms.get(names)
        if form is None:
            form = self.forms[names] = _Form()
            self.names.update(names)
            if len(self.names) > MOST_COLUMNS:
                self._too_many()
        return form

    def _too_many(self) -> None:
        raise InputError(f"{self.path}: more than {MOST_COLUMNS} different attributes: not a log of SUMO")

    def rest(self) -> Iterator[pa.Table]:
        """What is left, at the end of a piece."""
        if self.open is not None:
            self._close()
        if self.count:
            yield self._table()

    def _table(self) -> pa.Table:
        outer = {
            name: filled(pa.array([columns.get(name) for columns in self.outer], pa.string()))
            for name in dict.fromkeys(name for columns in self.outer for name in columns)
        }
        parts = []
        for names, form in self.forms.items():
            form.fold()
            columns = {name: column.take(pa.array(form.outer)) for name, column in outer.items()}
            for name, texts in zip(names, form.columns, strict=True):
                if name not in columns and not name.startswith(("xmlns", "xsi:")):  # what stands around goes before
                    columns[name] = filled(pa.array(texts, pa.string()))
            parts.append(pa.table(columns or {"id": pa.nulls(len(form.rows), pa.string())}))
        table = in_order(parts, [form.rows for form in self.forms.values()])
        self.forms, self.count, self.values, self.outer = {}, 0, 0, self.outer[-1:]
        self.last_names, self.last_form = None, _Form()
        return table


def filled(column: pa.Array) -> pa.Array:
    """Null for an empty text: SUMO writes one where it has nothing to say."""
    empty = pc.equal(column, "")
    return pc.if_else(empty, pa.scalar(None, pa.string()), column) if pc.any(empty).as_py() else column
