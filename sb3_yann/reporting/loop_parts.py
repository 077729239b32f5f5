"""Closed loops of the policy against the MPC, what they prove, and how far the two are apart."""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy import stats

from sb3_yann._validation import Array
from sb3_yann.control.model.labels import with_units
from sb3_yann.evaluation.episodes import Episodes
from sb3_yann.evaluation.law_plots import inputs_of, surfaces_figure, use_figure
from sb3_yann.evaluation.plots import loops_figure
from sb3_yann.reporting.html import Html, join, left_out, picture, say, table, tag
from sb3_yann.reporting.problem_parts import number, steepest
from sb3_yann.reporting.subject import MPC, POLICY, Finding, Part, Subject

NO_ENV = "No env was given: closed loops are left out. Pass report(model, env=...) to play them."
CONFIDENCE = 0.95
MOST_ROWS = 1000
ROUNDING = 1e-6
"""Relative difference of costs that counts as none."""
WITHIN = 1e-6
"""How far beyond its bounds an input may be, in half-widths: rounding of float32."""


def loops_part(subject: Subject) -> Part:
    """Return the closed loops against the MPC: costs, and a picture in plant units."""
    loops = subject.loops
    if loops is None:
        return Part("Closed loops against the MPC", left_out(NO_ENV))
    mpc, policy = loops[MPC], loops[POLICY]
    rows = []
    for name, of in (("mean", np.mean), ("median", np.median), ("worst", np.max)):
        old, new = float(of(mpc.costs)), float(of(policy.costs))
        rows.append([f"{name} cost", f"{old:.6g}", f"{new:.6g}", _change(old, new)])
    for name, counts in (
        ("steps that violate a limit", [each.violations.sum() for each in (mpc, policy)]),
        ("episodes that the env terminates", [each.terminated.sum() for each in (mpc, policy)]),
    ):
        rows.append([name, *map(str, counts), f"{counts[1] - counts[0]:+d}"])
    seeds = _span(subject.seeds)
    said = (
        f"{len(mpc.costs)} episodes of {subject.env_name}, seeds {seeds}, each played by the MPC "
        "and by the policy from the same start, without any noise of actions. A cost is minus the "
        "sum of the rewards."
    )
    caption = (
        "Closed loops in plant units. Of more than six episodes a line is the median, the dark "
        "band holds 80 % of them, the light one all. Time is in the unit of the sampling time."
    )
    drawn = picture(partial(loops_figure, subject.problem, loops), caption)
    single = [
        [str(seed), f"{a:.6g}", f"{b:.6g}", _change(a, b), str(v), str(w)]
        for seed, a, b, v, w in zip(subject.seeds, mpc.costs, policy.costs, mpc.violations,
                                    policy.violations, strict=True)
    ]  # fmt: skip
    head = ["seed", "MPC", "policy", "change", "MPC: violations", "policy: violations"]
    parts = [say(said, _known(subject)), table(["", "MPC", "policy", "change"], rows), drawn]
    content = join([*parts, tag("h3", "Every episode"), table(head, single[:MOST_ROWS])])
    return Part("Closed loops against the MPC", content, _safety(mpc, policy))


def _known(subject: Subject) -> str:
    """Return which of the starts the guard has chosen the policy by, as far as it says."""
    evidence = getattr(subject.state, "evidence", None)
    known = {*getattr(evidence, "seeds", ())} & {*subject.seeds}
    if not known:
        return ""
    return (
        f"{len(known)} of these starts are known to the guard, which chose the policy by them: "
        "what they say is too favorable. Pass other seeds."
    )


def _safety(mpc: Episodes, policy: Episodes) -> tuple[Finding, ...]:
    more = (policy.violations > mpc.violations) | (policy.terminated > mpc.terminated)
    lost = ~np.isfinite(policy.costs) & np.isfinite(mpc.costs)
    bad = int(np.sum(more | lost))
    text = (
        f"Episodes in which the policy violates more than the MPC, is terminated, or has no "
        f"finite cost: {bad} of {len(policy.costs)}."
    )
    return (Finding("failed" if bad else "passed", text),)


def statistics_part(subject: Subject) -> Part:
    """Return what the closed loops prove, in words."""
    if subject.loops is None:
        return Part("Statistics in words", left_out(NO_ENV))
    mpc, policy = subject.loops[MPC], subject.loops[POLICY]
    change, typical = policy.costs - mpc.costs, float(np.mean(mpc.costs))
    if not np.all(np.isfinite(change)):
        said = "Some costs are not finite: no average says anything."
        return Part("Statistics in words", say(said), (Finding("failed", said),))
    first, finding = _mean_in_words(change, typical)
    same = ROUNDING * np.abs(mpc.costs)
    cheaper, dearer = int(np.sum(change < -same)), int(np.sum(change > same))
    worst = int(np.argmax(np.where(change > same, change, 0.0)))
    most = float(change[worst]) if dearer else 0.0
    where = f", from seed {subject.seeds[worst]}" if dearer else ""
    sentences = [
        first,
        f"It costs less from {cheaper} starts and more from {dearer} of {len(change)}; the largest "
        f"increase is {most:.4g}{where}.",
        _rarity(mpc, policy),
        "These statements hold for starts that are drawn as these are, and for a plant that "
        "behaves as this env does.",
    ]
    return Part("Statistics in words", join(map(say, sentences)), (finding,))


def _mean_in_words(change: Array, typical: float) -> tuple[str, Finding]:
    """Return what the mean difference and its t interval say."""
    mean, count, scale = float(change.mean()), len(change), abs(typical) or 1.0
    if np.all(np.abs(change) <= ROUNDING * scale):
        said = "From these starts the policy costs what the MPC costs."
        return said, Finding("note", said)
    word = "less" if mean < 0 else "more"
    said = f"On average the policy costs {100 * abs(mean) / scale:.2f} % {word} than the MPC"
    if count < 2:
        return f"{said}. One episode says nothing about others.", Finding("note", f"{said}.")
    width = float(stats.t.ppf((1 + CONFIDENCE) / 2, count - 1) * change.std(ddof=1) / count**0.5)
    low, high = 100 * (mean - width) / scale, 100 * (mean + width) / scale
    interval = f"between {low:+.2f} and {high:+.2f} %"
    text = f"{said}; the change lies {interval} with a confidence of 95 %."
    kind = "passed" if high < 0 else "failed" if low > 0 else "note"
    if kind == "note":
        text += " That it differs from the MPC at all is not shown."
    words = (
        f"{text} The interval is Student's, of the {count} differences of paired episodes; it "
        "takes their mean for nearly normal."
    )
    return words, Finding(kind, text)


def _rarity(mpc: Episodes, policy: Episodes) -> str:
    """Return how often a violation may still happen: the upper limit of Clopper and Pearson."""
    bad, count = int(np.sum(policy.violations > 0)), len(policy.costs)
    most = 1.0 if bad == count else float(stats.beta.ppf(CONFIDENCE, bad + 1, count - bad))
    return (
        f"{bad} of {count} episodes violate a limit ({int(np.sum(mpc.violations > 0))} with the "
        f"MPC): with a confidence of 95 % fewer than {100 * most:.1f} % of such starts do."
    )


def distance_part(subject: Subject) -> Part:
    """Return where, and how far, the policy leaves the MPC."""
    policy, theta = subject.policy, subject.sampled
    rows = _distances(subject, "random points of the box", theta)
    if subject.loops is not None:
        visited = np.concatenate([x[:-1] for x in subject.loops[POLICY].observations])
        rows += _distances(subject, "steps of the closed loops", visited)
    bound = policy.max_correction
    box = policy.actor.mu.confines.any()
    networks = policy.actor.mu.n_networks
    sentences = [
        f"The policy is the MPC's law plus what {networks} network"
        f"{'s add' if networks > 1 else ' adds'}, clipped to the bounds of the inputs.",
        f"It may add at most {100 * bound:g} % of the input range." if bound is not None
        else "What it may add is bounded by the range of the inputs alone.",
        "It counts in a box of parameters only, and fades beyond." if box
        else "It counts everywhere.",
    ]  # fmt: skip
    head = ["input", "at", "mean", "95 % are below", "largest", "largest, % of half the range"]
    findings = (_bounded(subject, theta), *_largest(rows))
    parts = [say(*sentences), table(head, rows), _where(subject), *_pictures(subject)]
    return Part("Where and how far the policy leaves the MPC", join(parts), findings)


def _apart(subject: Subject, theta: Array) -> Array:
    """Return the distance of the policy's inputs from the law's (batch, m)."""
    finite = theta[np.isfinite(theta).all(axis=1)]
    return np.abs(inputs_of(subject.problem, subject.policy, finite) - subject.law(finite))


def _distances(subject: Subject, where: str, theta: Array) -> list[list[str]]:
    apart, rows = _apart(subject, theta), []
    for k, name in enumerate(with_units(subject.problem.model)[1]):
        own = apart[:, k]
        share = 100 * own.max() / subject.problem.u_half[k]
        values = own.mean(), np.percentile(own, 95), own.max()
        rows.append([name, where, *map(number, values), f"{share:.2f}"])
    return rows


def _largest(rows: list[list[str]]) -> tuple[Finding, ...]:
    name, where, *_, share = max(rows, key=lambda row: float(row[-1]))
    text = f"The policy is at most {share} % of half the range of {name} from the MPC, at {where}."
    return (Finding("note", text),)


def _bounded(subject: Subject, theta: Array) -> Finding:
    problem = subject.problem
    u = inputs_of(problem, subject.policy, theta)
    room = WITHIN * problem.u_half
    inside = bool(
        np.all((u >= problem.deviations.u_min - room) & (u <= problem.deviations.u_max + room))
    )
    text = f"Inputs keep their bounds at {len(theta)} random points of the box of parameters."
    if not inside:
        text = "Inputs leave their bounds at random points of the box of parameters."
    return Finding("passed" if inside else "failed", text)


def _where(subject: Subject) -> Html:
    problem, theta = subject.problem, subject.sampled
    apart = (_apart(subject, theta) / problem.u_half).max(axis=1)
    if apart.max() < ROUNDING:
        return say("At the random points the policy is the MPC: nothing has been learnt there.")
    far = theta[int(np.argmax(apart))] + problem.theta_ss
    point = ", ".join(
        f"{name} = {value:.4g}" for name, value in zip(problem.labels(True), far, strict=True)
    )
    rest = float(_apart(subject, np.zeros((1, problem.n_theta))).max())
    return say(
        f"Of the random points it is farthest from the MPC at {point}.",
        f"At the operating point it differs by {rest:.2g}.",
    )


def _pictures(subject: Subject) -> list[Html]:
    problem, policy, found = subject.problem, subject.policy, []
    if subject.has_regions and subject.loops is not None:
        caption = (
            "The regions that the policy's closed loops come through, and how far it is from the "
            "MPC in each, in the input that is farthest."
        )
        draw = partial(use_figure, problem, policy, subject.loops[POLICY])
        found.append(picture(draw, caption))
    if problem.n_theta < 2:
        return found
    plane = steepest(subject)
    frame = _frame(subject, plane)
    if frame is not None:
        names = " and ".join(problem.labels()[k] for k in plane)
        caption = (
            f"The first input over {names}: before is the MPC, after the policy. The frame holds "
            f"{'the closed loops' if subject.loops else 'the box of parameters'}; the other "
            "parameters are at the operating point. A black line, if there is one, surrounds where "
            "the MPC has a solution."
        )
        surfaces = partial(
            surfaces_figure, problem, subject.law, policy, entries=plane, frame=frame
        )
        found.append(picture(surfaces, caption))
    return found


def _frame(subject: Subject, plane: tuple[int, int]) -> tuple[Array, Array] | None:
    """Return what of a plane the closed loops come through, or the box; None where it is flat."""
    problem, entries = subject.problem, [*plane]
    low, high = problem.deviations.theta_min[entries], problem.deviations.theta_max[entries]
    if subject.loops is not None:
        seen = np.concatenate([x[:, entries] for x in subject.loops[POLICY].observations])
        seen = seen[np.isfinite(seen).all(axis=1)]
        room = 0.05 * np.ptp(seen, axis=0)
        low, high = seen.min(axis=0) - room, seen.max(axis=0) + room
    if not np.all(np.isfinite([low, high])) or np.any(low >= high):
        return None
    shift = problem.theta_ss[entries]
    return low + shift, high + shift


def _change(old: float, new: float) -> str:
    if not old:
        return f"{new - old:+.4g}"
    return f"{round(100 * (new - old) / abs(old), 2) + 0.0:+.2f} %"  # no "-0.00"


def _span(seeds: tuple[int, ...]) -> str:
    whole = len(seeds) > 2 and seeds == (*range(seeds[0], seeds[0] + len(seeds)),)
    return f"{seeds[0]} to {seeds[-1]}" if whole else ", ".join(map(str, seeds))
