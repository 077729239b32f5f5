"""The record of a commissioning: a line of JSON for each event, on disk before the next one."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann.commissioning.plant import PlantEpisode
from sb3_yann.commissioning.watchdog import Alarm

Event = dict[str, Any]
NAME = "commissioning.jsonl"
BEGIN = b'{"event": "begin"'


class Record:
    """Events in their order, in memory and, if there is a path, in a file.

    A last line that a kill cut off is left out, and overwritten by the next event.

    Parameters
    ----------
    path : Path, optional
        A file, or a folder (without a suffix), in which it is ``commissioning.jsonl``.
    """

    def __init__(self, path: Path | None) -> None:
        is_folder = path is not None and (path.is_dir() or not path.suffix)
        self.path = path / NAME if path is not None and is_folder else path
        self.events: list[Event] = []
        if self.path is None:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.exists():
            read = self.path.read_bytes()
            whole, _, rest = read.rpartition(b"\n")
            if rest and not whole and not rest.startswith(BEGIN[: len(rest)]):
                raise ValueError(f"{self.path} is no record of a commissioning. Name another file.")
            lines = whole.decode("utf-8").splitlines()
            for number, line in enumerate(lines, start=1):
                try:
                    self.events.append(_event(line))
                except ValueError as error:
                    raise ValueError(
                        f"{self.path}, line {number}: no event of a commissioning ({error}). Name "
                        "another file, or the one that was begun."
                    ) from error
            self._size, self._seen = len(whole) + (len(whole) > 0), len(read)
        else:
            self._size = self._seen = 0

    def append(self, event: Event) -> None:
        """Add an event; when this returns it is on the disk."""
        if self.path is None:
            self.events.append(event)
            return
        line = (json.dumps(event, allow_nan=False) + "\n").encode("utf-8")
        if (self.path.stat().st_size if self.path.exists() else 0) != self._seen:
            raise RuntimeError(
                f"{self.path} was changed by somebody else. One record belongs to one run."
            )
        with self.path.open("r+b" if self.path.exists() else "w+b") as file:
            file.truncate(self._size)
            file.seek(self._size)
            file.write(line)
            file.flush()
            os.fsync(file.fileno())
        self._size = self._seen = self._size + len(line)
        self.events.append(event)

    def save(self, model: OffPolicyAlgorithm, batch: int) -> str | None:
        """Save a model beside the record, all of it or nothing; return its name."""
        if self.path is None:
            return None
        name = f"{self.path.stem}-batch-{batch}.zip"
        unfinished = self.path.with_name(f"{self.path.stem}-unfinished.zip")
        model.save(unfinished)
        os.replace(unfinished, self.path.with_name(name))
        return name

    def load(self, name: str, model: OffPolicyAlgorithm) -> None:
        """Give a model the parameters of one that was saved."""
        assert self.path is not None  # names come from :meth:`save`
        model.set_parameters(str(self.path.with_name(name)), device=model.device)


def _event(line: str) -> Event:
    event = json.loads(line)
    if not isinstance(event, dict) or "event" not in event:
        raise ValueError("it has no key 'event'")
    return event


def as_event(episode: PlantEpisode) -> Event:
    """Return an episode as numbers and text."""
    alarm = episode.alarm
    return {
        "reward": episode.reward if math.isfinite(episode.reward) else None,
        "violations": episode.violations,
        "alarm": None if alarm is None else [alarm.kind, alarm.message],
        "step": episode.step,
        "apart": episode.apart,
        "thetas": episode.thetas.tolist(),
        "actions": episode.actions.tolist(),
    }


def as_episode(event: Event) -> PlantEpisode:
    """Return the episode of an event."""
    alarm = None if event["alarm"] is None else Alarm(*event["alarm"])
    reward = math.nan if event["reward"] is None else event["reward"]
    numbers = reward, event["violations"]
    played = np.array(event["thetas"], float), np.array(event["actions"], float)
    return PlantEpisode(*played, *numbers, alarm, event["step"], event["apart"])
