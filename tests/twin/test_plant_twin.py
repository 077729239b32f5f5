"""A twin predicts what it has not seen, and says what it is worth."""

import dataclasses
import hashlib

import numpy as np
import pytest
from stable_baselines3 import DDPG

from general_problems import solved
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
from sb3_yann.evaluation.plots import plot_twin
from sb3_yann.twin import trust as trusts
from sb3_yann.twin.log import Episode, as_episodes, more_of
from sb3_yann.twin.selection import FreeRuns
from sb3_yann.twin.trust import report
from twin_samples import DT, POLYNOMIALS, Cart, log, problem, random_episode, twin


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


def test_sensor_noise_shrinks_the_residual() -> None:
    noisy = PlantTwin.fit(problem(), log(5, noise=0.01))
    assert noisy.kind != twin().kind


def test_a_report_has_the_fingerprint_of_the_log() -> None:
    digest = hashlib.sha256(b"".join(each.tobytes() for pair in log(5) for each in pair))
    said = f"Fingerprint of its states and inputs (SHA-256): {digest.hexdigest()[:16]}."
    assert twin().report().startswith(f"{said}\nThe log: 5 episodes")


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
    with pytest.raises(TypeError, match="references must be a list with an entry for each"):
        PlantTwin.fit(problem(), log(2), references=iter([[0.0], [0.0]]))
    huge = [(1e200 * x, u) for x, u in log(2)]
    with pytest.raises(ValueError, match="NaN or infinite entries in 61 rows, first in row 0"):
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


def runs(*errors: list[float]) -> FreeRuns:
    """Return errors 1 and 10 steps ahead, of the given model first."""
    return FreeRuns(np.array([1, 10]), np.array(errors, float)[:, None])


def judged(found: FreeRuns, standing=(1.0, 1.0), **changes):
    """Return problems and advice on a log with nothing against it, but for the changes."""
    given = {
        "costs": (np.array([10.0, 20.0]), np.array([10.0, 20.0])),
        "inputs": (np.array([0.5]), np.array([0.5])),
        "n_episodes": 5,
        "beyond": (0.0, "x[0]"),
    }
    problems, advice = trusts.judge(found, np.array(standing), **(given | changes))
    return " ".join(problems), " ".join(advice)


GOOD = [0.1, 0.2]


def test_of_one_record_what_is_lacking_are_rows_and_hours() -> None:
    log = as_episodes(problem(), [(np.arange(0, 0.9, 0.01)[:, None] * [1, 0], np.zeros((89, 1)))])
    pieces = (*log, Episode(log[0].thetas[-1:].repeat(12, 0), log[0].actions[:11]))
    unit = dataclasses.replace(problem(), model=problem().model.named(time_unit="min"))
    assert more_of(unit, pieces, 3) == f"300 rows ({300 * problem().model.dt / 60:.3g} h)"
    assert more_of(unit, (*pieces, *log), 3) == more_of(unit, log, 3) == "3 episodes"


def test_the_edges_of_what_is_trusted() -> None:
    assert judged(runs(GOOD), beyond=(0.049, "x[0]")) == ("", "")
    assert "6 % of the logged x[0] lie beyond" in judged(runs(GOOD), beyond=(0.06, "x[0]"))[0]
    for error, refused in ((0.24, False), (0.26, True)):
        costs = np.array([10.0, 10.0]) * (1 + error), np.array([10.0, 10.0])
        said = judged(runs(GOOD), costs=costs)[0]
        assert bool(said) == refused
    assert said.endswith("held-out episodes err by 26 % of the mean; 25 % are the most.")
    assert "Log 5 episodes more" in judged(runs(GOOD), costs=costs)[1]
    inputs = np.array([0.019, 0.021, 0.0]), np.array([0.1, 0.1, 0.9e-4])
    problems, advice = judged(runs(GOOD), inputs=inputs)
    assert problems == "u[2] never moves: what it does is not in the log."
    assert "u[0] follows the MPC (1.90 % of its variance is its own)" in advice
    assert "u[1]" not in advice
    named = judged(runs(GOOD), inputs=inputs, names=["steam", "feed", "reflux"])
    assert "reflux never moves" in named[0] and "step test on reflux" in named[1]


def test_the_report_counts_what_it_leaves_out_and_says_what_the_log_does_not_show() -> None:
    mpc = solved("servo")
    still = tuple(random_episode(mpc, 10, seed) for seed in range(12))
    for each in still:
        each.thetas[:, 2] = 0.25
    given = dataclasses.replace(
        twin().trust, predicted=np.arange(12.0), actual=np.arange(12.0) + 0.5
    )
    said = report(mpc, still, "linear", given).splitlines()
    assert said[1] == "The log shows one value alone of r[0]: elsewhere the MPC will act."
    at = said.index("Cost of held-out episodes (or pieces of them), predicted and actual:")
    rows = [tuple(map(float, each.split())) for each in said[at + 1 : at + 11]]
    assert rows == [(i, i + 0.5) for i in range(10)] and said[at + 11] == "  ... and 2 more"
    still[3].thetas[2, 2] = 0.3
    ten = dataclasses.replace(given, predicted=np.arange(10.0), actual=np.arange(10.0) + 0.5)
    text = report(mpc, still, "linear", ten)
    assert "one value alone" not in text and "more" not in text.split("error")[0]
    table = [each.split() for each in text.splitlines() if each.startswith("  nothing moves")]
    assert [float(each) for each in table[0][2:]] == pytest.approx(given.standing, rel=1e-2)
    rows = {each[:17].strip(): each[19:].split() for each in text.splitlines()}
    chosen = given.chosen
    errors = given.runs.errors
    assert [float(e) for e in rows["linear model"]] == pytest.approx(errors[0], rel=1e-2)
    assert [float(e) for e in rows["twin"]] == pytest.approx(errors[chosen], rel=1e-2)
    none = dataclasses.replace(given, predicted=np.zeros(0), actual=np.zeros(0))
    for part in ("Error of free runs", "Cost of held-out"):
        assert part in text and part not in report(mpc, still, "linear", none)


def test_without_a_second_episode_the_pictures_are_empty() -> None:
    none = dataclasses.replace(twin().trust, predicted=np.zeros(0), actual=np.zeros(0))
    costs, runs = plot_twin(none)
    assert not costs.lines and not runs.lines and runs.get_xscale() == "linear"
    assert (costs.get_xlabel(), runs.get_xlabel()) == ("predicted cost", "steps ahead")
