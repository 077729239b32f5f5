"""What was made, how it was checked, and what came of it: one page for an engineer to sign."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from datetime import datetime, timezone
from os import PathLike
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_yann._archive import atomic_write
from sb3_yann._validation import check_type
from sb3_yann.env_pool import Source
from sb3_yann.guard import ImprovementGuard
from sb3_yann.improvement import Headroom
from sb3_yann.policy.policies import require_problem_of_twin, require_yann_policy
from sb3_yann.reporting import evidence_parts as evidence
from sb3_yann.reporting import problem_parts as problem
from sb3_yann.reporting.subject import (
    Finding,
    Html,
    Part,
    Subject,
    clean,
    page,
    paragraph,
    table,
    tag,
)
from sb3_yann.rollout import as_seeds
from sb3_yann.twin import PlantTwin

__all__ = ["report"]

TITLE = "Report on a policy that starts as an MPC"
PARTS = (
    problem.plant_part, problem.constraints_part, problem.law_part, evidence.loops_part,
    evidence.statistics_part, evidence.distance_part, evidence.guard_part, evidence.improve_part,
    evidence.commissioning_part, evidence.twin_part, evidence.headroom_part, evidence.again_part,
)  # fmt: skip


def report(
    model: BaseAlgorithm,
    path: str | PathLike[str] = "report.html",
    *,
    env: Source | None = None,
    guard: ImprovementGuard | None = None,
    twin: PlantTwin | None = None,
    headroom: Headroom | None = None,
    seeds: Iterable[int] = range(20),
    title: str = TITLE,
) -> Path:
    """Write a page about a model that an engineer can read, print and sign; return its path.

    It is one HTML file without scripts, and loads nothing: pictures are part of it. It has the
    plant and the problem in plant units, the register of constraints, the law and how it was
    checked, closed loops against the MPC, what they prove, where and how far the policy leaves the
    MPC, every decision of the guard, what `improve` and a commissioning did, the twin, the
    headroom, versions and seeds. A part without evidence is left out.

    Parameters
    ----------
    model : DDPG, TD3, SAC, TQC or PPO
        With a :class:`YannPolicy`. The decisions of its guard travel with it.
    path : path-like, default "report.html"
        Folders are made as needed. The file is there as a whole or not at all.
    env : gymnasium.Env, str or callable, optional
        Where closed loops are played, as of :func:`~sb3_yann.evaluation.evaluate`; by default the
        guard's simulator, if a guard is given, or the twin.
    guard : ImprovementGuard, optional
        The one that watched `learn`; it adds its settings to the decisions.
    twin : PlantTwin, optional
        Of the model's problem.
    headroom : Headroom, optional
        As :func:`headroom` has found it.
    seeds : iterable of int, default range(20)
        Of the closed loops, best ones that nothing was trained or tried on.
    title : str, optional
        The heading.

    Raises
    ------
    TypeError, ValueError
        If an argument is of another kind, or belongs to another model or problem.
    OSError
        If the file cannot be written: before anything is played.

    Examples
    --------
    >>> from stable_baselines3 import DDPG
    >>> from sb3_yann import report
    >>> model = DDPG("YannPolicy", "CSTR-v0", device="cpu")
    >>> report(model, "cstr.html", env="CSTR-v0", seeds=range(2)).name
    'cstr.html'
    """
    subject = _subject(model, env, guard, twin, headroom, seeds)
    target = Path(path)
    if target.suffix.lower() in (".pdf", ".docx", ".png", ".svg"):
        raise ValueError(f"path = {str(target)!r}: the page is HTML, name it .html; print it then.")
    with ExitStack() as stack:
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            unfinished = stack.enter_context(atomic_write(target))
            unfinished.touch()
        except OSError as error:
            raise OSError(
                f"path = {str(target)!r} cannot be written ({error}). Name a file in a folder that "
                "you may write to."
            ) from error
        parts = [make(subject) for make in PARTS]
        unfinished.write_text(page(title, _body(title, parts)), encoding="utf-8")
    return target


def _subject(
    model: BaseAlgorithm,
    env: Source | None,
    guard: ImprovementGuard | None,
    twin: PlantTwin | None,
    headroom: Headroom | None,
    seeds: Iterable[int],
) -> Subject:
    check_type("model", model, BaseAlgorithm, "an SB3 model with a YannPolicy")
    policy = require_yann_policy(model.policy, "report")
    check_type("guard", guard, ImprovementGuard | None, "an ImprovementGuard, or None")
    check_type("twin", twin, PlantTwin | None, "a PlantTwin, or None")
    check_type("headroom", headroom, Headroom | None, "a Headroom, or None")
    if guard is not None and getattr(guard, "model", None) is not model:
        raise ValueError(
            "The guard has not watched this model: pass the one that was its callback in learn, or "
            "none. The decisions travel with the model."
        )
    if twin is not None:
        require_problem_of_twin(policy, twin.problem)
    chosen = tuple(as_seeds(seeds))
    if not chosen:
        raise ValueError("seeds is empty: pass one whole number for each episode, e.g. range(20).")
    played = guard.env if env is None and guard is not None else env
    if played is None and twin is not None and twin.trusted:
        played = twin.env()
    return Subject(model, policy, played, guard, twin, headroom, chosen)


def _body(title: str, parts: Sequence[Part]) -> list[Html]:
    """Return heading, summary, contents, the parts themselves, and a table for signatures."""
    written = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    findings = list[tuple[Finding, Html | str]]()
    links = []
    sections = list[Html]()
    for part in parts:
        k = len(sections) + 1
        place: Html | str = ""
        if part.content:
            place = tag("a", str(k), href=f"#part-{k}")
            links.append(tag("li", tag("a", part.title, href=f"#part-{k}")))
            heading = tag("h2", f"{k}. {part.title}", id=f"part-{k}")
            sections.append(tag("section", heading, part.content))
        findings += [(found, place) for found in part.findings]
    counts = Counter(found.verdict for found, _ in findings)
    findings.sort(key=lambda each: each[0].verdict not in ("failed", "look"))  # these come first
    rows = [
        [tag("span", found.verdict, class_=found.verdict), found.text, place]
        for found, place in findings
    ]
    summary = f"{counts['passed']} checks passed, {counts['failed']} failed."
    if counts["look"]:
        summary += f" {counts['look']} to look at: a person decides."
    if counts["failed"]:
        summary += " Read what failed before you sign."
    signatures = [[clean(role), "", "", ""] for role in ("prepared", "checked", "approved")]
    return [
        tag("h1", title),
        tag("p", f"Written {written}.", class_="said"),
        tag("h2", "Summary"),
        paragraph(summary, "A note is for information: there is nothing to pass."),
        table(["", "finding", "part"], rows),
        tag("nav", tag("ol", *links)),
        *sections,
        tag("h2", "Signatures"),
        tag("div", table(["", "name", "date", "signature"], signatures), class_="sign"),
    ]
