"""What there is to gain is the same in the plant's own units; what is misread is refused."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit

import unit_samples as units
from sb3_yann import LinearModel, LinearMPC, PlantTwin, Tracking, headroom
from sb3_yann.audit.in_deviations import in_deviations
from sb3_yann.audit.plants import lack_of_fit
from sb3_yann.wrappers import SetPoint, StageCost

MPC = units.plant_mpc()


def tracking() -> LinearMPC:
    """Return an MPC of the same plant whose temperature follows a set-point."""
    design = {"Q": np.diag([1, 0]), "R": [[0.1]], "horizon": 3}
    return LinearMPC(units.MODEL, **design, **units.LIMITS, tracking=Tracking([0], 349, 351))


def test_a_plant_in_its_own_units_has_the_headroom_of_its_deviations() -> None:
    make = in_deviations(lambda: units.plant("plant", "plant"), MPC)
    plain = headroom(MPC.deviations, make, n_starts=3)
    shown = StageCost(units.plant("plant", "plant"), MPC)
    found = headroom(MPC, shown, n_starts=3)
    np.testing.assert_allclose(found.mpc_costs, plain.mpc_costs, rtol=1e-9)
    np.testing.assert_allclose(found.best_costs, plain.best_costs, rtol=1e-6)
    assert found.mpc_costs.max() < 10 and found.verdict == "do not bother"


@pytest.mark.parametrize(
    ("shows", "takes", "message"),
    [
        ("plant", "normalized", r"normalized inputs, from \[-1.*RescaleAction"),
        ("deviation", "deviation", r"takes deviations, from \[-2.*plant units"),
        ("deviation", "plant", "temperature = .* is shown.* this is a deviation"),
    ],
)
def test_other_units_are_refused(shows, takes, message) -> None:
    with pytest.raises(ValueError, match=message):
        headroom(MPC, units.plant(shows, takes), n_starts=2)


class Settable(units.OwnUnits):
    """It bends upwards, and can be put into a state."""

    def reset(self, *, seed=None, options=None):
        shown, info = super().reset(seed=seed)
        if options:
            self.x = np.array(options["state"]) - units.X_SS
            shown = self.shows(self.x)
        return shown, info

    def step(self, action):
        found = super().step(action)
        self.x[0] += 0.05 * self.x[0] ** 2
        return self.shows(self.x), *found[1:]


class Deaf(Settable):
    """No reset puts it into a state."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)


def bent(cls: type[Settable] = Settable) -> gym.Env:
    return TimeLimit(cls("plant", "plant"), 20)


def put(env: gym.Env, x: np.ndarray) -> None:
    env.unwrapped.x = x - units.X_SS


class TwinError(Exception):
    """A twin was asked for: plans are not made in the env."""


@pytest.fixture
def no_twin(monkeypatch) -> None:
    def fit(*_args: object, **_options: object) -> None:
        raise TwinError

    monkeypatch.setattr(PlantTwin, "fit", fit)


@pytest.mark.usefixtures("no_twin")
def test_a_plant_is_put_into_its_own_states() -> None:
    assert headroom(MPC, bent(), n_starts=2).total > 0


@pytest.mark.usefixtures("no_twin")
def test_a_plant_with_set_points_is_put_into_its_own_states() -> None:
    assert headroom(tracking(), SetPoint(bent(), 349, 351), n_starts=2).total > 0


@pytest.mark.usefixtures("no_twin")
def test_a_plant_that_no_reset_puts_into_a_state_takes_a_function() -> None:
    with pytest.raises(TwinError):
        headroom(MPC, bent(Deaf), n_starts=2)
    first = headroom(MPC, bent(Deaf), n_starts=2, set_state=put)
    get = {"get_state": lambda env: env.unwrapped.x + units.X_SS}
    again = headroom(MPC, bent(Deaf), n_starts=2, set_state=put, **get)
    np.testing.assert_allclose(first.best_costs, again.best_costs, rtol=1e-6)


def test_what_puts_no_state_is_named() -> None:
    with pytest.raises(TypeError, match="set_state = 3 must be a function"):
        headroom(MPC, bent(Deaf), set_state=3)


@pytest.mark.parametrize("low", [-1, 353])
def test_set_points_that_are_not_the_problem_s_are_named(low) -> None:
    plant = SetPoint(units.plant("plant", "plant"), low, low + 2)
    with pytest.raises(
        ValueError,
        match=r"set-point of temperature (= -.* is a deviation|is 35.*, and the MPC was solved)",
    ):
        headroom(tracking(), plant, n_starts=2)


class Acid(gym.Env):
    """A pH, and a flow of base that does next to nothing far from neutral."""

    observation_space = gym.spaces.Box(0, 14, (1,), np.float64)
    action_space = gym.spaces.Box(0, 100, (1,), np.float64)

    def __init__(self, noise: float = 0.0) -> None:
        self.noise = noise

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.excess = np.sinh(self.np_random.uniform(-5, 5, 1))
        return 7 + np.arcsinh(self.excess), {}

    def step(self, action):
        self.excess = 0.95 * self.excess + action / 20 - 2.5
        seen = 7 + np.arcsinh(self.excess) + self.noise * self.np_random.standard_normal(1)
        return seen, 0.0, False, False, {}


def neutral() -> LinearMPC:
    model = LinearModel([[0.95]], [[0.05]], 1, [7], [50], state_names=["pH"])
    limits = {"x_min": 0, "x_max": 14, "u_min": 0, "u_max": 100}
    return LinearMPC(model, Q=[[1]], R=[[0.01]], horizon=3, **limits)


def test_nothing_found_with_plans_of_a_poor_twin_is_not_called_little() -> None:
    found = headroom(neutral(), TimeLimit(Acid(), 30), n_starts=6)
    assert found.verdict == "not known" and found.lost is not None and found.lost > 0
    assert "when played, they cost" in str(found)
    assert "Where the env repeats its steps" in str(found)


def test_what_neighbors_share_is_told_from_noise() -> None:
    mpc, rng = MPC.deviations, np.random.default_rng(0)

    class Model:
        def step(self, theta, u, rows):
            return mpc.predict(theta, u)

    theta, u = rng.uniform(-1, 1, (500, 2)), rng.uniform(-1, 1, (500, 1))
    after = mpc.predict(theta, u)
    noisy, bent = after + rng.normal(0, 0.1, after.shape), after + 0.1 * theta**2
    assert abs(lack_of_fit(Model(), mpc, theta, u, noisy)) < 0.2
    assert lack_of_fit(Model(), mpc, theta, u, bent) > 0.9
