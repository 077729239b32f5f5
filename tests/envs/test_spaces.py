"""A ProblemBox is a Box that hands its problem to whoever asks, wherever it has traveled."""

import copy
import functools
import pickle
import sys
import types
from typing import Any

import cloudpickle
import gymnasium
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit

from sb3_yann_envs import ActionRepeat, ProblemBox

MODULE = "problem_box_targets"


class Problem:
    """A stand-in that can be pickled and compared."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self) -> None:
        raise AssertionError("an object that happens to be callable is not a factory")


@pytest.fixture(autouse=True)
def targets(monkeypatch: pytest.MonkeyPatch) -> Any:
    module: Any = types.ModuleType(MODULE)
    module.calls = 0

    def factory() -> Problem:
        module.calls += 1
        return Problem("made")

    module.factory = factory
    module.cached_factory = functools.cache(factory)
    monkeypatch.setitem(sys.modules, MODULE, module)
    return module


def box(problem: object) -> ProblemBox:
    return ProblemBox(-1.0, 1.0, (2,), problem=problem)


@pytest.mark.parametrize("name", ["factory", "cached_factory"])
def test_a_reference_to_a_factory_is_called_once_and_not_before_it_is_needed(
    name: str, targets: Any
) -> None:
    space = box(f"{MODULE}:{name}")
    assert targets.calls == 0
    assert space.problem is space.problem
    assert targets.calls == 1
    problem = Problem("given")
    assert box(problem).problem is problem


@pytest.mark.parametrize(
    "travel",
    [
        copy.deepcopy,
        lambda space: pickle.loads(pickle.dumps(space)),
        lambda space: cloudpickle.loads(cloudpickle.dumps(space)),
    ],
)
def test_a_space_travels_with_its_bounds_and_its_problem_or_the_reference_to_it(
    travel: Any, targets: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    space = box(f"{MODULE}:factory")
    arrived = travel(space)
    assert type(arrived) is ProblemBox and arrived == space and arrived.dtype == np.float32
    assert targets.calls == 0 and arrived.problem.name == "made"
    space.problem.name = "changed after it was made"  # type: ignore[attr-defined]
    monkeypatch.delattr(targets, "factory")
    assert travel(space).problem.name == "changed after it was made"


@pytest.mark.parametrize(
    "reference", ["", "module", "module:", ":name", "a b:c", "a:b:c", "a..b:c"]
)
def test_a_malformed_reference_is_refused_at_once(reference: str) -> None:
    with pytest.raises(ValueError, match="write 'module:attribute'"):
        box(reference)


@pytest.mark.parametrize(
    ("module", "missing"),
    [
        ("no_such_module", "no_such_module"),
        ("no_such_module.below", "no_such_module"),
        ("json.no_such_part", "json.no_such_part"),
    ],
)
def test_a_missing_module_is_named(module: str, missing: str) -> None:
    space = box(f"{module}:name")
    with pytest.raises(ValueError, match=f"'{module}:name': there is no module '{missing}'"):
        _ = space.problem


def test_a_dependency_missing_inside_the_module_is_reported_as_such(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "needs_something.py").write_text("import no_such_dependency\n")
    monkeypatch.syspath_prepend(tmp_path)
    space = box("needs_something:problem")
    with pytest.raises(ModuleNotFoundError, match="no_such_dependency"):
        _ = space.problem


IDS = {"CSTR-v0": 400, "ClippedPendulum-v0": 200}


def inputs(env, steps: int) -> np.ndarray:
    """Random inputs, a tenth beyond the bounds, so that some are clipped."""
    space = env.single_action_space
    shape = (steps, env.num_envs, 1)
    return np.random.default_rng(0).uniform(1.1 * space.low, 1.1 * space.high, shape)


@pytest.mark.parametrize("env_id", IDS)
def test_each_copy_is_the_single_environment(env_id) -> None:
    seeds = [3, 14, 15, 9]
    many = gymnasium.make_vec(env_id, num_envs=4)
    ones = [gymnasium.make(env_id) for _ in seeds]
    observation, info = many.reset(seed=seeds)
    firsts = [env.reset(seed=seed) for env, seed in zip(ones, seeds, strict=True)]
    np.testing.assert_array_equal(observation, [first[0] for first in firsts])
    np.testing.assert_array_equal(info["state"], [first[1]["state"] for first in firsts])
    for actions in inputs(many, 50):
        observation, reward, terminated, truncated, info = many.step(actions)
        steps = [env.step(u) for env, u in zip(ones, actions, strict=True)]
        single = [np.array(each) for each in zip(*(step[:4] for step in steps), strict=True)]
        np.testing.assert_allclose(observation, single[0], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(reward, single[1], rtol=1e-10)
        np.testing.assert_array_equal(terminated, single[2])
        np.testing.assert_array_equal(truncated, single[3])
        for name in ("cost", "violation", "state"):
            expected = [step[4][name] for step in steps]
            np.testing.assert_allclose(info[name], expected, rtol=1e-9, atol=1e-12)
            assert info[f"_{name}"].all()
        if terminated.any():
            break


def test_copies_far_from_the_random_starts_are_integrated_as_the_single_environment_is() -> None:
    starts = [[0, 0, 0, 0], [2, 2, 2, 0], [0.1, 2, 0, 3], [2, 0, 2, -30]]
    many = gymnasium.make_vec("CSTR-v0", num_envs=4)
    many.reset(options={"state": starts})
    *_, info = many.step(np.zeros((4, 1), np.float32))
    for start, state in zip(starts, info["state"], strict=True):
        one = gymnasium.make("CSTR-v0")
        one.reset(options={"state": start})
        expected = one.step(np.zeros(1, np.float32))[4]["state"]
        np.testing.assert_allclose(state, expected, rtol=1e-11, atol=1e-12)


def test_a_seed_of_numpy_is_a_seed() -> None:
    env = gymnasium.make_vec("CSTR-v0", num_envs=2)
    np.testing.assert_array_equal(env.reset(seed=np.int64(7))[0], env.reset(seed=7)[0])


@pytest.mark.parametrize("env_id", IDS)
def test_observations_are_in_the_space_and_the_time_limit_is_the_registered_one(env_id) -> None:
    env = gymnasium.make_vec(env_id, num_envs=3)
    observation, _ = env.reset(seed=0)
    assert observation in env.observation_space
    rest = np.zeros((3, 1), np.float32)
    for step in range(1, IDS[env_id] + 1):
        observation, _, terminated, truncated, _ = env.step(rest)
        assert observation in env.observation_space and not terminated.any()
        assert truncated.all() == (step == IDS[env_id])


def test_an_episode_that_is_over_starts_again_at_the_next_step() -> None:
    env = gymnasium.make_vec("CSTR-v0", num_envs=2)
    env.reset(seed=[0, 1], options={"state": [[0, 0, 0, 4.9], [0, 0, 0, -7.0]]})
    hot = np.array([[-55.0], [0.0]])
    for _ in range(40):
        last, reward, terminated, _, info = env.step(hot)
        if terminated[0]:
            break
    assert terminated.tolist() == info["violation"].tolist() == [True, False]
    assert reward[0] < -1e5 < reward[1]
    after, reward, terminated, truncated, _ = env.step(hot)
    assert reward[0] == 0 and not terminated.any() and not truncated.any()
    fresh = gymnasium.make("CSTR-v0")
    fresh.reset(seed=0, options={"state": [0, 0, 0, 4.9]})
    np.testing.assert_array_equal(after[0], fresh.reset()[0])  # the next start of seed 0
    assert not np.array_equal(after[1], last[1]) and reward[1] != 0


def test_what_does_not_fit_is_refused() -> None:
    env = gymnasium.make_vec("CSTR-v0", num_envs=2)
    with pytest.raises(gymnasium.error.ResetNeeded, match="no episode has begun"):
        env.step(np.zeros((2, 1)))
    with pytest.raises(ValueError, match="seed has 3 entries for 2 episodes"):
        env.reset(seed=[1, 2, 3])
    with pytest.raises(ValueError, match=r"state.* has 1 entries for 2 episodes"):
        env.reset(options={"state": [[0, 0, 0, 0]]})
    with pytest.raises(ValueError, match=r"T deviation must be in"):
        env.reset(options={"state": [[0, 0, 0, 0], [0, 0, 0, 9]]})
    with pytest.raises(ValueError, match="unknown keys"):
        env.reset(options={"start": [[0, 0, 0, 0]] * 2})
    for either in (env, gymnasium.make("CSTR-v0")):
        with pytest.raises(ValueError, match=r"\['state'\] is None: leave it out"):
            either.reset(options={"state": None})
    env.reset(seed=0)
    for wrong in (np.zeros(2), np.full((2, 1), np.nan)):
        with pytest.raises(ValueError, match=r"actions must be numbers of shape \(2, 1\)"):
            env.step(wrong)


class Counter(gym.Env):
    """Counts its steps; the reward is minus their number, the third is a violation."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, last: int = 10**6) -> None:
        self.last = last

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        self.actions = []
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        self.actions.append(float(action[0]))
        info = {"violation": self.t == 3, "t": self.t}
        return np.full(1, self.t, np.float32), -float(self.t), self.t == self.last, False, info


def test_rewards_add_up_and_observation_and_info_are_the_last_ones() -> None:
    env = ActionRepeat(Counter(), 4)
    env.reset()
    observation, reward, terminated, truncated, info = env.step(np.array([0.5]))
    assert (observation[0], reward, terminated, truncated) == (4, -10, False, False)
    assert info == {"violation": True, "t": 4}
    assert env.unwrapped.actions == [0.5] * 4
    _, reward, *_, info = env.step(np.array([-1]))
    assert (reward, info) == (-26, {"violation": False, "t": 8})


def test_an_episode_ends_at_once() -> None:
    env = ActionRepeat(Counter(last=6), 4)
    env.reset()
    env.step(np.zeros(1))
    _, reward, terminated, truncated, info = env.step(np.zeros(1))
    assert (reward, terminated, truncated, info["t"]) == (-11, True, False, 6)


def test_a_time_limit_counts_steps_below_and_decisions_above() -> None:
    for env, steps in (
        (ActionRepeat(TimeLimit(Counter(), 6), 4), 6),
        (TimeLimit(ActionRepeat(Counter(), 4), 6), 24),
    ):
        env.reset()
        truncated = False
        while not truncated:
            *_, terminated, truncated, info = env.step(np.zeros(1))
            assert not terminated
        assert info["t"] == steps


def test_an_env_that_says_nothing_of_violations_still_says_nothing() -> None:
    env = ActionRepeat(gym.make("Pendulum-v1"), 2)
    env.reset(seed=0)
    assert "violation" not in env.step(np.zeros(1))[-1]


def test_gymnasium_makes_it_again_from_its_spec() -> None:
    spec = ActionRepeat(gym.make("Pendulum-v1"), 3).spec
    again = gym.make(spec)
    assert isinstance(again, ActionRepeat)
    assert again.k == 3


@pytest.mark.parametrize("k", [0, -1, 1.5, True, "2"])
def test_a_number_of_steps_that_is_none_is_named(k) -> None:
    with pytest.raises(ValueError, match="must be a whole number of steps"):
        ActionRepeat(Counter(), k)
