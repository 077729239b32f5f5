"""References are reached without offset; steady states, and which references have one."""

from __future__ import annotations

import copy
import dataclasses
import pickle

import numpy as np
import pytest
from scipy import optimize

from general_problems import servo, solved
from sb3_yann import (
    DisturbanceBounds,
    DisturbanceObserver,
    LinearModel,
    LinearMPC,
    OutputBounds,
    PiecewiseAffine,
    RateLimits,
    Terminal,
    Tracking,
    offset_free,
)

TRACKING = ["servo", "servo with all of it", "two tanks, all parts", "more inputs than outputs"]


def reachable_constants(mpc: LinearMPC, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """References (count, p) and disturbances (count, d) with a steady state inside the bounds."""
    rng = np.random.default_rng(seed)
    parts = mpc.layout
    theta = rng.uniform(mpc.theta_min, mpc.theta_max, (20 * count, mpc.n_theta))
    r = theta[:, parts.reference]
    d = theta[:, parts.disturbance]
    inside = mpc.is_reachable(r, d)
    assert inside.sum() >= count
    return r[inside][:count], d[inside][:count]


@pytest.mark.parametrize("name", TRACKING)
def test_a_hundred_reachable_references_are_reached_without_offset(name: str) -> None:
    mpc = solved(name)
    r, d = reachable_constants(mpc, 100)
    start = np.zeros((100, mpc.n_theta))
    start[:, mpc.layout.constant] = np.hstack([r, d])
    theta = start
    for _ in range(150):
        theta = mpc.predict(theta, mpc.explicit()(theta))
    reached = theta[:, mpc.layout.state] @ mpc.tracking.C.T
    assert np.max(np.abs(reached - r)) < 1e-6


def test_with_as_many_disturbances_as_measurements_a_wrong_model_leaves_no_offset() -> None:
    mpc = solved("two tanks")
    observer = DisturbanceObserver(solved("two tanks").model)
    model = mpc.model
    # The plant: other gains, other poles, and a load that enters elsewhere.
    A = model.A * [[1.02, 1], [0.9, 0.97]]
    B = model.B * [[0.9, 1.2], [1, 1.1]]
    load = np.array([0.05, -0.03])
    r = np.array([0.2, 0.3])
    x = np.zeros(2)
    u = np.zeros(2)
    x_hat, d_hat = observer.reset(x)
    for _ in range(400):
        u = mpc.explicit()(np.concatenate([x_hat, r, d_hat]))
        x = A @ x + B @ u + load
        x_hat, d_hat = observer.update(x, u)
    np.testing.assert_allclose(x, r, atol=1e-6)
    blind = np.zeros(2)
    for _ in range(400):  # without the estimate there is an offset
        blind = A @ blind + B @ mpc.explicit()(np.concatenate([blind, r, 0 * d_hat])) + load
    assert np.max(np.abs(blind - r)) > 0.02


@pytest.mark.parametrize("name", TRACKING)
def test_the_steady_state_rests_and_shows_the_reference(name: str) -> None:
    mpc = solved(name)
    for r, d in zip(*reachable_constants(mpc, 5), strict=True):
        x, u = mpc.steady_state(r, d)
        np.testing.assert_allclose(mpc.model.step(x, u, d), x, atol=1e-12)
        np.testing.assert_allclose(mpc.tracking.C @ x, r, atol=1e-12)
        theta = np.concatenate([x, r, d, u[: mpc.layout.n_previous]])
        np.testing.assert_allclose(mpc.explicit()(theta), u, atol=1e-9)


def test_of_many_steady_states_it_is_the_cheapest() -> None:
    mpc = solved("more inputs than outputs")
    x, u = mpc.steady_state([0.3], [0.1, -0.1])
    A = mpc.model.A
    B = mpc.model.B

    def state(v: np.ndarray) -> np.ndarray:
        return np.linalg.solve(np.eye(2) - A, B @ v + mpc.model.E @ [0.1, -0.1])

    best = optimize.minimize(
        lambda v: state(v) @ mpc.Q @ state(v) + v @ mpc.R @ v,
        np.zeros(2),
        constraints={"type": "eq", "fun": lambda v: mpc.tracking.C @ state(v) - 0.3},
        tol=1e-14,
    )
    np.testing.assert_allclose(u, best.x, atol=1e-6)
    np.testing.assert_allclose(x, state(u), atol=1e-9)


def test_reachable_is_what_the_bounds_allow() -> None:
    mpc = servo(u_max=0.1)  # gain from u to x[0] at rest is 0.5 / 0.2 * 0.2 / 0.1 = 5
    assert mpc.is_reachable([0.49])
    assert not mpc.is_reachable([0.51])
    np.testing.assert_array_equal(mpc.is_reachable([[0.2], [0.9]]), [True, False])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"u_max": 0.1}, r"r = \[0.9\] with d = \[\] is not reachable: .*, and u\[0\] > u_max\[0"),
        ({"x_max": 0.5}, r"and x\[0\] > x_max\[0\]. Ask is_reachable"),
        ({"outputs": OutputBounds([[1, 1]], y_max=0.5)}, r"and y\[0\] > y_max\[0\]"),
    ],
)
def test_an_unreachable_reference_is_named_with_the_bound(
    changes: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        servo(**changes).steady_state([0.9])


def test_a_reference_of_another_shape_is_named() -> None:
    with pytest.raises(ValueError, match=r"r has shape \(2,\), expected \(1,\)"):
        servo().steady_state([1, 2])
    with pytest.raises(ValueError, match=r"d has shape \(1,\), expected \(0,\)"):
        servo().is_reachable([1], [1])


@pytest.mark.parametrize("horizon", [1, 5, 10])
def test_of_inputs_that_cost_their_moves_alone_the_least_norm_is_taken(horizon: int) -> None:
    mpc = LinearMPC(
        LinearModel([[0.8]], [[0.3, 0.2]], 1), Q=[[1]], R=np.zeros((2, 2)), horizon=horizon,
        u_min=-1, u_max=1, theta_min=-1, theta_max=1, tracking=Tracking([0], -0.5, 0.5),
        rate=RateLimits(R_du=np.eye(2)),
    )  # fmt: skip
    np.testing.assert_allclose(mpc.steady_states.u.ravel(), np.array([0.3, 0.2]) * 0.2 / 0.13)
    law = mpc.online()
    x = 0.0
    u = np.zeros(2)
    for _ in range(80):
        u = law([x, 0.3, *u])
        x = 0.8 * x + np.array([0.3, 0.2]) @ u
    np.testing.assert_allclose(x, 0.3, atol=1e-9)


# ---- The MPC with a disturbance of each state: what is added, and that all else stays ----


MPC = servo(x_min=[-5, -2], x_max=[5, 2])


def test_a_disturbance_is_a_twentieth_of_a_state_s_half_width_or_what_is_given() -> None:
    mpc, _ = offset_free(MPC)
    np.testing.assert_allclose(mpc.disturbances.d_max, [0.25, 0.1])
    np.testing.assert_allclose(mpc.disturbances.d_min, [-0.25, -0.1])
    np.testing.assert_array_equal(mpc.model.E, np.eye(2))
    given, _ = offset_free(MPC, [0.1, 0.5])
    assert given.disturbances.d_max.tolist() == [0.1, 0.5]
    assert mpc.theta_min.tolist() == [-5, -2, -1, -0.25, -0.1]
    for name in ("Q", "R", "u_min", "u_max", "x_min", "x_max"):
        np.testing.assert_array_equal(getattr(mpc, name), getattr(MPC, name))
    assert mpc.horizon == MPC.horizon and mpc.gamma == MPC.gamma


def test_the_observer_takes_all_noises_for_equal_in_half_widths() -> None:
    mpc, observer = offset_free(MPC)
    half = [5.0, 2.0]
    expected = DisturbanceObserver(
        mpc.model, state_noise=half, disturbance_noise=half, measurement_noise=half
    )
    np.testing.assert_array_equal(observer.gain, expected.gain)
    assert observer.model is mpc.model and observer.n_measured == 2


def test_names_and_operating_point_stay_and_a_terminal_set_is_solved_anew() -> None:
    model = dataclasses.replace(MPC.model, x_ss=[3.0, 4.0], u_ss=[5.0])
    named = model.named(["a", "b"], ["c"], {"a": "K"})
    shift = named.x_ss
    box = {"x_min": MPC.x_min + shift, "x_max": MPC.x_max + shift, "u_min": MPC.u_min + 5}
    box |= {"theta_min": MPC.theta_min[:2] + shift, "theta_max": MPC.theta_max[:2] + shift}
    box |= {"tracking": Tracking([0], MPC.tracking.r_min + 3, MPC.tracking.r_max + 3)}
    given = dataclasses.replace(MPC, model=named, **box, u_max=MPC.u_max + 5)
    mpc, _ = offset_free(given)
    assert (mpc.model.state_names, mpc.model.input_names) == (("a", "b"), ("c",))
    assert mpc.model.units == ("K", "", "")
    assert [*mpc.model.x_ss, *mpc.model.u_ss] == [3, 4, 5]
    assert len(mpc.terminal.set[1]) == 0
    assert len(offset_free(solved("invariant"))[0].terminal.set[1]) > 0


def test_the_notes_of_the_model_stay_and_its_drift_is_made_up_for() -> None:
    noted = LinearModel(
        [[0.8]], [[0.3]], 2.0, notes=["fitted to a log"], drift=[0.4], state_names=["T"]
    )
    with pytest.warns(UserWarning, match="no steady state"):
        mpc = LinearMPC(noted, Q=[[1]], R=[[1]], horizon=2, x_min=-3, x_max=3, u_min=-1, u_max=1)
    model = offset_free(mpc)[0].model
    assert (model.notes, model.drift.tolist(), model.dt) == (("fitted to a log",), [0.0], 2.0)
    assert "Note: fitted to a log" in model.report()


def test_a_terminal_cost_that_was_given_stays() -> None:
    mpc = dataclasses.replace(MPC, terminal=Terminal(cost=7 * np.eye(2)))
    np.testing.assert_array_equal(offset_free(mpc)[0].terminal.cost, 7 * np.eye(2))


def test_that_disturbances_are_estimated_survives_copies_pickles_files_and_replace(tmp_path):
    mpc, _ = offset_free(MPC)
    mpc.explicit().save(tmp_path / "law.npz")
    copies = [
        copy.deepcopy(mpc).model,
        pickle.loads(pickle.dumps(mpc)).model,
        dataclasses.replace(mpc, horizon=3).model,
        dataclasses.replace(mpc.model, dt=0.5),
        mpc.model.named(["a", "b"]),
        PiecewiseAffine.load(tmp_path / "law.npz").model,
    ]
    assert [each.estimated for each in copies] == 6 * [(0, 1)]
    assert MPC.model.estimated == ()


def test_nothing_calls_an_estimated_disturbance_measured() -> None:
    mpc, _ = offset_free(MPC)
    for text in (mpc.model.report(), mpc.report(samples=20), repr(mpc.model)):
        assert "measured" not in text and "estimate" in text


def test_measured_disturbances_stay_before_the_estimated_ones() -> None:
    mpc, observer = offset_free(solved("servo with a disturbance"), [0.3, 0.4])
    assert (mpc.model.estimated, mpc.model.measured) == ((1, 2), (0,))
    assert (observer.n_estimated, observer.n_known) == (2, 1)
    given = solved("servo with a disturbance")
    np.testing.assert_array_equal(mpc.model.E, np.hstack([given.model.E, np.eye(2)]))
    assert mpc.disturbances.d_max.tolist() == [*given.disturbances.d_max, 0.3, 0.4]


@pytest.mark.parametrize("estimated", [[1], [-1], [0, 0], [0.5], 0, "0"])
def test_an_index_of_no_disturbance_is_named(estimated) -> None:
    with pytest.raises((TypeError, ValueError), match="estimated"):
        LinearModel([[0.5]], [[1]], 1, E=[[1]], estimated=estimated)


def test_what_estimates_disturbances_already_or_is_no_mpc_is_named() -> None:
    with pytest.raises(ValueError, match="has 2 estimated disturbances already"):
        offset_free(offset_free(MPC)[0])
    with pytest.raises(TypeError, match=r"mpc = LinearModel.* must be a LinearMPC"):
        offset_free(MPC.model)
    for wrong in ([0.1, 0.0], [0.1, -1.0], [0.1]):
        with pytest.raises(ValueError, match="d_max"):
            offset_free(MPC, wrong)


@pytest.mark.parametrize("measured", [None, [0]])
def test_a_plant_with_a_load_that_is_measured_settles_without_offset(measured) -> None:
    model = LinearModel([[0.9, 0.2], [0, 0.8]], [[0], [0.5]], 1.0, E=[[0.3], [0.1]])
    preview = DisturbanceBounds(-1, 1, preview=2)
    mpc, observer = offset_free(servo(model, disturbances=preview, horizon=5), measured=measured)
    assert mpc.layout.names[2:6] == ("r[0]", "d[0]", "d_1[0]", "d_2[0]")
    x = np.zeros(2)
    load = np.array([0.5])
    law = mpc.online()
    y = slice(0, 2 if measured is None else 1)
    x_hat, d_hat = observer.reset(x[y])
    for _ in range(300):
        u = law(np.concatenate([x_hat, [0.7], np.tile(load, 3), d_hat]))
        x = model.A @ [0.98 * x[0], x[1]] + 1.1 * model.B @ u + 0.8 * model.E @ load + [0.05, 0]
        x_hat, d_hat = observer.update(x[y], u, load)
    assert x[0] == pytest.approx(0.7, abs=1e-6)
    with pytest.raises(ValueError, match="Measure what is tracked"):
        offset_free(MPC, measured=[1])
