"""Which residual is chosen: candidates, what they are fitted to, and their free runs."""

import dataclasses
from itertools import combinations_with_replacement

import numpy as np
import pytest

from general_problems import solved
from sb3_yann import LinearModel, LinearMPC, PlantTwin, Tracking, UntrustedTwinError
from sb3_yann.control import OutputBounds, Terminal
from sb3_yann.evaluation import evaluate
from sb3_yann.twin.dynamics import Coordinates
from sb3_yann.twin.log import Episode
from sb3_yann.twin.row_layout import RowLayout
from sb3_yann.twin.selection import FreeRuns, Setting, reidentified, ridge
from twin_samples import Cart, log, problem, twin
from twin_samples import random_episode as episode


@pytest.mark.parametrize("name", ["regulator with rates", "servo with all of it"])
@pytest.mark.parametrize("degree", [1, 2])
def test_weights_are_those_of_a_ridge_regression_on_what_the_model_leaves(name, degree) -> None:
    mpc = solved(name)
    log = [episode(mpc, seed=seed) for seed in range(4)]
    box = Coordinates.of(RowLayout(mpc), log[1:])  # the first one lies outside of it in part
    (found,) = ridge(box, log, [Setting(degree, 1e-3, 30.0)])
    z, y = (np.concatenate(each) for each in zip(*map(box.regression, log), strict=True))
    k = z.shape[1]
    constant = mpc.layout.has_constants
    powers = [p for d in range(1, degree + 1) for p in combinations_with_replacement(range(k), d)]
    F = np.column_stack([np.prod(z[:, p], axis=1) for p in map(list, powers)])
    weight = np.array([1e-3 * (30 if k - 1 in p else 1) for p in powers])
    if constant:
        F = np.column_stack([F, np.ones(len(F))])
        weight = np.append(weight, 0.0)
    solution = np.linalg.solve(F.T @ F + len(F) * np.diag(weight), F.T @ y)
    np.testing.assert_allclose(found.predict(z), F @ solution, rtol=1e-4, atol=1e-8)
    at_rest = found.predict(np.zeros((1, k)))
    np.testing.assert_allclose(at_rest, solution[-1:] if constant else 0.0, atol=1e-7)


def runs(*scores: list[float]) -> FreeRuns:
    """Return free runs with these scores of each candidate, by episode."""
    return FreeRuns(np.array([5]), np.exp(np.array(scores))[:, :, None])


def test_the_first_is_taken_of_what_is_one_standard_error_from_the_best() -> None:
    behind = np.array([0.1, 0.2, 0.3, 0.0])
    error = behind.std(ddof=1) / 2  # of four episodes
    best = np.array([0.0, -3.0, 2.0, 1.0])
    for mean, chosen in ((0.99 * error, 1), (1.01 * error, 2)):
        near = best + behind - behind.mean() + mean
        assert runs([9.0] * 4, [*near], [*best]).choose() == chosen
    assert runs([1.0, 2.0], [1.0, 2.0]).choose() == 0
    assert runs([0.0, 0.0], [2.0, 2.0], [1.0, 1.0]).choose(1) == 2


PUMP = 0.07
LEAK = 0.02
"""What a level gains by the pump, and loses, in a step; the model says 0.1 and nothing."""


def tank() -> LinearMPC:
    return LinearMPC(
        LinearModel([[0.9]], [[0.1]], dt=1.0, x_ss=[5.0], u_ss=[3.0]),
        Q=[[1.0]], R=[[0.1]], horizon=3, u_min=1, u_max=5, theta_min=2, theta_max=8,
        tracking=Tracking([0], 4, 6), outputs=OutputBounds([[2.0]], 5, 15),
        terminal=Terminal(set="invariant"),
    )  # fmt: skip


def worn_log(
    mpc: LinearMPC, pump: float = PUMP, leak: float = LEAK, noise: float = 1e-3
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return episodes of a tracking MPC on the tank."""
    rng = np.random.default_rng(0)
    found = []
    law = mpc.explicit().plant_input
    for _ in range(6):
        theta = [5 + np.array([rng.uniform(-1, 1), rng.uniform(-1, 1)])]
        inputs = []
        for _ in range(40):
            x, r = theta[-1]
            inputs.append(law([x, r]))
            moved = pump * (inputs[-1][0] - 3) - leak + noise * rng.standard_normal()
            x = 5 + 0.9 * (x - 5) + moved
            theta.append(np.array([x, r]))
        found.append((np.array(theta), np.array(inputs)))
    return found


def test_a_log_of_the_cart_corrects_its_model_and_keeps_all_else() -> None:
    found = twin(10).reidentified()
    for states, actions in log(3, first=50):
        given, today = (
            np.square(mpc.predict(states[:-1], actions) - states[1:]).mean()
            for mpc in (problem(), found)
        )
        assert today < 0.8 * given
    old, new = (
        evaluate(each.explicit(), Cart, range(900, 940)).costs for each in (problem(), found)
    )
    assert np.median(new) < 0.99 * np.median(old)  # a few run away with either
    for name in ("horizon", "gamma", "layout"):
        assert getattr(found, name) == getattr(problem(), name)
    for name in ("Q", "R", "u_min", "u_max", "theta_min", "theta_max"):
        np.testing.assert_array_equal(getattr(found, name), getattr(problem(), name))


def test_with_set_points_the_operating_point_is_where_the_plant_rests_today() -> None:
    named = tank().model.named(["level"], units={"level": "cm"})
    noted = LinearModel(**{**vars(named), "notes": ["Fitted once."]})
    mpc = dataclasses.replace(tank(), model=noted)
    found = PlantTwin.fit(mpc, worn_log(mpc)).reidentified()
    assert [each[:13] for each in found.model.notes] == ["Re-identified"]  # what is true of it
    assert (found.model.state_names, found.model.units) == (("level",), ("cm", ""))
    np.testing.assert_allclose(found.model.B, [[PUMP]], rtol=0.05)
    np.testing.assert_allclose(found.model.x_ss, [5.0], atol=1e-9)  # so that r stays what it is
    moved = found.model.u_ss - mpc.model.u_ss
    np.testing.assert_allclose(moved, [LEAK / PUMP], rtol=0.05)
    np.testing.assert_allclose(found.deviations.u_max, 2 - moved)
    assert found.layout == mpc.layout
    assert len(found.terminal.set[1]) > 0
    for (old, _), (new, _) in zip(worn_log(mpc), worn_log(found), strict=True):
        x, r = new[-10:].T
        assert np.abs(x.mean() - r[0]) < 0.01 < np.abs(old[-10:, 0].mean() - r[0])
    far = dataclasses.replace(mpc, terminal=Terminal())  # bounds it was not given: no warning
    found = PlantTwin.fit(far, worn_log(far, leak=0.15)).reidentified()
    assert found.model.u_ss > far.u_max


def test_what_drifts_is_not_taken_for_a_pole_where_there_are_no_set_points() -> None:
    given = {"tracking": None, "terminal": Terminal(), "theta_min": 2, "theta_max": 8}
    mpc = dataclasses.replace(tank(), **given)
    rng = np.random.default_rng(3)
    law = mpc.explicit().plant_input
    episodes = []
    for _ in range(6):
        x = [np.array([rng.uniform(4, 6)])]
        u = []
        for _ in range(40):
            u.append(np.clip(law(x[-1]) + 0.1 * rng.standard_normal(1), 1, 5))
            x.append(5 + 0.9 * (x[-1] - 5) + PUMP * (u[-1] - 3) - LEAK)
        episodes.append(Episode(np.array(x) - 5, np.array(u) - 3))
    found = reidentified(mpc, Coordinates.of(RowLayout(mpc), episodes), tuple(episodes))
    np.testing.assert_allclose([found.model.A, found.model.B], [[[0.9]], [[PUMP]]], atol=0.01)
    assert found.model.u_ss == mpc.model.u_ss


def test_where_the_model_is_right_the_mpc_is_the_given_one() -> None:
    mpc = tank()
    assert PlantTwin.fit(mpc, worn_log(mpc, pump=0.1, leak=0.0)).reidentified() is mpc


def test_a_twin_that_is_not_trusted_identifies_nothing() -> None:
    with pytest.raises(UntrustedTwinError, match="There is one episode"):
        PlantTwin.fit(problem(), log(1)).reidentified()


def test_a_worn_plant_s_set_points_lie_within_the_limits_of_its_twin() -> None:
    mpc = tank()
    rows = worn_log(mpc, pump=0.03)
    reached, asked = (np.array([theta[:, k] for theta, _ in rows]) for k in (0, 1))
    assert asked.max() > reached.max() + 0.25 * np.ptp(reached)  # the log alone does not show it
    found = PlantTwin.fit(mpc, rows)
    at = mpc.units.to_deviations(np.column_stack([asked[:, 0], asked[:, 0]]))
    assert not found.limits.violated(at).any()
