"""Seeded, paired episodes, and what is printed and drawn of them."""

from __future__ import annotations

from io import StringIO

import gymnasium as gym
import numpy as np
import pytest
from matplotlib.image import imread
from rich.console import Console
from stable_baselines3 import DDPG

from sb3_yann import YannPolicy
from sb3_yann.evaluation import Episodes, evaluate
from sb3_yann.reporting import comparison_table, save_trajectories
from sb3_yann_envs import problems

SEEDS = range(3)


def test_the_same_seeds_give_the_same_episodes() -> None:
    law = problems.clipped_pendulum().explicit()
    one, two = (evaluate(law, "ClippedPendulum-v0", SEEDS) for _ in range(2))
    np.testing.assert_array_equal(one.costs, two.costs)
    np.testing.assert_array_equal(one.observations[2], two.observations[2])


def test_an_untrained_model_costs_what_its_law_costs() -> None:
    law = evaluate(problems.cstr().explicit(), "CSTR-v0", SEEDS)
    model = evaluate(DDPG(YannPolicy, "CSTR-v0"), "CSTR-v0", SEEDS)
    np.testing.assert_allclose(model.costs, law.costs, rtol=1e-4)


def test_the_cost_is_minus_the_sum_of_the_rewards() -> None:
    env, u = gym.make("CSTR-v0"), np.zeros(1, np.float32)
    env.reset(seed=0)
    total, done = 0.0, False
    while not done:
        _, reward, terminated, truncated, _ = env.step(u)
        total += float(reward)
        done = terminated or truncated
    episodes = evaluate(lambda _: u, env, [0])
    assert episodes.costs == pytest.approx([-total])
    assert episodes.observations[0].shape == (401, 4)
    assert episodes.actions[0].shape == (400, 1)


def test_violations_are_counted_for_each_episode() -> None:
    too_little_cooling = np.full(1, -55, np.float32)
    episodes = evaluate(lambda _: too_little_cooling, "CSTR-v0", SEEDS)
    assert episodes.violations.tolist() == [1, 1, 1]
    assert (episodes.costs > 1e5).all()


def test_something_that_is_no_policy_is_named() -> None:
    with pytest.raises(TypeError, match="predict"):
        evaluate(3, "CSTR-v0", SEEDS)  # type: ignore[arg-type]


def fake(costs: list[float]) -> Episodes:
    steps = np.linspace(0, 1, 11)[:, None]
    episodes = len(costs)
    return Episodes(
        np.array(costs), np.zeros(episodes, int), (steps,) * episodes, (steps[1:],) * episodes
    )


def test_the_table_shows_losses_as_well_as_gains() -> None:
    console = Console(record=True, width=100, file=StringIO())
    console.print(comparison_table("costs", fake([10.0, 20.0]), fake([9.0, 27.0])))
    text = console.export_text()
    assert "-1.00" in text
    assert "+7.00" in text
    assert "+3.00 (+20.0 %)" in text


def test_the_picture_is_a_png_that_shows_something(tmp_path) -> None:
    path = save_trajectories(
        tmp_path / "new folder" / "run.png",
        {"before": fake([1.0]), "after": fake([2.0])},
        states={0: "x"},
        inputs=["u"],
        dt=0.1,
        time_unit="s",
        limits={0: (0.9, "limit")},
    )
    image = imread(path)
    assert image.shape[0] > 300
    assert image[..., :3].std() > 0.01
