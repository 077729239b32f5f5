"""What is killed or interrupted while it writes leaves a whole file behind.

The writer goes on and on in a process of its own, in turn with one of two contents. It is hit at a
random moment, ``KILLS=200`` times (10 by default). Needs a system that forks.
"""

import os
import re
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sb3_yann import Controller, export
from sb3_yann.commissioning.journal import Record
from sb3_yann.control import PiecewiseAffine
from sb3_yann_envs import problems

KILLS = int(os.environ.get("KILLS", 10))
LONGEST_WRITE = 0.08  # s


@pytest.fixture(autouse=True, scope="module")
def laws_are_solved() -> None:
    """Solve the laws before any fork."""
    for version in range(2):
        law(version)


class NotUsableError(Exception):
    """What is there is not whole, and cannot be used by mistake."""


@dataclass(frozen=True)
class Target:
    """Something that writes versions of a file, and tells which one is there."""

    name: str
    write: Callable[[Path, int], object]
    read: Callable[[Path], int]


@cache
def law(version: int) -> PiecewiseAffine:
    """Return the reactor's law, or that of other weights."""
    problem = problems.cstr()
    return replace(problem, R=(1 + version) * problem.R, terminal=None).explicit()


def read_law(folder: Path) -> int:
    found = PiecewiseAffine.load(folder / "law.npz")
    return next(version for version in range(2) if law(version) == found)


def read_code(folder: Path) -> int:
    """Return the version that all three files of an export name; files of two do not compile."""
    texts = [(folder / f"law{end}").read_text("ascii") for end in (".c", ".h", "_selftest.c")]
    marks = {re.findall(r"EXPORT_ID(?: !=)? (0x\w{8})u", text)[0] for text in texts}
    if len(marks) > 1:
        raise NotUsableError
    (version,) = {int("v1_" in text) for text in texts}
    return version


def write_record(folder: Path, version: int) -> None:
    record = Record(folder / "plant.jsonl")
    record.append({"event": "episode" if record.events else "begin", "at": version})


def read_record(folder: Path) -> int:
    found = [event["at"] for event in Record(folder / "plant.jsonl").events]
    assert found == [*range(len(found))], "an event is missing"
    return int(found[-1])


TARGETS = [
    Target("law.save", lambda path, k: law(k % 2).save(path / "law.npz"), read_law),
    Target(
        "export to npz",
        lambda path, k: export(law(k % 2), path / "law.npz", name=f"v{k % 2}"),
        lambda path: int(str(Controller.load(path / "law.npz").data["name"])[1:]),
    ),
    Target(
        "export to C",
        lambda path, k: export(law(k % 2), path / "law.c", name=f"v{k % 2}"),
        read_code,
    ),
    Target("record of Commissioning", write_record, read_record),
]


def fork(work: Callable[[], None]) -> int:
    """Return the process that does some work; it exits with 0, or with 1 after an error."""
    # A signal waits until the child can meet it.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    child = os.fork()
    if child:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        return child
    code = 1
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        work()
        code = 0
    finally:
        os._exit(code)


def write_on(target: Target, folder: Path) -> None:
    version = 1
    while True:
        target.write(folder, version)
        version += 1


def hit(target: Target, folder: Path, sign: int, rng: np.random.Generator) -> None:
    """Send a signal to a writer at a random moment."""
    target.write(folder, 0)
    child = fork(lambda: write_on(target, folder))
    time.sleep(rng.uniform(0, LONGEST_WRITE))
    os.kill(child, sign)
    os.waitpid(child, 0)


def require_whole(target: Target, folder: Path) -> None:
    try:
        target.read(folder)
    except NotUsableError:
        pass  # the three files of a C export are moved one after the other


@pytest.mark.parametrize("sign", [signal.SIGKILL, signal.SIGINT], ids=["kill", "Ctrl-C"])
@pytest.mark.parametrize("target", TARGETS, ids=lambda each: each.name)
def test_a_writer_that_is_hit_leaves_a_whole_file(target, sign, tmp_path) -> None:
    rng = np.random.default_rng(1)
    for trial in range(KILLS):
        folder = tmp_path / f"{trial}"
        folder.mkdir()
        hit(target, folder, sign, rng)
        require_whole(target, folder)
