"""What the guard has decided so far, for a reader and for a run that goes on."""

from __future__ import annotations

import csv
import os
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, TextIO

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_yann.guard.actor_checkpoint import ActorCheckpoint

Verdict = Literal["accepted", "accepted in part", "rejected"]


@dataclass(frozen=True)
class Decision:
    """One decision of the guard.

    Parameters
    ----------
    timestep, episode : int
        Steps and episodes of training until then.
    verdict : str
        "accepted", "accepted in part" (the networks of some regions only) or "rejected".
    reason : str
        Why not all of it was accepted.
    restored : bool
        Whether the actor was restored to the accepted checkpoint.
    candidate_cost, accepted_cost, mpc_cost : float
        Mean cost of an episode of the candidate, of the policy that is accepted now, and of the
        MPC. The mean is over all starts known at that time; new starts that were lost join them.
    worst_start : float
        Largest excess over the MPC that the accepted policy has on one start, nan if not known.
    regions : tuple of int
        Regions whose networks were accepted, where it was a part.
    step : float
        Factor of the actor's learning rate from now on; the guard fills it in.

    Examples
    --------
    >>> from sb3_yann import Decision
    >>> Decision(4, 1, "rejected", "mean cost 5, accepted 4", True, 5.0, 4.0, 4.0, 0.0, ()).restored
    True
    """

    timestep: int
    episode: int
    verdict: Verdict
    reason: str
    restored: bool
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

    Attributes
    ----------
    settings : dict
        What the evidence depends on.
    accepted : ActorCheckpoint
    evidence : object
        The episodes that a candidate is compared with.
    step : float
        Factor of the actor's learning rate.
    episodes, rejections : int
        Training episodes so far, and rejections in a row.
    new_starts, next_start : int
        How many new starts were played, and the seed of the next.
    passed : list of tuple
        Earlier accepted checkpoints that can be restored, the latest last. Each has its outcome on
        the first of the known starts.
    decisions : list of Decision
    """

    settings: dict[str, Any]
    accepted: ActorCheckpoint
    evidence: Any
    step: float = 1.0
    episodes: int = 0
    rejections: int = 0
    new_starts: int = 0
    next_start: int = 0
    passed: list[tuple[ActorCheckpoint, Any]] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)

    def accept(self, checkpoint: ActorCheckpoint, evidence: Any) -> None:
        """Make a checkpoint the accepted one."""
        self.accepted, self.evidence = checkpoint, evidence


@dataclass(frozen=True)
class DecisionLog:
    """Writes decisions to a CSV file, to the model's logger and to the screen."""

    path: Path | None = None
    verbose: int = 0

    def begin(self, decisions: list[Decision]) -> None:
        """Write a file of the decisions of earlier runs."""
        if self.path is not None:
            write_csv(self.path, decisions)

    def add_last(self, decisions: list[Decision], model: BaseAlgorithm) -> None:
        """Write the last decision."""
        last = decisions[-1]
        for name in ("candidate_cost", "accepted_cost", "mpc_cost", "worst_start", "step"):
            model.logger.record(f"guard/{name}", getattr(last, name))
        rejected = sum(each.verdict == "rejected" for each in decisions)
        model.logger.record("guard/rejected", rejected)
        model.logger.record("guard/accepted", len(decisions) - rejected)
        if self.path is not None:
            append_csv(self.path, decisions)
        model.logger.dump(model.num_timesteps)  # as EvalCallback; the next would replace it
        if self.verbose:
            print(
                f"Episode {last.episode}: {last.verdict}"
                + (f" ({last.reason})" if last.reason else "")
                + f"; mean cost {last.accepted_cost:.6g}, MPC {last.mpc_cost:.6g}"
            )


def write_csv(path: Path, decisions: list[Decision]) -> None:
    """Write the decisions, all or none of them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(path.name + ".unfinished")
    with unfinished.open("w", newline="", encoding="utf-8") as file:
        csv.DictWriter(file, NAMES).writeheader()
        _write_rows(file, decisions)
    os.replace(unfinished, path)


def append_csv(path: Path, decisions: list[Decision]) -> None:
    """Append the last decision; writing all of them would take ever longer."""
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
