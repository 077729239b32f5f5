"""Bad input is an error that names what it was, before any training."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TransformObservation
from stable_baselines3 import DDPG

from guard_samples import LAW, STEPS, At, Slide, better, build, make_guard, train, verdicts
from sb3_yann import AcceptanceRule, ImprovementGuard, StepSize
from sb3_yann.evaluation import evaluate
from sb3_yann.guard.decide import GuardSettings
from sb3_yann.rollout import name_of

BAD: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"env": 3}, TypeError, "env = 3 must be a simulator of the plant: the id of an environment"),
    ({"env": None}, TypeError, "env = None .* On a plant without a simulator use Commissioning"),
    ({"env": ["CSTR-v0"]}, TypeError, r"env = \['CSTR-v0'\] must be"),
    (
        {"n_eval_episodes": 0},
        ValueError,
        "n_eval_episodes = 0 must be a whole number of at least 1",
    ),
    ({"n_eval_episodes": 2.5}, ValueError, "n_eval_episodes = 2.5 must be a whole number"),
    ({"n_eval_episodes": True}, ValueError, "n_eval_episodes = True must be a whole number"),
    ({"seed": -1}, ValueError, "seed = -1 must be a whole number of at least 0"),
    ({"n_new_starts": -1}, ValueError, "n_new_starts = -1 must be a whole number of at least 0"),
    ({"n_final_starts": -1}, ValueError, "n_final_starts = -1 must be a whole number of at least"),
    ({"n_final_starts": True}, ValueError, "n_final_starts = True must be a whole number"),
    ({"eval_freq": 0}, ValueError, "eval_freq = 0 must be"),
    ({"eval_freq": None}, ValueError, "eval_freq = None must be"),
    ({"patience": 0}, ValueError, "patience = 0 must be"),
    ({"keep_if_worse": 1}, TypeError, "keep_if_worse = 1 must be True or False"),
    ({"rule": {"margin": -0.1}}, ValueError, "margin = -0.1 must be"),
    ({"rule": {"margin": np.nan}}, ValueError, "margin = nan must be"),
    ({"rule": {"margin": "1 %"}}, TypeError, "margin = '1 %' must be a number"),
    ({"rule": {"significance": 0.6}}, ValueError, "significance = 0.6 must be between 0 and 0.5"),
    ({"rule": {"by_region": "no"}}, TypeError, "by_region = 'no' must be True or False"),
    ({"rule": 0.01}, TypeError, r"rule = 0.01 .*=AcceptanceRule\(\.\.\.\), or a m"),
    ({"rule": {"fresh": 3}}, TypeError, "rule has no 'fresh'. .* margin, cvar_alpha, by_region"),
    ({"rule": StepSize()}, TypeError, "rule = StepSize.* must be"),
    ({"step_size": {"shrink": 1.5}}, ValueError, "shrink = 1.5 must be between 0 and 1"),
    ({"step_size": {"grow": 0.9}}, ValueError, "grow = 0.9 must be a finite number of at least 1"),
    ({"step_size": {"grow": np.inf}}, ValueError, "grow = inf must be"),
    ({"step_size": {"smallest": 2}}, ValueError, "smallest = 2 must be between 0 and 1"),
]


@pytest.mark.parametrize(("arguments", "error", "message"), BAD)
def test_a_bad_argument_is_named_with_its_value(arguments, error, message) -> None:
    with pytest.raises(error, match=message):
        ImprovementGuard(**{"env": Slide, **arguments})


def test_options_are_the_same_from_a_mapping_as_yaml_has_it() -> None:
    one = ImprovementGuard(Slide, rule={"margin": 0.5}, step_size={"grow": 2.0})
    other = ImprovementGuard(Slide, rule=AcceptanceRule(margin=0.5), step_size=StepSize(grow=2.0))
    assert one.settings == other.settings
    assert one.step_size == other.step_size


@pytest.mark.parametrize("name", ["state", "decisions"])
def test_before_learn_the_guard_says_that_it_has_no_state_yet(name) -> None:
    with pytest.raises(RuntimeError, match="no state yet: pass it to learn"):
        getattr(make_guard(), name)


@pytest.mark.parametrize("how", ["itself", "wrapped", "by a function"])
def test_the_training_env_is_refused(how) -> None:
    env = Slide()
    wrapped = gym.wrappers.TimeLimit(env, STEPS)
    given = {"itself": env, "wrapped": wrapped, "by a function": lambda: env}[how]
    model = build(env=env)
    with pytest.raises(ValueError, match="the training env, whose episodes its own would"):
        train(model, STEPS, make_guard(given))


def two_observations() -> gym.Env:
    space = gym.spaces.Box(-5, 5, (2,), np.float32)
    return TransformObservation(Slide(), lambda x: np.repeat(x, 2), space)


def other_actions(low: float) -> gym.Env:
    env = Slide()
    env.action_space = gym.spaces.Box(low, 1, (1,), np.float32)
    return env


@pytest.mark.parametrize("env", [two_observations, partial(other_actions, -2)])
def test_a_simulator_of_another_shape_is_refused(env) -> None:
    with pytest.raises(ValueError, match="Give it a simulator of this plant"):
        train(build(), STEPS, make_guard(env))


def test_a_policy_without_an_mpc_is_refused() -> None:
    with pytest.raises(TypeError, match=r"needs a YannPolicy.*TD3Policy"):
        train(DDPG("MlpPolicy", Slide()), STEPS, make_guard())


def test_an_unknown_id_is_gymnasium_s_own_error() -> None:
    with pytest.raises(gym.error.NameNotFound, match="Sldie"):
        train(build(), STEPS, make_guard("Sldie-v0"))


def test_what_is_given_reaches_the_settings_and_what_is_not_has_its_default() -> None:
    rule = AcceptanceRule(margin=0.5)
    given = {"n_new_starts": 3, "n_final_starts": 2, "eval_freq": 6, "patience": 8}
    some = ImprovementGuard(
        "CSTR-v0", n_eval_episodes=7, seed=40, keep_if_worse=True, rule={"margin": 0.5}, **given
    ).settings
    assert some == GuardSettings("CSTR-v0", range(40, 47), **given, keep_if_worse=True, rule=rule)
    plain = ImprovementGuard(Slide).settings
    assert plain == GuardSettings(
        "Slide", range(1_000_000, 1_000_100), n_new_starts=50, n_final_starts=500, eval_freq=1,
        patience=5, keep_if_worse=False, rule=AcceptanceRule(),
    )  # fmt: skip
    assert ImprovementGuard(Slide, n_new_starts=4).settings.n_final_starts == 40


def test_a_simulator_may_be_named_by_its_module_as_in_a_yaml_file() -> None:
    model, guard = build(learning_rate=0.0), make_guard("guard_samples:Slide", n_new_starts=4)
    train(model, 8, At([2], better), guard)
    assert verdicts(guard)[0] == "accepted"
    assert guard.state.settings["env"] == "guard_samples:Slide"
    with pytest.raises(
        ValueError, match="'guard_samples' has no function 'Slid' that makes an env"
    ):
        make_guard("guard_samples:Slid")


def test_a_simulator_has_the_same_name_in_another_process() -> None:
    class Named(Slide):
        """An env of a test."""

    assert name_of("CSTR-v0") == "CSTR-v0"
    assert name_of(Slide()) == "Slide" and name_of(Slide) == "Slide"
    assert name_of(Named).endswith("<locals>.Named")
    assert name_of(gym.make("Slide-v0")) == "Slide-v0"
    assert name_of(gym.make("Slide-v0", low=1.0)) == "Slide-v0{'low': 1.0}"
    assert name_of(partial(Slide, low=2.0)) == "Slide(){'low': 2.0}"
    assert name_of(partial(partial(Slide), (0, 1))) == "Slide((0, 1),){}"
    assert "<lambda>" in name_of(lambda: Slide())


NOISE = np.random.default_rng(0)


class Wobbly(Slide):
    """Costs that differ from episode to episode by so much, or are not finite from a seed on."""

    def __init__(self, size: float = 0.0, lost: int | None = None) -> None:
        super().__init__()
        self.size, self.lost = size, lost

    def reset(self, *, seed=None, options=None):
        self.bad = self.lost is not None and seed is not None and seed >= self.lost
        return super().reset(seed=seed, options=options)

    def step(self, action):
        seen, reward, *rest = super().step(action)
        reward *= 1 + self.size * NOISE.uniform(-1, 1)
        return seen, np.inf if self.bad else reward, *rest


def begun(env: Any, **options: Any) -> ImprovementGuard:
    """Return a guard that has played its first episodes."""
    guard = make_guard(env, n_new_starts=0, **options)
    train(build(gradient_steps=0), 1, guard)
    return guard


def test_costs_of_the_mpc_that_differ_by_more_than_a_millionth_cannot_be_compared() -> None:
    begun(partial(Wobbly, 1e-7))
    with pytest.raises(ValueError, match=r"played two episodes .* from the seed 1000000, at costs"):
        begun(partial(Wobbly, 1e-4))
    with pytest.raises(ValueError, match=r"from the seed 1000003 costs -inf"):
        begun(partial(Wobbly, lost=1_000_003))


def test_starts_that_are_all_the_same_are_told_and_one_alone_is_not() -> None:
    same = partial(Slide, low=2.0, high=2.0)
    with pytest.warns(
        UserWarning, match="All 10 starts of the guard's env .* are one and the same"
    ):
        begun(same)
    begun(same, n_eval_episodes=1)


def test_how_far_an_input_may_move_is_a_multiple_of_the_mpc_s_max_input_step() -> None:
    guard = begun(Slide, rule={"max_input_step": 2.0})
    episodes = evaluate(LAW, Slide, range(1_000_000, 1_000_010))
    most = max(np.abs(np.diff(each, axis=0)).max() for each in episodes.actions)
    np.testing.assert_allclose(guard.state.max_input_step, [2 * most + 2e-6], rtol=1e-6)
    assert begun(Slide).state.max_input_step is None


def test_the_tolerance_is_a_share_of_the_mpc_s_median_cost() -> None:
    evidence = begun(Slide, rule=AcceptanceRule(margin=0.02, cvar_alpha=0.1)).state.evidence.starts
    typical = np.median(evidence.mpc.costs)
    found = evidence.tolerance
    assert (found.margin, found.cvar_alpha, found.typical) == (0.02 * typical, 0.1, typical)
    assert evidence.n_starts == 10 and evidence.seeds == (*range(1_000_000, 1_000_010),)
