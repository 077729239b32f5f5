"""Closed loops, the guard's decisions, improve, twin, headroom, and how to do it again."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from importlib.metadata import PackageNotFoundError, version

import numpy as np
from scipy import stats
from stable_baselines3.common.type_aliases import TrainFreq

from sb3_yann._archive import digest_of
from sb3_yann.compare import COST_ROUNDING, EXCESS_ROOM, INPUT_STEP, RULE, Difference, less_safe
from sb3_yann.control import LinearMPC, PiecewiseAffine
from sb3_yann.control.linear_system import with_units
from sb3_yann.control.mpc.bound_excess import BoundNames, Bounds
from sb3_yann.control.mpc.misreading import misread_states
from sb3_yann.evaluation import change_in_percent, plots
from sb3_yann.guard import Decision
from sb3_yann.guard.start import OTHER_REWARD
from sb3_yann.guard.state import summary_of
from sb3_yann.improvement.improving import of_estimates
from sb3_yann.policy.checkpoint import fingerprint
from sb3_yann.reporting.subject import (
    NOT_SHOWN,
    OF_MPC,
    OF_POLICY,
    Finding,
    Html,
    Part,
    Subject,
    is_rewarded,
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
from sb3_yann.twin.env import TwinEnv
from sb3_yann.units import FLOAT32_ROUNDING

NO_ENV = "No env was given: closed loops are left out. Pass report(model, env=...) to play them."


def loops_part(subject: Subject) -> Part:
    """Return the closed loops against the MPC: costs, and a picture in plant units."""
    loops = subject.loops
    if loops is None:
        return part_of("", [], Finding("note", NO_ENV))
    mpc = loops[OF_MPC]
    policy = loops[OF_POLICY]
    averages = ("mean cost", np.mean), ("median cost", np.median), ("worst cost", np.max)
    values = [(name, float(of(mpc.costs)), float(of(policy.costs))) for name, of in averages]
    steps = [
        np.concatenate([np.abs(np.diff(np.asarray(u), axis=0)) for u in each.actions])
        for each in (mpc, policy)
    ]
    for i, name in enumerate(with_units(subject.problem.model)[1]):
        if len(steps[0]) and len(steps[1]):
            both = [each[:, i] for each in steps]
            values.append((f"largest step of {name}", float(both[0].max()), float(both[1].max())))
            values.append((f"mean step of {name}", float(both[0].mean()), float(both[1].mean())))
    rows = [[name, f"{old:.6g}", f"{new:.6g}", _change(old, new)] for name, old, new in values]
    for name, before, after in (
        ("steps that violate a limit", mpc.violations.sum(), policy.violations.sum()),
        ("episodes that the env terminates", mpc.terminated.sum(), policy.terminated.sum()),
    ):
        rows.append([name, str(before), str(after), f"{after - before:+d}"])
    first = subject.seeds[0]
    count = len(subject.seeds)
    is_range = count > 2 and subject.seeds == (*range(first, first + count),)
    seeds = f"{first} to {subject.seeds[-1]}" if is_range else ", ".join(map(str, subject.seeds))
    theta, u, _ = mpc.steps()  # in deviations
    own = float(subject.problem.deviations.stage_cost(theta, u).sum()) / count
    cost = "the sum of the MPC's stage cost: the env gives no reward"
    if is_rewarded(loops):
        cost = "minus the sum of the rewards"
        if abs(mpc.costs.mean() - own) > OTHER_REWARD * abs(own):
            cost += f", which is not the MPC's stage cost: that is {own:.6g} on average with it"
    how = (
        f"{count} episodes of {subject.env_name}, seeds {seeds}, each played by the MPC "
        "and by the policy from the same start, without any noise of actions. A cost is "
        f"{cost}.{of_estimates(subject.problem)}"
    )
    if _in_twin(subject):
        how += " The env is a twin, fitted to the plant's log: the plant has played none of them."
        how += " To leave what the log shows is a violation there."
    state = subject.state
    known = set() if state is None else {*state.evidence.starts.seeds} & {*subject.seeds}
    warning = (
        f"{len(known)} of these starts are known to the guard, which chose the policy by them: "
        "what they say is too favorable. Pass other seeds."
    )
    caption = (
        "Closed loops in plant units. Of more than six episodes a line is the median, and a band "
        "holds 80 % of them; what has a set-point is drawn as its distance from it. Below: the "
        "policy less the MPC, from the same starts."
    )
    gains = "What the policy costs more than the MPC at each start; below zero it costs less."
    found = mpc.costs, policy.costs, mpc.violations, policy.violations
    single = [
        [str(seed), f"{a:.6g}", f"{b:.6g}", _change(a, b), str(v), str(w)]
        for seed, a, b, v, w in zip(subject.seeds, *found, strict=True)
    ]
    head = ["seed", "MPC", "policy", "change", "MPC: violations", "policy: violations"]
    apart = np.abs(policy.costs - mpc.costs) > COST_ROUNDING * np.abs(mpc.costs)
    episodes = table(head, single[:1000])
    if not apart.any() and np.array_equal(mpc.violations, policy.violations):
        episodes = paragraph("Each costs what it costs with the MPC, and violates as often.")
    content = [
        paragraph(how, warning if known else ""),
        table(["", "MPC", "policy", "change"], rows),
        picture(partial(plots.plot_gains, loops), gains),
        picture(partial(plots.loops_figure, subject.problem, subject.shown_loops), caption),
        tag("h3", "Every episode"),
        episodes,
    ]
    less = less_safe(policy.unsafe(), mpc.unsafe())[:, :INPUT_STEP]  # the next part has the bounds
    bad = int(np.sum(less.any(axis=1)))
    text = "Episodes in which the policy violates more than the MPC, ends sooner, or has no finite "
    findings = [make_finding(not bad, f"{text}cost: {bad} of {count}.")]
    findings += _exceeded(subject.problem, loops)
    if words := misread_states(subject.problem, *mpc.steps()):
        findings.append(make_finding(False, words))
    return part_of("Closed loops against the MPC", content, *findings)


def _exceeded(problem: LinearMPC, loops: Mapping[str, Trajectories]) -> Iterator[Finding]:
    """Yield by how much a limit is exceeded, whoever acts: the MPC is no measure of that."""
    exceeding = []
    for who, played in loops.items():
        assert played.excess is not None
        largest = played.excess.largest
        k = int(np.argmax(largest))
        bad = int(np.sum((played.violations > 0) | (largest > EXCESS_ROOM)))
        words = BoundNames.of(problem).in_words(float(played.excess.worst[k]), float(largest[k]))
        if bad:
            exceeding.append(f"{who}, in {bad} of {len(largest)}{f': {words}' * bool(words)}")
    if exceeding:
        yield Finding("look", f"Episodes exceed a limit with the {'; with the '.join(exceeding)}.")


def _change(old: float, new: float) -> str:
    return change_in_percent((new - old) / abs(old)) if old else f"{new - old:+.4g}"


def _in_twin(subject: Subject) -> bool:
    return isinstance(getattr(subject.env, "unwrapped", None), TwinEnv)


def statistics_part(subject: Subject) -> Part:
    """Return what the closed loops prove, in words."""
    title = "Statistics in words"
    if subject.loops is None:
        return NOT_SHOWN
    mpc = subject.loops[OF_MPC]
    policy = subject.loops[OF_POLICY]
    change = policy.costs - mpc.costs
    count = len(change)
    if not np.all(np.isfinite(change)):
        text = "Some costs are not finite: no average says anything."
        return part_of(title, [paragraph(text)], make_finding(False, text))
    scale = abs(float(np.mean(mpc.costs))) or 1.0
    mean = 100 * float(change.mean()) / scale
    passed: bool | None = None
    text = f"On average the policy costs {abs(mean):.2f} % {'less' if mean < 0 else 'more'} than "
    text += "the MPC. One episode says nothing about others."
    if np.all(np.abs(change) <= COST_ROUNDING * scale):
        text = "From these starts the policy costs what the MPC costs."
    elif count > 1:
        width = 100 * Difference.relative(change, mpc.costs).room(RULE.significance)
        passed = True if mean + width < 0 else False if mean - width > 0 else None
        text = (
            f"On average the cost {'in the twin ' * _in_twin(subject)}changes by {mean:+.2f} %; "
            "the change lies between "
            f"{mean - width:+.2f} and {mean + width:+.2f} % with a confidence of 90 %, by "
            f"Student's interval of the ratio of the two means, of {count} pairs."
        )
        if passed is None:
            text += " That it differs from the MPC at all is not shown."
    rounding = COST_ROUNDING * np.abs(mpc.costs)
    less = int(np.sum(change < -rounding))
    more = int(np.sum(change > rounding))
    worst = int(np.argmax(change))
    largest = f"{change[worst]:.4g}, from seed {subject.seeds[worst]}" if more else "0"
    # The upper limit of Clopper and Pearson: how often a violation may still happen.
    bad = int(np.sum(policy.violations > 0))
    most = float(stats.binomtest(bad, count).proportion_ci(0.90).high)
    sentences = [
        text,
        f"It costs less from {less} starts and more from {more} of {count}; the largest "
        f"increase is {largest}.",
        f"{bad} of {count} episodes violate a limit ({int(np.sum(mpc.violations > 0))} with the "
        f"MPC): with a confidence of 95 % fewer than {100 * most:.1f} % of such starts do.",
        "These statements hold for starts that are drawn as these are, and for a plant that "
        "behaves as this env does.",
    ]
    return part_of(title, map(paragraph, sentences), make_finding(passed, text))


def distance_part(subject: Subject) -> Part:
    """Return where, and how far, the policy leaves the MPC."""
    problem = subject.problem
    policy = subject.policy
    theta = subject.samples
    points = {"random points of the box": theta}
    if subject.loops is not None:
        visited = [x[:-1] for x in subject.loops[OF_POLICY].observations]
        points["steps of the closed loops"] = np.concatenate(visited)
    rows = []
    for where, of in points.items():
        of = of[np.isfinite(of).all(axis=1)]
        apart = np.abs(plots.inputs_of(problem, policy, of) - subject.law(of))
        for k, name in enumerate(with_units(problem.model)[1]):
            own = apart[:, k]
            share = 50 * own.max() / problem.u_half[k]
            values = own.mean(), np.percentile(own, 95), own.max()
            rows.append([name, where, *map(number, values), f"{share:.2f}"])
    bound = policy.max_correction
    networks = policy.actor.mu.n_networks
    adds = "networks add" if networks > 1 else "network adds"
    most = "What it may add is bounded by the range of the inputs alone."
    if bound is not None:
        most = f"It may add at most {100 * bound:g} % of the input range."
    counts = "It counts everywhere."
    if policy.actor.mu.confines.any():
        counts = "It counts in a box of parameters only, and fades beyond."
    keeps = "The problem bounds no states and no outputs."
    if Bounds.of(problem).used.any():
        keeps = "It knows the bounds of states and outputs by its training alone."
    if len(policy.actor.mu.constants[2]):
        kept = problem.kept_set
        margin = 100 * policy.bounds_margin
        lasting = "for ever" if kept.for_ever else f"for {kept.steps} steps"
        keeps = (
            "Whatever it has learnt, it stops where the model's next state would leave the hard "
            f"bounds, or the set in which inputs can keep them {lasting} "
            f"({len(kept.g)} half-spaces, margin {margin:g} % of a half-width)."
        )
    head = ["input", "at", "mean", "95 % are below", "largest", "largest, % of the range"]
    whole = f"The policy is the MPC's law plus what {networks} {adds}, clipped to the bounds of "
    content = [
        paragraph(f"{whole}the inputs.", most, counts, keeps),
        table(head, rows),
        *_pictures(subject),
    ]
    u = plots.inputs_of(problem, policy, theta)
    rounding = FLOAT32_ROUNDING * problem.u_half
    low, high = problem.deviations.input_range(theta)
    # Where the MPC has no solution, bounds that change may give way: no further than with it.
    law = subject.law(theta)
    low = np.minimum(low, law) - rounding
    high = np.maximum(high, law) + rounding
    inside = bool(np.all((u >= low) & (u <= high)))
    text = "Inputs leave their bounds at random points of the box of parameters."
    if inside:
        text = f"Inputs keep their bounds at {len(theta)} random points of the box of parameters."
    name, where, *_, share = max(rows, key=lambda row: float(row[-1]))
    largest = f"The policy is at most {share} % of the range of {name} from the MPC, at {where}."
    if policy.actor.mu.network.is_zero():
        largest = "The policy is the MPC: its networks add nothing."
    # 50.0: % of the range of an input: as far from the MPC as its middle from a bound
    far = Finding("look" if float(share) > 50.0 else "note", largest)
    title = "Where and how far the policy leaves the MPC"
    return part_of(title, content, make_finding(inside, text), far)


def _pictures(subject: Subject) -> list[Html]:
    """Return the regions that are used, and the surface before and after."""
    problem = subject.problem
    policy = subject.policy
    loops = subject.loops
    found = []
    if isinstance(subject.law, PiecewiseAffine) and loops is not None:
        caption = (
            "The regions that the policy's closed loops visit, and how far it is from the MPC in "
            "each, in the input that is farthest."
        )
        draw = partial(plots.use_figure, problem, policy, subject.shown_loops[OF_POLICY])
        found.append(picture(draw, caption))
    if problem.n_theta < 2:
        return found
    plane = subject.steepest_plane
    entries = [*plane]
    low = problem.theta_min[entries]
    high = problem.theta_max[entries]
    if loops is not None:
        shown = subject.shown_loops[OF_POLICY].observations
        visited = np.concatenate([x[:, entries] for x in shown])
        visited = visited[np.isfinite(visited).all(axis=1)]
        room = 0.05 * np.ptp(visited, axis=0)
        low = visited.min(axis=0) - room
        high = visited.max(axis=0) + room
    if not np.all(np.isfinite([low, high])) or np.any(low >= high):
        return found
    names = " and ".join(problem.labels()[k] for k in plane)
    caption = (
        f"The first input over {names}: before is the MPC, after the policy. The frame holds "
        f"{'the closed loops' if loops else 'the box of parameters'}; the other "
        "parameters are at the operating point. A black line, if there is one, surrounds where "
        "the MPC has a solution."
    )
    options = {"entries": plane, "frame": (low, high)}
    draw = partial(plots.surfaces_figure, problem, subject.law, policy, **options)  # type: ignore[arg-type]
    return [*found, picture(draw, caption)]


def guard_part(subject: Subject) -> Part:
    """Return every decision of the guard with its reason, and whether its policy is this one."""
    state = subject.state
    if state is None:
        if subject.is_confirmed:
            return NOT_SHOWN
        text = "No guard was at work: nothing has confirmed it on new starts."
        return part_of("", [], Finding("note", text))
    passed: bool | None = state.accepted.is_actor_of(subject.policy)
    text = "The policy is the one that the guard accepted last."
    if not passed and subject.is_confirmed:
        passed = None
        by = "improve" if subject.improved is not None else "a commissioning"
        text = f"The policy is not the guard's: {by} has accepted another one since."
    elif not passed:
        text = (
            "The policy is NOT the one that the guard accepted last: it is a candidate, or was "
            "changed since. restore_accepted(model) gives the accepted one."
        )
    own = {name.replace("_", " "): value for name, value in state.settings.items()}
    if subject.guard is not None:
        given = subject.guard.settings
        for name in ("n_new_starts", "n_final_starts", "eval_freq", "patience", "keep_if_worse"):
            own[name.replace("_", " ")] = getattr(given, name)
        rule = asdict(given.rule).items()
        own |= {f"rule: {name}": value for name, value in rule if name not in state.settings}
    settings = [
        [name, f"{value.start} to {value.stop - 1}" if isinstance(value, range) else str(value)]
        for name, value in own.items()
    ]
    parts = [
        paragraph(text),
        lines(summary_of(state, subject.policy)),
        tag("h3", "Settings of the guard"),
        table(["setting", "value"], settings),
    ]
    if state.decisions:
        caption = (
            "What each candidate, by the verdict on it, and the accepted policy change of the "
            f"MPC's mean cost on the same starts, of the guard's {len(state.settings['seeds'])}."
        )
        parts += [picture(partial(plots.plot_decisions, state.decisions), caption)]
        parts += _decisions(state.decisions)
    return part_of("Decisions of the guard", parts, make_finding(passed, text))


def _decisions(decisions: Sequence[Decision]) -> list[Html]:
    head = ["", "episode", "verdict", "candidate", "accepted", "MPC", "restored", "reason"]
    rows = []
    for k, each in enumerate(decisions, start=1):
        regions = f"accepted in regions {', '.join(map(str, each.regions))}" * bool(each.regions)
        way = f"accepted {each.share:g} of the way" * (0 < each.share < 1)
        reasons = "; ".join(filter(None, [each.reason, regions, way]))
        row = [str(k), str(each.episode), each.verdict, *each.costs_in_words()]
        rows.append([*row, "yes" if each.restored else "", reasons])
    text = f"All {len(decisions)} decisions, with mean costs over the guard's starts."
    return [tag("h3", "Every decision"), paragraph(text), table(head, rows)]


IMPROVE_SETTINGS = {
    "max_steps": "the most steps of the simulator, for everything",
    "n_starts": "episodes for which the best inputs are planned in a model of the plant",
    "rounds": "how often, at most, a model is fitted, planned in, and the policy taught the plans",
    "updates": "steps of the optimizer each time that the policy is taught",
    "confine": "whether the MPC acts alone where the log, or the simulator's episodes, end",
    "seed": "repeats the same run",
}


def improve_part(subject: Subject) -> Part:
    """Return what `improve` did, in what, with how many episodes, and whose the policy is."""
    found = subject.improvements
    if not found:
        return NOT_SHOWN
    now = subject.improved
    state = subject.state
    is_mpc = subject.policy.actor.mu.network.is_zero()
    passed: bool | None = None
    if now is not None:
        passed = True
        text = (
            f"The policy is the one that improve accepted last, in {now.where} ({now.episodes} "
            f"episodes): {now.change_in_words}."
        )
    elif not any(each.accepted for each in found):
        whose = "The policy is the MPC: " * is_mpc
        text = f"{whose}improve was at work. {found[-1].reason}"
    elif is_mpc:
        text = "The policy is the MPC again: what improve accepted is gone."
    elif subject.is_confirmed:
        by_guard = state is not None and state.accepted.is_actor_of(subject.policy)
        by = "The guard" if by_guard else "A commissioning"
        text = f"{by} has accepted another policy after improve."
    else:
        passed = False
        text = "The policy is NOT the one that improve accepted last: it was changed since."
    rows = []
    tried = []
    for k, each in enumerate(found, start=1):
        where = f"{each.where}: {each.source}"
        rows.append([str(k), where, str(each.episodes), str(len(each.checks))])
        for j, of in enumerate(each.checks, start=1):
            changes = map(change_in_percent, (of.change, of.worst))
            tried.append([f"{k}.{j}", of.starts_in_words, *changes, of.verdict])
    settings = [[k, str(v), IMPROVE_SETTINGS.get(k, "")] for k, v in found[-1].settings.items()]
    how = (
        "Episodes are those of the log that the twin was fitted to, or those that were played in "
        "the simulator to compare. What was confirmed there holds for the plant as far as the "
        "twin or the simulator is like it."
    )
    candidates = [
        tag("h3", "Every candidate"),
        paragraph("What it changes of the MPC's mean cost of its starts; minus is cheaper."),
        table(["", "starts", "change", "worst start", "verdict"], tried),
    ]
    content = [
        paragraph(text),
        paragraph(how),
        table(["", "in", "episodes", "candidates"], rows),
        *(lines(f"{k}. {each.report()}") for k, each in enumerate(found, start=1)),
        *(candidates if tried else []),
        tag("h3", "Settings of the last improvement"),
        table(["setting", "value", "what it is"], settings),
    ]
    return part_of("What improve did", content, make_finding(passed, text))


def commissioning_part(subject: Subject) -> Part:
    """Return the batches of a commissioning, what its pairs show, and whose the policy is."""
    found = subject.commissioned
    if found is None:
        return NOT_SHOWN
    is_its = found.policy == fingerprint(subject.policy.actor)
    passed: bool | None = None
    if is_its and found.accepted:
        passed = True
        text = f"The policy is the one of {found.kept}, which the plant has confirmed in pairs."
    elif is_its:
        text = "The policy is the MPC: the plant has confirmed no other one."
    elif subject.is_confirmed:
        text = "The policy is not the commissioning's: another one has been accepted since."
    else:
        passed = False
        text = "The policy is NOT the one that the plant has confirmed: it was changed since."
    content = [paragraph(text), lines(found.report)]
    return part_of("What the plant has shown", content, make_finding(passed, text))


def twin_part(subject: Subject) -> Part:
    """Return the twin's report and evidence."""
    twin = subject.twin
    if twin is None:
        return NOT_SHOWN
    text = "The twin is trusted." if twin.trusted else "The twin is NOT trusted."
    caption = (
        "Left: costs of held-out episodes. Right: how the error of free runs grows with the steps "
        "that they look ahead."
    )
    shown = picture(lambda: plots.plot_twin(twin.trust)[0], caption)
    content = paragraph(text), lines(twin.report()), shown
    return part_of("The twin and its verdict", content, make_finding(twin.trusted, text))


def headroom_part(subject: Subject) -> Part:
    """Return the headroom: how much could be gained over the MPC, and of which kind."""
    found = subject.headroom
    if found is None:
        return NOT_SHOWN
    caption = "The gain over the MPC part by part; the bar of the total has its standard error."
    shown = picture(partial(plots.plot_headroom, found), caption)
    text = f"Headroom: {100 * found.total:.2f} % below the MPC's mean cost"
    finding = Finding("note", f"{text}; the verdict is to {found.verdict}.")
    return part_of("Headroom", [lines(found.report()), shown], finding)


# ---- What it takes to do it again ----


def again_part(subject: Subject) -> Part:
    """Return versions, seeds, settings and fingerprints."""
    model = subject.model
    problem = subject.problem
    versions = [["Python", platform.python_version()]]
    for library in (
        "sb3-yann", "stable-baselines3", "torch", "gymnasium", "numpy", "scipy", "numba", "daqp",
        "ppopt", "control", "matplotlib",
    ):  # fmt: skip
        try:
            versions.append([library, version(library)])
        except PackageNotFoundError:
            versions.append([library, "not installed"])
    versions.append(["system", f"{platform.system()} {platform.machine()}"])
    names: tuple[str, ...] = "gamma", "seed"
    if model.num_timesteps:  # what `improve` alone has made knows no other
        names += (
            "learning_rate", "batch_size", "buffer_size", "tau", "train_freq", "gradient_steps",
            "learning_starts", "action_noise", "num_timesteps",
        )  # fmt: skip
    own = {name.replace("_", " "): getattr(model, name, None) for name in names}
    own |= {f"policy: {k}": value for k, value in model.policy_kwargs.items() if k != "problem"}
    settings = []
    for name, value in own.items():
        text = str(value)
        if isinstance(value, TrainFreq):
            text = f"{value.frequency} {value.unit.value}"
        elif callable(value):
            text = getattr(value, "__name__", type(value).__name__)
        settings.append([name, text])
    program = problem.condensed()
    arrays = {name: getattr(program, name) for name in "H F c G w S feedback".split()}
    arrays |= {name: getattr(problem, name) for name in ("theta_min", "theta_max", "theta_ss")}
    given = {name: each for name, each in arrays.items() if each is not None}
    prints = [
        ["the policy's weights", fingerprint(subject.policy.actor)],
        ["the MPC problem", digest_of(given)],
    ]
    parts = [
        tag("h3", "Versions"), table(["library", "version"], versions),
        tag("h3", "Settings of the learner"), table(["setting", "value"], settings),
        tag("h3", "Fingerprints (SHA-256)"), table(["what", "fingerprint"], prints),
    ]  # fmt: skip
    return part_of("To do it again", parts)
