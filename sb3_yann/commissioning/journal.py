"""What has happened in a commissioning so far, on disk before anything else happens.

The record has a line of JSON for each event, with its CRC-32.
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._archive import atomic_write
from sb3_yann.commissioning.plant import PlantEpisode
from sb3_yann.commissioning.watchdog import Alarm
from sb3_yann.twin.log import SHORTEST

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

Event = dict[str, Any]
NAME = "commissioning.jsonl"
BEGIN = b'{"event": "begin"'


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Let Ctrl-C wait until the block is over."""
    is_main = threading.current_thread() is threading.main_thread()
    if not (is_main and callable(signal.getsignal(signal.SIGINT))):  # nothing is raised here
        yield
        return
    came = list[int]()
    before = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if came:
            signal.raise_signal(signal.SIGINT)


class Record:
    """Events in their order, in a file if there is a path; ``events`` are those that it held.

    In a folder, a path without a suffix, it is ``commissioning.jsonl``. A last line that a kill cut
    off is overwritten by the next event.
    """

    def __init__(self, path: Path | None) -> None:
        is_folder = path is not None and (path.is_dir() or not path.suffix)
        self.path = path / NAME if path is not None and is_folder else path
        self.events: list[Event] = []
        self._size = 0  # of the whole lines, in bytes
        self._seen = 0
        if self.path is None:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        read = self.path.read_bytes() if self.path.exists() else b""
        *lines, rest = read.split(b"\n")
        if not lines and not rest.startswith(BEGIN[: len(rest)]):
            raise ValueError(f"{self.path} is no record of a commissioning. Name another file.")
        for number, line in enumerate(lines, start=1):
            try:
                event = dict(json.loads(line))
                if event.pop("crc32", None) != _checksum(event):
                    raise ValueError("its checksum is another")
                self.events.append(event)
            except (TypeError, ValueError, RecursionError) as error:
                raise ValueError(
                    f"{self.path}, line {number}: no event of a commissioning ({error}). Name "
                    "another file, or the one that was begun."
                ) from error
        self._size = len(read) - len(rest)
        self._seen = len(read)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep the record for this run until the block is over, or the process."""
        if self.path is None:
            yield
            return
        with self.path.open("ab") as file:
            try:
                if sys.platform == "win32":
                    file.seek(2**30)  # where nobody reads or writes
                    msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
                else:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:  # some file systems have no locks
                if isinstance(error, BlockingIOError | PermissionError):
                    raise RuntimeError(
                        f"Another run has {self.path}, and one record belongs to one run. End that "
                        "one, or name another file."
                    ) from error
            try:
                yield
            finally:  # a process that was forked meanwhile holds the file open
                if sys.platform != "win32":
                    fcntl.flock(file, fcntl.LOCK_UN)

    def append(self, event: Event) -> None:
        """Add an event; when this returns it is on the disk."""
        if self.path is None:
            return
        checked = event | {"crc32": _checksum(event)}
        line = f"{json.dumps(checked, allow_nan=False)}\n".encode()
        self.path.touch()
        if self.path.stat().st_size != self._seen:
            raise RuntimeError(
                f"{self.path} was changed by somebody else. One record belongs to one run."
            )
        try:  # after a full disk, or Ctrl-C, the next event overwrites what is there
            with self.path.open("r+b") as file:
                file.truncate(self._size)
                file.seek(self._size)
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
            self._size += len(line)
        except OSError as error:
            raise OSError(
                error.errno,
                f"{self.path} could not be written ({error.strerror or error}). What it holds is "
                "whole: mend that, and the same script goes on from there.",
            ) from error
        finally:
            self._seen = self.path.stat().st_size

    def save(self, model: OffPolicyAlgorithm, batch: int) -> str | None:
        """Save a model beside the record, all of it or nothing; return its name."""
        if self.path is None:
            return None
        name = f"{self.path.stem}-batch-{batch}.zip"
        with atomic_write(self.path.with_name(name)) as part:  # on the disk before its line
            model.save(part)
        return name

    def load(self, name: str, model: OffPolicyAlgorithm) -> None:
        """Give a model the parameters of one that was saved."""
        assert self.path is not None  # names come from :meth:`save`
        model.set_parameters(str(self.path.with_name(name)), device=model.device)


def _checksum(event: Event) -> int:
    return zlib.crc32(json.dumps(event, allow_nan=False).encode())


def _as_event(data: Any) -> Event:
    """Return a dataclass as JSON has it, where NaN is null."""
    event = asdict(data)
    for name, each in event.items():
        if isinstance(each, np.ndarray):
            event[name] = each.tolist()
        elif isinstance(each, float) and not math.isfinite(each):
            event[name] = None
    return event


def _named(kind: type, event: Event) -> Event:
    """Return the fields of a dataclass that an event holds; null stands for NaN."""
    named = {each.name: event[each.name] for each in fields(kind)}
    return {name: math.nan if each is None else each for name, each in named.items()}


Verdict = Literal["accepted", "stays", "the MPC acts", "begins anew"]
NOT_DYNAMICS = ("not a number", "violation", "frozen sensor")
"""Alarms that say nothing of how the plant moves."""


@dataclass(frozen=True)
class Batch:
    """What came of one batch of episodes, and what was decided after it.

    Attributes
    ----------
    number, episodes, alarms : int
        Which batch, how many episodes it had, and in how many of them the MPC was called.
    acted : str
        "MPC", or the batch after which the policy was accepted that acted.
    max_correction : float
        How far it could leave the MPC, in input ranges.
    cost, predicted, mpc : float
        Mean stage cost of the quiet episodes of the one that acted; what the twin had predicted
        from these starts; what the MPC cost in turns with it. NaN where it took none, or there was
        no twin. Minus the plant's rewards where these are not the stage cost.
    pairs : int
        Of the policy and the MPC, since it is on trial.
    verdict : str
        "accepted" (a new policy, on trial), "stays" (the one that acted, or that was kept before),
        "the MPC acts" or "begins anew".
    reason : str
        What was found, in words.

    Examples
    --------
    >>> from sb3_yann.commissioning import Batch
    >>> Batch(1, 4, 0, "MPC", 0.0, 97.1, math.nan, math.nan, 0, "accepted", "").verdict
    'accepted'
    """

    number: int
    episodes: int
    alarms: int
    acted: str
    max_correction: float
    cost: float
    predicted: float
    mpc: float
    pairs: int
    verdict: Verdict
    reason: str


class Accepted(NamedTuple):
    """A policy that was accepted: after which batch, in which file, within which bound."""

    policy: str = "MPC"
    model: str | None = None
    bound: float = 0.0


ACCEPTED_MPC = Accepted()


@dataclass(frozen=True)
class CommissioningState:
    """What holds after a batch.

    One accepted policy is ``acting``, on trial ``since`` a batch; the plant has confirmed the one
    that is ``kept``. The log begins with the episode ``first``, everything began anew after
    ``anew`` batches. The twin in force was fitted to the episodes ``twin``. ``tried`` is whether
    what the model had learnt before has been.
    """

    max_correction: float
    acting: Accepted = ACCEPTED_MPC
    kept: Accepted = ACCEPTED_MPC
    first: int = 0
    anew: int = 0
    twin: list[int] | None = None
    twin_seed: int = 0
    tried: bool = False
    since: int = 0

    @property
    def policy(self) -> str:
        """The name of the policy that acts in turns with the MPC; "MPC" where there is none."""
        return self.acting.policy

    @property
    def is_kept(self) -> bool:
        """Whether the plant has confirmed the policy that acts in turns with the MPC."""
        return self.kept.policy == self.policy != "MPC"


class Journal:
    """Episodes and batches in their order, as they stand in the record.

    ``settings`` must be the same to go on; ``state`` holds before the first batch.
    """

    def __init__(self, record: Record, settings: dict[str, Any], state: CommissioningState) -> None:
        self.record = record
        self.state = state
        self.episodes: list[PlantEpisode] = []
        self.by_policy: list[bool] = []
        self.batches: list[Batch] = []
        self._first_of_batch = 0
        self._cut_off = 0
        self._open = ""  # who acts in the episode that has begun
        self.unended = 0  # episodes of the record that began and never ended
        begin: Event = {"event": "begin", **settings}
        if not record.events:
            record.append(begin)
        elif (first := record.events[0]) != begin:
            wrong = [f"{k} = {first.get(k)!r}" for k in begin if begin[k] != first.get(k)]
            raise ValueError(
                f"{record.path} was begun with {', '.join(wrong)}. Use these to go on, or name "
                "another file."
            )
        for number, event in enumerate(record.events[1:], start=2):
            try:
                self._take(event)
            except (KeyError, TypeError, ValueError) as error:
                raise ValueError(
                    f"{record.path}, line {number}: no event of a commissioning "
                    f"({type(error).__name__}: {error}). Name another file."
                ) from error
        record.events.clear()  # the episodes hold their numbers in a fifth of the memory

    @property
    def accepted(self) -> bool:
        """Whether a policy other than the MPC is accepted."""
        return self.state.policy != "MPC"

    @property
    def batch(self) -> list[tuple[PlantEpisode, bool]]:
        """The episodes since the last decision, and whether the policy began them."""
        rows = slice(self._first_of_batch, None)
        return [*zip(self.episodes[rows], self.by_policy[rows], strict=True)]

    @property
    def trial(self) -> list[range]:
        """The numbers of the episodes of each batch since the policy is on trial."""
        ends = np.cumsum([0, *(each.episodes for each in self.batches)])
        ends = np.append(ends[self.state.since :], len(self.episodes))
        return [range(a, b) for a, b in pairwise(ends.tolist()) if b > a]

    @property
    def pairs(self) -> list[tuple[PlantEpisode, PlantEpisode]]:
        """An episode of the policy that is on trial and one of the MPC, played in turns."""
        found = []
        for batch in self.trial:
            for both in zip(batch[::2], batch[1::2], strict=False):
                ours, its = sorted(both, key=lambda i: not self.by_policy[i])
                paired = self.by_policy[ours] and not self.by_policy[its]
                if paired and not self.episodes[its].alarm:
                    found.append((self.episodes[ours], self.episodes[its]))
        return found

    @property
    def log(self) -> list[int]:
        """The numbers of the episodes that show the plant as it is now."""
        numbers = range(self.state.first, len(self.episodes))
        usable = [i for i in numbers if self.episodes[i].usable_for_fitting]
        return [i for i in usable if len(self.episodes[i].actions) >= SHORTEST]

    @property
    def doubted(self) -> bool:
        """Whether no quiet episode has answered an alarm, or one that began and never ended."""
        return bool(self._open) or not all(e.usable_for_fitting for e in self.episodes[-1:])

    @property
    def cut_off(self) -> int:
        """How many episodes of this batch the policy began that never ended, but by Ctrl-C."""
        return self._cut_off + (self._open not in ("", "MPC"))

    @property
    def changed(self) -> bool:
        """Whether two episodes in a row had an alarm of how the plant moves in this batch."""
        last = [each.alarm for each, _ in self.batch[-2:]]
        return len(last) == 2 and all(alarm and alarm.kind not in NOT_DYNAMICS for alarm in last)

    def begin(self, by_policy: bool) -> None:
        """Note that an episode begins: if it never ends, that is evidence too."""
        self._note("start", number=len(self.episodes), acts=self._acting(by_policy))

    def interrupt(self) -> None:
        """Note that Ctrl-C or a full disk ended the episode: that says nothing of the policy."""
        if self._open:
            self._note("interrupted", number=len(self.episodes))

    def add(self, played: PlantEpisode, by_policy: bool) -> None:
        """Add an episode."""
        within = self.state.max_correction if by_policy else 0.0
        about = {"number": len(self.episodes), "acts": self._acting(by_policy)}
        try:
            self._note("episode", **about, max_correction=within, **_as_event(played))
        except OSError:  # a short line may have room yet
            self.interrupt()
            raise

    def close(self, batch: Batch, state: CommissioningState) -> None:
        """Add the decision that ends a batch."""
        self._note("batch", **_as_event(batch), from_here=asdict(state))

    def _acting(self, by_policy: bool) -> str:
        return self.state.policy if by_policy else "MPC"

    def _note(self, kind: str, **about: Any) -> None:
        """Write an event down, then do what it says."""
        event = {"event": kind, **about}
        with uninterrupted():
            self.record.append(event)
            self._take(event)

    def _take(self, event: Event) -> None:
        """Do what an event says: as it happens, and again from the record."""
        if event["event"] == "start":
            self._cut_off = self.cut_off
            self.unended += bool(self._open)
            self._open = event["acts"]
        elif event["event"] == "interrupted":
            self._open = ""
        elif event["event"] == "episode":
            if event["number"] != len(self.episodes):
                raise ValueError("the episode before it is missing")
            named = _named(PlantEpisode, event)
            named |= {name: np.array(named[name], float) for name in ("thetas", "actions")}
            named["alarm"] = None if event["alarm"] is None else Alarm(**event["alarm"])
            self.episodes.append(PlantEpisode(**named))
            self.by_policy.append(event["acts"] != "MPC")
            self._open = ""
        else:
            self.batches.append(Batch(**_named(Batch, event)))
            state = dict(event["from_here"])
            acting, kept = (Accepted(*state.pop(name)) for name in ("acting", "kept"))
            self.state = CommissioningState(acting=acting, kept=kept, **state)
            self._first_of_batch = len(self.episodes)
            self._cut_off = 0

    def report(self) -> str:
        """Return the batches as a table."""
        header = "batch  episodes  alarms  acted     within       cost  predicted  the MPC's  pairs"
        lines = [f"{header}  then"]
        for each in self.batches:
            numbers = "".join(f"{v:>11.5g}" for v in (each.cost, each.predicted, each.mpc))
            then = each.verdict + (f": {each.reason}" if each.reason else "")
            lines.append(
                f"{each.number:>5}{each.episodes:>10}{each.alarms:>8}  {each.acted:<9}"
                f"{100 * each.max_correction:>5.3g} %{numbers}{each.pairs:>7}  {then}"
            )
        return "\n".join(lines)
