"""A twin predicts what it has not seen, and says what it is worth."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from stable_baselines3 import DDPG

from sb3_yann import (
    AffineObservation,
    ImprovementGuard,
    LinearModel,
    LinearMPC,
    Log,
    NoActionNoise,
    PlantTwin,
    RateLimits,
    UntrustedTwinError,
    YannPolicy,
)
from twin_samples import DT, POLYNOMIALS, Cart, log, problem, twin


def test_it_predicts_episodes_that_it_has_not_seen() -> None:
    found = twin()
    assert found.trusted and found.kind.startswith("quadratic")
    for states, actions in log(3, first=50):
        thetas, _ = found.dynamics.roll_out(
            lambda rows: np.zeros((len(rows), 1)), np.repeat(states[None, :1], 5, axis=0), 1
        )
        assert thetas.shape == (2, 5, 1, 2)
        after = found.dynamics.step(states[None, :-1].repeat(5, 0), actions[None].repeat(5, 0))
        np.testing.assert_allclose(after, states[None, 1:].repeat(5, 0), atol=5e-3)


def test_the_same_log_gives_the_same_twin() -> None:
    again = PlantTwin.fit(problem(), log(5), residuals=POLYNOMIALS)
    for one, other in zip(twin().dynamics.members, again.dynamics.members, strict=True):
        for ours, theirs in zip(one.weights, other.weights, strict=True):
            np.testing.assert_array_equal(ours, theirs)


def test_sensor_noise_is_measured_and_shrinks_the_residual() -> None:
    noisy = PlantTwin.fit(problem(), log(5, noise=0.01))
    np.testing.assert_allclose(noisy.trust.noise, 0.01, rtol=0.3)
    assert noisy.kind != twin().kind


@pytest.mark.parametrize(
    ("episodes", "message"),
    [
        (lambda: log(1), "There is one episode"),
        (lambda: log(3, act=lambda x: [0.5]), "never moves: what it does is not in the log"),
        (lambda: [(100 * x, u) for x, u in log(3)], "beyond the problem's box of theta"),
        (lambda: log(5, noise=0.3), "Predicted costs of held-out episodes err by"),
    ],
)
def test_what_cannot_be_trusted_says_why_and_is_refused(episodes, message) -> None:
    found = PlantTwin.fit(problem(), episodes())
    assert not found.trusted and "not trusted" in repr(found)
    assert message in found.report() and "Verdict: NOT trusted; the MPC stays." in found.report()
    for refused in (found.env, lambda: ImprovementGuard(found)):
        with pytest.raises(UntrustedTwinError, match=message):
            refused()


def test_residuals_are_chosen_from_what_is_asked_for() -> None:
    found = PlantTwin.fit(problem(), log(3), residuals=["none"])
    assert found.kind == "none"
    assert np.all(found.dynamics.residual(np.ones((5, 1, 2)), np.ones((5, 1, 1))) == 0)
    with pytest.raises(ValueError, match="must be a list of some of"):
        PlantTwin.fit(problem(), log(3), residuals=["quartic"])


def test_a_guard_refuses_a_twin_of_another_problem_or_of_other_observations() -> None:
    other = DDPG("YannPolicy", "CSTR-v0", device="cpu", learning_starts=0)
    with pytest.raises(ValueError, match=r"Fit the twin with model\.policy\.problem"):
        other.learn(5, callback=[NoActionNoise(), ImprovementGuard(twin())])
    options = {"observation": AffineObservation.identity(2), "problem": problem()}
    model = DDPG(YannPolicy, Cart(), policy_kwargs=options, learning_starts=0)
    with pytest.raises(ValueError, match="The twin shows theta"):
        model.learn(5, callback=[NoActionNoise(), ImprovementGuard(twin())])


def test_a_short_piece_of_a_log_changes_nothing_that_matters() -> None:
    states, actions = log(1, first=70)[0]
    found = PlantTwin.fit(problem(), [*log(5), (states[:8], actions[:7])])
    assert found.trusted and found.trust.runs.horizons[-1] == 60


def test_a_model_that_is_far_worse_than_none_is_that_of_another_plant() -> None:
    plain = problem()
    model = LinearModel(plain.model.A, 200 * plain.model.B, plain.model.dt)
    foreign = dataclasses.replace(plain, model=model, terminal=None)
    found = PlantTwin.fit(foreign, log(3), residuals=["quadratic"])
    assert not found.trusted and "far worse than 'nothing moves'" in found.report()


def test_a_theta_that_forgets_the_input_before_it_is_not_trusted() -> None:
    limited = dataclasses.replace(problem(), rate=RateLimits(-2, 2), terminal=None)
    whole = [(np.hstack([x, np.vstack([[0.0], u])]), u) for x, u in log(4)]
    forgetful = [(np.hstack([x, np.zeros((len(x), 1))]), u) for x, u in log(4)]
    wrong = "theta does not hold the input before it"
    assert wrong not in PlantTwin.fit(limited, whole).report()
    found = PlantTwin.fit(limited, forgetful)
    assert not found.trusted and wrong in found.report()


def test_what_is_no_list_of_a_log_is_named() -> None:
    for wrong in (None, 5.0):
        with pytest.raises(TypeError, match="episodes must be a list of pairs"):
            PlantTwin.fit(problem(), wrong)
    with pytest.raises(TypeError, match="previous must be a list with an entry for each"):
        PlantTwin.fit(problem(), log(2), previous=iter([[0.0], [0.0]]))
    huge = [(1e200 * x, u) for x, u in log(2)]
    with pytest.raises(ValueError, match="not finite, or too large, in row 0"):
        PlantTwin.fit(problem(), huge)
    with pytest.raises(ValueError, match="seed = -1"):
        PlantTwin.fit(problem(), log(2), seed=-1)


@pytest.mark.parametrize(
    ("dt", "unit", "own_unit"), [(2.0, "", ""), (1.0, "s", "min"), (59.0, "s", "min")]
)
def test_a_log_of_another_sampling_time_is_refused(dt: float, unit: str, own_unit: str) -> None:
    model = LinearModel([[0.9]], [[0.5]], 1.0, time_unit=own_unit)
    mpc = LinearMPC(model, Q=[[1]], R=[[1]], horizon=3, x_min=-5, x_max=5, u_min=-1, u_max=1)
    rng = np.random.default_rng(0)
    log = Log.from_arrays(rng.normal(size=(31, 1)), rng.normal(size=(30, 1)), dt, time_unit=unit)
    with pytest.raises(ValueError, match=f"sampled every {dt:g}.*, the model of the MPC every 1"):
        PlantTwin.fit(mpc, log)


def test_of_a_log_with_gaps_pieces_of_five_steps_are_kept_and_the_rest_is_said() -> None:
    states, inputs = (np.array(each) for each in zip(*log(3), strict=True))
    times = [DT * np.arange(61)] * 3
    times[1] = times[1] + 0.6 * DT * (np.arange(61) > 20) + 100.0 * (np.arange(61) > 23)
    given = Log.from_arrays(states, inputs, DT, time=times)
    found = PlantTwin.fit(problem(), given, residuals=["none"])
    assert [len(each) for each in found.episodes] == [60, 20, 36, 60]
    np.testing.assert_array_equal(found.episodes[2].thetas, states[1, 24:])
    assert "Left out 1 pieces of less than 5 steps; 2 steps were gaps." in found.report()
