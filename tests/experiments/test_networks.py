"""The table that compares one network for each region with one for all."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from experiments import catalog, networks
from experiments.runner import Outcome, Run
from sb3_yann.networks import SharedYannLayer, YannLayer


def outcome(costs, steps, variations, violations=(0,)) -> Outcome:
    """Return what a run leaves: costs, largest steps and variations of its test episodes."""
    tested = np.zeros((1, len(costs)))
    extra = {"largest_step": np.array(steps), "variation": np.array(variations)}
    played = np.zeros(len(violations))
    return Outcome([0], [costs], tested, played, played, violations, extra)


@pytest.mark.parametrize(
    ("form", "layer"), [("per region", YannLayer), ("shared", SharedYannLayer)]
)
def test_each_form_is_the_one_that_it_names(form, layer) -> None:
    plant = catalog.PLANTS[networks.PLANTS[0]]
    build = catalog.LEARNERS[networks.FORMS[form]]
    learner = build(lambda: gym.make(plant.env_id), 0, plant=plant)
    assert type(learner.policy.actor.mu) is layer


def test_the_largest_step_is_that_of_the_worst_episode_and_the_variation_that_of_all() -> None:
    mpc = outcome([10, 20], [1.0, 2.0], [4.0, 6.0])
    runs = [
        outcome([9, 18], [3.0, 1.0], [4.0, 1.0], violations=(0, 1)),
        outcome([9, 21], [1.0, 2.0], [10.0, 10.0], violations=(2, 0)),
    ]
    plain, ours = networks.rows("CSTR", mpc, {"shared": runs})
    assert plain == "| CSTR | MPC | 15.00 |  | 1.00 | 1.00 | 0 |  |"
    assert ours.split(" | ")[1:] == [
        "shared",
        "14.25 (13.50 to 15.00)",
        "+1.00",
        "1.25 (1.00 to 1.50)",
        "1.25 (0.50 to 2.00)",
        "3",
        "2 |",
    ]


def test_the_mpc_moves_its_input_as_it_does_in_the_plant() -> None:
    name = networks.PLANTS[1]
    found = catalog.execute(Run(name, "MPC", 0, 0))
    plant, seed = catalog.PLANTS[name], catalog.TEST_SEEDS[0]
    env, law, inputs = gym.make(plant.env_id), plant.problem().explicit(), []
    theta, over = env.reset(seed=seed)[0], False
    while not over:
        inputs.append(law(theta))
        theta, _, ended, cut, _ = env.step(inputs[-1])
        over = ended or cut
    changes = np.abs(np.diff(np.array(inputs), axis=0))
    assert found.extra["largest_step"][0] == pytest.approx(changes.max(), rel=1e-4)
    assert found.extra["variation"][0] == pytest.approx(changes.sum(), rel=1e-4)
