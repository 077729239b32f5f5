"""What a report is about, and what a part of it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC, PiecewiseAffine
from sb3_yann.control.linearization.wrapper_stack import require_state_shown
from sb3_yann.control.mpc.bound_excess import excess_of_episodes
from sb3_yann.control.online import Law
from sb3_yann.guard import ImprovementGuard
from sb3_yann.guard.state import GuardState
from sb3_yann.improvement import Headroom
from sb3_yann.improvement.improving import Improvement, fingerprint
from sb3_yann.policy.observations import normalized
from sb3_yann.policy.policies import StartsAsMPC
from sb3_yann.reporting.html import Html, tag
from sb3_yann.rollout import Controller, Source, Trajectories, name_of, one_env, rollout
from sb3_yann.twin import PlantTwin

POLICY, MPC = "policy", "MPC"


@dataclass(frozen=True)
class Finding:
    """One line of the summary: a verdict, and a text.

    The verdict is "passed", "failed", "look" where a person has to decide, or "note".
    """

    verdict: str
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


def left_out(title: str, why: str, *findings: Finding) -> Part:
    """Return a part that says in a sentence why it is not there."""
    return Part(title, tag("p", why, class_="said"), findings)


def _as_controller(act: Callable[[Any], Any]) -> Controller:
    return lambda t, observations, rows: act(observations)


@dataclass
class Subject:
    """What a report is about.

    Attributes
    ----------
    model, policy : BaseAlgorithm and YannPolicy
    env : gymnasium.Env, str, callable or None
    guard : ImprovementGuard or None
    twin : PlantTwin or None
    headroom : Headroom or None
    seeds : tuple of int
    """

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

    @cached_property
    def loops(self) -> dict[str, Trajectories] | None:
        """The closed loops of MPC and policy: theta and inputs in deviations; None without env."""
        if self.env is None:
            return None
        with one_env(self.env) as env:
            require_state_shown(env, self.policy.observation_given)
        found = {}
        for name, act in {MPC: self.act_as_mpc, POLICY: self.act_as_policy}.items():
            played = rollout(_as_controller(act), self.env, self.seeds)
            found[name] = replace(
                played,
                observations=tuple(map(self._theta, played.observations)),
                actions=tuple(map(self.policy.inputs, played.actions)),
            )
            excess = excess_of_episodes(self.problem, found[name].pairs)
            found[name] = replace(found[name], excess=excess)
        return found

    @property
    def shown_loops(self) -> dict[str, Trajectories]:
        """The same loops in plant units."""
        units = self.problem.units
        return {
            name: replace(
                each,
                observations=tuple(map(units.to_plant, each.observations)),
                actions=tuple(map(units.input_to_plant, each.actions)),
            )
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
        rng, bounds = np.random.default_rng(0), self.problem.deviations
        middle = (bounds.theta_min + bounds.theta_max) / 2
        half = (bounds.theta_max - bounds.theta_min) / 2
        middle, half = np.where(np.isfinite(half), [middle, half], [[0.0], [1.0]])
        return np.asarray(middle + half * rng.uniform(-1, 1, (500, len(half))))

    @cached_property
    def steepest_plane(self) -> tuple[int, int]:
        """The two entries of theta that move the inputs most at the operating point."""
        problem = self.problem
        gain = self.law.gain(problem.theta_rest)
        size = np.abs(gain * problem.theta_half / problem.u_half[:, None]).max(axis=0)
        first, second = np.sort(np.argsort(-size, kind="stable")[:2])
        return int(first), int(second)
