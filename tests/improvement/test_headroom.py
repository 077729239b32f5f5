"""What can be gained over an MPC is reported before anybody trains, and of what kind it is."""

from __future__ import annotations

import dataclasses
import re
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import unit_samples as units
from experiments.optimum import clipped_pendulum_optimum, cstr_optimum
from sample_plants import Sampled
from sb3_yann import (
    DisturbanceBounds,
    Headroom,
    LinearModel,
    LinearMPC,
    NonFiniteWarning,
    PlantTwin,
    Terminal,
    Tracking,
    UntrustedTwinError,
    headroom,
    improve,
    offset_free,
)
from sb3_yann.evaluation import evaluate
from sb3_yann.improvement import simulator
from sb3_yann.improvement.measuring import verdict_of
from sb3_yann.improvement.simulator import in_deviations
from sb3_yann.twin.selection import fit_ensemble
from sb3_yann.wrappers import ObserveDisturbance, SetPoint, StageCost
from sb3_yann_envs import problems
from twin_samples import problem
from twin_samples import twin as cart_twin

NO_PLANS = 900
"""Steps that suffice for three or four episodes of each MPC, and for no plan."""


def heater(**changes) -> LinearMPC:
    """One state that follows a set-point, its input within bounds."""
    design = {"Q": [[1.0]], "R": [[0.1]], "horizon": 3, "u_min": -2, "u_max": 2}
    tracking = Tracking([0], -1, 1)
    box = {"theta_min": -5, "theta_max": 5, "model": LinearModel([[0.8]], [[0.5]], dt=1.0)}
    return LinearMPC(**{**design, "tracking": tracking, **box, **changes})


class Heater(Sampled):
    """x+ = .8 x + .5 u + load + bend u^2 + noise; the set-point changes in mid-episode."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Box(-2, 2, (1,), np.float32)

    def __init__(
        self, load: float = 0.0, bend: float = 0.0, steps: int = 60, noise: float = 0.0
    ) -> None:
        self.load = load
        self.bend = bend
        self.steps = steps
        self.noise = noise
        self.mpc = heater()

    def reset(self, *, seed=None, options=None):
        found = super().reset(seed=seed)
        self.later = self.np_random.uniform(-1, 1)
        return found

    def cost(self, u):
        return self.mpc.stage_cost(self.x, u)

    def moved(self, u):
        x = 0.8 * self.x[0] + 0.5 * u[0] + self.load + self.bend * u[0] ** 2
        x += self.noise * self.np_random.standard_normal()
        return np.array([x, self.later if self.t + 1 >= self.steps // 2 else self.x[1]])


@pytest.fixture(autouse=True)
def quick(monkeypatch) -> None:
    """The plants of these tests are simple: networks know them sooner."""
    monkeypatch.setattr(simulator, "fit_ensemble", partial(fit_ensemble, updates=500))


class Counted(Heater):
    """Counts its steps."""

    steps_taken = 0

    def step(self, action):
        type(self).steps_taken += 1
        return super().step(action)


def test_where_the_model_is_the_plant_there_is_nothing_to_gain(capsys, monkeypatch) -> None:
    monkeypatch.setattr("sb3_yann._progress.DELAY", 0)
    Counted.steps_taken = 0
    found = headroom(heater(), Counted, n_starts=5)
    assert found.verdict == "keep the MPC" and 0 <= found.total < 1e-3
    assert "Verdict: keep the MPC" in str(found)
    assert found.steps == Counted.steps_taken and f"{found.steps:,} of the env." in str(found)
    lines = [each for each in capsys.readouterr().err.splitlines() if each.startswith("[")]
    assert "5 episodes of the MPC" in lines[0] and f"{found.steps:,} steps] plans" in lines[-1]
    assert "the best of each start so far: -0.0" in lines[-1]


def test_it_takes_no_step_more_than_it_may() -> None:
    Counted.steps_taken = 0
    found = headroom(heater(), Counted, n_starts=5, max_steps=700)
    assert found.steps == Counted.steps_taken <= 700
    assert f"tries {found.budget:,} are needed" in improve(heater(), Counted, max_steps=700).reason
    assert found.observer_played is not None and "were too few to go on" in found.report()
    assert found.verdict == "not known" and "from 5 of 5 starts no plan" in found.report()
    with pytest.raises(ValueError, match="max_steps = 100 are too few for 5 episodes of the MPC"):
        headroom(heater(), Counted, n_starts=5, max_steps=100)


def test_an_observer_is_played_beside_a_measured_disturbance() -> None:
    model = LinearModel([[0.8]], [[0.5]], dt=1.0, E=[[1.0]])
    box = {"theta_min": -5, "theta_max": 5, "disturbances": DisturbanceBounds(-1, 1)}
    space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    measured = partial(np.append, values=np.float32(0.1))  # of a load of .3
    shown = lambda: gym.wrappers.TransformObservation(Heater(0.3), measured, space)  # noqa: E731
    mpc = dataclasses.replace(heater(), model=model, terminal=None, **box)
    found = headroom(mpc, shown, n_starts=4, max_steps=NO_PLANS)
    assert found.observer_played is not None
    assert found.observer_played.mean() < 0.7 * found.mpc_costs.mean()


def test_ctrl_c_prints_what_has_been_played_so_far(capsys, monkeypatch) -> None:
    def interrupted(search: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sb3_yann.improvement.measuring._Search.plan", interrupted)
    with pytest.raises(KeyboardInterrupt):
        headroom(heater(), Heater, n_starts=3)
    assert "Interrupted; of what was played so far:\nVerdict:" in capsys.readouterr().err


class Ending(Heater):
    """Ends some of its episodes, as a plant that trips."""

    def step(self, action):
        shown, reward, _, over, info = super().step(action)
        return shown, reward, bool(self.t == 20 and self.later > 0), over, info


def test_episodes_that_the_env_ends_are_counted() -> None:
    said = headroom(heater(), Ending, n_starts=6, max_steps=NO_PLANS).report()
    assert re.search("[1-5] of 6 episodes of the MPC are ended by the env", said)


def test_an_offset_is_named_and_the_two_lines_remove_it() -> None:
    found = headroom(heater(), partial(Heater, load=0.2), n_starts=6)
    assert found.verdict == "add ObserveDisturbance first"
    assert found.offset > 0.9 * found.total > 0.05
    mpc, observer = offset_free(heater())
    low = mpc.disturbances.d_min
    high = mpc.disturbances.d_max
    env = ObserveDisturbance(Heater(load=0.2), observer, low, high)
    episode = evaluate(mpc.online(), env, [0])
    measured, wanted = episode.observations[0][:, :2].T
    assert abs(measured[-1] - wanted[-1]) < 1e-3
    without = evaluate(heater().explicit(), Heater(load=0.2), [0]).observations[0]
    assert abs(without[-1, 0] - without[-1, 1]) > 0.02


def test_an_observer_that_pays_from_one_start_of_three_is_not_known_to_pay() -> None:
    class Seldom(Heater):
        def reset(self, *, seed=None, options=None):
            found = super().reset(seed=seed)
            self.load = 0.2 * (seed == 1)
            return found

    found = headroom(heater(), Seldom, n_starts=3, max_steps=NO_PLANS)
    assert found.offset > 0.02 and found.verdict == "not known"
    assert "may be chance on so few starts" in found.report()


@pytest.mark.filterwarnings("ignore:For 50 steps")  # of the env below
def test_a_disturbance_beyond_the_default_is_reported() -> None:
    plant = partial(Heater, load=0.6)
    found = headroom(heater(), plant, n_starts=3, max_steps=NO_PLANS)
    assert found.d_max is not None and found.d_max[0] > 0.6
    assert f"offset_free(mpc, d_max=[{found.d_max[0]:.3g}])" in found.report()
    costs = []
    for pair in (offset_free(heater()), offset_free(heater(), d_max=found.d_max)):
        bounds = pair[0].disturbances
        env = ObserveDisturbance(plant(), pair[1], bounds.d_min, bounds.d_max)
        runs = evaluate(pair[0].online(), env, range(3))
        costs.append([heater().stage_cost(x[:-1, :2], u).sum() for x, u in runs.pairs])
    np.testing.assert_allclose(costs[1], found.observer_costs, rtol=0.05)  # of estimates
    assert np.mean(costs[0]) > 1.1 * np.mean(costs[1])
    little = headroom(heater(), partial(Heater, load=0.1), n_starts=3, max_steps=NO_PLANS)
    assert little.d_max is None


def test_the_reactor_s_figure_is_that_of_its_optimum() -> None:
    found = headroom(problems.cstr(), "CSTR-v0", n_starts=2, seed=2000)
    starts = evaluate(problems.cstr().explicit(), "CSTR-v0", range(2000, 2002)).observations
    best = cstr_optimum([each[0] for each in starts])
    np.testing.assert_allclose(found.best_costs, best, rtol=2e-3)
    assert np.all(found.best_costs <= found.mpc_costs)
    assert found.offset + found.model_error + found.nonlinearity == pytest.approx(found.total)
    assert found.total == pytest.approx(1 - best.mean() / found.mpc_costs.mean(), rel=0.02)


def test_the_re_identified_mpc_is_handed_over() -> None:
    plant = partial(Heater, load=0.3)
    found = headroom(heater(), plant, n_starts=3, max_steps=NO_PLANS)
    runs = evaluate(found.reidentified.online(), plant, range(3))
    costs = [heater().stage_cost(x[:-1], u).sum() for x, u in runs.pairs]
    np.testing.assert_allclose(costs, found.reidentified_played, rtol=1e-6)
    advice = dataclasses.replace(found, verdict="re-identify", offset=0, model_error=found.total)
    assert "take the MPC headroom(...).reidentified" in advice.report()


def test_changes_of_a_set_point_are_not_known_before() -> None:
    """With preview the optimum would move before the change; the plan costs what the MPC costs."""
    found = headroom(heater(), Heater(steps=40), n_starts=6, seed=20)
    np.testing.assert_allclose(found.best_costs, found.mpc_costs, rtol=2e-3)


def test_little_that_plans_find_between_moves_of_a_set_point_is_not_all() -> None:
    found = headroom(heater(), partial(Heater, bend=0.03, steps=20), n_starts=6)
    assert 1e-3 < found.total < 0.02 and found.verdict == "not known"
    assert f"improve(mpc, make, max_steps={found.budget:_}) may find more" in found.report()


def test_noise_is_no_headroom() -> None:
    """A plan that knew the noise to come would cost a fifth less than the MPC, which is optimal."""
    found = headroom(heater(), partial(Heater, noise=0.1), n_starts=10)
    assert found.verdict == "keep the MPC" and found.total < 0.01


def test_the_best_of_a_random_plant_is_one_controller() -> None:
    found = headroom(heater(), partial(Heater, noise=0.02, load=0.2), n_starts=6)
    assert found.verdict == "add ObserveDisturbance first" and found.offset > 0.4
    assert found.total < found.offset + 0.05


@pytest.mark.nightly
def test_another_way_to_swing_is_found() -> None:
    """From the MPC's own swing the search ends 1 % below it; a push first leads to 4 %."""
    seed = 2008
    found = headroom(problems.clipped_pendulum(), "ClippedPendulum-v0", n_starts=2, seed=seed)
    starts = evaluate(lambda _: [0.0], "ClippedPendulum-v0", [seed, seed + 1]).observations
    best = clipped_pendulum_optimum([each[0] for each in starts])
    assert 1 - best.mean() / found.mpc_costs.mean() > 0.02
    assert found.total > 0.75 * (1 - best.mean() / found.mpc_costs.mean())


def test_a_twin_s_members_share_the_starts() -> None:
    mpc = problem()
    twin = cart_twin()
    found = headroom(mpc, twin, n_starts=3)
    alone = evaluate(mpc.explicit(), twin.env, [2])
    np.testing.assert_allclose(found.mpc_costs[2], alone.costs[0], rtol=1e-5)
    assert found.total > 0.005 and "the twin" in found.report()
    with pytest.raises(ValueError, match="another MPC's plant"):
        headroom(heater(), twin)


def test_a_twin_that_cannot_be_trusted_is_refused() -> None:
    mpc = problems.cstr()
    runs = evaluate(mpc.explicit(), "CSTR-v0", [3000])
    states = runs.observations[0] + np.random.default_rng(0).normal(0, 0.5, (401, 4))
    twin = PlantTwin.fit(mpc, [(states, runs.actions[0])])
    with pytest.raises(UntrustedTwinError):
        headroom(mpc, twin)


def test_a_simulator_may_fail_where_the_mpc_does_not_go() -> None:
    class Fragile(Heater):
        failed = 0
        raises = True

        def step(self, action):
            if abs(self.x[0]) > 1.2:
                type(self).failed += 1
                if self.raises:
                    raise RuntimeError("beyond what the equations are for")
                self.x[0] = np.nan
            return super().step(action)

    class Vanishing(Fragile):
        raises = False

    healthy, vanished = (
        headroom(heater(), make(bend=0.1, steps=20), n_starts=2) for make in (Heater, Vanishing)
    )
    with pytest.warns(NonFiniteWarning, match=r"raised RuntimeError\('beyond .* counts as lost"):
        failed = headroom(heater(), Fragile(bend=0.1, steps=20), n_starts=2)
    assert Fragile.failed and Vanishing.failed
    for found in (failed, vanished):
        np.testing.assert_allclose(found.best_costs, healthy.best_costs, rtol=2e-3)


def test_what_it_cannot_use_is_named() -> None:
    with pytest.raises(ValueError, match=r"The env shows \(4,\).*PastInputs"):
        headroom(heater(), "CSTR-v0")
    with pytest.raises(TypeError, match="mpc = 3"):
        headroom(3, "CSTR-v0")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="n_starts = 1"):
        headroom(heater(), Heater(), n_starts=1)

    class Random(Heater):
        def step(self, action):
            self.load = 0.1 * np.random.default_rng().standard_normal()
            return super().step(action)

    with pytest.raises(ValueError, match="does not repeat it"):
        headroom(heater(), Random())

    class Failing(Heater):
        def step(self, action):
            observation, *rest = super().step(action)
            return observation * np.nan, *rest

    with pytest.raises(ValueError, match="from the seed 0 costs nan: what the env shows"):
        headroom(heater(), Failing())


def test_what_an_observer_loses_is_shown_as_a_loss() -> None:
    costs = np.array([10.0, 20.0, 30.0])
    dear = np.array([9.0, 20.0, 43.0])
    found = Headroom(
        costs, costs, costs, costs, 0.0, 0.0, 0.0, "keep the MPC", "a simulator",
        observer_played=dear, why={"model": "it has no rest"},
    )  # fmt: skip
    text = found.report()
    assert "-0.00 %" not in text
    observer = "+20.00 % as it was played, worst start +43.33 % of its own cost; 1 of 3 cost more"
    assert f"  observer     {observer}\n  new model    not played: it has no rest" in text
    assert "a re-identified model: not played, +0.00 % more by all the rest" in text
    some = dataclasses.replace(found, best_costs=costs - 0.2, nonlinearity=0.01, budget=8_000)
    for said in ("less than 2 %", "improve(mpc, make, max_steps=8_000) may still find some of it"):
        assert said in some.report()


def test_an_observer_that_pays_on_average_alone_is_advised_with_its_worst_start() -> None:
    costs = np.full(4, 10.0)
    mixed = np.array([4.0, 5.0, 6.0, 12.0])
    found = Headroom(
        costs, mixed, costs, mixed, 0.325, 0.0, 0.0, "add ObserveDisturbance first", "a simulator",
        observer_played=mixed,
    )  # fmt: skip
    assert "Not from every start" in found.report() and "worst start +20.00 %" in found.report()
    gains = dataclasses.replace(found, observer_played=costs - 1)
    assert "Not from every start" not in gains.report()
    there = dataclasses.replace(gains, source="the twin", steps=9, d_max=np.array([2.0])).report()
    assert "offset_free(mpc, d_max=[2]), and export(mpc, path, estimator=observer), or" in there
    assert "PlantTwin.fit(mpc, log, observer=observer))" in there and "9 of the twin" in there


def test_nothing_found_with_plans_of_a_poor_model_is_not_called_little() -> None:
    costs = np.array([10.0, 20.0])
    found = Headroom(
        costs, costs, costs, costs, 0.0, 0.0, 0.0, "not known", "a simulator", lost=0.031
    )
    text = found.report()
    assert "nothing was found, but plans were made in a model of its episodes that is not" in text
    assert "they cost 3.1 % more than the MPC" in text


MPC = units.plant_mpc()


def tracking() -> LinearMPC:
    """Return an MPC of the same plant whose temperature follows a set-point."""
    design = {"Q": np.diag([1, 0]), "R": [[0.1]], "horizon": 3}
    return LinearMPC(units.MODEL, **design, **units.LIMITS, tracking=Tracking([0], 349, 351))


def test_a_plant_in_its_own_units_has_the_headroom_of_its_deviations() -> None:
    make = in_deviations(lambda: units.plant("plant", "plant"), MPC)
    plain = headroom(MPC.deviations, make, n_starts=3)
    found = headroom(MPC, StageCost(units.plant("plant", "plant"), MPC), n_starts=3)
    np.testing.assert_allclose(found.mpc_costs, plain.mpc_costs, rtol=1e-9)
    np.testing.assert_allclose(found.best_costs, plain.best_costs, rtol=1e-6)
    assert found.mpc_costs.max() < 10 and found.verdict == "keep the MPC"


@pytest.mark.parametrize(
    ("shows", "takes", "message"),
    [
        ("plant", "normalized", r"normalized inputs, from \[-1.*RescaleAction"),
        ("deviation", "deviation", r"takes deviations, from \[-2.*plant units"),
        ("plant", "deviation", r"takes deviations, from \[-2.*plant units"),
        ("deviation", "plant", "temperature = .* is shown.* this is a deviation"),
    ],
)
def test_other_units_are_refused(shows, takes, message) -> None:
    with pytest.raises(ValueError, match=message):
        headroom(MPC, units.plant(shows, takes), n_starts=2)


@pytest.mark.parametrize("low", [-1, 353])
@pytest.mark.filterwarnings("ignore:SetPoint shows")
def test_set_points_that_are_not_the_problem_s_are_named(low) -> None:
    plant = SetPoint(units.plant("plant", "plant"), low, low + 2)
    with pytest.raises(
        ValueError,
        match=r"set-point of temperature (= -.* is a deviation|is 35.*, and the MPC was solved)",
    ):
        headroom(tracking(), plant, n_starts=2)


@pytest.mark.parametrize(
    ("parts", "doubt", "verdict"),
    [
        ((0.0, 0.0, 0.019), 0.0, "keep the MPC"),  # learning would find a part of it
        ((0.0, 0.0, 0.021), 0.0, "learn"),
        ((0.004, 0.003, 0.014), 0.0, "learn"),
        ((0.006, 0.0, 0.001), 0.0, "add ObserveDisturbance first"),
        ((0.004, 0.0, 0.0), 0.0, "keep the MPC"),
        ((0.0, 0.3, 0.1), 0.5, "not known"),  # it may be chance
        ((0.0, 0.0, 0.021), 0.03, "not known"),
        ((0.0, 0.015, 0.004), 0.02, "keep the MPC"),  # little, and that may be chance
        ((0.006, 0.0, 0.012), 0.0, "add ObserveDisturbance first"),  # too little to learn
        ((0.0, 0.3, 0.1), 0.3, "re-identify"),
    ],
)
def test_two_lines_are_worth_less_than_a_training(parts, doubt, verdict) -> None:
    assert verdict_of(*parts, doubt=doubt) == verdict


@pytest.mark.nightly
def test_a_swing_is_found_where_the_mpc_shows_none() -> None:
    mpc = dataclasses.replace(problems.clipped_pendulum(), Q=np.eye(2), terminal=Terminal())
    found = headroom(mpc, "ClippedPendulum-v0")  # with few starts roundings decide
    hangs = found.mpc_costs > 2000
    much = 0.3 * found.mpc_costs[hangs]
    assert np.any(found.best_costs[hangs] < much) and found.verdict == "learn"
    assert np.all(np.minimum(found.observer_costs, found.reidentified_costs)[hangs] > much)
    assert "improve(mpc, make, max_steps=142_200)" in found.report()


def test_an_mpc_with_disturbances_has_an_observer_or_measures_them() -> None:
    mpc, observer = offset_free(heater())
    env = ObserveDisturbance(Heater(load=0.1), observer, -0.25, 0.25)
    found = headroom(mpc, env, n_starts=3)
    assert found.offset == 0 and np.array_equal(found.observer_costs, found.mpc_costs)


class Foreseen(Heater):
    """A load that is known two samples ahead moves it, and its input less than its model says."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (5,), np.float32)
    starts = (-0.3, 0.3)

    def __init__(self) -> None:
        super().__init__()
        model = LinearModel([[0.8]], [[0.5]], dt=1.0, E=[[1.0]])
        loads = DisturbanceBounds(-0.3, 0.3, preview=2)
        self.mpc = heater(model=model, disturbances=loads)

    def moved(self, u):
        x, r, *loads = self.x
        after = 0.8 * x + 0.4 * u[0] + loads[0] + 0.2
        return np.array([after, r, *loads[1:], self.np_random.uniform(-0.3, 0.3)])


def test_what_is_foreseen_moves_the_plant_only_when_it_is_there() -> None:
    found = headroom(Foreseen().mpc, Foreseen, n_starts=3, max_steps=NO_PLANS)
    assert found.offset > 0.1 and "observer" not in found.why
    told = found.reidentified.model
    np.testing.assert_allclose([told.A[0, 0], told.B[0, 0], told.E[0, 0]], [0.8, 0.4, 1], atol=0.01)
