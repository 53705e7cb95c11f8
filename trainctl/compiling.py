"""How long compiling takes, and a message when it begins: laws are compiled once, and later runs are not slower for it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event

#: What compiles a law with its plant and observer, and what is said of it and of all the rest.
LAW, OF_LAW, OF_REST = "advance_kernel", "compiling the law, about 20 s, once", "compiling, some seconds, once"


class Compiling(event.Listener):
    """Counts the seconds of numba's compiler; what is loaded from disk is not compiled. ``tell`` gets each word once."""

    def __init__(self, tell: Callable[[str], None] | None) -> None:
        self.seconds = 0.0
        self.tell, self.told, self.depth, self.began = tell, set[str](), 0, 0.0

    def on_start(self, event: Any) -> None:
        """A function is compiled, maybe for another one that is."""
        if self.depth == 0:
            self.began = time.perf_counter()
        self.depth += 1
        words = OF_LAW if event.data["dispatcher"].py_func.__name__ == LAW else OF_REST
        if self.tell is not None and words not in self.told and OF_LAW not in self.told:
            self.told.add(words)
            self.tell(words)

    def on_end(self, event: Any) -> None:
        """One of them is done."""
        self.depth -= 1
        if self.depth == 0:
            self.seconds += time.perf_counter() - self.began


@contextmanager
def compiling(tell: Callable[[str], None] | None = None) -> Iterator[Compiling]:
    """Listen to numba's compiler inside."""
    found = Compiling(tell)
    with event.install_listener("numba:compile", found):
        yield found
