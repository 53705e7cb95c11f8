"""Rows of one train in tables of all units, as compiled code takes them: the numbers of rows and columns stand in the code.

Where all trains have as many units, loops over the units of one have a fixed length; the compiler then unrolls them and takes
several units together. That halves the time of a stage, and changes no sum.
"""

from __future__ import annotations

from typing import Any

import numba
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np import arrayobj

from trainctl.signals import Floats, Ints

types: Any = numba.types
arrays: Any = arrayobj
pack_array: Any = cgutils.pack_array

#: Tables of units by their places in ``code``, behind the number of units of every train.
UNITS, OWN, ESTIMATE, CORRECTION = range(4)

#: So many trains are worth code of their own for their number of units: some runs side by side.
WORTH = 24


def numbers(first: Ints, own: Floats, estimate: Floats, correction: Floats) -> str:
    """What ``block`` reads of a code: units of every train, 0 where they differ, and columns of own state, estimate, correction."""
    count = first[1:] - first[:-1]
    same = len(count) >= WORTH and (count == count[0]).all()
    return " ".join(str(k) for k in (int(count[0]) if same else 0, *(table.shape[1] for table in (own, estimate, correction))))


def sliced(code: str, which: int, table: Any, begin: int, end: int) -> Any:
    """Rows ``begin`` to ``end`` of a table, those of one train, with as many columns as ``code`` says it has; a view."""
    return table[begin:end]


@intrinsic(prefer_literal=True)
def viewed(typing, code, which, table, begin, end):  # type: ignore[no-untyped-def]
    """``sliced`` in compiled code: its shape is constant where it is known."""
    if not isinstance(code, types.Literal):
        return None
    known = [int(k) for k in code.literal_value.split()[-4:]]
    rows, columns = known[UNITS], known[which.literal_value]

    def written(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        kind = signature.return_type
        intp, (_, _, whole, begins, ends) = context.get_value_type(types.intp), arguments
        shape, size = [intp(rows) if rows else builder.sub(ends, begins)], context.get_abi_sizeof(context.get_data_type(kind.dtype))
        strides, offset = [intp(size)], begins
        if kind.ndim == 2:
            shape.append(intp(columns))
            strides, offset = [intp(size * columns), intp(size)], builder.mul(begins, intp(columns))
        found, data = arrays.make_array(kind)(context, builder), arrays.make_array(kind)(context, builder, whole).data
        arrays.populate_array(
            found, data=builder.gep(data, [offset]), shape=pack_array(builder, shape), strides=pack_array(builder, strides),
            itemsize=intp(size), meminfo=None, parent=None,
        )  # fmt: skip
        return found._getvalue()

    return table(code, which, table, begin, end), written


#: Rows of one train.
block: Any = sliced if numba.config.DISABLE_JIT else viewed  # type: ignore[attr-defined]
