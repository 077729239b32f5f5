"""The guard's decisions, the twin with its verdict, and what there was to gain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

from sb3_yann.evaluation.plots import decisions_figure, headroom_figure, twin_figure
from sb3_yann.guard import Decision
from sb3_yann.guard.summary import summary_of
from sb3_yann.reporting.html import Html, join, left_out, lines, picture, say, table, tag
from sb3_yann.reporting.subject import Finding, Part, Subject

MOST = 3000
"""Decisions in the table; of more, refusals in the middle are left out."""


def guard_part(subject: Subject) -> Part:
    """Return every decision of the guard with its reason, and whether its policy is this one."""
    title, state = "Decisions of the guard", subject.state
    if state is None:
        said = (
            "No guard was at work on this model: nothing has confirmed the policy on new starts. "
            "Pass an ImprovementGuard to learn."
        )
        if subject.improved is not None:
            said = "No guard was at work on this model. What confirmed the policy is the next part."
        return Part(title, left_out(said), (Finding("note", "No guard was at work."),))
    accepted = state.accepted.is_actor_of(subject.policy)
    text = "The policy is the one that the guard accepted last."
    if not accepted:
        text = (
            "The policy is NOT the one that the guard accepted last: it is a candidate, or was "
            "changed since. restore_accepted(model) gives the accepted one."
        )
    since = not accepted and subject.improved is not None
    if since:
        text = "The policy is not the guard's: improve has accepted another one since."
    finding = Finding("passed" if accepted else "note" if since else "failed", text)
    starts = len(state.settings["seeds"])
    caption = (
        "Mean cost of each candidate by the verdict on it, of the accepted policy and of the MPC, "
        f"over the guard's {starts} starts."
    )
    parts = [
        say(text),
        lines(summary_of(state, subject.policy)),
        _settings(subject, state.settings),
    ]
    if state.decisions:
        parts += [picture(partial(decisions_figure, state.decisions), caption)]
        parts += [*_decisions(state.decisions)]
    return Part(title, join(parts), (finding,))


def _settings(subject: Subject, settings: dict[str, Any]) -> Html:
    """Return what the guard compares, and how, as a table."""
    rows = [[name.replace("_", " "), _short(value)] for name, value in settings.items()]
    if subject.guard is not None:
        given = subject.guard.acceptance
        names = ("n_new_starts", "n_final_starts", "eval_every", "patience", "keep_if_worse")
        rows += [[n.replace("_", " "), str(getattr(given, n))] for n in names if hasattr(given, n)]
        rows += [[f"rule: {k}", str(v)] for k, v in asdict(given.rule).items() if k not in settings]
    return join([tag("h3", "Settings of the guard"), table(["setting", "value"], rows)])


def _short(value: Any) -> str:
    if isinstance(value, range):
        return f"{value.start} to {value.stop - 1}"
    return str(value)


def _decisions(decisions: Sequence[Decision]) -> list[Html]:
    kept = [*enumerate(decisions, start=1)]
    if len(kept) > MOST:
        ends = {*range(1, MOST // 4), *range(len(kept) - MOST // 4, len(kept) + 1)}
        good = [k for k, each in kept if each.verdict != "rejected"][: MOST // 2]
        kept = [pair for pair in kept if pair[0] in ends | {*good}]
    head = ["", "episode", "verdict", "candidate", "accepted", "MPC", "restored", "reason"]
    rows = [
        [str(k), str(each.episode), each.verdict, *(f"{cost:.6g}" for cost in _costs(each)),
         "yes" if each.restored else "", _reason(each)]
        for k, each in kept
    ]  # fmt: skip
    said = f"All {len(decisions)} decisions, with mean costs over the guard's starts."
    if len(kept) < len(decisions):
        said = f"{len(kept)} of {len(decisions)} decisions: the others, refusals, are left out."
    return [tag("h3", "Every decision"), say(said), table(head, rows)]


def _costs(decision: Decision) -> tuple[float, float, float]:
    return decision.candidate_cost, decision.accepted_cost, decision.mpc_cost


def _reason(decision: Decision) -> str:
    """Return why not all was accepted, and what was."""
    parts = [decision.reason]
    if decision.regions:
        parts.append(f"accepted in regions {', '.join(map(str, decision.regions))}")
    if 0 < decision.share < 1:
        parts.append(f"accepted {decision.share:g} of the way")
    return "; ".join(filter(None, parts))


def improve_part(subject: Subject) -> Part:
    """Return what `improve` did, in what, with how many episodes, and whose the policy is."""
    title, found = "What improve did", subject.improvements
    if not found:
        return Part(title, left_out("improve was not at work on this model."))
    head = ["", "in", "episodes", "checks passed", "what came of it"]
    rows = [
        [str(k), f"{each.where}: {each.source}", str(each.episodes),
         f"{sum(check.accepted for check in each.checks)} of {len(each.checks)}", each.report()]
        for k, each in enumerate(found, start=1)
    ]  # fmt: skip
    of_last = [[name.replace("_", " "), str(value)] for name, value in found[-1].settings.items()]
    finding = _finding_of_improve(subject)
    said = (
        "Episodes are those of the log that the twin was fitted to, or those that were played in "
        "the simulator to compare. What was confirmed there holds for the plant as far as the "
        "twin or the simulator is like it."
    )
    parts = [say(finding.text), say(said), table(head, rows)]
    parts += [tag("h3", "Settings of the last improvement"), table(["setting", "value"], of_last)]
    return Part(title, join(parts), (finding,))


def _finding_of_improve(subject: Subject) -> Finding:
    """Return whether the policy is the one that `improve` accepted last."""
    now, state = subject.improved, subject.state
    if now is not None:
        place = f"{now.where} ({now.episodes} episodes, {100 * now.change:+.2f} %)"
        return Finding("passed", f"The policy is the one that improve accepted last, in {place}.")
    if not any(each.accepted for each in subject.improvements):
        return Finding("note", f"improve was at work. {subject.improvements[-1].reason}")
    if subject.policy.actor.mu.network.is_zero():
        return Finding("note", "The policy is the MPC again: what improve accepted is gone.")
    if state is not None and state.accepted.is_actor_of(subject.policy):
        return Finding("note", "The guard has accepted another policy after improve.")
    text = "The policy is NOT the one that improve accepted last: it was changed since."
    return Finding("failed", text)


def twin_part(subject: Subject) -> Part:
    """Return the twin's report and evidence."""
    twin, title = subject.twin, "The twin and its verdict"
    if twin is None:
        return Part(title, left_out("No twin was given: pass report(model, twin=...) to show it."))
    text = "The twin is trusted." if twin.trusted else "The twin is NOT trusted."
    caption = (
        "Left: costs of held-out episodes. Right: how the error of free runs grows with the steps "
        "that they look ahead."
    )
    drawn = picture(partial(twin_figure, twin.trust), caption)
    finding = Finding("passed" if twin.trusted else "failed", text)
    return Part(title, join([say(text), lines(twin.report()), drawn]), (finding,))


def headroom_part(subject: Subject) -> Part:
    """Return what there was to gain, and of which kind."""
    found, title = subject.headroom, "What there is to gain"
    if found is None:
        said = "No headroom was given: pass report(model, headroom=headroom(mpc, env)) to show it."
        return Part(title, left_out(said))
    caption = "The gain over the MPC part by part; the bar of the total has its standard error."
    drawn = picture(partial(headroom_figure, found), caption)
    finding = Finding("note", f"Headroom: {100 * found.total:.2f} % below the MPC's mean cost; "
                      f"the verdict is to {found.verdict}.")  # fmt: skip
    return Part(title, join([lines(found.report()), drawn]), (finding,))
