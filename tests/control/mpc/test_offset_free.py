"""The MPC with a disturbance of each state: what is added, and that all else stays."""

from __future__ import annotations

import copy
import dataclasses
import pickle

import numpy as np
import pytest

from general_problems import servo, solved
from sb3_yann import (
    DisturbanceBounds,
    DisturbanceObserver,
    LinearModel,
    LinearMPC,
    PiecewiseAffine,
    Terminal,
    Tracking,
    offset_free,
)

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
    x, load, law = np.zeros(2), np.array([0.5]), mpc.online()
    y = slice(0, 2 if measured is None else 1)
    x_hat, d_hat = observer.reset(x[y])
    for _ in range(300):
        u = law(np.concatenate([x_hat, [0.7], np.tile(load, 3), d_hat]))
        x = model.A @ [0.98 * x[0], x[1]] + 1.1 * model.B @ u + 0.8 * model.E @ load + [0.05, 0]
        x_hat, d_hat = observer.update(x[y], u, load)
    assert x[0] == pytest.approx(0.7, abs=1e-6)
    with pytest.raises(ValueError, match="Measure what is tracked"):
        offset_free(MPC, measured=[1])
