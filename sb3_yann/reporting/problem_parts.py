"""The plant, the problem, its constraints, and the law with what it was checked against."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import torch as th

from sb3_yann._validation import Array
from sb3_yann.compare import COST_ROUNDING, EXCESS_ROOM, less_safe, unsafe_columns
from sb3_yann.control import LinearMPC, PiecewiseAffine
from sb3_yann.control.linear_system import (
    labels_of,
    labels_of_outputs,
    missing_observer,
    with_units,
)
from sb3_yann.control.mpc.bound_excess import BoundNames, costs_of
from sb3_yann.control.mpc.report import ActiveConstraints
from sb3_yann.env_pool import one_env
from sb3_yann.evaluation.plots import plot_regions
from sb3_yann.reporting.subject import (
    OF_MPC,
    OF_POLICY,
    Finding,
    Html,
    Part,
    Subject,
    lines,
    make_finding,
    number,
    paragraph,
    part_of,
    picture,
    table,
    tag,
)
from sb3_yann.rollout import Trajectories
from sb3_yann.units import FLOAT32_ROUNDING
from sb3_yann.wrappers.theta import EstimateState, below


def plant_part(subject: Subject) -> Part:
    """Return the plant and the problem, in plant units."""
    problem = subject.problem
    model = subject.problem.model
    states, inputs, loads = with_units(model)
    kinds = ["state"] * len(states) + ["input"] * len(inputs)
    kinds += ["estimated " * (i in model.estimated) + "disturbance" for i in range(len(loads))]
    rest = map(number, [*model.x_ss, *model.u_ss, *model.d_ss])
    point = [*zip([*states, *inputs, *loads], kinds, rest, strict=True)]
    ends = zip(problem.labels(units=True), problem.theta_min, problem.theta_max, strict=True)
    box = [[name, number(low), number(high)] for name, low, high in ends]
    soft = problem.soft.penalty
    facts = [
        ["horizon", f"{problem.horizon} steps of {model.step_length}"],
        ["weight of the states, Q", _matrix(problem.Q)],
        ["weight of the inputs, R", _matrix(problem.R)],
        ["discount of the MPC, gamma", number(problem.gamma)],
        ["where the MPC has no solution", problem.infeasible.replace("_", " ")],
        ["penalty of a unit of a broken soft bound", number(soft) if soft else "no soft bounds"],
    ]
    if max(problem.blocks) > 1:
        facts.append(["samples for which a move is held", ", ".join(map(str, problem.blocks))])
    if problem.price.counts:
        prices = zip([*states, *inputs], [*problem.price.x, *problem.price.u], strict=True)
        facts.append(["prices in a sample", ", ".join(f"{k}: {number(p)}" for k, p in prices if p)])
    content = [
        paragraph("All values are in the plant's units unless a line says otherwise."),
        tag("h3", "Operating point"),
        table(["quantity", "kind", "value"], point),
        tag("h3", "The control problem"),
        table(["setting", "value"], facts),
        tag("h3", "Parameters of the law, and the box for which it is solved"),
        table(["parameter", "lower", "upper"], box),
        tag("h3", "The linear model"),
        lines(model.report()),
    ]
    lacks = [Finding("note", each) for each in (missing_observer(model),) if each]
    return part_of("Plant and problem", content, *lacks)


def _matrix(M: Array) -> str:
    """Return a matrix in one line, a diagonal one by its diagonal."""
    if np.array_equal(M, np.diag(np.diag(M))):
        return f"diag({', '.join(f'{each:g}' for each in np.diag(M))})"
    return "; ".join(", ".join(f"{each:.4g}" for each in row) for row in M)


# ---- Constraints ----


def constraints_part(subject: Subject) -> Part:
    """Return the register of all constraints: bounds, where they act, and what the loops show."""
    problem = subject.problem
    loops = subject.loops or {}
    plans = [*map(ActiveConstraints(problem).at, subject.samples)]
    solvable = [plan for plan in plans if plan is not None]
    acting = Counter(
        key for plan in solvable for key in {each.partition(" at its ")[0] for each in plan}
    )
    head = ["quantity", "lower", "upper", "kind", "acts in the plan"]
    head += [f"{name}: {what}" for name in loops for what in ("range", "steps beyond")]
    rows = []
    bounds = BoundNames.of(problem)
    half = dict(zip(bounds.names, bounds.half, strict=True))
    for name, key, of, k, kind, series in _bounds(problem):
        share = 100 * acting[key] / max(len(solvable), 1)
        low, high = (side[k] for side in problem.limits[of])
        row = [name, number(low), number(high), kind, f"{share:.1f} %"]
        room = EXCESS_ROOM * half.get(key.removeprefix("the rate of "), 0.0)
        for episodes in subject.shown_loops.values():
            parts = [np.zeros(0)]
            beyond = 0
            for x, u in episodes.pairs:
                values = series(x, u)[:, k]
                lower, upper = problem.limits_at(of, x[: len(values)])  # at run time
                parts.append(values)
                out = (values < lower[..., k] - room) | (values > upper[..., k] + room)
                beyond += int(out[len(out) - len(u) :].sum())  # where it begins is no step
            values = np.concatenate(parts)
            row += [f"{number(np.nanmin(values))} to {number(np.nanmax(values))}", str(beyond)]
        rows.append(row)
    last = problem.terminal.set[1]
    sentences = [
        "The plan is the optimal one of the MPC; its share is that of the solvable points among "
        f"{len(plans)} drawn at random from the box of parameters. A step beyond is one by more "
        f"than {EXCESS_ROOM:g} half-widths, as for violations.",
        f"The terminal set has {len(last)} half-spaces." if len(last) else "No terminal set.",
    ]
    findings = _bound_findings(problem, loops) if loops else []
    if subject.env is not None:
        with one_env(subject.env) as env:
            if below(env, EstimateState) is not None:
                text = "Bounds count on an observer's estimates: the plant may be beyond them."
                findings.append(Finding("note", text))
    content = paragraph(*sentences), table(head, rows)
    return part_of("Constraints register", content, *findings)


def _bound_findings(problem: LinearMPC, loops: dict[str, Trajectories]) -> list[Finding]:
    """Return whether the policy exceeds bounds of the problem by more than the MPC does."""
    mpc = loops[OF_MPC].excess
    policy = loops[OF_POLICY].excess
    assert mpc is not None and policy is not None
    ours, its = (unsafe_columns(0, 0, 0, each) for each in (policy, mpc))
    is_worse = bool(np.any(less_safe(ours, its)))
    text = (
        "Excess over the hard bounds of the problem, in half-widths: "
        f"{policy.largest.max():.3g} at most with the policy, {mpc.largest.max():.3g} with the "
        f"MPC; {policy.summed.mean():.3g} and {mpc.summed.mean():.3g} summed over an episode, on "
        "average."
    )
    names = BoundNames.of(problem)
    if is_worse:
        worst = int(np.argmax(policy.largest - mpc.largest))
        size = policy.largest[worst]
        text += (
            f" In episode {worst} the policy exceeds them by {size:.3g}, the MPC by "
            f"{mpc.largest[worst]:.3g}: {names.in_words(policy.worst[worst], size)} with the "
            "policy."
        )
    passed = None if np.any(policy.largest > 0) else True
    found = [make_finding(False if is_worse else passed, text)]
    if problem.soft.penalty:
        # A steep penalty multiplies what rounding moves a state by.
        rounding = FLOAT32_ROUNDING * problem.theta_half
        moved = [(x + np.copysign(rounding, x), u) for x, u in loops[OF_MPC].pairs]
        old, new, rounded = (
            np.mean([costs_of(problem, *pair)[0] for pair in pairs])
            for pairs in (loops[OF_MPC].pairs, loops[OF_POLICY].pairs, moved)
        )
        most = max(old * (1 + COST_ROUNDING), rounded)
        costs_more = new > most and policy.penalty.mean() > mpc.penalty.mean()
        text = (
            "Penalty of the soft bounds in an episode, on average: "
            f"{policy.penalty.mean():.4g} with the policy, {mpc.penalty.mean():.4g} with the "
            f"MPC. Stage costs and penalty together: {new:.6g} and {old:.6g}."
        )
        over = np.where(policy.largest > 0, 0.0, policy.any_bound)
        worst = int(np.argmax(over))
        if words := names.in_words(policy.worst[worst], over[worst]):
            text += f" In episode {worst} {words} with the policy."
        found.append(make_finding(not costs_more, text))
    return found


def _bounds(problem: LinearMPC) -> Iterator[tuple[str, str, str, int, str, Any]]:
    """Yield label, key, limits, their entry, kind, values in an episode, of each bound."""
    model = problem.model
    C = problem.outputs.C
    labels = with_units(model)
    names = labels_of(model)
    shown, keys = (
        labels_of_outputs(C, each[0] if model.state_names else ()) for each in (labels, names)
    )
    previous = problem.layout.previous
    hard = np.zeros(model.n_inputs, bool)
    groups: list[tuple[Any, ...]] = [
        (labels[1], names[1], "u", hard, lambda x, u: u),
        (labels[0], names[0], "x", problem.soft.x > 0, lambda x, u: x),
        (shown, keys, "y", problem.soft.y > 0, lambda x, u: x[:, : C.shape[1]] @ C.T),
    ]
    if problem.has_rate_bounds:
        called = [f"change of {each} in a step" for each in labels[1]]
        rates = [f"the rate of {each}" for each in names[1]]
        groups.append((called, rates, "du", hard, lambda x, u: u - x[:-1, previous]))
    mixed = problem.mixed
    combined = [f"mixed[{i}]" for i in range(len(mixed.F))]
    groups.append(
        (combined, combined, "mixed", mixed.soft > 0,
         lambda x, u: x[:-1, : mixed.F.shape[1]] @ mixed.F.T + u @ mixed.G.T)
    )  # fmt: skip
    for called, keys, of_limits, is_soft, values in groups:
        for k in np.flatnonzero(np.isfinite(problem.limits[of_limits]).any(axis=0)):
            yield called[k], keys[k], of_limits, int(k), "soft" if is_soft[k] else "hard", values


# ---- The law ----


def law_part(subject: Subject) -> Part:
    """Return the law and what it was checked against, here and when it was found."""
    law = subject.law
    how = "The MPC's law is solved at each point: there are no regions to check beforehand."
    if isinstance(law, PiecewiseAffine):
        how = (
            f"The MPC's law is explicit: {law.n_regions} regions with {law.n_halfspaces} "
            "half-spaces, solved once. When it was found, a program was "
            "solved at a point of every region, the optimality conditions of each region and of "
            "its neighbors were checked, and random points were compared."
        )
    count, error, doubtful = _error_of_law(subject)
    off = _error_inside_policy(subject)
    compared = (
        f"For this report it was compared with an independent quadratic program at "
        f"{len(subject.samples)} random points of its box: {count} have a solution, the "
        f"largest difference of an input is {error:.1e} of half its range, and {doubtful} "
        "points are solvable by one only."
    )
    inside = "The law inside the policy, without what it has learnt, differs by at most "
    inside += f"{off:.1e} of half the range."
    solves = f"The law solves the MPC problem: {error:.1e} of half the input range off at {count} "
    holds = f"The policy holds that law: {off:.1e} of half the range off."
    return part_of(
        "The law and how it was checked",
        [*map(paragraph, (how, compared, inside)), _regions(subject)],
        make_finding(error <= 1e-6 and doubtful == 0, f"{solves}points."),
        make_finding(off <= 1e-5, holds),  # the policy rounds to float32
    )


def _regions(subject: Subject) -> Html:
    problem = subject.problem
    if not isinstance(subject.law, PiecewiseAffine) or problem.n_theta < 2:
        why = "A picture of regions needs an explicit law of two parameters or more."
        return tag("p", why, class_="said")
    plane = subject.steepest_plane
    names = " and ".join(problem.labels()[k] for k in plane)
    caption = (
        f"Regions of the law over {names}; the other parameters are at the operating point. "
        "A number is a region, a color shows which constraints act in the optimal plan."
    )
    return picture(partial(plot_regions, problem, entries=plane, by="constraint"), caption)


def _error_of_law(subject: Subject) -> tuple[int, float, int]:
    """Return how many points have a solution, the law's error, and points in doubt."""
    problem = subject.problem
    law = subject.law
    program = ActiveConstraints(problem).units
    errors = [0.0]
    doubtful = 0
    inputs = law(subject.samples)
    inside = law.in_domain(subject.samples)
    for theta, u, is_inside in zip(subject.samples, inputs, inside, strict=True):
        U = program.scaled.solve((theta - program.center) / program.half)
        if (U is not None) != is_inside:
            # Points within rounding of the border do not count.
            near = 1e-6 * problem.theta_half * np.vstack([np.eye(len(theta)), -np.eye(len(theta))])
            doubtful += not np.any(law.in_domain(theta + near) != is_inside)
        elif U is not None:
            planned = program.program.first_input(U * program.reach, theta, len(u))
            errors.append(float(np.max(np.abs(planned - u) / problem.u_half)))
    return len(errors) - 1, max(errors), doubtful


def _error_inside_policy(subject: Subject) -> float:
    """Return the error of the law inside the policy, in half-widths of the input range."""
    problem = subject.problem
    policy = subject.policy
    with th.no_grad():
        own = policy.actor.mu.law(th.as_tensor(subject.samples, device=policy.device)).double()
    middle = (problem.deviations.u_max + problem.deviations.u_min) / 2
    scaled = (subject.law(subject.samples) - middle) / problem.u_half
    off = np.abs(own.cpu().numpy() - scaled)[subject.law.in_domain(subject.samples)]
    return float(off.max(initial=0.0))
