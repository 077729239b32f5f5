"""What a report is about, and what a part of it is."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._validation import Array
from sb3_yann.audit import Headroom
from sb3_yann.commissioning.improve import Improvement, fingerprint
from sb3_yann.control import LinearMPC, PiecewiseAffine
from sb3_yann.control.linearization.wrapper_stack import require_state_shown
from sb3_yann.control.mpc.choice import Law
from sb3_yann.evaluation.episodes import Episodes, Predictor, Source, evaluate, one_env
from sb3_yann.guard import ImprovementGuard
from sb3_yann.guard.simulator_acceptance import name_of
from sb3_yann.guard.state import GuardState
from sb3_yann.policy.policies import YannPolicy
from sb3_yann.reporting.html import Html
from sb3_yann.twin import PlantTwin

POLICY, MPC = "policy", "MPC"


@dataclass(frozen=True)
class Finding:
    """One line of the summary.

    Attributes
    ----------
    verdict : str
        "passed", "failed", or "note" where there is nothing to pass.
    text : str
    """

    verdict: str
    text: str


@dataclass(frozen=True)
class Part:
    """A part of the report.

    Attributes
    ----------
    title : str
    content : Html
    findings : tuple of Finding
        What the summary says of it.
    """

    title: str
    content: Html
    findings: tuple[Finding, ...] = ()


class _Mpc:
    """The MPC's own law behind the maps of a policy from observations and to actions."""

    def __init__(self, subject: Subject) -> None:
        self.subject = subject

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, None]:
        """Return the actions of the MPC."""
        subject = self.subject
        theta = subject.thetas(observation)
        u = subject.law(np.nan_to_num(theta, nan=0.0, posinf=0.0, neginf=0.0))  # as the policy does
        return subject.policy.input_units.action(u).astype(subject.policy.action_space.dtype), None


class _Policy:
    """A model's policy on observations as the env shows them."""

    def __init__(self, subject: Subject) -> None:
        self.subject = subject

    def predict(self, observation: Any, *, deterministic: bool) -> tuple[Any, Any]:
        """Return the actions of the policy."""
        seen = self.subject.seen(observation)
        return self.subject.model.predict(seen, deterministic=True)


@dataclass
class Subject:
    """What a report is about.

    Attributes
    ----------
    model, policy : OffPolicyAlgorithm and YannPolicy
    env : gymnasium.Env, str, callable or None
    guard : ImprovementGuard or None
    twin : PlantTwin or None
    headroom : Headroom or None
    seeds : tuple of int
    call : dict
        Arguments of `report` that were given, by their names, in their order.
    points : int
        Drawn at random from the box of theta.
    """

    model: OffPolicyAlgorithm
    policy: YannPolicy
    env: Source | None
    guard: ImprovementGuard | None
    twin: PlantTwin | None
    headroom: Headroom | None
    seeds: tuple[int, ...]
    call: dict[str, Any] = field(default_factory=dict)
    points: int = field(default=500)

    @property
    def problem(self) -> LinearMPC:
        """The policy's."""
        return self.policy.problem

    @cached_property
    def law(self) -> Law:
        """The MPC's law, as the policy was built with."""
        return self.problem.law(self.policy.law)

    @property
    def has_regions(self) -> bool:
        """Whether the law is explicit."""
        return isinstance(self.law, PiecewiseAffine)

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
        now = fingerprint(self.policy.actor.state_dict())
        return accepted[-1] if accepted and accepted[-1].policy == now else None

    @property
    def env_name(self) -> str:
        """A name of the simulator."""
        function = self.env.func if isinstance(self.env, partial) else self.env  # without arguments
        return "" if function is None else name_of(function)

    def seen(self, observations: Any) -> Any:
        """Return observations of the env, below any VecNormalize, as the policy sees them."""
        normalize = self.model.get_vec_normalize_env()
        return observations if normalize is None else normalize.normalize_obs(observations)

    def thetas(self, observations: Any) -> Array:
        """Return theta (batch, n_theta) for observations of the env."""
        theta = self.policy.theta(self.seen(np.asarray(observations)))
        return np.asarray(theta.double().cpu().numpy())

    @cached_property
    def loops(self) -> dict[str, Episodes] | None:
        """The closed loops of MPC and policy: theta and inputs in deviations; None without env."""
        if self.env is None:
            return None
        both: dict[str, Predictor] = {MPC: _Mpc(self), POLICY: _Policy(self)}
        with one_env(self.env) as env:
            require_state_shown(env, self.policy.told)
        return {
            name: self._in_deviations(evaluate(act, self.env, self.seeds))
            for name, act in both.items()
        }

    def _in_deviations(self, episodes: Episodes) -> Episodes:
        return replace(
            episodes,
            observations=tuple(self.thetas(each) for each in episodes.observations),
            actions=tuple(self.policy.inputs(each) for each in episodes.actions),
        )

    @cached_property
    def sampled(self) -> Array:
        """Points drawn uniformly from the box of theta (points, n_theta), with a seed of 0."""
        rng, problem = np.random.default_rng(0), self.problem
        low, high = problem.deviations.theta_min, problem.deviations.theta_max
        middle, half = (low + high) / 2, (high - low) / 2
        bounded = np.isfinite(half)
        middle, half = np.where(bounded, middle, 0.0), np.where(bounded, half, 1.0)
        return np.asarray(middle + half * rng.uniform(-1, 1, (self.points, problem.n_theta)))
