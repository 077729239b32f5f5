"""The guard's decisions, improve, twin, headroom, timing, and what it takes to do it again."""

from __future__ import annotations

import hashlib
import platform
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from time import perf_counter
from typing import Any

import numpy as np
from stable_baselines3.common.type_aliases import TrainFreq

from sb3_yann.control import PiecewiseAffine
from sb3_yann.evaluation.plots import plot_decisions, plot_headroom, plot_twin
from sb3_yann.guard import Decision
from sb3_yann.guard.state import summary_of
from sb3_yann.improvement.improving import fingerprint
from sb3_yann.reporting.html import Html, join, lines, paragraph, picture, table, tag
from sb3_yann.reporting.subject import Finding, Part, Subject, left_out, make_finding


def guard_part(subject: Subject) -> Part:
    """Return every decision of the guard with its reason, and whether its policy is this one."""
    title, state = "Decisions of the guard", subject.state
    if state is None:
        why = (
            "No guard was at work on this model: nothing has confirmed the policy on new starts. "
            "Pass an ImprovementGuard to learn."
        )
        if subject.improved is not None:
            why = "No guard was at work on this model. What confirmed the policy is the next part."
        return left_out(title, why, Finding("note", "No guard was at work."))
    passed: bool | None = state.accepted.is_actor_of(subject.policy)
    text = "The policy is the one that the guard accepted last."
    if not passed and subject.improved is not None:
        passed = None
        text = "The policy is not the guard's: improve has accepted another one since."
    elif not passed:
        text = (
            "The policy is NOT the one that the guard accepted last: it is a candidate, or was "
            "changed since. restore_accepted(model) gives the accepted one."
        )
    rows = []
    for name, value in state.settings.items():
        is_range = isinstance(value, range)
        rows.append([name, f"{value.start} to {value.stop - 1}" if is_range else str(value)])
    if subject.guard is not None:
        given = subject.guard.settings
        names = ("n_new_starts", "n_final_starts", "eval_freq", "patience", "keep_if_worse")
        rows += [[name, str(getattr(given, name))] for name in names]
        rule = asdict(given.rule).items()
        rows += [[f"rule: {name}", str(v)] for name, v in rule if name not in state.settings]
    settings = [[name if ":" in name else name.replace("_", " "), text] for name, text in rows]
    parts = [
        paragraph(text),
        lines(summary_of(state, subject.policy)),
        tag("h3", "Settings of the guard"),
        table(["setting", "value"], settings),
    ]
    if state.decisions:
        caption = (
            "Mean cost of each candidate by the verdict on it, of the accepted policy and of the "
            f"MPC, over the guard's {len(state.settings['seeds'])} starts."
        )
        parts += [picture(partial(plot_decisions, state.decisions), caption)]
        parts += _decisions(state.decisions)
    return Part(title, join(parts), (make_finding(passed, text),))


def _decisions(decisions: Sequence[Decision]) -> list[Html]:
    """Return every decision with its reason, as a table."""
    head = ["", "episode", "verdict", "candidate", "accepted", "MPC", "restored", "reason"]
    rows = []
    for k, each in enumerate(decisions, start=1):
        reasons = [each.reason]
        if each.regions:
            reasons.append(f"accepted in regions {', '.join(map(str, each.regions))}")
        if 0 < each.share < 1:
            reasons.append(f"accepted {each.share:g} of the way")
        costs = (each.candidate_cost, each.accepted_cost, each.mpc_cost)
        row = [str(k), str(each.episode), each.verdict, *(f"{cost:.6g}" for cost in costs)]
        rows.append([*row, "yes" if each.restored else "", "; ".join(filter(None, reasons))])
    text = f"All {len(decisions)} decisions, with mean costs over the guard's starts."
    return [tag("h3", "Every decision"), paragraph(text), table(head, rows)]


def improve_part(subject: Subject) -> Part:
    """Return what `improve` did, in what, with how many episodes, and whose the policy is."""
    title, found = "What improve did", subject.improvements
    if not found:
        return left_out(title, "improve was not at work on this model.")
    now, state = subject.improved, subject.state
    if now is not None:
        place = f"{now.where} ({now.episodes} episodes, {100 * now.change:+.2f} %)"
        text = f"The policy is the one that improve accepted last, in {place}."
        finding = make_finding(True, text)
    elif not any(each.accepted for each in found):
        finding = Finding("note", f"improve was at work. {found[-1].reason}")
    elif subject.policy.actor.mu.network.is_zero():
        text = "The policy is the MPC again: what improve accepted is gone."
        finding = Finding("note", text)
    elif state is not None and state.accepted.is_actor_of(subject.policy):
        finding = Finding("note", "The guard has accepted another policy after improve.")
    else:
        text = "The policy is NOT the one that improve accepted last: it was changed since."
        finding = make_finding(False, text)
    rows = []
    for k, each in enumerate(found, start=1):
        checks = str(len(each.checks))
        place = f"{each.where}: {each.source}"
        rows.append([str(k), place, str(each.episodes), checks, each.report()])
    settings = [[name.replace("_", " "), str(value)] for name, value in found[-1].settings.items()]
    how = (
        "Episodes are those of the log that the twin was fitted to, or those that were played in "
        "the simulator to compare. What was confirmed there holds for the plant as far as the "
        "twin or the simulator is like it."
    )
    content = [
        paragraph(finding.text),
        paragraph(how),
        table(["", "in", "episodes", "candidates", "what came of it"], rows),
        tag("h3", "Settings of the last improvement"),
        table(["setting", "value"], settings),
    ]
    return Part(title, join(content), (finding,))


def twin_part(subject: Subject) -> Part:
    """Return the twin's report and evidence."""
    twin, title = subject.twin, "The twin and its verdict"
    if twin is None:
        return left_out(title, "No twin was given: pass report(model, twin=...) to show it.")
    text = "The twin is trusted." if twin.trusted else "The twin is NOT trusted."
    caption = (
        "Left: costs of held-out episodes. Right: how the error of free runs grows with the steps "
        "that they look ahead."
    )
    shown = picture(lambda: plot_twin(twin.trust)[0], caption)
    content = join([paragraph(text), lines(twin.report()), shown])
    return Part(title, content, (make_finding(twin.trusted, text),))


def headroom_part(subject: Subject) -> Part:
    """Return the headroom: how much could be gained over the MPC, and of which kind."""
    found, title = subject.headroom, "Headroom"
    if found is None:
        why = "No headroom was given: pass report(model, headroom=headroom(mpc, env)) to show it."
        return left_out(title, why)
    caption = "The gain over the MPC part by part; the bar of the total has its standard error."
    shown = picture(partial(plot_headroom, found), caption)
    text = f"Headroom: {100 * found.total:.2f} % below the MPC's mean cost"
    finding = Finding("note", f"{text}; the verdict is to {found.verdict}.")
    return Part(title, join([lines(found.report()), shown]), (finding,))


# ---- Timing, and what it takes to do it again ----


def cost_part(subject: Subject) -> Part:
    """Return how long a call takes on this machine, and how large things are."""
    policy, law, calls = subject.policy, subject.law, 200
    space, theta = policy.observation_space, subject.problem.theta_rest
    observation = np.zeros(space.shape or (1,), space.dtype)

    def times(call: Callable[[], Any]) -> tuple[str, str]:
        call()
        taken = []
        for _ in range(calls):
            begun = perf_counter()
            call()
            taken.append(1e6 * (perf_counter() - begun))
        return f"{np.median(taken):.1f}", f"{np.percentile(taken, 99):.1f}"

    checked = policy.first_obs_checked
    policy.first_obs_checked = True  # no observation of the env
    rows = [
        ["model.predict, one observation", *times(lambda: subject.model.predict(observation))],
        ["the MPC's law, one theta", *times(lambda: law(theta))],
    ]
    policy.first_obs_checked = checked
    tensors = policy.actor.state_dict().values()
    sizes = {
        "the actor's weights and constants": sum(t.numel() * t.element_size() for t in tensors)
    }
    if isinstance(law, PiecewiseAffine):
        sizes["the law, with what finds its regions"] = sum(each.nbytes for each in law.packed)
    if sys.platform != "win32":
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        sizes["this process at its largest"] = peak if sys.platform == "darwin" else 1024 * peak
    how = f"{calls} calls each, one after the other, at the operating point, on this machine."
    content = [
        paragraph(how),
        table(["what", "median (µs)", "99 % are below (µs)"], rows),
        table(["what", "size (kB)"], [[what, f"{n / 1000:.4g}"] for what, n in sizes.items()]),
    ]
    return Part("Timing and memory", join(content))


def again_part(subject: Subject) -> Part:
    """Return versions, seeds, settings and fingerprints."""
    model, problem = subject.model, subject.problem
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
    names = (
        "gamma", "learning_rate", "batch_size", "buffer_size", "tau", "train_freq",
        "gradient_steps", "learning_starts", "action_noise", "seed", "num_timesteps",
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
    program, digest = problem.condensed(), hashlib.sha256()
    arrays = [program.H, program.F, program.c, program.G, program.w, program.S]
    arrays += [] if program.feedback is None else [program.feedback]
    arrays += [problem.deviations.theta_min, problem.deviations.theta_max, problem.theta_ss]
    for each in arrays:
        digest.update(np.ascontiguousarray(each).tobytes())
    prints = [
        ["the policy's weights", fingerprint(subject.policy.actor.state_dict())],
        ["the MPC problem", digest.hexdigest()],
    ]
    parts = [
        tag("h3", "Versions"), table(["library", "version"], versions),
        tag("h3", f"Settings of the {type(model).__name__}"), table(["setting", "value"], settings),
        tag("h3", "Fingerprints (SHA-256)"), table(["what", "fingerprint"], prints),
    ]  # fmt: skip
    return Part("To do it again", join(parts))
