"""What a report is about, what a part of it is, and the pieces of HTML that it is made of."""

from __future__ import annotations

import base64
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from html import escape
from importlib.resources import files
from io import BytesIO
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_yann._validation import Array, is_text
from sb3_yann.commissioning.commissioning import Commissioned
from sb3_yann.control import LinearMPC
from sb3_yann.control.mpc.bound_excess import costs_of, excess_of_episodes
from sb3_yann.control.online import Law
from sb3_yann.control.wrapper_stack import require_state_shown
from sb3_yann.env_pool import Source, name_of, one_env, require_like
from sb3_yann.guard import ImprovementGuard
from sb3_yann.guard.state import GuardState
from sb3_yann.improvement import Headroom
from sb3_yann.improvement.improving import Improvement
from sb3_yann.policy.checkpoint import fingerprint, is_confirmed
from sb3_yann.policy.observations import normalized
from sb3_yann.policy.policies import StartsAsMPC
from sb3_yann.rollout import Controller, Trajectories, rollout
from sb3_yann.twin import PlantTwin

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class Html(str):
    """Text that is HTML already."""


def clean(value: Any) -> Html:
    """Return a value as escaped HTML, unless it is that already; what is no text is replaced."""
    if isinstance(value, Html):
        return value
    return Html(escape("".join(c if c in "\n\t" or is_text(c) else "\ufffd" for c in str(value))))


def tag(name: str, *content: Any, **attributes: str) -> Html:
    """Return an element; ``class_`` is the attribute of that name."""
    own = "".join(f' {key.rstrip("_")}="{escape(each)}"' for key, each in attributes.items())
    return Html(f"<{name}{own}>{''.join(map(clean, content))}</{name}>")


def join(parts: Iterable[Any]) -> Html:
    """Return pieces one below the other."""
    return Html("\n".join(map(clean, parts)))


def paragraph(*sentences: str) -> Html:
    """Return a paragraph."""
    return tag("p", " ".join(sentences))


def lines(text: str) -> Html:
    """Return text with its lines and columns as they are."""
    return tag("pre", text)


def number(value: float) -> str:
    """Return a number in four digits; "none" for what is infinite."""
    return f"{value:.4g}" if np.isfinite(value) else "none"


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> Html:
    """Return a table that scrolls on a narrow screen; columns of numbers are set to the right."""
    body = [[*row] for row in rows]
    numeric = re.compile(r"\s*|[+−-]*\d.*|none")
    kinds: list[dict[str, str]] = [{} for _ in head]
    for k, kind in enumerate(kinds):
        if body and all(numeric.fullmatch(str(row[k])) for row in body):
            kind["class_"] = "number"
    lines = [
        tag("tr", *(tag(name, each, **kind) for each, kind in zip(row, kinds, strict=True)))
        for name, row in [("th", head), *(("td", row) for row in body)]
    ]
    return tag("div", tag("table", tag("thead", lines[0]), tag("tbody", *lines[1:])), class_="wide")


def picture(draw: Callable[[], Axes | Figure], caption: str) -> Html:
    """Return a picture with its caption; a name with a dollar sign is no formula.

    Letters that the font lacks become boxes, without a warning. A large SVG becomes a PNG.
    """
    import matplotlib

    options: Any = {"text.parse_math": False, "svg.hashsalt": "sb3-yann"}
    with matplotlib.rc_context(options), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font", UserWarning)
        drawn: Any = draw()
        figure = getattr(drawn, "figure", None) or drawn  # of Axes, else itself
        kind = "svg+xml"
        buffer = BytesIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
        if len(buffer.getvalue()) > 120_000:
            kind = "png"
            buffer = BytesIO()
            figure.savefig(buffer, format="png", dpi=110)
    source = f"data:image/{kind};base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
    shown = Html(f'<img alt="{escape(caption)}" src="{source}">')
    return tag("figure", tag("div", shown, class_="wide"), tag("figcaption", caption))


def page(title: str, body: Iterable[Any]) -> str:
    """Return the whole page."""
    template = (files("sb3_yann.reporting") / "page.html").read_text(encoding="ascii")
    return Template(template).substitute(title=clean(title), body=join(body))


OF_POLICY = "policy"
OF_MPC = "MPC"


@dataclass(frozen=True)
class Finding:
    """One line of the summary: a verdict, and a text."""

    verdict: str  # "passed", "failed", "look" where a person has to decide, or "note"
    text: str


def make_finding(passed: bool | None, text: str) -> Finding:
    """Return a finding that passed or failed; None is a note: there is nothing to pass."""
    return Finding("note" if passed is None else "passed" if passed else "failed", text)


@dataclass(frozen=True)
class Part:
    """A part of the report: its title, its content, and what the summary says of it."""

    title: str
    content: Html
    findings: tuple[Finding, ...] = ()


def part_of(title: str, content: Iterable[Any], *findings: Finding) -> Part:
    """Return a part of pieces one below the other."""
    return Part(title, join(content), findings)


NOT_SHOWN = part_of("", [])
"""A part without content, which is left out of the page."""


def is_rewarded(loops: Mapping[str, Trajectories]) -> bool:
    """Return whether an env gives any reward but zero: if none, the stage cost counts."""
    return any(each.any() for played in loops.values() for each in played.rewards)


def _as_controller(act: Callable[[Any], Any]) -> Controller:
    return lambda t, observations, rows: act(observations)


@dataclass
class Subject:
    """What a report is about."""

    model: BaseAlgorithm
    policy: StartsAsMPC
    env: Source | None
    guard: ImprovementGuard | None
    twin: PlantTwin | None
    headroom: Headroom | None
    seeds: tuple[int, ...]

    @property
    def problem(self) -> LinearMPC:
        """The policy's."""
        return self.policy.problem

    @cached_property
    def law(self) -> Law:
        """The MPC's law, as the policy was built with."""
        return self.problem.law(self.policy.law)

    @property
    def state(self) -> GuardState | None:
        """What a guard has left in the model."""
        state = getattr(self.model, "guard_state", None)
        return state if isinstance(state, GuardState) else None

    @property
    def improvements(self) -> tuple[Improvement, ...]:
        """What `improve` has left in the model."""
        found = getattr(self.model, "improvements", ())
        return tuple(each for each in found if isinstance(each, Improvement))

    @cached_property
    def improved(self) -> Improvement | None:
        """What made the policy that it is: the last improvement, if nothing changed it since."""
        accepted = [each for each in self.improvements if each.accepted]
        now = fingerprint(self.policy.actor)
        return accepted[-1] if accepted and accepted[-1].policy == now else None

    @property
    def commissioned(self) -> Commissioned | None:
        """What a commissioning has left in the model."""
        found = getattr(self.model, "commissioned", None)
        return found if isinstance(found, Commissioned) else None

    @cached_property
    def is_confirmed(self) -> bool:
        """Whether a guard, `improve` or a commissioning has accepted the policy as it is."""
        return is_confirmed(self.model)

    @cached_property
    def env_name(self) -> str:
        """A name of the simulator."""
        if self.env is None:
            return ""
        with one_env(self.env) as env:
            return name_of(env)

    @cached_property
    def loops(self) -> dict[str, Trajectories] | None:
        """The closed loops of MPC and policy: theta and inputs in deviations; None without env."""
        if self.env is None:
            return None
        with one_env(self.env) as env:
            require_like(env, self.policy, f"env = {name_of(env)}", "the model")
            require_state_shown(env, self.policy.observation_given)
        found = {}
        for name, act in {OF_MPC: self.act_as_mpc, OF_POLICY: self.act_as_policy}.items():
            played = rollout(_as_controller(act), self.env, self.seeds)
            played = played.mapped(self._theta, self.policy.inputs)
            found[name] = replace(played, excess=excess_of_episodes(self.problem, played.pairs))
        if not is_rewarded(found):
            for name, played in found.items():
                costs = [costs_of(self.problem, *pair)[0] for pair in played.pairs]
                found[name] = replace(played, costs=np.array(costs))
        return found

    @property
    def shown_loops(self) -> dict[str, Trajectories]:
        """The same loops in plant units."""
        units = self.problem.units
        return {
            name: each.mapped(units.to_plant, units.input_to_plant)
            for name, each in (self.loops or {}).items()
        }

    def act_as_mpc(self, observations: Any) -> Any:
        """Return the MPC's actions for observations of the env; what is not finite is at rest."""
        theta = np.nan_to_num(self._theta(observations), nan=0.0, posinf=0.0, neginf=0.0)
        action = self.policy.action_units.action(self.law(theta))
        return action.astype(self.policy.action_space.dtype)

    def act_as_policy(self, observations: Any) -> Any:
        """Return the policy's actions for observations of the env."""
        return self.model.predict(normalized(self.model, observations), deterministic=True)[0]

    def _theta(self, observations: Any) -> Array:
        theta = self.policy.theta(normalized(self.model, observations))
        return np.asarray(theta.double().cpu().numpy())

    @cached_property
    def samples(self) -> Array:
        """500 points drawn uniformly from the box of theta (500, n_theta), with a seed of 0."""
        rng = np.random.default_rng(0)
        bounds = self.problem.deviations
        middle = (bounds.theta_min + bounds.theta_max) / 2
        middle = np.where(np.isfinite(bounds.theta_max - bounds.theta_min), middle, 0.0)
        half = self.problem.theta_half
        return np.asarray(middle + half * rng.uniform(-1, 1, (500, len(half))))

    @cached_property
    def steepest_plane(self) -> tuple[int, int]:
        """The two entries of theta that move the inputs most at the operating point."""
        problem = self.problem
        gain = self.law.gain(problem.theta_rest)
        size = np.abs(gain * problem.theta_half / problem.u_half[:, None]).max(axis=0)
        first, second = np.sort(np.argsort(-size, kind="stable")[:2])
        return int(first), int(second)
