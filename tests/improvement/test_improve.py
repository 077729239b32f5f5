"""A policy that is improved is better on the plant, or stays what it was."""

import copy
import importlib
import pickle
from contextlib import closing
from dataclasses import replace
from functools import cache, partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium.wrappers import TimeLimit
from sb3_contrib import TQC
from stable_baselines3 import DDPG, PPO, SAC, TD3

from guard_samples import random_states
from improvement_samples import FEW, Counted, Elsewhere, Plain, Spring, bits, model_of, quick
from sb3_yann import (
    LinearMPC,
    NoActionNoise,
    PlantTwin,
    Tracking,
    UntrustedTwinError,
    YannPolicy,
    headroom,
    improve,
)
from sb3_yann.audit.reward import CostMismatchWarning
from sb3_yann.compare import TOO_LITTLE
from sb3_yann.evaluation import evaluate
from sb3_yann.improvement import Check, Improvement, confirmation, imitation
from sb3_yann.improvement.imitation import Teacher, fit_layer
from sb3_yann.twin.forecast import Forecast
from sb3_yann.wrappers import SetPoint
from twin_samples import Calm, observed_env, offset_free_problem, problem
from weights import is_mpc

UNSEEN = range(900, 930)
SIMULATED = {kind: {"simulator": True} for kind in (SAC, TQC, PPO)}
NIGHTLY = pytest.mark.nightly
pytestmark = pytest.mark.usefixtures("brisk")
module = importlib.import_module("sb3_yann.improvement.improving")


@cache
def mpc_cost() -> np.ndarray:
    return evaluate(problem().explicit(), Spring, UNSEEN).costs


def relative(model) -> np.ndarray:
    """Return what unseen episodes cost, relative to the MPC."""
    return evaluate(model, Spring, UNSEEN).costs / mpc_cost()


@cache
def better() -> bytes:
    """Return a model that was improved, pickled."""
    with pytest.MonkeyPatch.context() as patch:
        quick(patch)
        model = model_of()
        found = improve(model, Spring, **FEW)
    return pickle.dumps((bits(model), found, model.policy.state_dict()))


@pytest.mark.parametrize("kind", [DDPG, TD3, SAC, TQC, pytest.param(PPO, marks=NIGHTLY)])
def test_a_policy_gains_on_starts_that_it_has_not_seen(kind, tmp_path) -> None:
    th.manual_seed(3)
    model = model_of(kind=kind, **SIMULATED.get(kind, {}))
    drawn = random_states()
    found = improve(model, Spring, **FEW)
    assert random_states() == drawn
    if kind is DDPG:  # its seed repeats it
        weights, before, _ = pickle.loads(better())
        assert bits(model) == weights and found.policy == before.policy
        assert found.checks == before.checks
    assert found.accepted and found.where == "the simulator" and found.model is model
    assert found.change < -0.01 and found.checks[-1].final
    assert relative(model).mean() < 0.99 and relative(model).max() < 1.005
    target = model.policy.actor_target.state_dict()
    own = model.policy.actor.state_dict()
    assert all(th.equal(target[name], each) for name, each in own.items())
    model.save(tmp_path / "model")
    again = kind.load(tmp_path / "model", env=Spring())
    theta = np.float32([0.5, -0.2])
    one, two = (each.predict(theta, deterministic=True)[0] for each in (again, model))
    np.testing.assert_array_equal(one, two)
    (kept,) = again.improvements
    assert kept.report() == found.report() and kept.model is None
    assert kept.settings == {**FEW, "confine": True, "seed": 0} and kept.policy == found.policy
    again.learn(15, callback=None if kind in SIMULATED else NoActionNoise())


@pytest.mark.parametrize("confine", [True, False])
def test_beyond_what_its_episodes_show_the_mpc_acts_alone(confine) -> None:
    model = model_of()
    if confine:
        model.policy.load_state_dict(pickle.loads(better())[2])
    else:
        env = Spring()  # it is copied, and left where it is
        env.reset(seed=5)
        x = env.x.copy()
        assert improve(model, env, confine=False, **FEW).accepted
        assert env.t == 0 and np.array_equal(env.x, x)
    layer = model.policy.actor.mu
    begins = np.array([each[0] for each in evaluate(model, Spring, UNSEEN).observations])
    far = th.as_tensor(1.5 * np.abs(begins).max(0) * [[1, 1], [-1, 1]])
    assert layer.confined(th.as_tensor(0.9 * begins)).min() == 1
    assert layer.confined(far).tolist() == [[1.0 - confine]] * 2


@pytest.mark.parametrize("share", [1.0, 0.999, 0.3, 0.004])
def test_it_takes_no_step_more_than_it_may_and_closes_its_envs(share) -> None:
    most = max(int(share * pickle.loads(better())[1].steps), 1)
    Counted.forget()
    model = model_of(Counted)
    before = bits(model)
    made = Counted.made
    found = improve(model, Counted, max_steps=most, **FEW)
    assert found.steps == Counted.steps <= most
    assert Counted.closed == Counted.made - made
    assert found.accepted == (share == 1.0)
    if found.accepted:
        assert f"{found.steps:,} of the simulator" in str(found)
        # The first episode is played twice, and the input is pushed once from five starts.
        assert 20 * (found.episodes + 1) + 5 == found.steps > 0
    else:
        assert bits(model) == before and found.change == 0.0
        assert f"max_steps = {most:,} are too few to go on" in found.reason
        needed = "at best 3,225, for all rounds and tries 14,425 are needed"
        assert (needed if share > 0.01 else "an episode takes more") in found.reason
        assert share != 0.3 or found.steps == 21  # it is known after one episode, and a push
        assert "The model is as it was" in found.report()


def test_no_fewer_steps_are_called_needed_than_did_not_suffice(monkeypatch) -> None:
    monkeypatch.setattr(module.Simulator, "needed", lambda _, later: later)  # episodes grew longer
    found = improve(model_of(), Spring, max_steps=450, **FEW)
    assert "taken; for all rounds and tries 660 are needed" in found.reason


def test_where_there_is_nothing_to_gain_the_model_stays_bit_for_bit(monkeypatch) -> None:
    monkeypatch.setattr(Teacher, "teach", None)  # no plan beats the MPC
    model = model_of(Plain)
    before = bits(model)
    found = improve(model, Plain, **FEW)
    assert not found.accepted and found.change == 0.0 and is_mpc(model)
    assert found.reason.startswith("Nothing better was found: plans ")
    assert bits(model) == before


@pytest.mark.parametrize("share", [0.3, -0.3])
def test_whatever_is_taught_nothing_worse_is_accepted(monkeypatch, share) -> None:
    def wrong(layer, problem, rows, inputs, rng, updates):
        for each in layer.network.weights():
            with th.no_grad():
                each.add_(share)

    monkeypatch.setattr("sb3_yann.improvement.imitation.fit_layer", wrong)
    model = model_of()
    before = bits(model)
    found = improve(model, Spring, **FEW)
    assert not found.accepted and found.reason and bits(model) == before


def test_ten_starts_that_show_no_gain_leave_it_to_the_confirmation(monkeypatch) -> None:
    check = module.SimulatorTrial.check

    def none_gains(trial, *given, final):
        found, rest = check(trial, *given, final=final)
        return found if final else replace(found, change=1e-3, accepted=False), rest

    show = Teacher.show
    guessed = []  # by plans of a round: whether they may begin with what the policy does by then

    def recorded(teacher, act=None, played=None):
        if played is None:
            rows = teacher.scenarios.starts[:, : problem().n_theta]
            guessed.append(act is not None and not np.allclose(act(rows), teacher.law(rows)))
        show(teacher, act, played)

    monkeypatch.setattr(module.SimulatorTrial, "check", none_gains)
    monkeypatch.setattr(Teacher, "show", recorded)
    assert improve(problem(), Spring, **FEW | {"rounds": 2}).accepted
    assert len(guessed) > 1 and not guessed[0] and all(guessed[1:])


def test_too_little_a_gain_is_confirmed_once(monkeypatch) -> None:
    asked = []

    def little(*given):
        found, trial = confirmation.confirm(*given)
        asked.append(found)
        return replace(found, accepted=False, reason=f"-.07 %: {TOO_LITTLE}"), trial

    monkeypatch.setattr(module, "confirm", little)
    assert not improve(problem(), Spring, **FEW).accepted
    assert len(asked) == 1


def test_what_was_learnt_before_is_kept_or_bettered() -> None:
    before, first, state = pickle.loads(better())
    model = model_of()
    model.policy.load_state_dict(state)
    assert bits(model) == before
    kept = relative(model).mean()
    second = improve(model, Spring, seed=1, **FEW)
    assert first.before is None and second.before is not None
    assert second.before.accepted and second.before.change < -0.01
    assert relative(model).mean() <= kept + 0.002
    if not second.accepted:
        assert bits(model) == before


def test_an_mpc_gets_a_model_with_one_network(tmp_path) -> None:
    found = improve(problem(), Spring, **FEW)
    assert isinstance(found.model, DDPG) and found.model.policy.problem == problem()
    assert found.accepted and relative(found.model).mean() < 0.99
    assert found.export(tmp_path / "controller.npz").paths
    assert len(found.model.actor.mu.network.first.nodes) == 1


def test_a_largest_correction_is_kept() -> None:
    model = model_of(max_correction=0.05)
    improve(model, Spring, **FEW)
    theta = np.random.default_rng(0).uniform(-2, 2, (50, 2)).astype(np.float32)
    apart = np.abs(model.predict(theta)[0] - problem().explicit()(theta))
    assert apart.max() <= 0.05 * 2 + 1e-6


def test_lines_say_what_is_done_and_read_well_in_a_file(capsys, monkeypatch) -> None:
    monkeypatch.setattr("sb3_yann._progress.DELAY", 0)
    found = improve(model_of(), Spring, **FEW)
    lines = [each for each in capsys.readouterr().err.splitlines() if each.startswith("[")]
    assert len(lines) >= 3
    assert not any("\r" in line or "\x1b" in line for line in lines)
    assert "episodes of the MPC, half with random inputs" in lines[0]
    shown = next(line for line in lines if "] candidate 1, round 1 of at most" in line)
    assert ", the first 10 starts: -" in shown and "; from other starts in the model -" in shown
    assert ", plans -" in shown and " s more if all is needed]" in shown
    assert any("] confirmation, 10 new starts: -" in line for line in lines)
    last = f"candidate {len(found.checks)}, confirmation, "
    assert last in lines[-1] and lines[-1].endswith(f"{100 * found.change:+.2f} %, accepted")
    assert not any("fit 1" in line or " of 30" in line for line in lines)  # of little use there
    improve(model_of(), Spring, progress_bar=False, n_starts=1, rounds=1, updates=1)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("where", "error"),
    [("imitate", KeyboardInterrupt), ("confirm", MemoryError), ("refit_critic", KeyboardInterrupt)],
)
def test_what_is_cut_off_leaves_the_model_as_it_was(monkeypatch, capsys, where, error) -> None:
    def cut(*_):
        raise error

    monkeypatch.setattr(module, where, cut)
    Counted.forget()
    model = model_of(Counted)
    before = bits(model)
    made = Counted.made
    with pytest.raises(error):
        improve(model, Counted, **FEW)
    assert bits(model) == before and is_mpc(model)
    assert not hasattr(model, "improvements")
    assert Counted.closed == Counted.made - made
    if where == "imitate":
        with pytest.raises(error):
            improve(model, twin_of(), **FEW)
    said = capsys.readouterr().err.count("Ctrl-C ended the search. The model is as it was.")
    assert said == {"imitate": 2, "confirm": 0, "refit_critic": 1}[where]


def test_a_reward_of_its_own_is_named_at_the_caller_s_line() -> None:
    class Own(Spring):
        def step(self, action):
            shown, _, *rest = super().step(action)
            return shown, float(self.x[0] ** 3 + self.t % 2), *rest

    with pytest.warns(CostMismatchWarning) as caught:
        improve(model_of(Own), Own, **{**FEW, "n_starts": 1, "updates": 1})
    assert caught[0].filename == __file__


def tracking() -> LinearMPC:
    return LinearMPC(
        problem().model, Q=np.diag([1.0, 0.0]), R=[[0.1]], horizon=3, gamma=0.95,
        u_min=-1, u_max=1, theta_min=[-3, -3], theta_max=[3, 3], tracking=Tracking([0], -1, 1),
    )  # fmt: skip


class Stiff(Spring):
    """Rests beside its set-points under the MPC."""

    stiffness = 0.8


def followed() -> gym.Env:
    return TimeLimit(SetPoint(Stiff(1000), -1, 1, hold=30), 30)


def test_set_points_are_followed_for_less_whatever_plans_gain(monkeypatch) -> None:
    monkeypatch.setattr(Teacher, "gain", 0.0)  # plans know no set-point before it comes
    model = DDPG(YannPolicy, followed(), device="cpu", policy_kwargs={"problem": tracking()})
    found = improve(model, followed, **FEW)
    assert found.accepted and found.change < -0.02


@pytest.mark.filterwarnings("ignore::sb3_yann.CostMismatchWarning")
def test_an_observer_is_a_part_of_the_model_and_of_its_export(monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(module, "TRIES", 1)
    mpc = offset_free_problem()[0]

    def make():
        return observed_env(Calm(20))

    model = DDPG(YannPolicy, make(), device="cpu", policy_kwargs={"problem": mpc})
    before = bits(model)
    found = improve(model, make, n_starts=4, rounds=1, updates=100)
    assert found.steps > 0 and found.checks
    assert found.accepted != (bits(model) == before)
    assert not found.export(tmp_path / "controller.npz").note  # it lacks nothing
    assert improve(model, make, max_steps=30).estimator is not None  # nor where nothing is learnt


class Strange(Spring):
    """Shows one value more."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = gym.spaces.Box(-3, 3, (3,), np.float32)


class Unseeded(Spring):
    """Draws its starts from elsewhere."""

    def reset(self, *, seed=None, options=None):
        found = super().reset(seed=seed)
        self.x = np.random.default_rng().uniform(-1, 1, 2)
        return self.x.astype(np.float32), found[1]


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (Unseeded, r"the env does not repeat it.*wrap it in sb3_yann.wrappers.SeededGlobals"),
        (
            partial(Spring, 3),
            r"None of \d+ episodes of the MPC in the simulator begins with \d+ steps",
        ),
        (Strange, r"The env shows \(3,\) and takes \(1,\); theta of the MPC has"),
    ],
)
def test_a_simulator_that_will_not_do_is_named(make, what) -> None:
    model = model_of()
    before = bits(model)
    with pytest.raises(ValueError, match=what):
        improve(model, make, **FEW)
    assert bits(model) == before


def test_an_env_that_does_not_show_theta_is_named_in_plant_units_too() -> None:
    shifted = replace(problem(), model=replace(problem().model, x_ss=[1.0, 2.0], u_ss=[0.0]))
    with pytest.raises(ValueError, match=r"The env shows \(3,\) and takes \(1,\); theta of the"):
        headroom(shifted, Strange, n_starts=2)


class Rare(Spring):
    """Shows nothing that is finite from some starts."""

    def reset(self, *, seed=None, options=None):
        self.bad = seed is not None and seed % 4 == 0
        return super().reset(seed=seed)

    def step(self, action):
        shown, *rest = super().step(action)
        return (np.full(2, np.nan, np.float32) if self.bad else shown), *rest


def test_starts_from_which_the_mpc_itself_is_lost_count_for_nothing() -> None:
    found = improve(model_of(Rare), Rare, **FEW)
    assert found.accepted and found.change < -0.01


def test_what_is_no_simulator_or_no_model_is_refused() -> None:
    model = model_of()
    with pytest.raises(TypeError, match="or a function that makes one"):
        improve(model, [Spring(), Spring()])
    with closing(gym.make_vec("CSTR-v0", num_envs=2)) as several:
        with pytest.raises(TypeError, match="or a function that makes one"):
            improve(model, several)
    with pytest.raises(TypeError, match=r"makes envs returned None, not a gymnasium"):
        improve(model, lambda: None)
    with pytest.raises(TypeError, match="twin = 3 must be a PlantTwin; or a simulator"):
        improve(model, 3)
    with pytest.raises(TypeError, match="improve needs a YannPolicy"):
        improve(DDPG("MlpPolicy", Spring()), Spring)
    for name in ("n_starts", "rounds", "updates", "max_steps"):
        with pytest.raises(ValueError, match=name):
            improve(model, Spring, **{name: 0})


ENOUGH = {"n_starts": 10, "rounds": 2, "updates": 300}


@cache
def twin_of(make=Spring, episodes: int = 20) -> PlantTwin:
    """Return the twin of episodes of a plant's MPC."""
    mpc = make().observation_space.problem
    played = evaluate(mpc.explicit(), make, range(episodes))
    return PlantTwin.fit(mpc, played.pairs, updates=1000)


def test_a_policy_of_a_twin_gains_on_the_plant(capsys, monkeypatch) -> None:
    monkeypatch.setattr("sb3_yann._progress.DELAY", 0)
    model = model_of()
    found = improve(model, twin_of(), **ENOUGH)
    assert found.accepted and found.where == "the twin" and found.source == repr(twin_of())
    assert found.change < -0.01 and found.episodes == 20 and found.steps == 0
    lines = [each for each in capsys.readouterr().err.splitlines() if each.startswith("[")]
    assert lines[-1].endswith("no objection")
    assert any("in the twin: policy -" in line and ", plans -" in line for line in lines)
    assert any("change on the plant, by " in line for line in lines)
    assert relative(model).mean() < 0.995 and relative(model).max() < 1.01


@pytest.mark.parametrize("source", ["simulator", pytest.param("twin", marks=NIGHTLY)])
def test_in_plant_units_it_finds_the_same(source) -> None:
    if source == "twin":
        makes = (Spring, Spring, Elsewhere)
        models = [model_of(make) for make in makes]
        pairs = zip(models, map(twin_of, makes), strict=True)
        plain, again, found = (improve(model, twin, **ENOUGH) for model, twin in pairs)
        assert bits(models[0]) == bits(models[1]) and plain.checks == again.checks
    else:
        plain = pickle.loads(better())[1]
        found = improve(model_of(Elsewhere), Elsewhere, **FEW)
    assert plain.accepted and found.accepted
    assert found.change == pytest.approx(plain.change, rel=0.05)


def test_a_forecast_that_may_lose_or_holds_too_little_is_refused(monkeypatch) -> None:
    lost = Forecast(-0.1, -0.2, -0.05, "", 0.3, "the worst 5 % of the starts cost too much")
    monkeypatch.setattr(PlantTwin, "forecast", lambda *_: lost)
    found = improve(problem(), twin_of(), **FEW)
    assert not found.accepted and found.checks[-1].worst >= 0.3
    assert found.checks[-1].reason == f"from new starts, {lost.objection}"
    narrow = Forecast(0.0, -1e-4, 2e-4, "log about 5 episodes more")
    monkeypatch.setattr(PlantTwin, "forecast", lambda *_: narrow)
    found = improve(problem(), twin_of(), **FEW)
    assert found.reason.endswith("by -0.01 to +0.02 %: too little to teach.")
    assert found.report().splitlines()[-1].endswith("headroom(mpc, twin) says")


def test_what_no_check_lets_through_changes_nothing(monkeypatch) -> None:
    monkeypatch.setattr(confirmation, "MARGIN", -1.0)  # no start can pass
    model = model_of()
    before = bits(model)
    found = improve(model, twin_of(), **FEW)
    assert not found.accepted and found.change == 0 and bits(model) == before
    assert not any(each.accepted for each in found.checks)


def test_of_long_episodes_parts_are_planned_and_the_whole_is_checked(monkeypatch) -> None:
    planned = []
    monkeypatch.setattr(confirmation, "WINDOW", 9)
    monkeypatch.setattr(
        module, "Teacher", lambda some, seed: planned.append(some) or Teacher(some, seed)
    )
    found = improve(model_of(), twin_of(), **{**ENOUGH, "updates": 1500})
    assert found.accepted and found.change < -0.001
    assert {len(each.given) for each in planned} == {9}
    trial = confirmation.Trial.draw(twin_of(), 10, np.random.default_rng(0))
    assert trial.steps == max(map(len, twin_of().episodes)) == 20
    lost = trial.mpc._replace(costs=trial.mpc.costs + 1e3)
    assert len(trial.hard(lost)) == confirmation.HARDEST
    unsafe = trial.mpc.unsafe.copy()
    unsafe[12, [4, 5, 6, 8]] = 0.25, 0.25, 0.25, 0  # of the input, at one of the starts around
    place, speed = trial.starts[0, 12]
    where = f"outside the log, from x[0] = {place:.3g}, x[1] = {speed:.3g}, "
    found = trial.check(1, trial.mpc._replace(unsafe=unsafe))
    assert found.reason == f"{where}u[0] exceeds its bound by 0.25"


def test_a_fit_takes_the_way_of_most_plans_and_reaches_bounds() -> None:
    layer = copy.deepcopy(model_of(networks="shared").policy.actor.mu)
    rng = np.random.default_rng(0)
    rows = rng.uniform(-1, 1, (600, problem().n_theta))
    most = np.where(rng.random(600) < 0.7, 0.5, -0.5)  # their mean, .2, is what no plan does
    wanted = np.where(rows[:, 0] > 0.5, 1.0, most)[:, None]
    inputs = problem().deviations.u_min + problem().u_half * (1 + wanted)
    fit_layer(layer, problem(), rows, inputs, rng, 1500)
    with th.no_grad():
        found = layer(th.as_tensor(rows)).numpy()[:, 0]
    assert np.median(np.abs(found - 0.5)[rows[:, 0] < 0.3]) < 0.1
    assert np.mean(found[rows[:, 0] > 0.6] == 1.0) > 0.9


def test_a_twin_that_is_not_trusted_is_refused_and_so_are_steps_of_a_simulator() -> None:
    model = model_of()
    before = bits(model)
    with pytest.raises(ValueError, match="max_steps = 9 bounds the steps of a simulator, and a tw"):
        improve(model, twin_of(), max_steps=9)
    with pytest.raises(UntrustedTwinError, match="There is one episode"):
        improve(model, twin_of(episodes=1))
    with pytest.raises(ValueError, match=r"Fit the twin with model\.policy\.problem"):
        improve(DDPG("YannPolicy", "CSTR-v0"), twin_of())
    assert bits(model) == before


def test_the_critic_is_refitted_to_the_returns_of_the_twin(monkeypatch) -> None:
    for name, value in {"RETURNS": 1000, "RETURN_STEPS": 60, "CRITIC_UPDATES": 1000}.items():
        monkeypatch.setattr(imitation, name, value)
    model = model_of()
    rng = np.random.default_rng(5)
    at = twin_of().starts.draw_logged(500, rng)
    u = np.clip(problem().explicit()(at) + 0.1 * rng.standard_normal((500, 1)), -1, 1)
    act = imitation.policy_of(model.actor.mu, problem())
    returns = -imitation._discounted(model.policy, twin_of(), act, at, u)
    known = np.isfinite(returns)

    def error() -> float:
        with th.no_grad():
            points = th.as_tensor(np.hstack([at, u]))
            off = model.critic.values(points)[0].numpy()[:, 0] - returns
            return float(np.abs(off[known]).mean())

    before = error()
    imitation.refit_critic(model.policy, twin_of(), seed=0)
    assert error() < 0.8 * before
    same = model.critic_target.state_dict()
    assert all(th.equal(each, same[name]) for name, each in model.critic.state_dict().items())


def test_a_report_says_what_was_accepted_or_why_nothing_was() -> None:
    passed = Check(1, True, "", -0.021, 0.0004, True, -0.015, 0.003)
    refused = Check(2, False, "2 starts with violations", -0.03, 0.0, False)
    found = Improvement((refused, passed), -0.021, accepted=True)
    assert found.reason == "" and str(found) == found.report()
    assert found.report().splitlines()[:5] == [
        "Accepted: a better policy.",
        "  change       -2.10 % of the MPC's mean cost in the twin, from starts like the log's",
        "  worst start  +0.04 % of the MPC's mean cost in the twin: the plant's may be worse",
        "  violations   no more than the MPC's",
        "  steps        2 candidates tried",
    ]
    sure = replace(passed, interval=(-0.03, -0.002))
    twin = Improvement((replace(refused, interval=(-0.04, 0.01)), sure), -0.021, True)
    assert twin.interval == sure.interval
    assert replace(twin, checks=twin.checks[:1], accepted=False, change=0.0).interval == (0, 0)
    assert "from starts like the log's; on the plant -3.00 to -0.20 % (90 %)" in str(twin)
    decided = replace(sure, starts=40, final=True)
    there = str(replace(twin, checks=(decided,), where="the simulator", steps=5000))
    said = "change       -2.10 % (-3.00 to -0.20 %, 90 %) of the MPC's mean cost in the simulator"
    assert f"{said}, from 40 new starts" in there
    assert "steps        5,000 of the simulator, 1 candidate tried" in there
    where = "of the MPC's mean cost in the twin, from starts like the log's"
    assert Improvement((refused,), 0.0, accepted=False).report().splitlines()[:3] == [
        "Nothing better was found: 2 starts with violations. The model is as it was.",
        f"  refused      the last candidate, -3.00 % {where}",
        "  steps        1 candidate tried",
    ]
    small = Check(1, True, "", -4e-4, 0.0, True)
    assert "-0.04 % in the twin is too little, or not sure" in str(
        Improvement((small,), 0.0, accepted=False)
    )
    assert Improvement((), 0.0, False).reason == "Nothing better was found: no gain in the twin."


@pytest.mark.parametrize(
    ("where", "note", "leads_on"),
    [
        ("the twin", "it may lose: to settle it, log steps of u", "the MPC and log steps of u"),
        ("the twin", "plans +0.00 %, too little to teach", "keep the MPC: plans gain little"),
        ("the twin", "2 starts with violations", "log more episodes, of other starts"),
        (
            "the twin",
            "to settle it, log held steps of u[0]; with errors that last, the change is 0 to +1 %",
            "keep the MPC and log held steps of u[0]; then fit the twin anew",
        ),
        ("the simulator", "max_steps = 9 are too few to go on", "give more max_steps, or keep"),
        ("the simulator", "max_steps = 9: wrap the env in a TimeLimit", "end episodes by a Time"),
        ("the simulator", "2 starts with violations", "improve(..., n_starts=80, updates=8000)"),
    ],
)
def test_a_refusal_leads_on(where: str, note: str, leads_on: str) -> None:
    settings = {"n_starts": 40, "updates": 4000, "rounds": 4}
    refused = Improvement((), 0.0, False, where=where, note=note, settings=settings)
    assert leads_on in refused.report().splitlines()[-1]


class Limited(Spring):
    """Says that whoever leaves the MPC breaks a limit, from some starts."""

    def reset(self, *, seed=None, options=None):
        self.bad = seed is not None and seed % 7 == 0
        return super().reset(seed=seed)

    def step(self, action):
        left = np.abs(problem().explicit()(self.x.astype(np.float32)) - action).max() > 1e-3
        *rest, info = super().step(action)
        return *rest, {**info, "violation": bool(self.bad and left)}


def test_a_policy_that_breaks_a_limit_is_refused_whatever_it_gains() -> None:
    model = model_of(Limited)
    before = bits(model)
    found = improve(model, Limited, **FEW)
    assert not found.accepted and bits(model) == before
    assert "starts with violations" in found.reason
