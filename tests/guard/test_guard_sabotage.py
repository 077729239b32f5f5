"""Whatever happens to the actor, what does not improve is taken back, bit for bit."""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TimeLimit, TransformReward
from stable_baselines3 import DDPG, TD3

from errors import told
from guard_samples import (
    LEFT,
    MPC,
    RIGHT,
    STEPS,
    At,
    Slide,
    accepted_bits,
    actor_bits,
    better,
    bits,
    blow_up,
    build,
    correct,
    make_guard,
    overwrite,
    randomize,
    train,
    verdicts,
    worse,
)
from sample_plants import Sampled
from sb3_yann import (
    ImprovementGuard,
    LinearModel,
    LinearMPC,
    NoActionNoise,
    OutputBounds,
    SoftBounds,
    StepSize,
    report,
)
from sb3_yann.evaluation import evaluate
from sb3_yann.wrappers import StageCost
from weights import first_layer, is_mpc, last_layer

SABOTAGE = {
    "worse": worse,
    "random": randomize,
    "all ones": partial(overwrite, value=1.0),
    "overflowing": blow_up,
    "nan": partial(overwrite, value=np.nan),
    "infinite": partial(overwrite, value=np.inf),
    "minus infinity": partial(overwrite, value=-np.inf),
}
STATES = np.linspace(-5, 5, 101, dtype=np.float32)[:, None]


@pytest.mark.parametrize(
    ("algorithm", "sabotage", "place"),
    [
        *((DDPG, each, "before the guard") for each in SABOTAGE.values()),
        (DDPG, randomize, "after the guard"),
        (TD3, blow_up, "before the guard"),
        (TD3, worse, "after the guard"),
    ],
)
def test_a_sabotaged_actor_is_rejected_and_restored_bit_for_bit(algorithm, sabotage, place) -> None:
    # Without learning: what is not the accepted policy's is the sabotage's.
    model = build(algorithm, gradient_steps=0)
    guard = make_guard()
    step = 3 * STEPS if place == "before the guard" else 4 * STEPS  # the last one of all
    good = At([STEPS], better)
    bad = At([step], sabotage)
    callbacks = [good, bad, guard] if place == "before the guard" else [good, guard, bad]
    seen: list[object] = []
    train(
        model,
        4 * STEPS,
        *callbacks,
        At([step - 1, 4 * STEPS], lambda p: seen.append(bits(p.actor.state_dict()))),
    )
    assert verdicts(guard) == ["accepted", "rejected"]
    assert guard.decisions[1].restored
    assert actor_bits(model.policy) == accepted_bits(guard)
    assert bits(model.policy.actor.state_dict()) == seen[0]


@pytest.mark.parametrize(("algorithm", "sabotage"), [(DDPG, worse), (TD3, randomize)])
def test_amid_learning_actor_target_and_moments_return_to_those_last_accepted(
    algorithm, sabotage
) -> None:
    model = build(algorithm)
    guard = make_guard(rule={"by_region": False})
    kept: dict[int, object] = {}
    compared: list[bool] = []

    def spoil(policy) -> None:
        kept[0] = accepted_bits(guard)
        sabotage(policy)
        policy.actor.optimizer.state_dict()["state"][0]["exp_avg"].fill_(7.0)
        policy.actor_target.load_state_dict(policy.actor.state_dict())

    def compare(policy) -> None:
        compared.append(actor_bits(policy) == kept[0] == accepted_bits(guard))

    sabotages = At([STEPS, 5 * STEPS], spoil)
    train(model, 6 * STEPS, At([1], better), sabotages, guard, At([STEPS, 5 * STEPS], compare))
    assert compared == [True, True]


@pytest.mark.parametrize("kind", ["worse", "nan", "infinite", "overflowing"])
def test_a_policy_that_is_worse_before_training_gives_way_to_the_mpc(kind) -> None:
    model = build(gradient_steps=0)
    guard = make_guard()
    SABOTAGE[kind](model.policy)
    with pytest.warns(UserWarning, match="refused by the starts of this guard, before training, "):
        train(model, STEPS, guard)
    assert guard.decisions[0].reason.startswith("before training, ")
    assert is_mpc(model) and is_mpc(model.policy.actor_target)
    assert not np.isnan(guard.decisions[0].accepted_cost)
    np.testing.assert_array_equal(model.predict(STATES)[0], build().predict(STATES)[0])
    np.testing.assert_allclose(model.predict(STATES)[0], MPC.explicit()(STATES), atol=1e-6)


@pytest.mark.parametrize("margin", [0.0, 0.01])
def test_equal_costs_neither_refuse_a_policy_before_training_nor_a_candidate(margin) -> None:
    class Indifferent(Slide):
        def step(self, action):
            observation, _, *rest = super().step(action)
            return observation, -abs(float(self.x[0])) / 3, *rest

    for before in (True, False):
        model = build(gradient_steps=0)
        guard = make_guard(Indifferent, rule={"margin": margin})
        change = partial(correct, region=LEFT, value=-0.5)
        if before:
            change(model.policy)
        train(model, STEPS, *([] if before else [At([1], change)]), guard)
        assert verdicts(guard) == ([] if before else ["accepted"])
        assert not is_mpc(model)


@pytest.mark.slow
def test_the_accepted_cost_never_rises_and_is_never_above_the_mpc_s() -> None:
    model = build(learning_rate=0.1)
    guard = make_guard()
    train(model, 40 * STEPS, guard, At(range(0, 200, 7 * STEPS), randomize))
    costs = [guard.decisions[0].mpc_cost, *(each.accepted_cost for each in guard.decisions)]
    assert np.all(np.diff(costs) <= 1e-6)
    assert "rejected" in verdicts(guard)


def test_a_violation_is_rejected_at_once_though_the_cost_falls_and_patience_is_left() -> None:
    env = partial(Slide, limits=(-1.1, -0.6))  # positive starts: the MPC's -1 is allowed
    env = partial(env, low=3.0)
    model = build(env=env(), gradient_steps=0)
    simulator = partial(Slide, limits=(-1.1, -0.6), low=3.9)
    guard = make_guard(simulator, patience=5, n_eval_episodes=2, seed=0)
    train(model, 2 * STEPS, At([1], partial(correct, region=RIGHT, value=0.5)), guard)
    assert verdicts(guard) == ["rejected"]
    assert guard.decisions[0].restored
    assert "2 starts with violations" in guard.decisions[0].reason
    assert guard.decisions[0].candidate_cost < guard.decisions[0].mpc_cost
    assert is_mpc(model)


@pytest.mark.parametrize(
    ("keep_if_worse", "values", "restored"),
    [
        (True, [1.8, 1.9, 2.0], [False, False, True]),
        (False, [1.8, 1.9, 2.0], [True, True, True]),  # worse than the MPC
        (False, [0.1, 0.2, 0.1], [False, False, True]),  # better than the MPC only
        (False, [0.1, 0.4, 0.1], [False, False, False]),  # the second one is accepted
    ],
)
def test_with_patience_the_actor_goes_on_until_the_last_of_so_many_rejections(
    keep_if_worse, values, restored
) -> None:
    model = build(gradient_steps=0)
    guard = make_guard(patience=3, keep_if_worse=keep_if_worse)
    left = iter([0.3, *values])
    move = At(range(STEPS, 5 * STEPS, STEPS), lambda p: correct(p, RIGHT, next(left)))
    train(model, 4 * STEPS + 1, move, guard)
    assert guard.decisions[0].verdict == "accepted"
    assert [each.restored for each in guard.decisions][1:4] == restored
    shrunk = [each.step < 1 for each in guard.decisions][1:4]
    assert not any(shrunk[i] for i in range(3) if not any(restored[: i + 1]))


def test_rejections_shrink_the_step_to_its_floor_and_acceptances_let_it_grow_to_one() -> None:
    model = build(gradient_steps=0)
    guard = make_guard(step_size=StepSize(0.3, 2.5, 0.2), rule={"margin": 10.0})
    values = iter([1.8, 1.9, 2.0, 0.3, 0.4, 0.5])
    move = At(range(STEPS, 7 * STEPS, STEPS), lambda p: correct(p, RIGHT, next(values)))
    steps: list[float] = []
    watch = At(range(STEPS, 7 * STEPS, STEPS), lambda policy: steps.append(policy.actor_step))
    train(model, 6 * STEPS, move, guard, watch)
    assert verdicts(guard) == ["rejected"] * 3 + ["accepted"] * 3
    assert steps == pytest.approx([0.3, 0.2, 0.2, 0.5, 1, 1])
    assert [each.step for each in guard.decisions] == steps
    assert model.policy.actor_step == 1  # a later run without a guard


@pytest.mark.parametrize("what", ["cost", "observation"])
def test_a_candidate_with_what_is_not_finite_in_its_episodes_violates_and_returns(what) -> None:
    class Faulty(Slide):
        """Half the MPC's input breaks a sensor."""

        def step(self, action):
            broken = self.x[0] > 1.9 and abs(float(action[0])) < 0.9
            observation, reward, *rest = super().step(action)
            if broken and what == "cost":
                reward = np.nan
            return observation * (np.nan if broken and what != "cost" else 1), reward, *rest

    model = build(gradient_steps=0)
    guard = make_guard(Faulty, patience=5)
    told(lambda: train(model, STEPS, At([1], better), guard))
    assert "a cost or an observation that is no finite number" in guard.decisions[0].reason
    assert guard.decisions[0].restored


def test_with_patience_left_the_end_returns_all_the_same_and_says_so() -> None:
    model = build(gradient_steps=0)
    guard = make_guard(patience=5, keep_if_worse=True)
    train(model, 2 * STEPS, At([1], worse), guard)
    assert guard.decisions[-1].restored
    assert is_mpc(model)
    worse(model.policy)
    train(model, STEPS + 1, guard)  # five more, not what was left
    assert [each.restored for each in guard.decisions[-2:]] == [False, True]


A = np.array([[1, 0.2], [0, 1]])
B = np.array([[0.02], [0.2]])
LIMIT = 0.6
COMMON: Any = {"Q": np.diag([1, 0]), "R": [[0.05]], "horizon": 6, "u_min": -2, "u_max": 2}
WIDE: Any = {"theta_min": [-3, -2], "theta_max": [3, 2]}
BOX: Any = {"x_min": [-9, -LIMIT], "x_max": [9, LIMIT]}
KINDS: dict[str, Any] = {
    "hard states": {**BOX, "theta_min": [-3, -LIMIT], "theta_max": [3, LIMIT]},
    "hard outputs": {**WIDE, "outputs": OutputBounds([[0, 1]], -LIMIT, LIMIT)},
    "soft states": {**WIDE, **BOX, "soft": SoftBounds(x=[0, LIMIT], penalty=500)},
}


class Carriage(Sampled):
    """A double integrator whose info says nothing; it begins at rest."""

    observation_space = gym.spaces.Box(-20, 20, (2,), np.float64)
    action_space = gym.spaces.Box(-2, 2, (1,), np.float64)
    starts = ([1.5, 0.0], [2.5, 0.0])

    def moved(self, u: Any) -> Any:
        return A @ self.x + B @ np.clip(u, -2, 2)


def carriage(kind: str) -> tuple[LinearMPC, Any]:
    names: Any = {"state_names": ["place", "speed"], "units": ["m", "m/s", "N"]}
    mpc = LinearMPC(LinearModel(A, B, dt=0.2, **names), **COMMON, **KINDS[kind])
    return mpc, lambda: TimeLimit(StageCost(Carriage(), mpc), 12)


def built(mpc: LinearMPC, make: Any, **options: Any) -> DDPG:
    """Return a model that does not learn."""
    given = {"device": "cpu", "seed": 0, "learning_starts": 10**6}
    options["problem"] = mpc
    return DDPG("YannPolicy", make(), policy_kwargs=options, **given)


FREE: Any = {"networks": "shared", "keep_bounds": False}


@th.no_grad()
def push(policy: Any) -> None:
    """Add to the MPC's input against the position: it drives faster, which costs less."""
    first_layer(policy).zero_()
    last_layer(policy).zero_()
    first_layer(policy)[0, 0, :, 0] = 2.0
    last_layer(policy)[0, 0, :64] = 2.0


@pytest.mark.parametrize("kind", KINDS)
def test_the_guard_never_accepts_a_faster_policy_than_the_bounds_let(kind: str) -> None:
    mpc, make = carriage(kind)
    model = built(mpc, make, **FREE)
    own = evaluate(model, make, range(20, 24))
    push(model.policy)
    pushed = evaluate(model, make, range(20, 24))
    assert pushed.costs.mean() < own.costs.mean()
    assert max(np.abs(each[:, 1]).max() for each in pushed.observations) > 1.1 * LIMIT
    model = built(mpc, make, **FREE)
    rule = {"backtrack": False, "by_region": False}
    guard = ImprovementGuard(make, n_eval_episodes=4, n_new_starts=4, n_final_starts=4, rule=rule)
    model.learn(24, callback=[NoActionNoise(), At([6], push), guard])
    log = evaluate(model, make, range(20, 24))
    assert guard.decisions[0].verdict == "rejected" and guard.decisions[0].restored
    named = "speed exceeds its bound by"
    if kind == "soft states":
        named = "more than with the MPC: speed exceeds its soft bound by"
    reason = guard.decisions[0].reason
    assert named in reason and "m/s" in reason
    assert max(np.abs(each[:, 1]).max() for each in log.observations) < LIMIT * 1.01


def test_a_guard_s_costs_are_the_mpc_s_where_the_policy_knows_a_scale_and_an_offset() -> None:
    mpc, plant = carriage("soft states")
    mpc = replace(mpc, soft=SoftBounds(x=[0, LIMIT], penalty=0.1))
    costs = []
    for scale, offset in ((1.0, 0.0), (0.01, 50.0)):
        make = lambda s=scale, o=offset: TransformReward(plant(), lambda r: s * r + o)  # noqa: E731
        model = built(mpc, make, critic={"reward_scale": scale, "reward_offset": offset})
        guard = ImprovementGuard(make, n_eval_episodes=4, n_new_starts=4, n_final_starts=4)
        model.learn(1, callback=[NoActionNoise(), guard])
        costs.append(guard.state.evidence.starts.mpc.costs / scale)
    np.testing.assert_allclose(*costs, rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_the_page_to_sign_fails_and_names_the_bound_its_excess_and_the_unit(
    kind: str, tmp_path: Path
) -> None:
    mpc, make = carriage(kind)
    model = built(mpc, make, **FREE)
    push(model.policy)
    page = report(model, tmp_path / "page.html", env=make, seeds=range(20, 24)).read_text()
    failed = [row for row in re.findall("<tr>.*?</tr>", page, re.DOTALL) if ">failed<" in row]
    says = rf"speed exceeds its {'soft ' * (kind == 'soft states')}bound by [\d.]+ m/s with"
    assert any(re.search(says, row) for row in failed)


@pytest.mark.parametrize("weight", [0.05, 0.4])
def test_a_guard_s_env_that_pays_another_cost_than_training_is_reported(weight: float) -> None:
    mpc, make = carriage("hard states")
    paid = replace(mpc, R=[[weight]])
    model = built(mpc, make)
    other = {"n_eval_episodes": 4, "n_final_starts": 2}
    guard = ImprovementGuard(lambda: TimeLimit(StageCost(Carriage(), paid), 12), **other)
    found = told(lambda: model.learn(120, callback=[NoActionNoise(), guard]))
    assert sum(["pays something else" in each for each in found]) == (weight != mpc.R[0, 0])
