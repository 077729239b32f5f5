"""Twins with an observer of the disturbance: the policy, the watchdog and the plant's batches."""

import numpy as np
import pytest
from stable_baselines3 import DDPG

from sb3_yann import Commissioning, Improvement, PlantTwin, YannPolicy, improve
from sb3_yann.commissioning import commissioning
from sb3_yann.commissioning.watchdog import Watchdog
from sb3_yann.evaluation import evaluate
from sb3_yann.improvement.confirmation import Trial
from sb3_yann.twin.dynamics import law_of
from sb3_yann.wrappers import StageCost
from twin_samples import POLYNOMIALS, observed, observed_env, observed_log, offset_free_problem


def plant() -> StageCost:
    """Return the cart as its offset-free MPC sees it, with that MPC's stage cost."""
    return StageCost(observed_env(), offset_free_problem()[0])


def model() -> DDPG:
    mpc = offset_free_problem()[0]
    return DDPG(YannPolicy, plant(), policy_kwargs={"problem": mpc}, seed=0, device="cpu")


@pytest.mark.nightly
def test_fifteen_episodes_show_a_gain_that_the_plant_keeps() -> None:
    mpc, observer = offset_free_problem()
    episodes = [each[:2] for each in observed_log(15)]
    twin = PlantTwin.fit(mpc, episodes, observer=observer, residuals=POLYNOMIALS)
    found = improve(mpc, twin, updates=2000)
    assert found.accepted and found.interval[1] < -0.01
    both = found.model, mpc.explicit()
    ours, its = (evaluate(each, plant, range(3000, 3040)).costs for each in both)
    low, high = found.interval
    assert low <= ours.sum() / its.sum() - 1 <= high


def test_the_watchdog_is_quiet_and_sees_what_the_observer_smooths() -> None:
    found = observed()
    law = law_of(offset_free_problem()[0])
    dog = Watchdog.of(found)
    env = plant()
    for fault, quiet in ((0.0, True), (0.3, False)):
        theta = env.reset(seed=901)[0].astype(float)
        over = False
        dog.start(theta)
        for k in range(60):
            if k == 20:
                env.unwrapped.x = env.unwrapped.x + np.array([0.0, fault])
            u = law(theta[None])[0].astype(np.float32)
            before = theta
            theta, _, _, over, _ = env.step(u)
            theta = theta.astype(float)
            dog.watch(before, u.astype(float), theta)
        assert over and (dog.alarm is None) == quiet


def test_commissioning_takes_the_observer_of_the_env(monkeypatch) -> None:
    monkeypatch.setattr(commissioning, "improve", lambda *_, **__: Improvement((), 0.0, False))
    run = Commissioning(model(), plant(), batch=3, updates=500)
    batches = run.run(batches=1)
    assert run.twin is not None and run.twin.dynamics.row.observer is not None
    assert run.twin.trusted and batches[0].acted == "MPC"
    assert [each.alarm for each in run.episodes] == [None] * 3
    assert batches[0].cost == pytest.approx(batches[0].mpc, rel=0.01)


def trial() -> Trial:
    """Return one of a plant whose set-points change amid an episode."""
    return Trial.draw(observed(), 12, np.random.default_rng([0, 1]))


def test_what_loses_on_episodes_like_the_logs_is_refused() -> None:
    found = trial()
    costs = found.mpc.costs
    follow = np.tile(found.follow, len(found.starts))
    room = 4e-4 * found.mean
    held = found.known & (follow < 0)
    loses = costs + np.where(held, -2 * room, room * found.known)
    assert loses[found.known].mean() < costs[found.known].mean()
    said = found.check(1, found.mpc._replace(costs=loses))
    assert not said.accepted and said.reason.startswith("episodes like the log's cost 0.04 % more")
    gains = found.check(1, found.mpc._replace(costs=costs - room * found.known))
    assert gains.accepted and gains.logged == pytest.approx(-4e-4)
    assert gains.error == pytest.approx(0, abs=1e-12)
