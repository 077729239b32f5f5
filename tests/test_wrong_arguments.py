"""What is given wrongly is named at the door: what it was, what was expected, what to do."""

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG

import general_problems
from errors import raises
from guard_samples import Slide, make_guard, train
from guard_samples import build as build_slide
from policy_samples import build, scalar_mpc
from sample_plants import LinearPlant
from sb3_yann import (
    DisturbanceObserver,
    ImprovementGuard,
    LinearModel,
    LinearMPC,
    PlantTwin,
    SimulatedEpisodes,
    export,
    headroom,
    improve,
    restore_accepted,
)
from sb3_yann.commissioning.plant import Plant
from sb3_yann.control import PiecewiseAffine
from sb3_yann.evaluation import comparison_table, evaluate
from sb3_yann.evaluation.plots import loops_figure
from sb3_yann.wrappers import ObserveDisturbance, PastInputs, PreviousInput, StageCost


def plant() -> LinearPlant:
    return LinearPlant(scalar_mpc())


def played(*seeds: int):
    """Return episodes of a reactor that is left alone."""
    return evaluate(lambda _: [0.0], "CSTR-v0", seeds)


def drawn(runs):
    return loops_figure(scalar_mpc(), runs)


ENV = r"env = None must be a gymnasium\.Env: gymnasium\.make\(id\)"
PLAYED = "must be the Trajectories that evaluate returns"


def test_seeds_of_numpy_play_the_episodes_of_their_numbers() -> None:
    assert np.array_equal(played(*np.arange(3)).costs, played(0, 1, 2).costs)


class NoCopy(LinearPlant):
    def __deepcopy__(self, memo):
        raise RuntimeError("a licence of one seat")


class Endless(LinearPlant):
    def step(self, action):
        return (*super().step(action)[:2], False, False, {})


def hand_made(high: float = 5.0) -> PiecewiseAffine:
    """A law of one region, u = -x[0], which knows no plant."""
    box = {"theta_min": [-5, -5], "theta_max": [5, high], "u_min": [-1], "u_max": [1]}
    rows = {"A": [[1.0, 0.0], [-1.0, 0.0]], "b": [5.0, 5.0], "starts": [0]}
    return PiecewiseAffine(gains=[[[-1.0, 0.0]]], offsets=[[0.0]], **rows, **box)


def with_two_outputs() -> ObserveDisturbance:
    model = LinearModel([[0.5]], [[1]], 1, E=[[1]])
    return ObserveDisturbance(
        LinearPlant(scalar_mpc()), DisturbanceObserver(model), [-1, -1], [1, 1]
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: StageCost(plant(), None), TypeError("problem = None must be a L")),
        (lambda: StageCost(None, scalar_mpc()), TypeError(ENV)),
        (lambda: PreviousInput(None), TypeError(ENV)),
        (lambda: PastInputs(plant(), None), TypeError("delays = None must be a li")),
        (
            lambda: PreviousInput(plant(), initial="none"),
            TypeError("initial = 'none' is not an array of real numbers"),
        ),
        (lambda: restore_accepted(None), TypeError("model = None must be a DDPG or TD3")),
        (lambda: SimulatedEpisodes(None), TypeError("env = None must be the id of")),
        (lambda: evaluate(lambda _: [0.0], None, [0]), TypeError("env = None must be the")),
        (lambda: evaluate(lambda _: [0.0], plant(), 3), TypeError("seeds = 3 must be a seed")),
        (lambda: comparison_table("", None, played(0)), TypeError(f"before = None {PLAYED}")),
        (lambda: comparison_table("", played(0), 3), TypeError(f"after = 3 {PLAYED}")),
        (lambda: drawn([played(0)]), TypeError("runs = .* must be a mapping")),
        (lambda: drawn({"a": 1}), TypeError(rf"runs\['a'\] = 1 {PLAYED}")),
        (lambda: played(-1), "seeds = -1 must be a whole number of at least 0"),
        (lambda: export(scalar_mpc(), "law.c", name=3), "name = 3 must be a word of letters"),
        (lambda: export("c", scalar_mpc()), TypeError("path = LinearMPC.* must be the path of a")),
        (
            lambda: comparison_table("", played(), played()),
            "before has 0 episodes and after 0; .* one at least",
        ),
        (
            lambda: comparison_table("", played(0, 1), played(0)),
            "before has 2 episodes and after 1; they must be those of the same seeds",
        ),
        (lambda: headroom(scalar_mpc(), 3), TypeError("env = 3 must be the id of an environment")),
        (
            lambda: headroom(scalar_mpc(), NoCopy(scalar_mpc())),
            TypeError(r"cannot be copied \(a licence of one seat\). Pass a function that makes"),
        ),
        (
            lambda: improve("m.zip", None),
            TypeError("model = 'm.zip' must be a model with a YannPolicy"),
        ),
        (lambda: DisturbanceObserver("A"), TypeError("model = 'A' must be a LinearModel, e.g.")),
        (lambda: PlantTwin.fit("cstr", []), TypeError("problem = 'cstr' must be a LinearMPC")),
        (lambda: LinearMPC("A", Q=[[1]], R=[[1]], horizon=1), TypeError("model = 'A' must be a L")),
        (
            lambda: PlantTwin.fit(
                scalar_mpc(), [(np.ma.array(np.eye(5, 1), mask=1), np.eye(4, 1))]
            ),
            "states of episode 0 has masked entries",
        ),
        (
            lambda: LinearModel.from_data(np.zeros((5, 1)), np.zeros((4, 1)), dt=1, delay=4),
            r"delay = 4, but no episode has more than 4 steps: record longer",
        ),
        (
            lambda: general_problems.solved("servo with all of it").steady_state(
                r=np.zeros((3, 1))
            ),
            r"make 3 points, and steady_state takes one: r \(p,\) and d \(d,\)",
        ),
        (
            lambda: hand_made(high=np.inf).plot(),
            "box is not bounded in entries .* of theta: there is no frame to draw. Choose others",
        ),
        (with_two_outputs, r"low has shape \(2,\), but the observer estimates 1"),
        (
            lambda: build(policy_kwargs={"features_extractor_class": th.nn.Identity}),
            "features_extractor_class must stay FlattenExtractor: the law takes theta",
        ),
        (
            lambda: ImprovementGuard("CSTR-v0", log_path="/"),
            "log_path = '/' is a folder; name a file in it",
        ),
    ],
)
def test_a_wrong_argument_is_named_with_what_was_expected(call, message) -> None:
    with raises(message):
        call()


def test_a_plants_episode_that_never_ends_is_an_error(monkeypatch) -> None:
    monkeypatch.setattr("sb3_yann.commissioning.plant.ENDLESS", 20)
    env = Endless(scalar_mpc())
    plant = Plant(env, DDPG("YannPolicy", env, policy_kwargs={"problem": scalar_mpc()}))
    with pytest.raises(RuntimeError, match="An episode of the plant did not end in 20 steps"):
        plant.play(plant.begin(seed=0), plant.mpc, None)


@pytest.mark.filterwarnings("ignore:u.0. moves the env otherwise")  # that it ignores
def test_a_simulator_without_costs_on_new_starts_is_named() -> None:
    class Costless(Slide):
        def reset(self, *, seed=None, options=None):
            self.new = seed is not None and seed >= 1_000_010
            return super().reset(seed=seed)

        def step(self, action):
            observation, reward, *rest = super().step(action)
            return observation, np.nan if self.new else reward, *rest

    guard = make_guard(Costless, n_new_starts=5, n_final_starts=5)
    with pytest.raises(ValueError, match=r"finite number on none of 5 new starts .* must be"):
        train(build_slide(), 20, guard)
