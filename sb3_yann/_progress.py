"""What is printed; what is waited for, on stderr: after three seconds a bar, in a file lines."""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import Any, TextIO

from tqdm import tqdm  # type: ignore[import-untyped]

from sb3_yann._validation import check_bool

DELAY = 3.0  # seconds that pass without a word
FILE_INTERVAL = 30.0  # seconds without a line after which a bar leaves one in a file; of parts 300

_silent = ContextVar("silent", default="TQDM_DISABLE" in os.environ)
_parts = ContextVar("parts", default=False)


def answer(text: object, file: TextIO | None = None) -> None:
    """Print on stdout, or in a file. Characters that its encoding lacks are escaped."""
    file = file or sys.stdout
    line = str(text)
    with suppress(LookupError, TypeError, AttributeError):  # a stream that names no encoding
        line = line.encode(file.encoding, "backslashreplace").decode(file.encoding)
    print(line, file=file)


def say(text: object, file: TextIO | None = None) -> None:
    """Print what is no command's answer: none of these lines ends a training."""
    with suppress(OSError, ValueError):  # a pipe whose reader has gone, a file that is closed
        answer(text, file)


def is_watched() -> bool:
    """Return whether stderr is a terminal or a notebook, rather than a file or another's bar."""
    if type(sys.stderr).__module__.startswith("ipykernel"):
        return True
    own = sys.__stderr__
    return own is not None and sys.stderr is own and own.isatty()


@contextmanager
def shown(progress_bar: bool, parts: bool = False) -> Iterator[None]:
    """Show what takes long, unless it is False here or further out.

    Bars of ``parts`` count and foretell nothing, and leave little in a file but for the first line:
    `Progress` says how long all of them take.
    """
    check_bool("progress_bar", progress_bar)
    if not _parts.get():
        _Lines.latest = -math.inf
    token = _silent.set(_silent.get() or not progress_bar)
    of_parts = _parts.set(_parts.get() or parts)
    try:
        yield
    finally:
        _silent.reset(token)
        _parts.reset(of_parts)


class _Bar(tqdm):  # type: ignore[misc]
    """A bar without tqdm's thread; a process that is killed leaves no lock behind."""

    monitor_interval = 0


_Bar.set_lock(threading.RLock())


class _Lines:
    """A file in which a line is left where there was none for so many seconds.

    The ``first`` one may be left in any case.
    """

    latest = -math.inf  # of all of them

    def __init__(self, interval: float, first: bool = False) -> None:
        self.interval = interval
        self.first = first

    def write(self, text: str) -> None:
        """Write a line, without what moves the cursor."""
        now = time.monotonic()
        if text.strip() and (self.first or now >= _Lines.latest + self.interval):
            _Lines.latest = now
            self.first = False
            say(text.strip(), sys.stderr)

    def flush(self) -> None:
        """Make it seen."""
        sys.stderr.flush()


def bar(
    what: str, items: Iterable[Any] | None = None, total: int | None = None, timed: bool = False
) -> Any:
    """Return a bar over items, or one to ``update``; those inside each other share a line.

    A ``timed`` one foretells its end among parts too, in a file after three seconds.
    """
    watched = is_watched()
    of_parts = _parts.get() and not timed
    counted = total is not None or isinstance(items, Sized)
    words = "  {desc}: {n_fmt}" + " of {total_fmt}" * counted
    if not of_parts:
        words += ", {elapsed} so far" + ", {remaining} left" * counted
    return _Bar(
        items,
        desc=what,
        total=total,
        delay=DELAY,
        leave=False,
        miniters=1,
        position=0,
        file=sys.stderr if watched else _Lines(FILE_INTERVAL * (10 if of_parts else 1), timed),
        disable=_silent.get(),
        bar_format=words if of_parts or not watched else None,
    )


class Progress:
    """Lines with the time and the steps so far, once a call has taken three seconds."""

    def __init__(self, steps: Callable[[], int] | None = None) -> None:
        self.begun = time.monotonic()
        self.steps = steps

    def __call__(self, text: str, left: float = 0.0, detail: bool = False) -> None:
        """Write a line; ``left`` are the seconds that the rest may take, 0 where nobody knows.

        In a file a ``detail`` is left out, unless there was no other line for thirty seconds.
        """
        passed = time.monotonic() - self.begun
        if _silent.get() or passed < DELAY:
            return
        steps = "" if self.steps is None else f" {self.steps():>9,} steps"
        rest = f", about {left:.0f} s more if all is needed" if left > 0 else ""
        line = f"[{passed:5.0f} s{steps}{rest}] {text}"
        if is_watched():
            _Bar.write(line, file=sys.stderr)
        else:
            _Lines(FILE_INTERVAL if detail else 0.0).write(line)
