"""Pairs of episodes, one of the policy and one of the MPC: the plant decides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.compare import (
    LARGEST,
    Difference,
    Scores,
    Verdict,
    less_safe,
    level_of_look,
    looks,
    no_worse,
)
from sb3_yann.control.mpc.bound_excess import BoundNames
from sb3_yann.improvement.imitation import Inputs, controller_of
from sb3_yann.improvement.simulator import Simulator, of_law
from sb3_yann.improvement.trial import RULE, Check
from sb3_yann.twin.log import Episode

FIRST_LOOK = 10  # pairs of a trial between rounds
LOOKS = looks(FIRST_LOOK, 80)  # pairs after which it is decided, or more are played
ENOUGH = 40  # pairs that an acceptance takes: the worst 5 % of the starts are two of them


@dataclass
class Pairs:
    """The same starts with the MPC and with a policy.

    Attributes
    ----------
    simulator : Simulator
    seeds : list of int
    mpc, policy : ndarray, shape (pairs,)
        Costs.
    unsafe_of_mpc, unsafe : ndarray, shape (pairs, 9)
        As :func:`~sb3_yann.compare.unsafe_columns` returns it.
    episodes : list of Episode or None
        Those of the policy.
    """

    simulator: Simulator
    seeds: list[int] = field(default_factory=list)
    mpc: Array = field(default_factory=lambda: np.empty(0))
    policy: Array = field(default_factory=lambda: np.empty(0))
    unsafe_of_mpc: Array = field(default_factory=lambda: np.empty((0, 9)))
    unsafe: Array = field(default_factory=lambda: np.empty((0, 9)))
    episodes: list[Episode | None] = field(default_factory=list)

    def play(self, act: Inputs | None, seeds: Sequence[int]) -> None:
        """Add pairs, and let the simulator's model learn of them; without a policy the MPC's."""
        mpc = self.simulator.play(of_law(self.simulator.problem), seeds)
        ours = mpc if act is None else self.simulator.play(controller_of(act), seeds)
        known = np.isfinite(mpc.costs)  # where the MPC's own cost is none, nothing is compared
        self.seeds += [seed for seed, finite in zip(seeds, known, strict=True) if finite]
        if not self.seeds:
            raise ValueError(
                f"The MPC's own cost is finite in none of {len(seeds)} episodes of the simulator: "
                "there is nothing to compare with."
            )
        self.mpc = np.append(self.mpc, mpc.costs[known])
        self.policy = np.append(self.policy, ours.costs[known])
        self.unsafe_of_mpc = np.concatenate([self.unsafe_of_mpc, mpc.unsafe()[known]])
        self.unsafe = np.concatenate([self.unsafe, ours.unsafe()[known]])
        self.episodes += [e for e, k in zip(self.simulator.learn(ours), known, strict=True) if k]

    def replay(self, act: Inputs) -> Pairs:
        """Return the pairs of another policy from the same starts; the MPC's are known."""
        ours = self.simulator.play(controller_of(act), self.seeds)
        return replace(
            self, policy=ours.costs, unsafe=ours.unsafe(), episodes=self.simulator.learn(ours)
        )

    @property
    def relative(self) -> Array:
        """What each costs against the MPC, in its own cost or the MPC's typical one."""
        own = np.maximum(np.abs(self.mpc), np.median(np.abs(self.mpc)))
        return np.asarray((self.policy - self.mpc) / np.where(own > 0, own, 1.0))

    @property
    def change(self) -> float:
        """Mean cost against the MPC's: -0.02 is 2 % less."""
        mean = max(float(np.abs(self.mpc).mean()), 1e-300)
        return float((self.policy - self.mpc).mean()) / mean

    @property
    def lost(self) -> list[Episode]:
        """The policy's episodes that cost more than with the MPC, or are less safe."""
        worse = (self.relative > 0) | less_safe(self.unsafe, self.unsafe_of_mpc).any(axis=1)
        return [e for e, lost in zip(self.episodes, worse, strict=True) if lost and e is not None]

    def verdict(self, level: float) -> Verdict:
        """Return whether the policy is no worse, and its gain sure, at a level of significance."""
        names = BoundNames.of(self.simulator.problem)
        ours, mpc = Scores(self.policy, self.unsafe), Scores(self.mpc, self.unsafe_of_mpc)
        # A rare loss has been taught: the mean of the worst 5 % decides.
        tolerance = replace(RULE.tolerance(self.mpc, names), worst_start=np.inf)
        least = RULE.least_gain
        return no_worse(ours, mpc, mpc, tolerance, names=self.seeds, level=level, least_gain=least)

    def check(self, number: int, level: float, final: bool) -> Check:
        """Return what they say of the policy, at a one-sided level of significance."""
        count, found = len(self.seeds), self.verdict(level)
        mean = max(float(np.abs(self.mpc).mean()), 1e-300)
        gain = Difference.of(self.relative)
        reason = found.reason
        if not reason and not (self.change <= -RULE.least_gain and found.is_sure):
            reason = f"{100 * self.change:+.2g} % (± {100 * gain.error:.1g}) in {count} pairs: too "
            reason += "small a gain, or not sure"
        worst = float((self.policy - self.mpc).max()) / mean if count else np.inf
        safe = not less_safe(self.unsafe, self.unsafe_of_mpc).any()
        of_mean = Difference.of((self.policy - self.mpc) / mean)
        interval = (of_mean.mean - of_mean.room(level), of_mean.mean + of_mean.room(level))
        shown = self.change, worst, safe, gain.mean, gain.error
        return Check(number, not reason, reason, *shown, final=final, interval=interval)

    @property
    def ride_a_bound(self) -> bool:
        """Whether a hard bound is in force: it is exceeded in some episode, also by the MPC."""
        return bool(self.unsafe_of_mpc[:, LARGEST].any() or self.unsafe[:, LARGEST].any())


def confirm(
    act: Inputs,
    simulator: Simulator,
    number: int,
    say: Callable[[str, int], None] = lambda text, pairs: None,
    significance: float = RULE.significance,
) -> tuple[Check, Pairs]:
    """Play pairs from new starts until they are decisive; return the last look, and all pairs.

    Looks come after 10, 20, 40 and 80 pairs; all together err with a probability of no more than
    ``significance``. A policy that breaks a bound, or does not gain, is refused at the first look
    that shows it. Where a hard bound is in force, acceptance takes all 80: it may be exceeded in
    few episodes, and that is never traded for cost.

    Parameters
    ----------
    act : callable
        The policy.
    simulator : Simulator
        It plays them.
    number : int
        Of the check.
    say : callable
        Called with what each look shows, and after how many pairs.
    significance : float
        Probability that a policy that is no better is accepted.
    """
    pairs = Pairs(simulator)
    for look, count in enumerate(LOOKS, start=1):
        pairs.play(act, simulator.new_seeds(count - len(pairs.seeds)))
        level = level_of_look(significance, look)
        found = pairs.check(number, level, final=True)
        say(f"{len(pairs.seeds)} pairs: {100 * found.change:+.2f} %", len(pairs.seeds))
        enough = LOOKS[-1] if pairs.ride_a_bound else ENOUGH
        if found.accepted and len(pairs.seeds) >= enough:
            break
        if not found.accepted and pairs.verdict(level).is_hopeless:
            break
    if found.accepted and len(pairs.seeds) < ENOUGH:
        few = f"{len(pairs.seeds)} pairs whose costs are finite are too few"
        found = replace(found, accepted=False, reason=few)
    return found, pairs
