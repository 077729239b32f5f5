"""The record of a commissioning: a line of JSON for each event, on disk before the next one."""

from __future__ import annotations

import json
import math
import os
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._archive import atomic_write
from sb3_yann.commissioning.plant import PlantEpisode
from sb3_yann.commissioning.watchdog import Alarm

Event = dict[str, Any]
NAME = "commissioning.jsonl"
BEGIN = b'{"event": "begin"'
ENDING = ', "digest": "{:0>16}"}}'


class Record:
    """Events in their order, in a file if there is a path.

    ``events`` are those that the file held.

    A last line that a kill cut off is left out, and overwritten by the next event. Each line ends
    with a digest of all up to it: a record that was changed is refused, and so is one of before
    there were digests.

    Parameters
    ----------
    path : Path, optional
        A file, or a folder (without a suffix), in which it is ``commissioning.jsonl``.

    Raises
    ------
    OSError
        If the file cannot be read.
    ValueError
        If it is no record, or has changed since it was written.
    """

    def __init__(self, path: Path | None) -> None:
        is_folder = path is not None and (path.is_dir() or not path.suffix)
        self.path = path / NAME if path is not None and is_folder else path
        self.events: list[Event] = []
        self._digest = ""
        if self.path is None:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.exists():
            read = self.path.read_bytes()
            whole, _, rest = read.rpartition(b"\n")
            if rest and not whole and not rest.startswith(BEGIN[: len(rest)]):
                raise ValueError(f"{self.path} is no record of a commissioning. Name another file.")
            for number, line in enumerate(whole.split(b"\n") if whole else [], start=1):
                try:
                    self.events.append(self._event(line.decode("utf-8")))
                except ValueError as error:
                    raise ValueError(
                        f"{self.path}, line {number}: no event of a commissioning ({error}). Name "
                        "another file, or the one that was begun."
                    ) from error
            if self._is_whole(rest[:-1]):  # a kill never leaves more than the line
                raise ValueError(
                    f"{self.path} has changed since it was written: its last line does not end. "
                    "Name another file, or the one that was begun."
                )
            self._size, self._seen = len(whole) + (len(whole) > 0), len(read)
        else:
            self._size = self._seen = 0

    def append(self, event: Event) -> None:
        """Add an event; when this returns it is on the disk."""
        if self.path is None:
            return
        text, digest = _with_digest(json.dumps(event, allow_nan=False), self._digest)
        line = f"{text}\n".encode()
        if (self.path.stat().st_size if self.path.exists() else 0) != self._seen:
            raise RuntimeError(
                f"{self.path} was changed by somebody else. One record belongs to one run."
            )
        try:
            with self.path.open("r+b" if self.path.exists() else "w+b") as file:
                file.truncate(self._size)
                file.seek(self._size)
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except BaseException:  # a full disk, or Ctrl-C: the next event overwrites what is there
            self._seen = self.path.stat().st_size if self.path.exists() else 0
            raise
        self._size = self._seen = self._size + len(line)
        self._digest = digest

    def save(self, model: OffPolicyAlgorithm, batch: int) -> str | None:
        """Save a model beside the record, all of it or nothing; return its name."""
        if self.path is None:
            return None
        name = f"{self.path.stem}-batch-{batch}.zip"
        with atomic_write(self.path.with_name(name)) as part:  # on the disk before its line
            model.save(part)
        return name

    def digest_of(self, name: str | None) -> str | None:
        """Return the digest of a model that was saved."""
        if self.path is None or name is None:
            return None
        return sha256(self.path.with_name(name).read_bytes()).hexdigest()

    def load(self, name: str, digest: str | None, model: OffPolicyAlgorithm) -> None:
        """Give a model the parameters of one that was saved; ValueError if it has changed."""
        assert self.path is not None  # names come from :meth:`save`
        if self.digest_of(name) != digest:
            raise ValueError(
                f"{self.path.with_name(name)} has changed since it was accepted. Put back the file "
                f"that was written, or begin anew with another record than {self.path}."
            )
        model.set_parameters(str(self.path.with_name(name)), device=model.device)

    def _is_whole(self, line: bytes) -> bool:
        before = self._digest
        try:
            self._event(line.decode("utf-8"))
        except ValueError:
            return False
        finally:
            self._digest = before
        return True

    def _event(self, line: str) -> Event:
        """Return the event of the next line, whose digest must follow from the lines before."""
        text = f"{line[: -len(ENDING.format(0))]}}}"
        signed, digest = _with_digest(text, self._digest)
        if signed != line:
            raise ValueError("it has changed since it was written, or has no digest")
        event = json.loads(text)
        if not isinstance(event, dict) or "event" not in event:
            raise ValueError("it has no key 'event'")
        self._digest = digest
        return event


def _with_digest(text: str, before: str) -> tuple[str, str]:
    """Return the text of an event with its digest as the last key, and the digest."""
    digest = sha256(f"{before}{text}".encode()).hexdigest()[:16]
    return text[:-1] + ENDING.format(digest), digest


def as_event(episode: PlantEpisode) -> Event:
    """Return an episode as numbers and text."""
    alarm = episode.alarm
    return {
        "reward": episode.reward if math.isfinite(episode.reward) else None,
        "violations": episode.violations,
        "alarm": None if alarm is None else [alarm.kind, alarm.message],
        "step": episode.step,
        "apart": episode.apart,
        "excited": episode.excited,
        "thetas": episode.thetas.tolist(),
        "actions": episode.actions.tolist(),
    }


def as_episode(event: Event) -> PlantEpisode:
    """Return the episode of an event."""
    alarm = None if event["alarm"] is None else Alarm(*event["alarm"])
    reward = math.nan if event["reward"] is None else event["reward"]
    numbers = reward, event["violations"]
    played = np.array(event["thetas"], float), np.array(event["actions"], float)
    return PlantEpisode(*played, *numbers, alarm, event["step"], event["apart"], event["excited"])
