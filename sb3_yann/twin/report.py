"""A twin in words, for whoever has to decide whether to use it."""

from __future__ import annotations

from collections.abc import Iterator
from decimal import ROUND_CEILING, Context

import numpy as np

from sb3_yann.control import LinearMPC
from sb3_yann.control.linear_system import labels_of
from sb3_yann.twin.log import Episode, records
from sb3_yann.twin.trust import ALONE, Trust


def report(problem: LinearMPC, episodes: tuple[Episode, ...], kind: str, trust: Trust) -> str:
    """Return what a twin explains, what it does not know, and whether to trust it, as text.

    Parameters
    ----------
    problem : LinearMPC
        Of the plant.
    episodes : tuple of Episode
        The log.
    kind : str
        The residual that was chosen.
    trust : Trust
        The evidence.
    """
    parts = _data(problem, episodes), _errors(kind, trust), _costs(trust), _inputs(problem, trust)
    lines = [line for part in (*parts, _noise(problem, trust), _verdict(trust)) for line in part]
    return "\n".join(lines)


def _data(problem: LinearMPC, episodes: tuple[Episode, ...]) -> Iterator[str]:
    steps = sum(map(len, episodes))
    yield f"The log: {len(episodes)} episodes, {steps} steps."
    for pieces in filter(lambda each: len(each) > 1, records(episodes)):
        yield (
            f"Episodes {pieces[0]} to {pieces[-1]} are consecutive pieces of one record. Every "
            f"other one is independent: {len(pieces[::2])} of {len(pieces)}."
        )
    constant = problem.layout.constant
    seen = np.concatenate([each.thetas[:, constant] for each in episodes])
    names = np.array(problem.layout.names)[constant]
    if still := [*names[np.ptp(seen, axis=0) == 0]]:
        yield f"The log shows one value alone of {', '.join(still)}: elsewhere the MPC will act."


def _errors(kind: str, trust: Trust) -> Iterator[str]:
    yield f"Residual beside the linear model: {kind}."
    if len(trust.actual) == 0:
        return
    yield "Error of free runs over held-out episodes, in standard deviations of the states:"
    yield "  steps ahead      " + "".join(f"{h:>9d}" for h in trust.runs.horizons)
    rows = (
        ("twin", trust.runs.errors[trust.chosen]),
        ("linear model", trust.runs.errors[0]),
        ("nothing moves", trust.standing),
    )
    for name, errors in rows:
        yield f"  {name:<17}" + "".join(f"{each:>9.3g}" for each in errors)


def _costs(trust: Trust) -> Iterator[str]:
    if len(trust.actual) == 0:
        return
    yield "Cost of held-out episodes (or pieces of them), predicted and actual:"
    for predicted, actual in zip(trust.predicted[:10], trust.actual[:10], strict=True):
        yield f"  {predicted:>10.4g} {actual:>10.4g}"
    if (more := len(trust.actual) - 10) > 0:
        yield f"  ... and {more} more"
    yield f"  error {100 * min(trust.cost_error, 1e6):.3g} % of the mean cost"


def _inputs(problem: LinearMPC, trust: Trust) -> Iterator[str]:
    yield "Inputs: how much they move, and how much of that does not follow the MPC:"
    for k in range(problem.model.n_inputs):
        known = "its gain is known from the log"
        if trust.excitation[k] < ALONE:
            known = "its gain rests on the given B"
        moves, share = 100 * trust.moves[k], 100 * trust.excitation[k]
        name = labels_of(problem.model)[1][k]
        yield f"  {name}: {moves:.3g} % of half the range, {share:.2f} %: {known}"


def _noise(problem: LinearMPC, trust: Trust) -> Iterator[str]:
    names = labels_of(problem.model)[0]
    found = ", ".join(f"{n} {_rounded_up(s)}" for n, s in zip(names, trust.noise, strict=True))
    yield f"Sensor noise, at most (standard deviations): {found}."


def _rounded_up(value: float) -> str:
    """Return a number in two digits that is no less: what holds at most stays true."""
    digits = Context(prec=2, rounding=ROUND_CEILING).create_decimal(repr(float(value)))
    return f"{float(digits):.2g}"


def _verdict(trust: Trust) -> Iterator[str]:
    yield "Verdict: trusted." if trust.trusted else "Verdict: NOT trusted; the MPC stays."
    yield from (f"  {each}" for each in trust.problems)
    if trust.advice:
        yield "What would help:"
        yield from (f"  {each}" for each in np.unique(trust.advice))
