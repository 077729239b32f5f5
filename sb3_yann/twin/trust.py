"""What a twin is worth: how well it predicts what it has not seen, what would help, in words."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann.control.identification.fit import frozen_rows, words_for
from sb3_yann.control.linear_system import labels_of
from sb3_yann.twin.alignment import Logged, objections
from sb3_yann.twin.dynamics import Coordinates, Dynamics, Residual
from sb3_yann.twin.log import Episode, more_of, records
from sb3_yann.twin.selection import FreeRuns
from sb3_yann.units import FLOAT32_ROUNDING

COST_ERROR = 0.25  # of predicted episode costs, relative to their mean: the largest that is trusted
OUTSIDE = 0.05  # share of logged rows beyond the box of theta from which on units are doubted
ALONE = 0.02  # share of an input's variance that is its own, from which on its gain is known


class UntrustedTwinError(ValueError):
    """The twin cannot be trusted; the message says why, and what would help."""


@dataclass(frozen=True)
class Trust:
    """The evidence for a twin.

    Attributes
    ----------
    runs : FreeRuns
        Held-out free-run errors of all candidates, of the model as it is, and of standing still.
    chosen : int
        Which candidate was taken; the first is the linear model as it is.
    standing : ndarray, shape (h,)
        Errors of the prediction that nothing moves.
    predicted, actual : ndarray, shape (episodes,)
        Costs of held-out episodes, of two to four their pieces, in closed loop.
    excitation : ndarray, shape (m,)
        Share of each input's variance that the MPC, its set-points held, and theta, but for
        previous inputs, do not explain.
    moves : ndarray, shape (m,)
        Standard deviations of the inputs, in half-widths.
    problems, advice : tuple of str
        Why it is not to be trusted, and what would help; empty where there is nothing to say.
    """

    runs: FreeRuns
    chosen: int
    standing: Array
    predicted: Array
    actual: Array
    excitation: Array
    moves: Array
    problems: tuple[str, ...]
    advice: tuple[str, ...]

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against it."""
        return not self.problems

    @property
    def lacks_alone(self) -> bool:
        """Whether it is that costs err too much, and nothing else, that speaks against it."""
        return len(self.problems) == 1 and not self.cost_error <= COST_ERROR

    @property
    def cost_error(self) -> float:
        """Root mean square error of the predicted costs, relative to the mean cost."""
        return relative_error(self.predicted, self.actual)


def relative_error(predicted: Array, actual: Array) -> float:
    """Return the root mean square error relative to the mean; inf where there is nothing."""
    if not len(actual):
        return np.inf
    return float(np.sqrt(np.mean((predicted - actual) ** 2)) / max(np.abs(actual).mean(), 1e-300))


def costs_of(problem: LinearMPC, episode: Episode) -> float:
    """Return the stage cost of a logged episode."""
    thetas = episode.thetas[:-1, : problem.n_theta]
    return float(np.sum(problem.deviations.stage_cost(thetas, episode.actions)))


def costs_of_each(
    coordinates: Coordinates, episodes: tuple[Episode, ...], by_fold: Sequence[Residual]
) -> tuple[Array, Array]:
    """Return predicted and actual costs of episodes, each by the residual without its fold."""
    if not by_fold:
        return np.empty(0), np.empty(0)
    predicted = []
    problem = coordinates.row.problem
    for i, episode in enumerate(episodes):
        own = Dynamics(problem, coordinates, (by_fold[i % len(by_fold)],))
        with np.errstate(all="ignore"):
            cost = own.replay_in_closed_loop(episode)
        predicted.append(float(np.nan_to_num(cost[0], nan=1e150, posinf=1e150)))
    return np.array(predicted), np.array([costs_of(problem, each) for each in episodes])


def judge(
    runs: FreeRuns,
    standing: Array,
    costs: tuple[Array, Array],
    inputs: tuple[Array, Array],
    n_episodes: int,
    beyond: tuple[float, str],
    names: Sequence[str] = (),
    more: Callable[[int], str] = "{} episodes".format,
) -> tuple[list[str], list[str]]:
    """Return what speaks against a twin, and what would help.

    The first candidate of the ``runs`` is the linear model as it is; ``standing`` (h,) are the
    errors of standing still, ``costs`` predicted and actual ones (episodes,), ``inputs`` how much
    of each is its own, and how much it moves (m,). ``beyond`` is the largest share of logged rows
    beyond the box of theta, and of which entry; ``more`` names an amount of log.
    """
    problems = []
    advice = []
    share, moves = inputs
    several = n_episodes > 1
    if not several:
        problems.append("There is one episode: nothing is left to test the twin on.")
        advice.append(
            "Log at least one episode more; five are a good number. A long record may be cut "
            "into three consecutive pieces or more: log.cut(200) makes some of 200 steps."
        )
    named = [*names] or [f"u[{k}]" for k in range(len(moves))]
    for name, own, moved in zip(named, share, moves, strict=True):
        if moved < 1e-4:  # an input that moves by less, in half-widths, does not move
            problems.append(f"{name} never moves: what it does is not in the log.")
            advice.append(f"Make a small step test on {name}, or log another set-point.")
        elif own < ALONE:
            advice.append(
                f"{name} follows the MPC ({100 * own:.2f} % of its variance is its own), so its "
                "gain rests on the given B. A small step test would tell."
            )
    units = "Compare units, operating point and sampling time of the log and the model."
    # 10.0: A model that errs by so many times what moves describes another plant
    if several and runs.errors[0][0] / max(standing[0], 1e-300) > 10.0:
        problems.append(
            f"The problem's model predicts {runs.horizons[0]} steps far worse than 'nothing "
            f"moves' ({runs.errors[0][0]:.3g} against {standing[0]:.3g} standard deviations)."
        )
        advice.append(units)
    if beyond[0] > OUTSIDE:
        rows = f"{100 * beyond[0]:.3g} % of the logged {beyond[1]}"
        problems.append(f"{rows} lie beyond the problem's box of theta.")
        wider = "Widen the box (theta_min, theta_max; r_min, r_max of Tracking)"
        advice.append(f"{wider}, or c{units[1:]}")
    error = relative_error(*costs)
    if several and not error <= COST_ERROR:
        problems.append(
            f"Predicted costs of held-out episodes err by {100 * min(error, 1e6):.3g} % of the "
            f"mean; {100 * COST_ERROR:.0f} % are the most."
        )
        advice.append(
            f"Log {more(max(3, n_episodes))} more. If that is no help, the sensors are too "
            "noisy, or what moves the plant is not in the log: a load, a state, a lag, backlash, "
            "a recalibrated sensor."
        )
    return problems, advice


def evidence(
    dynamics: Dynamics,
    log: tuple[Episode, ...],
    found: tuple[FreeRuns, int, tuple[Array, Array]],
    units_confirmed: bool = False,
) -> Trust:
    """Return the evidence for a twin; each episode of the log is left out once.

    ``found`` are free runs of the candidates, the chosen one, and its predicted and actual costs.
    """
    runs, chosen, costs = found
    problem = dynamics.problem
    coordinates = dynamics.coordinates
    states = [each.thetas[:, coordinates.row.state] for each in log]
    moves = [np.concatenate([x[h:] - x[:-h] for x in states]) for h in runs.horizons]
    still = np.array([np.sqrt(np.mean((each / coordinates.units) ** 2)) for each in moves])
    logged = Logged(coordinates, log, units_confirmed)
    inputs = logged.excitation, np.std(logged.inputs, axis=0) / problem.u_half
    theta = np.concatenate([each.thetas[:, : problem.n_theta] for each in log])
    room = FLOAT32_ROUNDING * problem.theta_half
    own = problem.deviations
    outside = (theta < own.theta_min - room) | (theta > own.theta_max + room)
    shares = outside.mean(axis=0) * (not logged.made_by_law.all())
    beyond = float(shares.max()), problem.labels()[int(np.argmax(shares))]
    names, input_names = labels_of(problem.model)
    independent = sum(len(each[::2]) for each in records(problem, log))
    more = partial(more_of, problem, log)
    problems, advice = judge(runs, still, costs, inputs, independent, beyond, input_names, more)
    if problem.layout.n_previous:
        held = np.concatenate([each.thetas[1:, problem.layout.previous] for each in log])
        apart = np.abs(held - logged.inputs) / problem.u_half
        # 0.01: how far theta's previous input may be from the one before it, in half-widths
        share = float(np.mean(np.any(apart > 0.01, axis=1)))
        wrong = f"In {100 * share:.3g} % of the rows theta does not hold the input before it."
        problems += [wrong] * (share > OUTSIDE)
    problems += objections(logged)
    driven = [dynamics.row.features(e.thetas[:-1], e.actions)[:, len(names) :] for e in log]
    shown = [*map(problem.units.to_plant, states)]
    problems += words_for(frozen_rows(states, driven), names, shown)
    return Trust(runs, chosen, still, *costs, *inputs, tuple(problems), tuple(advice))


def report(problem: LinearMPC, episodes: tuple[Episode, ...], kind: str, trust: Trust) -> str:
    """Return what a twin explains, what it does not know, and whether to trust it, as text."""
    steps = sum(map(len, episodes))
    lines = [f"The log: {len(episodes)} episode{'s' * (len(episodes) != 1)}, {steps} steps."]
    for pieces in filter(lambda each: len(each) > 1, records(problem, episodes)):
        lines.append(
            f"Episodes {pieces[0]} to {pieces[-1]} are consecutive pieces of one record. Every "
            f"other one is independent: {len(pieces[::2])} of {len(pieces)}."
        )
    constant = problem.layout.constant
    seen = np.concatenate([each.thetas[:, constant] for each in episodes])
    if still := [*np.array(problem.labels())[constant][np.ptp(seen, axis=0) == 0]]:
        one = f"The log shows one value alone of {', '.join(still)}"
        lines.append(f"{one}: elsewhere the MPC will act.")
    lines.append(f"Residual beside the linear model: {kind}.")
    if len(trust.actual):
        units = "in standard deviations of the states"
        lines.append(f"Error of free runs over held-out episodes, {units}:")
        errors_by_name = {
            "steps ahead": trust.runs.horizons,
            "twin": trust.runs.errors[trust.chosen],
            "linear model": trust.runs.errors[0],
            "nothing moves": trust.standing,
        }
        for name, errors in errors_by_name.items():
            real = np.where(errors <= FLOAT32_ROUNDING, 0.0, errors)
            lines.append(f"  {name:<17}" + "".join(f"{each:>9.3g}" for each in real))
        lines.append("Cost of held-out episodes (or pieces of them), predicted and actual:")
        for predicted, actual in zip(trust.predicted[:10], trust.actual[:10], strict=True):
            lines.append(f"  {predicted:>10.4g} {actual:>10.4g}")
        if (more := len(trust.actual) - 10) > 0:
            lines.append(f"  ... and {more} more")
        lines.append(f"  error {100 * min(trust.cost_error, 1e6):.3g} % of the mean cost")
    unexplained = "neither states nor the MPC at held set-points tell"
    lines.append(f"Inputs: how much they move, and what share of it {unexplained}:")
    inputs = zip(labels_of(problem.model)[1], trust.excitation, trust.moves, strict=True)
    for name, own, moves in inputs:
        rests = "rests on the given B" if own < ALONE else "is known from the log"
        half = f"{100 * moves:.3g} % of half the range"
        lines.append(f"  {name}: {half}, {100 * own:.2f} %: its gain {rests}")
    lines.append("Verdict: trusted." if trust.trusted else "Verdict: NOT trusted; the MPC stays.")
    lines += [f"  {each}" for each in trust.problems]
    if trust.advice:
        lines += ["What would help:", *(f"  {each}" for each in np.unique(trust.advice))]
    return "\n".join(lines)
