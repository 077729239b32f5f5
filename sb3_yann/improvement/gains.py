"""What can be gained over an MPC, in figures and words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.compare import change_in_percent, paired_rows, summary_lines
from sb3_yann.control import LinearMPC

LITTLE = 0.005
"""A gain below this, relative to the MPC's cost, is not worth an observer or a new model."""
WORTH = 0.02
"""A gain below this is not worth learning, which finds a part of it."""
ROUNDING = 1e-9
"""Of an episode's cost: so much more is the same."""
CURE = (
    "mpc, observer = offset_free(mpc), and env = ObserveDisturbance(env, observer, "
    "mpc.disturbances.d_min, mpc.disturbances.d_max)."
)
ADVICE = {
    "keep the MPC": "there is little to gain over the MPC.",
    "add ObserveDisturbance first": f"that brings most of it: {CURE}",
    "re-identify": "a linear model of the plant as it is brings most of it: take the MPC "
    "headroom(...).reidentified.",
    "learn": "most of it is beyond a linear model: improve(mpc, {source}), or DDPG under an "
    "ImprovementGuard.",
}
UNKNOWN = "not known"
"""The verdict where what was found may be chance, and where nothing was found in a poor model."""


@dataclass(frozen=True)
class Headroom:
    """What can be gained over an MPC, as :func:`headroom` has found it.

    Attributes
    ----------
    mpc_costs, observer_costs, reidentified_costs, best_costs : ndarray, shape (starts,)
        Costs of the MPC; with a disturbance observer (:func:`offset_free`); with a model that is
        re-identified from these episodes (the MPC's own where those are worse on average); of the
        best that was found.
    offset, model_error, nonlinearity : float
        Parts of the gain, relative to the MPC's mean cost: what the observer gains, which removes
        the offset of a plant that is not its model; what the re-identified model gains beyond
        that; the rest.
    verdict : str
        What to do: one of "keep the MPC", "add ObserveDisturbance first", "re-identify", "learn";
        "not known" where what was found is worth it but may be chance, and where nothing was found
        with plans that were made in a poor model.
    source : str
        Where it was found.
    d_max : ndarray, shape (n,), optional
        Of :func:`offset_free`, where its default is less than the disturbances of this plant.
    lost : float, optional
        By how much plans cost more than the MPC when they were first played, relative to it, where
        the model of the env's episodes is poor.
    observer_played, reidentified_played : ndarray, shape (starts,), optional
        What the MPC with an observer and the re-identified one cost when they were played, losses
        included; None where they were not.
    steps : int
        Of the env, all that were taken.
    note : str
        What was left out; empty where nothing was.
    reidentified : LinearMPC, optional
        The same MPC with a model that these episodes, or a twin's log, tell.
    budget : int
        Steps of the env that `improve` is likely not to exceed; 0 in a twin.

    Examples
    --------
    >>> costs = np.array([10.0, 20.0])
    >>> found = Headroom(costs, costs, costs, costs - 0.5, 0.0, 0.0, 1 / 30, "learn", "a simulator")
    >>> round(found.total, 4)
    0.0333
    """

    mpc_costs: Array
    observer_costs: Array
    reidentified_costs: Array
    best_costs: Array
    offset: float
    model_error: float
    nonlinearity: float
    verdict: str
    source: str
    d_max: Array | None = None
    lost: float | None = None
    observer_played: Array | None = None
    reidentified_played: Array | None = None
    steps: int = 0
    note: str = ""
    reidentified: LinearMPC | None = None
    budget: int = 0

    @property
    def total(self) -> float:
        """The whole gain, relative to the MPC's mean cost."""
        return gain(self.mpc_costs, self.best_costs)

    @property
    def standard_error(self) -> float:
        """How far the total may be off because there are only so many starts."""
        spread = np.std(self.mpc_costs - self.best_costs, ddof=1) / np.sqrt(len(self.mpc_costs))
        return float(spread / (abs(self.mpc_costs.mean()) or 1.0))

    def report(self) -> str:
        """Return the figures, and what to do, in words."""
        parts = (
            f"{100 * part + 0.0:+.2f} % {name}"
            for name, part in (
                ("with a disturbance observer", -self.offset),
                ("more with a re-identified model", -self.model_error),
                ("more by nonlinearity and constraints", -self.nonlinearity),
            )
        )
        steps = f"{self.steps:,} of the env. {self.note}".strip() if self.steps else self.note
        return summary_lines(
            f"Verdict: {self.verdict}. By its own stage cost, from starts of {self.source}:",
            **paired_rows(self.best_costs, self.mpc_costs),
            of_that=", ".join(parts),
            observer=self._as_played(self.observer_played),
            new_model=self._as_played(self.reidentified_played),
            steps=steps,
            next=self._advice(),
        )

    __str__ = report

    def _as_played(self, costs: Array | None) -> str:
        """Return what came of another MPC, losses included."""
        if costs is None:
            return "not played"
        each = (costs - self.mpc_costs) / np.maximum(np.abs(self.mpc_costs), 1e-300)
        more = np.count_nonzero(each > ROUNDING)
        return (
            f"{change_in_percent(-gain(self.mpc_costs, costs))} as it was played, worst start "
            f"{change_in_percent(each.max())} of its own cost; {more} of {len(costs)} cost more"
        )

    def _advice(self) -> str:
        """Return what the verdict means, and whether more starts might change it."""
        parts = self.offset, self.model_error, self.nonlinearity
        if self.verdict != verdict_of(*parts) != "keep the MPC":
            return "what was found may be chance on so few starts. Take more: n_starts=."
        poor = ""
        if self.lost is not None:
            poor = (
                "plans were made in a model of its episodes that is not the plant: when played, "
                f"they cost {_more(self.lost)} the MPC. Take more starts: n_starts=."
            )
        if self.verdict == UNKNOWN:
            return f"nothing was found, but {poor}"
        source = f"make, max_steps={self.budget:_}" if self.budget else "twin"
        advice = self._with_d_max(ADVICE[self.verdict]).format(source=source)
        played = self.observer_played
        if self.verdict == "add ObserveDisturbance first" and played is not None:
            if np.any(played > self.mpc_costs + LITTLE * np.abs(self.mpc_costs)):
                advice += " Not from every start: look at the worst one before you take it."
        return f"{advice} The rest is not known: {poor}" if poor else advice

    def _with_d_max(self, advice: str) -> str:
        """Return advice that gives `offset_free` the disturbances of this plant."""
        if self.d_max is None:
            return advice
        largest = ", ".join(f"{each:.3g}" for each in self.d_max)
        return advice.replace("offset_free(mpc)", f"offset_free(mpc, d_max=[{largest}])")


def _more(lost: float) -> str:
    return f"{100 * lost:.3g} % more than" if lost >= LITTLE / 10 else "as much as"


def gain(before: Array, after: Array) -> float:
    """Return by how much mean costs fall, relative to those before."""
    return float((before.mean() - after.mean()) / (abs(before.mean()) or 1.0))


def verdict_of(offset: float, model_error: float, nonlinearity: float, doubt: float = 0.0) -> str:
    """Return what to do: a key of `ADVICE`, or `UNKNOWN` where it may be chance.

    Where the largest part is the rest, and too little to learn, an observer or a new model may be
    worth it still.

    Parameters
    ----------
    offset, model_error, nonlinearity : float
        Parts of the gain, relative to the MPC's cost.
    doubt : float, default 0
        What the whole must exceed besides, where it is known from so many random starts only.

    Examples
    --------
    >>> verdict_of(0.0, 0.0, 0.015), verdict_of(0.0, 0.01, 0.005), verdict_of(0.0, 0.005, 0.02)
    ('keep the MPC', 're-identify', 'learn')
    """
    parts = offset, model_error, nonlinearity
    verdict = [*ADVICE][1 + int(np.argmax(parts))]
    worth = WORTH if verdict == "learn" else LITTLE
    if sum(parts) < worth and max(offset, model_error) >= LITTLE:
        verdict, worth = [*ADVICE][1 + int(np.argmax(parts[:2]))], LITTLE
    if sum(parts) < worth or WORTH > sum(parts) < doubt:
        return "keep the MPC"
    return verdict if sum(parts) >= doubt else UNKNOWN
