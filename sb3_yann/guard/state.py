"""What the guard has decided so far, for a reader and for a run that goes on."""

from __future__ import annotations

import csv
import io
import math
import os
import warnings
from dataclasses import asdict, dataclass, field, fields
from itertools import count
from pathlib import Path
from typing import Any, Literal

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_yann._archive import atomic_write
from sb3_yann._validation import Array
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
        Whether the accepted checkpoint was restored.
    candidate_cost, accepted_cost, mpc_cost : float
        Mean cost of the candidate, the policy accepted now and the MPC, over the first
        ``n_starts``: the same in each decision. The hard starts that joined them are left out.
        That of a candidate that could not be played is nan; the reason says why.
    worst_start : float
        Largest excess of the accepted policy over the MPC on one of these starts.
    regions : tuple of int
        Regions whose networks were accepted, where it was a part.
    step : float
        Factor of the actor's learning rate from now on.
    share : float
        How far towards the candidate what was accepted lies: 1, a half, a quarter, or 0.

    Examples
    --------
    >>> from sb3_yann import Decision
    >>> Decision(9, 1, "accepted", "", False, 3.0, 3.0, 4.0, -0.5, (), 1.0).accepted_cost
    3.0
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
    step: float
    share: float = 0.0


def relative_change(cost: float, mpc_cost: float) -> float:
    """Return how much more than the MPC's a cost is, relative to it; nan if the MPC's is 0."""
    return (cost - mpc_cost) / abs(mpc_cost) if mpc_cost else math.nan


@dataclass
class GuardState:
    """All that a stopped run needs to go on; it travels in the model's zip.

    Attributes
    ----------
    settings : dict, what the evidence depends on
    accepted : ActorCheckpoint, the one accepted last
    evidence : Evidence or None, what candidates are compared with
    step : float, factor of the actor's learning rate
    episodes, rejections : int, training episodes so far, and refusals in a row
    new_starts, next_start : int, number of new starts so far, and the seed of the next
    passed : list of (ActorCheckpoint, Outcome or None), the latest last
        Earlier accepted checkpoints, with their outcomes on the first of the known starts.
    decisions : list of Decision, all so far
    input_step : ndarray, shape (m,), or None, how far inputs may move from one sample to the next
    mpc : ActorCheckpoint or None, the MPC, with the weights that it goes on to learn from
    last_trial : int or None, training episodes until the last trial in a simulator
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
    input_step: Array | None = None
    mpc: ActorCheckpoint | None = None
    last_trial: int | None = None

    def accept(self, checkpoint: ActorCheckpoint, evidence: Any) -> None:
        """Make a checkpoint the accepted one."""
        self.accepted, self.evidence = checkpoint, evidence


def log_last(
    decisions: list[Decision],
    model: BaseAlgorithm,
    path: Path | None,
    verbose: int,
    anew: bool = False,
) -> bool:
    """Write the last decision to the CSV file, to the model's logger and to the screen.

    Parameters
    ----------
    decisions, model : list of Decision and BaseAlgorithm
        All decisions so far, and the model whose logger is used.
    path, verbose : Path or None and int
        The CSV file, if any, and whether to print.
    anew : bool, default False
        Whether the file lacks earlier decisions: then all are written.

    Returns
    -------
    bool
        Whether the file holds all decisions. Training goes on where it does not: a warning says so.
    """
    last = decisions[-1]
    names = ("candidate_cost", "accepted_cost", "mpc_cost", "worst_start", "step")
    shown = {name: getattr(last, name) for name in names}
    for who in ("candidate", "accepted"):
        change = relative_change(shown[f"{who}_cost"], last.mpc_cost)
        shown[f"{who}_change_percent"] = 100 * change
    for name, value in shown.items():
        if math.isfinite(value):  # that of a candidate that could not be played is not
            model.logger.record(f"guard/{name}", value)
    rejected = sum(each.verdict == "rejected" for each in decisions)
    model.logger.record("guard/rejected", rejected)
    model.logger.record("guard/accepted", len(decisions) - rejected)
    model.logger.dump(model.num_timesteps)  # as EvalCallback does, or the next would replace it
    if verbose:
        reason = f" ({last.reason})" if last.reason else ""
        told = [_told("candidate", last.candidate_cost, last.mpc_cost)]
        told += [_told("accepted policy", last.accepted_cost, last.mpc_cost)]
        told += [f"MPC {last.mpc_cost:.6g}"]
        print(f"Episode {last.episode}: {last.verdict}{reason}; mean costs: {', '.join(told)}")
    return path is None or write_record(path, decisions, anew)


def _told(who: str, cost: float, mpc_cost: float) -> str:
    if not math.isfinite(cost):
        return f"{who} not known"
    change = relative_change(cost, mpc_cost)
    percent = f" ({100 * change:+.3g} %)" if math.isfinite(change) else ""
    return f"{who} {cost:.6g}{percent}"


def write_record(path: Path, decisions: list[Decision], anew: bool) -> bool:
    """Add the last decision to a record, or write all anew; warn and return False if it fails."""
    try:
        if anew or not path.exists():
            write_csv(path, decisions)
        else:  # writing all of them would take ever longer
            with path.open("a", newline="", encoding="utf-8") as file:
                file.write(_rows(decisions[-1:], header=False))
    except OSError as error:
        warnings.warn(
            f"The guard's record {path} could not be written ({error}). Training goes on, and "
            "guard.decisions has all decisions; the record is completed once there is room.",
            stacklevel=2,
        )
        return False
    return True


def begin_record(path: Path, decisions: list[Decision]) -> bool:
    """Write the decisions so far; what a file holds of another run is kept beside, with a warning.

    A run that goes on from a checkpoint drops what it had decided after it. Returns whether they
    could be written, as :func:`write_record` does.
    """
    try:
        with path.open(newline="", encoding="utf-8", errors="replace") as file:
            ours, theirs = _rows(decisions, header=True), file.read()
        known = ours.startswith(theirs) or (decisions != [] and theirs.startswith(ours))
    except FileNotFoundError:
        known = True
    except OSError:
        known = False
    if not known:
        numbers = (path.with_name(f"{path.stem}.{i}{path.suffix}") for i in count(1))
        beside = next(each for each in numbers if not each.exists())
        os.rename(path, beside)
        warnings.warn(f"{path} held the record of another run: it is {beside} now.", stacklevel=2)
    return write_record(path, decisions, anew=True)


def write_csv(path: Path, decisions: list[Decision]) -> None:
    """Write the decisions, all or none of them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as part:
        part.write_text(_rows(decisions, header=True), encoding="utf-8", newline="")


def _rows(decisions: list[Decision], header: bool) -> str:
    """Return decisions as lines of a CSV file."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, [each.name for each in fields(Decision)])
    if header:
        writer.writeheader()
    for each in decisions:
        writer.writerow({**asdict(each), "regions": " ".join(map(str, each.regions))})
    return text.getvalue()
