"""What takes long is shown on stderr: a bar for a person, few lines in a file, else nothing."""

from __future__ import annotations

import io
import sys
from typing import Any

import pytest

from sb3_yann import _progress
from sb3_yann._progress import Progress, bar, is_watched, shown


class Clock:
    """Seconds that pass only when a test says so."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch) -> Clock:
    found = Clock()
    monkeypatch.setattr(_progress.time, "monotonic", found)
    monkeypatch.setattr(_progress, "_LINES", _progress._Lines())
    return found


class Terminal(io.StringIO):
    """A terminal as sys.stderr."""

    def isatty(self) -> bool:
        return True


def counted(clock: Clock, each: float, n: int = 100) -> None:
    made = bar("plans", total=n)
    made._time = clock
    made.start_t = made.last_print_t = clock()
    for _ in range(n):
        clock.now += each
        made.update()
    made.close()


def test_what_takes_less_than_three_seconds_shows_nothing(clock, capsys) -> None:
    counted(clock, each=0.029)
    Progress()("done")
    assert capsys.readouterr() == ("", "")


def test_a_file_gets_a_line_after_three_seconds_then_one_each_half_minute(clock, capsys) -> None:
    counted(clock, each=1.0)
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert out == "" and len(lines) == 4 and "\r" not in err
    assert lines[0].startswith("plans:   3%") and "/100 [00:03<" in lines[0]


def test_a_terminal_gets_a_bar_that_goes_again(clock, monkeypatch) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setattr(sys, "__stderr__", screen)
    assert is_watched()
    counted(clock, each=1.0)
    assert "\n" not in screen.getvalue() and "\rplans:  50%" in screen.getvalue()
    assert screen.getvalue().split("\r")[-2].strip() == ""


def test_where_another_bar_has_taken_stderr_there_are_lines(monkeypatch) -> None:
    monkeypatch.setattr(sys, "stderr", Terminal())
    assert not is_watched()


def test_a_notebook_is_watched(monkeypatch) -> None:
    stream: Any = type("OutStream", (io.StringIO,), {"__module__": "ipykernel.iostream"})
    monkeypatch.setattr(sys, "stderr", stream())
    assert is_watched()


def test_lines_name_the_time_the_steps_and_what_is_left(clock, capsys) -> None:
    progress = Progress(lambda: 1234)
    clock.now += 5.0
    progress("a round is over", left=20.0)
    assert capsys.readouterr().err == (
        "[    5 s     1,234 steps, up to about 20 s left] a round is over\n"
    )


def test_bars_of_parts_count_and_foretell_nothing(clock, capsys) -> None:
    with shown(True, parts=True):
        counted(clock, each=1.0)
    assert capsys.readouterr().err.splitlines()[0] == "plans: 3 of 100"


def test_false_silences_all_that_is_called(clock, capsys) -> None:
    with shown(False), shown(True):
        progress = Progress()
        counted(clock, each=1.0)
        progress("a round is over")
    assert capsys.readouterr() == ("", "")
    counted(clock, each=1.0)
    assert capsys.readouterr().err
