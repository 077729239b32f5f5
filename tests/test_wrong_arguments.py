"""Arguments of a wrong kind, size or sign: named at the door, with what was expected."""

from __future__ import annotations

import numpy as np
import pytest
from stable_baselines3 import DDPG

from policy_samples import scalar_mpc
from sample_plants import LinearPlant
from sb3_yann import (
    ImprovementGuard,
    NoActionNoise,
    SimulatedEpisodes,
    export,
    restore_accepted,
)
from sb3_yann.evaluation import comparison_table, evaluate, summary_table
from sb3_yann.evaluation.plots import loops_figure
from sb3_yann.wrappers import (
    PastInputs,
    PreviousInput,
    StageCost,
)


def plant() -> LinearPlant:
    return LinearPlant(scalar_mpc())


def played(*seeds: int):
    """Return episodes of a reactor that is left alone."""
    return evaluate(lambda _: [0.0], "CSTR-v0", seeds)


def drawn(runs):
    return loops_figure(scalar_mpc(), runs)


ENV = r"env = None must be a gymnasium\.Env: gymnasium\.make\(id\)"
PLAYED = "must be the Trajectories that evaluate returns"
WRONG_KINDS = {
    "StageCost without a problem": (lambda: StageCost(plant(), None), "problem = None must be a L"),
    "StageCost without an env": (lambda: StageCost(None, scalar_mpc()), ENV),
    "PreviousInput without an env": (lambda: PreviousInput(None), ENV),
    "PastInputs without delays": (lambda: PastInputs(plant(), None), "delays = None must be a li"),
    "PreviousInput from a word": (
        lambda: PreviousInput(plant(), initial="none"),
        "initial = 'none' is not an array of real numbers",
    ),
    "restoring no model": (lambda: restore_accepted(None), "model = None must be a DDPG or TD3"),
    "a simulator that is none": (lambda: SimulatedEpisodes(None), "env = None must be the id of"),
    "episodes of no env": (lambda: evaluate(lambda _: [0.0], None, [0]), "env = None must be the"),
    "a number for seeds": (lambda: evaluate(lambda _: [0.0], plant(), 3), "seeds = 3 must hold a"),
    "no episodes before": (
        lambda: comparison_table("", None, played(0)),
        f"before = None {PLAYED}",
    ),
    "no episodes after": (lambda: summary_table("", played(0), 3), f"after = 3 {PLAYED}"),
    "runs without names": (lambda: drawn([played(0)]), "runs = .* must be a mapping"),
    "a number for a run": (lambda: drawn({"a": 1}), rf"runs\['a'\] = 1 {PLAYED}"),
}


@pytest.mark.parametrize(("call", "message"), WRONG_KINDS.values(), ids=WRONG_KINDS)
def test_a_wrong_kind_is_a_type_error_that_names_the_argument(call, message) -> None:
    with pytest.raises(TypeError, match=message):
        call()


WRONG_VALUES = {
    "a seed below zero": (lambda: played(-1), "seeds = -1 must be a whole number of at least 0"),
    "a word for a seed": (lambda: played("a"), "seeds = 'a' must be a whole number"),
    "a number for a name": (
        lambda: export(scalar_mpc(), "law.c", name=3),
        "name = 3 must be a word of letters",
    ),
    "no episodes to compare": (
        lambda: comparison_table("", played(), played()),
        "before has 0 episodes and after 0; .* one at least",
    ),
    "no episodes to sum up": (
        lambda: summary_table("", played(), played()),
        "before has 0 episodes and after 0; .* one at least",
    ),
    "a comparison of other seeds": (
        lambda: comparison_table("", played(0, 1), played(0)),
        "before has 2 episodes and after 1; they must be those of the same seeds",
    ),
    "one episode beside many": (
        lambda: summary_table("", played(0, 1), played(0)),
        "before has 2 episodes and after 1; they must be those of the same seeds",
    ),
}


@pytest.mark.parametrize(("call", "message"), WRONG_VALUES.values(), ids=WRONG_VALUES)
def test_a_wrong_value_is_a_value_error_that_says_what_was_expected(call, message) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_a_guard_that_has_not_been_at_work_says_so() -> None:
    with pytest.raises(RuntimeError, match="The guard has no state yet: pass it to learn"):
        ImprovementGuard("CSTR-v0").summary()


def test_a_simulator_of_a_function_that_returns_none_is_named() -> None:
    model = DDPG("YannPolicy", plant(), device="cpu", policy_kwargs={"problem": scalar_mpc()})
    with pytest.raises(TypeError, match="The function that makes envs returned None, not a gymnas"):
        model.learn(1, callback=[NoActionNoise(), SimulatedEpisodes(lambda: None)])


def test_seeds_of_numpy_play_the_episodes_of_their_numbers() -> None:
    assert np.array_equal(played(*np.arange(3)).costs, played(0, 1, 2).costs)
