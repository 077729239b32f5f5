"""The plant, the problem, its constraints, and the law with what it was checked against."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import torch as th

from sb3_yann._validation import Array
from sb3_yann.compare import less_safe, unsafe_columns
from sb3_yann.control import LinearMPC, PiecewiseAffine
from sb3_yann.control.model.labels import labels_of, missing_observer, with_units
from sb3_yann.control.mpc.bound_excess import excess_of_episodes
from sb3_yann.evaluation.episodes import Episodes
from sb3_yann.evaluation.law_plots import ActiveConstraints, regions_figure
from sb3_yann.reporting.html import Html, join, left_out, lines, picture, say, table, tag
from sb3_yann.reporting.subject import MPC, POLICY, Finding, Part, Subject

EXACT = 1e-6
"""The largest error of the law, in half-widths of the input range, that passes."""
SAME = 1e-5
"""The same of the law inside the policy, which rounds to float32."""


def plant_part(subject: Subject) -> Part:
    """Return the plant and the problem, in plant units."""
    problem, model = subject.problem, subject.problem.model
    states, inputs = with_units(model)
    point = [[name, "state", number(value)] for name, value in zip(states, model.x_ss, strict=True)]
    point += [
        [name, "input", number(value)] for name, value in zip(inputs, model.u_ss, strict=True)
    ]
    kinds = ["estimated disturbance" if i in model.estimated else "disturbance"
             for i in range(model.n_disturbances)]  # fmt: skip
    point += [[f"d[{i}]", kinds[i], number(value)] for i, value in enumerate(model.d_ss)]
    labels, shift = problem.labels(units=True), problem.theta_ss
    box = [
        [name, number(low), number(high)]
        for name, low, high in zip(
            labels, problem.theta_min + shift, problem.theta_max + shift, strict=True
        )
    ]
    soft = problem.soft.penalty
    facts = [
        ["horizon", f"{problem.horizon} steps of {model.dt:g}"],
        ["weight of the states, Q", matrix(problem.Q)],
        ["weight of the inputs, R", matrix(problem.R)],
        ["discount of the MPC, gamma", number(problem.gamma)],
        ["where the MPC has no solution", problem.infeasible.replace("_", " ")],
        ["penalty of a unit of a broken soft bound", number(soft) if soft else "no soft bounds"],
    ]
    found = (Finding("note", missing_observer(model)),) if model.estimated else ()
    return Part(
        "Plant and problem",
        join(
            [
                say("All values are in the plant's units unless a line says otherwise."),
                tag("h3", "Operating point"),
                table(["quantity", "kind", "value"], point),
                tag("h3", "The control problem"),
                table(["setting", "value"], facts),
                tag("h3", "Parameters of the law, and the box for which it is solved"),
                table(["parameter", "lower", "upper"], box),
                tag("h3", "The linear model"),
                lines(model.report()),
            ]
        ),
        found,
    )


def constraints_part(subject: Subject) -> Part:
    """Return the register of all constraints: bounds, where they act, and what the loops show."""
    acting = _shares(subject)
    loops = subject.loops or {}
    head = ["quantity", "lower", "upper", "kind", "acts in the plan"]
    head += [f"{name}: {what}" for name in loops for what in ("range", "steps beyond")]
    rows = []
    for each in _bounds(subject):
        name, key, low, high, kind, series = each
        row = [name, number(low), number(high), kind, _percent(acting.get(key, 0.0))]
        room = 1e-6 * (high - low if np.isfinite(high - low) else 1.0)
        for episodes in loops.values():
            values = np.concatenate([series(x, u) for x, u in _pairs(episodes)])
            beyond = int(np.sum((values < low - room) | (values > high + room)))
            row += [f"{number(np.nanmin(values))} to {number(np.nanmax(values))}", str(beyond)]
        rows.append(row)
    last = subject.problem.terminal.set[1]
    said = [
        "The plan is the optimal one of the MPC; its share is that of the solvable points among "
        f"{subject.points} drawn at random from the box of parameters.",
        f"The terminal set has {len(last)} half-spaces." if len(last) else "No terminal set.",
    ]
    if not loops:
        said.append("Without an env, what closed loops do to the bounds is left out.")
    found = _constraint_findings(subject.problem, loops) if loops else ()
    return Part("Constraints register", join([say(*said), table(head, rows)]), found)


def _constraint_findings(problem: LinearMPC, loops: dict[str, Episodes]) -> tuple[Finding, ...]:
    """Return whether the policy exceeds bounds of the problem by more than the MPC does."""
    mpc, policy = (excess_of_episodes(problem, _pairs(loops[who])) for who in (MPC, POLICY))
    sides = [unsafe_columns(0, 0, 0, each) for each in (policy, mpc)]
    breach = bool(np.any(less_safe(sides[0], sides[1])))
    worst = int(np.argmax(policy.largest - mpc.largest))
    text = (
        "Excess over the hard bounds of the problem, in half-widths: "
        f"{policy.largest.max():.3g} at most with the policy, {mpc.largest.max():.3g} with the "
        f"MPC; {policy.summed.mean():.3g} and {mpc.summed.mean():.3g} summed over an episode, on "
        "average."
    )
    if breach:
        text += (
            f" In episode {worst} the policy exceeds them by {policy.largest[worst]:.3g}, the MPC "
            f"by {mpc.largest[worst]:.3g}: the policy breaks a bound that the MPC keeps."
        )
    exceeded = bool(np.any(policy.largest > 0))
    found = [Finding("failed" if breach else "note" if exceeded else "passed", text)]
    if problem.soft.penalty:
        costs = [
            np.mean([np.sum(problem.stage_cost(x[:-1], u)) for x, u in _pairs(loops[who])])
            + each.penalty.mean()
            for who, each in ((POLICY, policy), (MPC, mpc))
        ]
        dear = costs[0] > costs[1] * (1 + 1e-6) and policy.penalty.mean() > mpc.penalty.mean()
        found.append(
            Finding(
                "failed" if dear else "passed",
                "Penalty of the soft bounds in an episode, on average: "
                f"{policy.penalty.mean():.4g} with the policy, {mpc.penalty.mean():.4g} with the "
                f"MPC. Stage costs and penalty together: {costs[0]:.6g} and {costs[1]:.6g}.",
            )
        )
    return tuple(found)


def _pairs(episodes: Episodes) -> Iterator[tuple[Array, Array]]:
    return zip(episodes.observations, episodes.actions, strict=True)


def _bounds(subject: Subject) -> Iterator[tuple[str, str, float, float, str, Any]]:
    """Yield label, key, bounds, kind, and the values in an episode, of what is bounded."""
    problem, model = subject.problem, subject.problem.model
    labels, names = with_units(model), labels_of(model)
    C, y = problem.outputs.C, model.x_ss @ problem.outputs.C.T
    outputs = [f"y[{i}]" for i in range(len(C))]
    soft = problem.soft.x > 0, problem.soft.y > 0
    previous = problem.layout.previous

    def rate(x: Array, u: Array, k: int) -> Array:
        return u[:, k] - x[:-1, previous][:, k]

    groups: list[tuple[Any, ...]] = [
        (labels[1], names[1], problem.u_min, problem.u_max, model.u_ss, None, _input),
        (labels[0], names[0], problem.x_min, problem.x_max, model.x_ss, soft[0], _state),
        (outputs, outputs, problem.outputs.y_min, problem.outputs.y_max, y, soft[1],
         partial(_output, C)),
    ]  # fmt: skip
    if problem.has_rate_bounds:
        rates = [f"the rate of {each}" for each in names[1]]
        none = np.zeros(model.n_inputs)
        limits = problem.rate.du_min, problem.rate.du_max
        groups.append(([f"change of {each} in a step" for each in labels[1]], rates, *limits, none,
                       None, rate))  # fmt: skip
    for called, keys, low, high, rest, is_soft, values in groups:
        for k, (label, key) in enumerate(zip(called, keys, strict=True)):
            if not np.any(np.isfinite([low[k], high[k]])):
                continue
            own = low[k] + rest[k], high[k] + rest[k]
            kind = "soft" if is_soft is not None and is_soft[k] else "hard"
            yield label, key, *own, kind, partial(_shifted, values, k, rest[k])


def _shifted(values: Any, k: int, rest: float, x: Array, u: Array) -> Array:
    return np.asarray(values(x, u, k) + rest)


def _input(x: Array, u: Array, k: int) -> Array:
    return u[:, k]


def _state(x: Array, u: Array, k: int) -> Array:
    return x[:, k]


def _output(C: Array, x: Array, u: Array, k: int) -> Array:
    return np.asarray(x[:, : C.shape[1]] @ C[k])


def _shares(subject: Subject) -> dict[str, float]:
    """Return the share of the solvable points where a quantity is on a bound in the plan."""
    acting, counts, solvable = ActiveConstraints(subject.problem), dict[str, int](), 0
    for theta in subject.sampled:
        found = acting.at(theta)
        if found is None:
            continue
        solvable += 1
        for key in {each.partition(" at its ")[0] for each in found}:
            counts[key] = counts.get(key, 0) + 1
    return {key: count / max(solvable, 1) for key, count in counts.items()}


def law_part(subject: Subject) -> Part:
    """Return the law and what it was checked against, here and when it was found."""
    law = subject.law
    if isinstance(law, PiecewiseAffine):
        size = f"{law.n_regions} regions with {law.n_halfspaces} half-spaces"
        how = (
            f"The MPC's law is explicit: {size}, solved once. When it was found, a program was "
            "solved at a point of every region, the optimality conditions of each region and of "
            "its neighbors were checked, and random points were compared."
        )
    else:
        how = "The MPC's law is solved at each point: there are no regions to check beforehand."
    checked, error, apart, inside = _compared(subject)
    again = (
        f"For this report it was compared with an independent quadratic program at "
        f"{len(subject.sampled)} random points of its box: {checked} have a solution, the largest "
        f"difference of an input is {error:.1e} of half its range, and {apart} points are judged "
        "solvable by one only."
    )
    network = (
        f"The law inside the policy, without what it has learnt, differs by at most {inside:.1e} "
        "of half the range."
    )
    right = error <= EXACT and apart == 0
    findings = (
        Finding("passed" if right else "failed", f"The law solves the MPC problem: {error:.1e} of "
                f"half the input range off at {checked} points."),
        Finding("passed" if inside <= SAME else "failed",
                f"The policy holds that law: {inside:.1e} of half the range off."),
    )  # fmt: skip
    return Part("The law and how it was checked", join([say(how), say(again), say(network),
                                                        _regions(subject)]), findings)  # fmt: skip


def _regions(subject: Subject) -> Html:
    problem = subject.problem
    if not subject.has_regions or problem.n_theta < 2:
        return left_out("A picture of regions needs an explicit law of two parameters or more.")
    plane = steepest(subject)
    names = " and ".join(problem.labels()[k] for k in plane)
    caption = (
        f"Regions of the law over {names}; the other parameters are at the operating point. "
        "A number is a region, a color tells which constraints act in the optimal plan."
    )
    return picture(partial(regions_figure, problem, entries=plane, by="constraint"), caption)


def steepest(subject: Subject) -> tuple[int, int]:
    """Return the two entries of theta that move the inputs most at the operating point."""
    problem = subject.problem
    gain = subject.law.gain(np.zeros((1, problem.n_theta)))[0]
    size = np.abs(gain * problem.theta_half / problem.u_half[:, None]).max(axis=0)
    first, second = np.sort(np.argsort(-size, kind="stable")[:2])
    return int(first), int(second)


def _compared(subject: Subject) -> tuple[int, float, int, float]:
    """Return how many points were compared, the law's error, doubts, and the policy's law's error.

    Points within rounding of the border are solvable for one and not for the other: they do not
    count.
    """
    problem, units, rows = subject.problem, ActiveConstraints(subject.problem).units, []
    law = subject.law(subject.sampled)
    inside = subject.law.in_domain(subject.sampled)
    m, apart = problem.model.n_inputs, 0
    for theta, u, known in zip(subject.sampled, law, inside, strict=True):
        U = units.scaled.solve((theta - units.center) / units.half)
        if (U is not None) != known:
            apart += not _near_the_border(subject, theta, bool(known))
        elif U is not None:
            planned = units.program.first_input(U * units.reach, theta, m)
            rows.append(np.abs(planned - u) / problem.u_half)
    error = float(np.max(rows)) if rows else 0.0
    layer = subject.policy.actor.mu
    with th.no_grad():
        own = layer.law(th.as_tensor(subject.sampled, device=subject.policy.device)).double()
    middle = (problem.u_max + problem.u_min) / 2
    scaled = (law - middle) / problem.u_half
    known_alone = inside if not problem.has_rate_bounds else np.zeros(len(inside), bool)
    off = np.abs(own.cpu().numpy() - scaled)[known_alone]
    return len(rows), error, apart, float(off.max()) if off.size else 0.0


def _near_the_border(subject: Subject, theta: Array, known: bool) -> bool:
    room = 1e-6 * subject.problem.theta_half
    around = theta + room * np.vstack([np.eye(len(theta)), -np.eye(len(theta))])
    return bool(np.any(subject.law.in_domain(around) != known))


def number(value: float) -> str:
    """Return a number in four digits; "none" for what is infinite."""
    return f"{value:.4g}" if np.isfinite(value) else "none"


def matrix(M: Array) -> str:
    """Return a matrix in one line, a diagonal one by its diagonal."""
    if np.array_equal(M, np.diag(np.diag(M))):
        return f"diag({', '.join(f'{each:g}' for each in np.diag(M))})"
    return "; ".join(", ".join(f"{each:.4g}" for each in row) for row in M)


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
