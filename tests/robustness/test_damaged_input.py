"""Readers of damaged files raise what they document, or read the same.

Each target draws so many mutations; ``FUZZ_COUNT=100000 make test-all ARGS="-k damaged"`` draws
more. Anything else than a documented error, or exactly what was written, is a finding: another
exception, another law, more than ten seconds, or numbers that are not finite.
"""

import contextlib
import os
import signal
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sample_problems import small_mpc
from sb3_yann import LinearModel
from sb3_yann._archive import read_arrays, write_arrays
from sb3_yann.commissioning.journal import CommissioningState, Journal, Record
from sb3_yann.commissioning.plant import PlantEpisode

SECONDS = 10
"""After which a reader counts as hung."""
EDGES = (0, 1, -1, 2, 7, 10**9, -(2**31), 2**62, np.nan, np.inf, -np.inf, 1e300, 5e-324, 0.5)


class Wrong(Exception):
    """What was read is not what was written, or of no use."""


@dataclass
class Target:
    """A reader: ``attempt`` reads one mutation, drawn by ``rng``, or raises."""

    attempt: Callable[[np.random.Generator], str]
    errors: tuple[type[BaseException], ...] = (ValueError, OSError)


@contextlib.contextmanager
def _limited() -> Iterator[None]:
    def hung(*_: Any) -> None:
        raise Wrong(f"it took more than {SECONDS} seconds")

    before = signal.signal(signal.SIGALRM, hung)
    signal.alarm(SECONDS)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Return some bytes with one to four changes: flipped, set, cut, repeated, moved, inserted."""
    broken = bytearray(content)
    for _ in range(rng.integers(1, 5)):
        if not broken:
            break
        at, other = (int(each) for each in rng.integers(len(broken), size=2))
        some = slice(at, at + int(rng.integers(1, 64)))
        kind = rng.integers(7)
        if kind == 0:
            broken[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            broken[at] = int(rng.integers(256))
        elif kind == 2:
            del broken[at:]
        elif kind == 3:
            broken[other:other] = broken[some]
        elif kind == 4:
            broken[some] = bytes(len(broken[some]))
        elif kind == 5:
            broken[at:at] = rng.bytes(int(rng.integers(1, 16)))
        else:
            broken[some] = b"\xff" * len(broken[some])
    return bytes(broken)


def _law_file(kind: str, folder: Path) -> tuple[Callable[[Path], Any], Path]:
    path = folder / "law.npz"
    model = LinearModel([[1, 0.1], [0, 1]], [[0.005], [0.1]], 0.1, state_names=["x", "v"])
    mpc = small_mpc(model, R=[[0.1]], u_max=2)
    law = mpc.explicit() if kind == "law" else mpc.online()
    law.save(path)
    return type(law).load, path


def _arrays(kind: str) -> Callable[[Path], Target]:
    """Return a target of files with a right digest, and entries that a stranger has changed."""

    def target(folder: Path) -> Target:
        load, path = _law_file(kind, folder)
        arrays = read_arrays(path)

        def attempt(rng: np.random.Generator) -> str:
            changed = dict(arrays)
            for name in rng.choice([*arrays], size=rng.integers(1, 3)):
                changed[name] = _changed(np.array(changed.get(name, 0)), rng)
                if rng.random() < 0.05:
                    del changed[name]
            write_arrays(path, changed)
            act = load(path)
            for theta in rng.uniform(-6, 6, (4, act.n_theta)):
                if not np.isfinite(act(theta)).all():
                    raise Wrong("an input is no number")
            return "of use"

        return Target(attempt)

    return target


def _changed(array: Any, rng: np.random.Generator) -> Any:
    kind = rng.integers(7)
    if kind == 0 and array.size and array.dtype.kind in "fi":
        value = EDGES[rng.integers(len(EDGES))]
        whole = array.dtype.kind == "i" and np.isfinite(value) and value == int(value)
        array = array.astype(np.int64 if whole else np.float64)
        array.flat[rng.integers(array.size)] = value
        return array
    if kind == 1:
        return array[..., :-1] if array.ndim else array.reshape(1)
    if kind == 2:
        return np.concatenate([array, array]) if array.ndim else np.zeros(3)
    if kind == 3:
        return array.astype(str)
    if kind == 4:
        return array.T
    if kind == 5:
        return np.zeros((0, *array.shape[1:]), array.dtype)
    return array.astype(np.float32) * np.float32(-1) if array.dtype.kind in "fi" else array


def _record(folder: Path) -> Target:
    """Return a target of damaged records of a commissioning."""
    path = folder / "plant.jsonl"
    settings = {"batch": 2}
    journal = Journal(Record(path), settings, CommissioningState(0.1))
    for _ in range(3):
        journal.begin(False)
        rows = np.ones((3, 2)), np.ones((2, 1))
        journal.add(PlantEpisode(*rows, -1.0, 0, None, 0.1, 0.0), False)
    content = path.read_bytes()
    events = Record(path).events

    def attempt(rng: np.random.Generator) -> str:
        path.write_bytes(damaged(content, rng))
        found = Record(path)
        if found.events != events[: len(found.events)]:
            raise Wrong("other events were read")
        Journal(found, settings, CommissioningState(0.1))
        return "the same" if len(found.events) == len(events) else "cut off"

    return Target(attempt)


TARGETS: dict[str, Callable[[Path], Target]] = {
    **{f"{kind}, signed": _arrays(kind) for kind in ("law", "online")},
    "record": _record,
}


@pytest.mark.skipif(not hasattr(signal, "SIGALRM"), reason="no alarm on this system")
@pytest.mark.parametrize("name", TARGETS)
def test_what_is_damaged_is_refused_or_read_as_it_was(name, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    target = TARGETS[name](tmp_path)
    count = int(os.environ.get("FUZZ_COUNT", 200))
    outcomes = set()
    for k in range(count):
        rng = np.random.default_rng((7, k))
        try:
            with _limited():
                outcomes.add(target.attempt(rng))
        except target.errors as error:
            assert str(error), f"{name}, seed (7, {k}): {error!r} says nothing"
            outcomes.add(type(error).__name__)
        except Exception as error:
            pytest.fail(f"{name}, seed (7, {k}): {error!r}")
    assert len(outcomes) > 1  # what is refused and what is taken are both met
