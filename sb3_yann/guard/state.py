"""What the guard has decided so far, for a reader and for a run that goes on."""

from __future__ import annotations

import csv
import os
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, TextIO

from sb3_yann.guard.actor_checkpoint import ActorCheckpoint


@dataclass(frozen=True)
class Decision:
    """One decision of the guard.

    Attributes
    ----------
    timestep, episode : int
        Steps and episodes of training until then.
    verdict : str
        "accepted", "accepted in part" (the networks of some regions only) or "rejected".
    reason : str
        Why not all of it was accepted.
    returned : bool
        Whether the actor went back to the accepted state.
    candidate_cost, accepted_cost, mpc_cost : float
        Mean cost of an episode of the policy that was tried, of the one that is accepted now, and
        of the MPC, from all starts that are known at that time: new ones that were lost join them.
    worst_start : float
        Largest excess over the MPC that the accepted policy has on one start, nan if not known.
    regions : tuple of int
        Regions whose networks were taken over, where it was a part.
    step : float
        Factor of the actor's learning rate from now on; the guard fills it in.
    """

    timestep: int
    episode: int
    verdict: Literal["accepted", "accepted in part", "rejected"]
    reason: str
    returned: bool
    candidate_cost: float
    accepted_cost: float
    mpc_cost: float
    worst_start: float
    regions: tuple[int, ...]
    step: float = 1.0


NAMES = [each.name for each in fields(Decision)]


@dataclass
class GuardState:
    """All that a stopped run needs to go on; it travels in the model's zip.

    ``passed`` are policies that were accepted, the latest last, with their outcomes on the first of
    the known starts: what may be gone back to. ``fresh`` counts the new starts that were tried,
    ``next_start`` is the seed of the next.
    """

    settings: dict[str, Any]
    accepted: ActorCheckpoint
    evidence: Any
    step: float = 1.0
    episodes: int = 0
    rejections: int = 0
    fresh: int = 0
    next_start: int = 0
    passed: list[tuple[ActorCheckpoint, Any]] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)


def write_csv(path: Path, decisions: list[Decision]) -> None:
    """Write the decisions, all or none of them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(path.name + ".unfinished")
    with unfinished.open("w", newline="", encoding="utf-8") as file:
        csv.DictWriter(file, NAMES).writeheader()
        _write_rows(file, decisions)
    os.replace(unfinished, path)


def append_csv(path: Path, decisions: list[Decision]) -> None:
    """Write the last decision, as all but it are there: all of them would take ever longer."""
    if not path.exists():
        write_csv(path, decisions)
        return
    with path.open("a", newline="", encoding="utf-8") as file:
        _write_rows(file, decisions[-1:])


def _write_rows(file: TextIO, decisions: list[Decision]) -> None:
    writer = csv.DictWriter(file, NAMES)
    for decision in decisions:
        regions = " ".join(map(str, decision.regions))
        writer.writerow({**asdict(decision), "regions": regions})
