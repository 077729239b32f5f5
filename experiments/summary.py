"""The table that the README quotes, a row for each plant, and how it gets there."""

from __future__ import annotations

from collections.abc import Mapping

from experiments.markdown import number, table
from experiments.measures import (
    BARE,
    EXPLORED,
    MPC,
    OPTIMUM,
    OURS,
    Row,
    Standing,
    plants_of,
    standing,
)
from experiments.runner import Outcome, Run

RIVAL = "DDPG"
HEADER = (
    "plant",
    OPTIMUM,
    MPC,
    f"**{OURS}**",
    "no simulator explored",
    "settings of its own",
    "worst start",
    "excess cost",
    RIVAL,
    f"excess cost of {RIVAL}",
    "violations",
    "seeds",
)


def summary(outcomes: Mapping[Run, Outcome], episodes: int) -> str:
    """Return one table with a row for each plant that was learnt, and its legend, in Markdown."""
    found = [standing(outcomes, plant, episodes) for plant in plants_of(outcomes)]
    rows = [_cells(at) for at in found if OURS in at.learners]
    starts = max((len(out.test_costs[-1]) for out in outcomes.values()), default=0)
    return f"{table(HEADER, rows)}\n\n{_legend(episodes, starts)}" if rows else ""


def _cells(at: Standing) -> list[str]:
    """Return the row of a plant; a learner that was not run leaves its cells empty."""
    names = OPTIMUM, MPC, EXPLORED, BARE, OURS, RIVAL
    optimum, mpc, explored, bare, own, rival = (
        at.row(name) if name in at.learners else None for name in names
    )
    ours = explored or own
    return [
        at.plant,
        _mean(optimum),
        _mean(mpc),
        f"**{_mean(explored)}**" if explored else "",
        _mean(bare),
        _mean(own),
        number(ours.worst, sign="+") if ours else "",
        _excess(ours),
        _mean(rival),
        _excess(rival),
        _of_both(ours, rival, "unsafe_training"),
        _of_both(ours, rival, "seeds"),
    ]


def _mean(row: Row | None) -> str:
    if row is None:
        return ""
    spread = f" ({number(row.low)} to {number(row.high)})" if row.seeds > 1 else ""
    return number(row.median) + spread


def _excess(row: Row | None) -> str:
    return number(row.excess[0], 0, "+") if row and row.excess else ""


def _of_both(ours: Row | None, rival: Row | None, name: str) -> str:
    return " / ".join(str(getattr(row, name)) for row in (ours, rival) if row)


def _legend(episodes: int, starts: int) -> str:
    return (
        f"Mean cost of a test episode after {episodes} training episodes, over {starts} starts "
        "that training and guard never see: the median over the seeds (and the range). "
        f"**{OURS}** has one set of options for every plant, and `SimulatedEpisodes`, in which "
        "noise harms nobody; *no simulator explored*: `tau=0.02`, all else as it comes. "
        f"*Worst start*: the largest cost above the MPC's over all seeds and starts of {OURS}; "
        "this and what follows is of its own settings where no simulator was explored. "
        "*Excess cost*: what all training episodes together cost above the MPC from the same "
        f"starts, median. *Violations* (training episodes beyond a limit) and *seeds* are those of "
        f"{OURS} / {RIVAL}."
    )
