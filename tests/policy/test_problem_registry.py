"""A problem is given as an object, by a name or by a reference; what is none is named."""

from __future__ import annotations

import pytest
from stable_baselines3 import DDPG

import sb3_yann
from policy_samples import (
    actions,
    make_policy,
    scalar_mpc,
    unbounded,
)
from sample_plants import LinearPlant
from sb3_yann import LinearMPC, YannPolicy
from sb3_yann_envs import problems


@pytest.mark.parametrize(
    "reference", ["CSTR-v0", "sb3_yann_envs.problems:cstr", "my reactor", None]
)
def test_a_problem_may_be_an_object_a_name_or_a_reference(reference) -> None:
    sb3_yann.register_problem("my reactor", "sb3_yann_envs.problems:cstr")
    plant = LinearPlant(problems.cstr())
    problem = problems.cstr() if reference is None else reference
    model = DDPG(YannPolicy, plant, policy_kwargs={"problem": problem})
    assert model.policy.problem == problems.cstr()


def test_a_policy_without_a_problem_says_how_to_give_one() -> None:
    with pytest.raises(ValueError, match=r'policy_kwargs=\{"problem": mpc\}'):
        DDPG(YannPolicy, "Pendulum-v1")


@pytest.mark.parametrize(
    ("problem", "error", "message"),
    [
        ("no such name", ValueError, "'no such name'"),
        ("no_such_module:mpc", ValueError, "no_such_module"),
        ("sb3_yann_envs.problems:nothing", ValueError, "nothing"),
        ("math:pi", TypeError, "expected a LinearMPC"),
        (42, TypeError, "expected a LinearMPC"),
        (LinearMPC, TypeError, "expected a LinearMPC"),
        ("sb3_yann:LinearMPC", TypeError, "expected a LinearMPC"),
        (scalar_mpc().explicit(), TypeError, "is PiecewiseAffine.*expected a LinearMPC"),
    ],
)
def test_a_problem_that_cannot_be_found_is_named(problem, error, message) -> None:
    with pytest.raises(error, match=message):
        make_policy(unbounded(), actions(), problem=problem)


def test_a_name_registered_again_means_the_new_problem() -> None:
    env = LinearPlant(scalar_mpc())
    for weight in (1, 10):
        sb3_yann.register_problem("again", scalar_mpc(R=[[weight]]))
        model = DDPG(YannPolicy, env, policy_kwargs={"problem": "again"})
        assert model.policy.problem.R == [[weight]]


def test_only_problems_can_be_registered() -> None:
    with pytest.raises(TypeError, match="problem = 3"):
        sb3_yann.register_problem("three", 3)
