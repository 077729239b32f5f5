"""A problem and its law in words, for whoever has to sign them off."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import numpy as np

from sb3_yann._progress import bar
from sb3_yann._validation import Array
from sb3_yann.control.explicit.solve import ProgramUnits
from sb3_yann.control.linear_system import labels_of
from sb3_yann.control.mpc.condensing import condense
from sb3_yann.control.mpc.problem import MPCProblem, margins
from sb3_yann.control.online import Law, OnlineLaw

LOOP_STEPS = 50  # of a closed loop on the model
BOUND = "bound of entry {}, which may move in"


def report(problem: MPCProblem, law: Law, samples: int = 500, seed: int = 0) -> str:
    """Return the parameters, the size of the law, and shares of the bounded box, as text.

    Points are drawn uniformly from the box: shares are good to 1 / sqrt(samples).
    """
    rng = np.random.default_rng(seed)
    own = problem.deviations
    points = rng.uniform(own.theta_min, own.theta_max, (samples, problem.n_theta))
    feasible = points[law.in_domain(points)]
    parts = _parameters(problem), _size(problem, law), _shares(own, law, points, feasible)
    return "\n".join(chain(*parts, _active(own, feasible)))


def _parameters(problem: MPCProblem) -> Iterator[str]:
    meanings = {"x": "state {}", "r": "reference of tracked output {}", "d": "disturbance {}"}
    meanings["u_prev"] = "input {} of the step before"
    previews = dict(zip("rd", problem.layout.previews, strict=True))
    points = problem.units.to_plant(problem.theta_rest)
    rests = problem.units.shifted
    how = "in plant units; the operating point is in brackets" if rests else "in theta"
    yield f"Parameters of the law, {problem.n_theta}, {how}:"
    labels = problem.labels(units=True)
    width = max(10, *map(len, labels))
    low = problem.theta_min
    high = problem.theta_max
    shown = [f"[{each:.4g}]" if rests else "" for each in points]
    room = max(10, *(len(each) + 1 for each in shown)) if rests else 0
    entries = zip(labels, problem.layout.entries, strict=True)
    for i, (label, (kind, index, ahead)) in enumerate(entries):
        meaning = f"{shown[i]:<{room}}{meanings.get(kind, BOUND).format(index)}"
        if ahead:
            meaning += f", {ahead} sample{'s' * (ahead > 1)} ahead"
        is_estimated = kind == "d" and index in problem.model.estimated
        if kind in previews and (is_estimated or ahead == previews[kind]):
            meaning += " and after" if ahead else ", constant over the horizon"
        if is_estimated:
            meaning += ", which an observer estimates"
        yield f"  {label:<{width}} {low[i]:>10.4g} to {high[i]:<10.4g} {meaning}"


def _size(problem: MPCProblem, law: Law) -> Iterator[str]:
    yield f"Horizon: {problem.horizon} steps of {problem.model.step_length}."
    if isinstance(law, OnlineLaw):
        yield f"The law is solved online, with {law.n_constraints} constraints."
    else:
        yield f"The law has {law.n_regions} regions and {law.n_halfspaces} half-spaces."
    yield from _weights(problem)
    if len(problem.blocks) < problem.horizon:
        yield f"Inputs are held over blocks of {', '.join(map(str, problem.blocks))} steps."
    if problem.price.counts:
        named = zip((*labels_of(problem.model)[0], *labels_of(problem.model)[1]),
                    (*problem.price.x, *problem.price.u), strict=True)  # fmt: skip
        yield f"Prices: {', '.join(f'{name} {price:g}' for name, price in named if price)}."
    rows = len(problem.terminal.set[1])
    yield f"The terminal set has {rows} half-spaces." if rows else "There is no terminal set."
    if problem.soft.penalty:
        kinds = [problem.bounded[kind] for kind in ("x", "y", "mixed")]
        soft = [each.names[i] for each in kinds for i in np.flatnonzero(each.softness)]
        yield f"Soft bounds: {', '.join(soft)}; a unit costs {problem.soft.penalty:g}."
    if problem.layout.n_references and not problem.model.estimated:
        yield "There is no integral action: a plant that is not its model may rest beside its"
        yield "set-points. offset_free(mpc) has it, and may cost less or more on the way there:"
        yield "  headroom(mpc, env) plays it in a simulator. Add it where that gains."


def _weights(problem: MPCProblem) -> Iterator[str]:
    """Yield what half the range of each state and input costs in a step, and what hardly counts."""
    labels = chain(*labels_of(problem.model)[:2])
    half = ((problem.theta_max - problem.theta_min) / 2)[problem.layout.state]
    states = np.diag(problem.Q) * half**2
    costs = [*states, *(np.diag(problem.R) * problem.u_half**2)]
    named = [(name, cost) for name, cost in zip(labels, costs, strict=True) if cost]
    if not named:
        return
    yield f"Half its range costs, in a step: {', '.join(f'{n} {cost:.3g}' for n, cost in named)}."
    # States that cost a hundredth of the dearest one hardly count.
    if small := [n for n, cost in named[: np.count_nonzero(states)] if cost < 0.01 * max(states)]:
        yield f"  Little beside others: {', '.join(small)}. Weights are in plant units."


def _shares(problem: MPCProblem, law: Law, points: Array, feasible: Array) -> Iterator[str]:
    yield f"Of {len(points)} random parameters of the box"
    yield f"  {_percent(len(feasible), len(points))} are feasible;"
    if len(problem.tracking.C):
        parts = problem.layout
        r, d = np.split(points[:, parts.now], [parts.n_references], axis=1)
        reachable = np.all(margins(problem, r, d, points) >= 0, axis=-1)
        share = _percent(reachable.sum(), len(points))
        yield f"  {share} have a reachable steady state, at other set-points some cost stays;"
    kept = _stay_feasible(problem, law, feasible).sum() if len(feasible) else 0
    kept_share = f"  of the feasible ones, {_percent(kept, len(feasible))} stay feasible"
    yield f"{kept_share} for {LOOP_STEPS} steps in closed loop on the model."


def _stay_feasible(problem: MPCProblem, law: Law, theta: Array) -> Array:
    """Tell which rows of theta (batch, n_theta) the closed loop keeps in the domain."""
    (A, B) = problem.prediction
    kept = np.ones(len(theta), dtype=bool)
    for _ in bar("closed loops on the model: steps", range(LOOP_STEPS)):
        theta = theta @ A.T + law(theta) @ B.T
        kept &= law.in_domain(theta)
        theta = np.where(kept[:, None], theta, 0.0)  # those that left may grow without bound
    return kept


class ActiveConstraints:
    """Names the constraints that are active in the optimal plan at a theta."""

    def __init__(self, problem: MPCProblem) -> None:
        program, self.names = condense(problem)
        self.units = ProgramUnits(program, problem.deviations.u_min, problem.deviations.u_max)

    def at(self, theta: Array) -> list[str] | None:
        """Return the active constraints at theta (n_theta,), None where no plan is feasible."""
        scaled = self.units.scaled
        z = (theta - self.units.center) / self.units.half
        U = scaled.solve(z)
        if U is None:
            return None
        slack = scaled.w + scaled.S @ z - scaled.G @ U  # of unit rows, in half-widths
        return [*dict.fromkeys(self.names[i] for i in np.flatnonzero(slack < 1e-7))]

    def __call__(self, region: int, theta: Array) -> str:
        """Return what a picture calls a region that holds theta."""
        return ", ".join(self.at(theta) or ()) or "no constraint acts"


def _active(problem: MPCProblem, feasible: Array) -> Iterator[str]:
    """Yield which constraints act in the optimal plan, anywhere in the horizon."""
    acting = ActiveConstraints(problem)
    counts = dict.fromkeys(acting.names, 0)
    for theta in bar("plans at random parameters", feasible):
        for name in acting.at(theta) or ():  # none on the border of the domain
            counts[name] += 1
    yield "Constraints that act in the plan, as a share of the feasible parameters:"
    ranked = sorted(counts.items(), key=lambda item: -item[1])
    for name, count in ranked:
        if count:
            yield f"  {_percent(count, len(feasible)):>6} {name}"
    idle = [name for name, count in ranked if not count]
    if idle:
        yield f"  never: {', '.join(idle)}"


def _percent(count: int, total: int) -> str:
    return f"{100 * count / total:.1f} %" if total else "none"
