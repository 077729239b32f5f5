"""Bad input, a simulator or a training that does not fit: an error that names it, or a warning."""

import pickle
import re
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TransformObservation
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import (
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
)
from stable_baselines3.common.env_util import make_vec_env

from errors import told
from guard_samples import (
    FIRST,
    REGION,
    RIGHT,
    STEPS,
    At,
    Slide,
    actor_bits,
    better,
    build,
    correct,
    make_guard,
    train,
    tried,
    verdicts,
)
from sb3_yann import (
    CostAudit,
    CostMismatchWarning,
    ImprovementGuard,
    NoActionNoise,
    restore_accepted,
)
from sb3_yann.wrappers import SeededGlobals
from weights import is_mpc, last_layer

BAD: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"env": 3}, TypeError, "env = 3 must be a simulator of the plant: the id of an environment"),
    ({"n_eval_episodes": 0}, ValueError, "n_eval_episodes = 0 must be a whole number of at least"),
    ({"seed": -1}, ValueError, "seed = -1 must be a whole number of at least 0"),
    ({"n_new_starts": -1}, ValueError, "n_new_starts = -1 must be a whole number of at least 0"),
    ({"n_final_starts": -1}, ValueError, "n_final_starts = -1 must be a whole number of at least"),
    ({"eval_freq": 0}, ValueError, "eval_freq = 0 must be"),
    ({"patience": 0}, ValueError, "patience = 0 must be"),
    ({"keep_if_worse": 1}, TypeError, "keep_if_worse = 1 must be True or False"),
    ({"rule": {"margin": -0.1}}, ValueError, "margin = -0.1 must be"),
    ({"rule": 0.01}, TypeError, r"rule = 0.01 .*=AcceptanceRule\(\.\.\.\), or a m"),
    ({"rule": {"fresh": 3}}, TypeError, "rule has no 'fresh'. .* margin, cvar_alpha, by_region"),
    ({"step_size": {"shrink": 1.5}}, ValueError, "shrink = 1.5 must be between 0 and 1"),
    ({"step_size": {"grow": 0.9}}, ValueError, "grow = 0.9 must be a finite number of at least 1"),
    ({"log_path": "\ud800.csv"}, ValueError, "csv' can be no file of this computer .'utf-8' codec"),
    ({"save_path": "a\0"}, ValueError, "can be no file of this computer .embedded null"),
    ({"step_size": {"smallest": 2}}, ValueError, "smallest = 2 must be between 0 and 1"),
]


@pytest.mark.parametrize(("arguments", "error", "message"), BAD)
def test_a_bad_argument_is_named_with_its_value(arguments, error, message) -> None:
    with pytest.raises(error, match=message):
        ImprovementGuard(**{"env": Slide, **arguments})


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


def test_a_simulator_that_is_made_otherwise_than_the_training_env_is_told() -> None:
    gym.register("Slide-v7", Slide)
    try:
        with pytest.warns(UserWarning, match=r"Slide-v7 with .*None\}.* env has \{'low': -3.0\}"):
            train(build(env=gym.make("Slide-v7", low=-3.0)), STEPS, make_guard("Slide-v7"))
    finally:
        gym.registry.pop("Slide-v7")


def test_a_policy_without_an_mpc_is_refused_and_one_env_for_all_starts() -> None:
    env = Slide()
    with pytest.raises(ValueError, match="returned the same one twice"):
        train(build(), 4, make_guard(lambda: env))
    with pytest.raises(TypeError, match=r"needs a YannPolicy.*TD3Policy"):
        train(DDPG("MlpPolicy", Slide()), STEPS, make_guard())


NOISE = np.random.default_rng(0)


class Wobbly(Slide):
    """Costs that differ from episode to episode by so much, or from some seeds are no number."""

    def __init__(self, size: float = 0.0, lost: Any = (), number: float = np.inf) -> None:
        super().__init__()
        self.size = size
        self.lost = lost
        self.number = number

    def reset(self, *, seed=None, options=None):
        self.bad = seed in self.lost
        return super().reset(seed=seed, options=options)

    def step(self, action):
        seen, reward, *rest = super().step(action)
        reward *= 1 + self.size * NOISE.uniform(-1, 1)
        return seen, self.number if self.bad else reward, *rest


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
        begun(partial(Wobbly, lost=[1_000_003]))


def test_an_env_that_draws_from_the_global_generator_is_named() -> None:
    class Unseeded(Slide):
        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed, options=options)
            self.x = np.random.uniform(-4, 4, 1)  # noqa: NPY002
            return self.x.astype(np.float32), {}

    with pytest.raises(ValueError, match=r"played two episodes .*SeededGlobals"):
        begun(Unseeded)
    begun(lambda: SeededGlobals(Unseeded()))


def test_a_fault_while_the_first_episodes_are_played_leaves_the_next_learn_a_clean_start() -> None:
    class Busy(Slide):
        calls = 0

        def reset(self, *, seed=None, options=None):
            if seed is not None and seed >= FIRST:
                Busy.calls += 1
                if Busy.calls == 11:  # while the MPC is in the policy's place
                    raise OSError("licence server busy")
            return super().reset(seed=seed, options=options)

    model = build(gradient_steps=0)
    better(model.policy)
    before = actor_bits(model.policy)
    with pytest.raises(OSError, match="busy"):
        train(model, STEPS, make_guard(Busy))
    assert actor_bits(model.policy) == before
    train(model, STEPS, guard := make_guard(Busy))
    assert len(guard.state.evidence.starts.seeds) == 10
    assert actor_bits(model.policy) == before


def test_new_starts_where_the_mpc_s_cost_is_no_number_are_left_out() -> None:
    faulty = partial(Wobbly, lost=range(FIRST + 11, FIRST + 1000, 3), number=np.nan)
    _, guard = tried(better, env=faulty, n_new_starts=5)
    assert verdicts(guard) == ["accepted"]


def test_another_simulator_of_the_same_name_begins_afresh_and_says_so() -> None:
    def simulator(cost: float):
        class Plant(Slide):
            def step(self, action):
                observation, reward, *rest = super().step(action)
                return observation, reward * cost, *rest

        return lambda: Plant()

    model = build(gradient_steps=0)
    train(model, STEPS, At([1], better), first := make_guard(simulator(1.0)))
    costs = first.state.evidence.scores.costs
    train(model, STEPS, make_guard(simulator(1.0)))  # a warning would be an error
    with pytest.warns(UserWarning, match="it is another simulator of that name"):
        train(model, STEPS, second := make_guard(simulator(1.1)))
    np.testing.assert_allclose(second.state.evidence.scores.costs, 1.1 * costs)
    assert second.state.settings == first.settings.of_evidence


@pytest.mark.parametrize("together", [lambda a, b: [a, b], lambda a, b: [CallbackList([a]), b]])
def test_two_guards_at_once_are_refused(together) -> None:
    guards = together(make_guard(), make_guard())
    model = build()
    with pytest.raises(ValueError, match="2 guards were passed to learn, expected is one"):
        train(model, STEPS, *guards)
    train(model, STEPS, guards[1])


def test_candidates_that_are_rarer_than_episodes_are_named_before_the_first_step() -> None:
    env = gym.wrappers.TimeLimit(Slide(), STEPS)
    with pytest.warns(UserWarning, match="eval_freq = 3 counts .* 8 steps are 2 of them, of 4"):
        train(build(env=env), 2 * STEPS, make_guard(eval_freq=3))
    train(build(env=env), 2 * STEPS, make_guard(eval_freq=2))  # a warning would be an error
    train(build(), 2, make_guard(eval_freq=2))  # of episodes of any length nothing is known


def test_rl_zoo_is_told_of_a_guard_that_it_would_not_end_after_ctrl_c() -> None:
    zoo = {"__name__": "rl_zoo3.exp_manager"}
    with pytest.warns(UserWarning, match="number 2 of the hyperparameters' callbacks.*guard first"):
        eval("act()", {**zoo, "act": lambda: train(build(), 2, make_guard())})
    callbacks = [make_guard(), NoActionNoise()]  # a warning would be an error
    eval("act()", {**zoo, "act": lambda: build().learn(2, callback=callbacks)})


@pytest.mark.parametrize(("kind", "deep"), [("every", False), ("every", True), ("eval", False)])
def test_a_guard_within_an_event_callback_is_refused(deep, kind) -> None:
    inner = CallbackList([CallbackList([make_guard()])]) if deep else make_guard()
    outer = EveryNTimesteps(STEPS, inner)
    if kind == "eval":
        outer = EvalCallback(Slide(), callback_on_new_best=inner)
    with pytest.raises(ValueError, match=r"within a callback of the class E.* Pass the guard to"):
        train(build(), STEPS, outer)


def test_with_other_settings_the_accepted_policy_the_hard_starts_and_the_count_are_kept() -> None:
    class LostLater(Slide):
        """From new starts on, a strong correction on the right loses."""

        def reset(self, *, seed=None, options=None):
            seen.append(seed)
            self.new = seed is not None and seed >= FIRST + 10
            return super().reset(seed=seed, options=options)

        def step(self, action):
            strong = self.new and self.x[0] > 1.9 and float(action[0]) > -0.65
            observation, reward, *rest = super().step(action)
            return observation, reward - (1.0 if strong else 0.0), *rest

    seen: list[int] = []
    model = build(gradient_steps=0)
    values = iter([0.3, 0.5])
    moves = At([1, STEPS + 1], lambda policy: correct(policy, RIGHT, next(values)))
    train(model, 2 * STEPS, moves, first := make_guard(LostLater, n_new_starts=10))
    hard = set(first.state.evidence.starts.seeds) - set(range(FIRST, FIRST + 10))
    assert hard
    used = first.state.evidence.next_seed
    correct(model.policy, RIGHT, 1.9)  # what the model has got when the next learn begins
    seen.clear()
    second = make_guard(LostLater, n_new_starts=10, n_eval_episodes=4)
    with pytest.warns(UserWarning, match=r"had learnt is refused by .* one with that guard's sett"):
        train(model, STEPS, second)
    assert set(second.state.evidence.starts.seeds) >= hard | set(range(FIRST, FIRST + 4))
    right = last_layer(model)[REGION[RIGHT], 0, -1]
    assert float(right.detach()) == pytest.approx(0.3)
    new = {seed for seed in seen if seed is not None} - set(second.state.evidence.starts.seeds)
    assert new and min(new) >= used


def _halved() -> gym.Env:
    return gym.wrappers.TransformReward(gym.make("CSTR-v0"), lambda reward: reward / 2)


def test_a_guard_names_a_reward_that_is_not_the_cost_once_and_a_passed_audit_alone() -> None:
    model = DDPG("YannPolicy", _halved(), seed=0, device="cpu", batch_size=2)
    guard = ImprovementGuard(_halved, n_eval_episodes=2, n_new_starts=0)
    for callbacks, count in (([guard], 1), ([guard], 0), ([guard, CostAudit()], 1)):
        learn = partial(model.learn, 110, callback=[NoActionNoise(), *callbacks])
        found = told(learn, CostMismatchWarning)
        assert len(found) == count
        assert all("0.5 times minus the cost" in each for each in found)


class Door(gym.Env):
    """x runs away; the env ends the episode beyond 3, whatever the MPC does there."""

    def __init__(self, success: bool = False, cuts: bool = False) -> None:
        self.success = success
        self.cuts = cuts
        self.observation_space = gym.spaces.Box(-5, 5, (1,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(1.7, 1.8, 1)
        self.t = 0
        return self.x.astype(np.float32), {}

    def step(self, action):
        self.x = 1.3 * self.x + 0.1 * float(np.asarray(action)[0])
        self.t += 1
        out = bool(abs(self.x[0]) > 3)
        trips = out and not self.success and not self.cuts
        info = {"violation": trips, "is_success": out and self.success}
        cost = float(self.x[0] ** 2)
        return self.x.astype(np.float32), -cost, out and not self.cuts, out and self.cuts, info


@pytest.mark.filterwarnings("ignore:.* moves the env otherwise")  # a tenth as far
@pytest.mark.parametrize(
    ("success", "cuts"),
    [(False, False), (False, True), (True, False), (True, True)],
    ids=["a trip", "cut off", "a goal", "cut off at a goal"],
)
def test_an_episode_that_ends_sooner_is_refused_unless_its_end_is_a_success(success, cuts) -> None:
    """All episodes end under the MPC too; without its input they end a step sooner, and cheaper."""
    model = build(learning_rate=0.0, env=Door(success, cuts))
    guard = make_guard(partial(Door, success, cuts), n_new_starts=0, n_final_starts=0)
    # The MPC's input is -1 right of 1.4: plus 2 it is 1.
    train(model, 8, At([2], partial(correct, region=RIGHT, value=2.0)), guard)
    first = guard.decisions[0]
    assert first.candidate_cost < first.mpc_cost
    assert first.verdict == ("accepted" if success else "rejected")
    told = "or that ends sooner" in first.reason and "is_success" in first.reason
    assert success or (told and is_mpc(model))


class Endless(Slide):
    def step(self, action):
        observation, reward, *_ = super().step(action)
        return observation, reward, False, False, {}


def test_envs_are_made_for_the_first_trial_kept_for_the_others_and_closed_at_the_end() -> None:
    counts = {"made": 0, "closed": 0}

    class Counted(Slide):
        def __init__(self) -> None:
            counts["made"] += 1
            super().__init__()

        def close(self) -> None:
            counts["closed"] += 1

    guard = make_guard(Counted, n_new_starts=0)
    train(build(), 12, At([2], better), guard)
    trials = len(guard.decisions)
    assert trials > 1
    # One more, whose spaces are looked at before.
    assert counts["made"] == counts["closed"] <= len(guard.state.evidence.starts.seeds) + 1


def test_an_episode_that_is_long_is_told_before_memory_is_full(monkeypatch) -> None:
    monkeypatch.setattr("sb3_yann.rollout.LONG_EPISODE", 20)
    monkeypatch.setattr("sb3_yann.rollout.MAX_EPISODE_STEPS", 50)
    with (
        pytest.warns(UserWarning, match=r"not ended after 20 steps, all of which .*TimeLimit"),
        pytest.raises(RuntimeError, match="has not ended after 50 steps"),
    ):
        train(build(), 4, make_guard(Endless))


@pytest.mark.parametrize("n_envs", [1, 2])
def test_a_training_env_that_never_ends_is_reported(n_envs, monkeypatch) -> None:
    monkeypatch.setattr("sb3_yann.guard.callback.LONG_EPISODE", 20)
    endless = build(env=make_vec_env(Endless, n_envs))
    found = told(lambda: train(endless, 30 * n_envs, NoActionNoise(), make_guard()))
    (message,) = (each for each in found if "has not ended" in each)
    assert re.search(r"training env has not ended after 20 .*TimeLimit", message)


def test_the_accepted_policy_can_be_had_from_a_checkpoint(tmp_path) -> None:
    model = build(learning_rate=0.0)
    guard = make_guard(eval_freq=100)
    train(model, 6, At([5], better), guard, CheckpointCallback(5, str(tmp_path), "run"))
    copied = pickle.loads(pickle.dumps(guard))
    assert copied.summary() == guard.summary()
    train(copied.model, 6, copied)
    loaded = DDPG.load(tmp_path / "run_5_steps", device="cpu")
    assert not is_mpc(loaded)
    restore_accepted(loaded)
    assert is_mpc(loaded)
    with pytest.raises(ValueError, match="No ImprovementGuard has been at work on this DDPG"):
        restore_accepted(build())
