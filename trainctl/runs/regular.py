"""Blocks of XML exactly as SUMO writes it: one row a line, the same attributes in the same order, nothing else.

A block is read as CSV whose separator is the quotation mark: texts between two marks are values, and texts outside are literal
(`` speed=``). It is regular if the rows of one form (one element, one number of attributes) have the same literals, if every line
holds one element, and if nothing stands in it that XML would read in another way: then it is well-formed, and what the strict
parser would find is what the columns hold. Any doubt makes the block irregular, and the strict parser decides.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv as pc_csv

from trainctl.runs.kinds import Kind
from trainctl.signals import Ints

_NAME = rb"([A-Za-z_][A-Za-z0-9_.-]*)"
_FIRST = re.compile(rb" *<" + _NAME + rb" +" + _NAME + rb"=")
_NEXT = re.compile(rb" +" + _NAME + rb"=")
_LAST = re.compile(rb" */>")
#: Different rows in a block, by element and number of attributes.
MOST_FORMS = 8
#: Attributes of a regular row; each is two columns.
MOST_ATTRIBUTES = 100

_PARSE = pc_csv.ParseOptions(delimiter='"', quote_char=False, double_quote=False, escape_char=False, ignore_empty_lines=False)


def regular_rows(block: bytes, kind: Kind, wanted: frozenset[str]) -> pa.Table | None:
    """Rows of a block of whole time steps; None if the block is not regular.

    Parameters
    ----------
    block : bytes
        Part of a log in UTF-8 that begins and ends within its root, outside any other element.
    kind : Kind
        A kind with steps.
    wanted : frozenset of str
        Elements that are rows; others of the kind are left out.
    """
    element = kind.step.encode()
    found = _lines(block, element) if block.endswith(b"</" + element + b">") and _plain(block) else None
    if found is None:
        return None
    times, lines, step = found
    parts = _rows(block, lines, kind)
    if parts is None:
        return None
    tables, places = [], []
    for tag, which, part in parts:
        if "time" in part.column_names:
            return None
        if tag in wanted:
            tables.append(part.add_column(0, "time", times.take(pa.array(step[which]))))
            places.append(np.arange(len(step))[which])
    return in_order(tables, places) if tables else pa.table({})


_NEWLINE, _RETURN, _MARK, _SLASH, _LESS = b'\n\r"/<'


def _plain(block: bytes) -> bool:
    """Whether nothing stands in a block that XML reads in another way, or not at all: references, control characters, tabs."""
    if b"&" in block:
        return False
    bytes_ = np.frombuffer(block, np.uint8)
    returns = int(np.count_nonzero(bytes_ == _RETURN)) if b"\r" in block else 0
    if np.count_nonzero(bytes_ < 0x20) != np.count_nonzero(bytes_ == _NEWLINE) + returns:
        return False
    if block.isascii():
        return True
    try:
        return not {"\ufffe", "\uffff"} & set(block.decode())  # no characters
    except UnicodeDecodeError:
        return False


def in_order(parts: list[pa.Table], places: Sequence[Sequence[int] | Ints]) -> pa.Table:
    """Tables of some rows each as one table, every row in its place."""
    if len(parts) == 1:
        return parts[0]
    whole = pa.concat_tables(parts, promote_options="default").combine_chunks()
    return whole.take(pa.array(np.argsort(np.concatenate([np.asarray(p, np.int64) for p in places]))))


class _Lines(NamedTuple):
    """Lines of a block: where each begins and ends, and the first letter of its element."""

    begins: Ints
    ends: Ints  # behind the line's end
    letters: npt.NDArray[np.uint8]

    def some(self, which: Ints | npt.NDArray[np.bool_]) -> _Lines:
        return _Lines(self.begins[which], self.ends[which], self.letters[which])

    def text(self, block: bytes) -> bytes:
        """The lines one after the other."""
        if not len(self.begins):
            return b""
        apart = np.flatnonzero(self.begins[1:] != self.ends[:-1])  # lines that follow each other are one piece
        begins, ends = np.append(self.begins[0], self.begins[apart + 1]), np.append(self.ends[apart], self.ends[-1])
        return b"".join([block[begin:end] for begin, end in zip(begins.tolist(), ends.tolist(), strict=True)])


def _lines(block: bytes, step: bytes) -> tuple[pa.Array, _Lines, Ints] | None:
    """Times of the steps, the lines of the rows, and the number of the step each row is in."""
    bytes_ = np.frombuffer(block, np.uint8)
    ends = np.append(np.flatnonzero(bytes_ == _NEWLINE), len(block))
    begins = np.append(0, ends[:-1] + 1)
    marks = np.flatnonzero(bytes_ == _LESS)
    if len(marks) < 2 or len(ends) - len(marks) not in (0, 1):
        return None
    if len(ends) > len(marks):  # what is left of the line in which the last block ended
        if block[: ends[0]].strip():
            return None
        begins, ends = begins[1:], ends[1:]
    if (marks < begins).any() or (marks >= ends).any():  # one in every line
        return None
    letters = bytes_[marks + 1]
    opening, closing = letters == step[0], letters == _SLASH
    empty = opening & (bytes_[ends - 2 - (bytes_[ends - 1] == _RETURN)] == _SLASH)
    lines, row = _Lines(begins, ends + 1, letters), ~(opening | closing)
    change = (opening & ~empty).astype(np.int64) - closing
    depth = np.cumsum(change) - change  # before each line
    if (depth[opening] != 0).any() or (depth[~opening] != 1).any() or not closing[-1]:
        return None
    if lines.some(closing).text(block).replace(b"</" + step + b">", b"").strip():
        return None
    times = np.empty(int(np.count_nonzero(opening)), object)
    for which, last in ((opening & ~empty, rb" *>"), (empty, rb" */>")):
        told = _times(lines.some(which).text(block), int(np.count_nonzero(which)), step, last)
        if told is None:
            return None
        times[which[opening]] = told
    column = pa.array([time.decode() or None for time in times.tolist()], pa.string())
    return column, lines.some(row), np.cumsum(opening)[row] - 1


def _times(text: bytes, count: int, step: bytes, last: bytes) -> list[bytes] | None:
    """The times of so many steps, whose beginnings stand a line each, with such an end; None if they are not alike."""
    if not count:
        return []
    pieces = text.split(b'"')
    first, rest = pieces[0], pieces[-1]
    if len(pieces) != 2 * count + 1 or not re.fullmatch(rb" *<" + step + rb" +time=", first):
        return None
    if not re.fullmatch(last + rb"\r?\n", rest) or not {*pieces[2:-1:2]} <= {rest + first}:
        return None
    return pieces[1::2]


#: Element, its rows among all, their values.
_Part = tuple[str, Ints, pa.Table]


def _rows(block: bytes, lines: _Lines, kind: Kind) -> list[_Part] | None:
    """Rows by element; None if those of one element with as many attributes are not alike."""
    out: list[_Part] = []
    for letter in np.unique(lines.letters).tolist():
        tag = _tag(chr(letter), kind)
        for which, text in _by_attributes(block, lines, np.flatnonzero(lines.letters == letter)):
            part = _rows_of(text, len(which), tag)
            if part is None or len(out) == MOST_FORMS:
                return None
            out.append((tag.decode(), which, part))
    return out


def _by_attributes(block: bytes, lines: _Lines, which: Ints) -> Iterator[tuple[Ints, bytes]]:
    """Rows with as many attributes, and their text."""
    mine = lines.some(which)
    text = mine.text(block)
    marks = np.frombuffer(text, np.uint8) == _MARK
    if np.count_nonzero(marks) == len(which) * text.count(b'"', 0, text.index(b"\n")):  # or one has less and one more
        yield which, text
        return
    number = np.diff(np.searchsorted(np.flatnonzero(marks), np.cumsum(mine.ends - mine.begins)), prepend=0)
    for one in np.unique(number).tolist():
        yield which[number == one], mine.some(number == one).text(block)


def _tag(letter: str, kind: Kind) -> bytes:
    """The element of the kind's that begins with a letter."""
    return next((row for row in kind.rows if row.startswith(letter)), "").encode()


def _rows_of(text: bytes, rows: int, tag: bytes) -> pa.Table | None:
    """The values of so many lines of one element, all alike; None if they are not."""
    literals = text[: text.find(b"\n")].rstrip(b"\r").split(b'"')[::2]
    if not 2 <= len(literals) <= MOST_ATTRIBUTES:
        return None
    first, others = _FIRST.fullmatch(literals[0]), [_NEXT.fullmatch(literal) for literal in literals[1:-1]]
    if first is None or first[1] != tag or None in others or not _LAST.fullmatch(literals[-1]):
        return None
    names = [first[2].decode(), *(other[1].decode() for other in others if other is not None)]
    if len(set(names)) < len(names) or any(name.startswith("xmlns") for name in names):
        return None
    columns = [f"{k}" for k in range(2 * len(names) + 1)]
    try:
        table = pc_csv.read_csv(
            pa.py_buffer(text),
            read_options=pc_csv.ReadOptions(use_threads=False, block_size=len(text) + 1, column_names=columns),
            parse_options=_PARSE,
            convert_options=pc_csv.ConvertOptions(
                column_types=dict.fromkeys(columns[1::2], pa.string())
                | {name: pa.binary(len(literal)) for name, literal in zip(columns[::2], literals, strict=True)},
                strings_can_be_null=True, null_values=[""],
            ),
        )  # fmt: skip
    except pa.ArrowException:  # another number of values in a line, a literal of another length, not UTF-8
        return None
    if table.num_rows != rows:
        return None
    if not all(_only(table[name], literal) for name, literal in zip(columns[::2], literals, strict=True)):
        return None
    return table.select(columns[1::2]).rename_columns(names)


def _only(column: pa.ChunkedArray, literal: bytes) -> bool:
    """Whether a column of texts of one length holds nothing but this one."""
    texts = column.combine_chunks()
    there = np.frombuffer(texts.buffers()[1], np.uint8)[: len(texts) * len(literal)].reshape(len(texts), len(literal))
    return not column.null_count and bool((there == np.frombuffer(literal, np.uint8)).all())
