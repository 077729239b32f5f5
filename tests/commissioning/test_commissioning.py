"""On a plant only accepted policies act; a kill loses nothing; faults give the plant to the MPC."""

import json
import shutil
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG

from sb3_yann import Commissioning, Improvement, YannPolicy
from sb3_yann.commissioning import commissioning
from sb3_yann.commissioning.commissioning import Costs, is_kept, pays_its_own, why_taken_back
from sb3_yann.commissioning.plant import Plant
from sb3_yann.commissioning.watchdog import Alarm
from sb3_yann.compare import Difference
from sb3_yann.env_pool import one_env
from sb3_yann.improvement import Check
from sb3_yann.policy.checkpoint import is_confirmed, whole_policy
from twin_samples import Cart, problem
from weights import is_mpc


def commission(path: Any = None, env: Any = Cart, **options: Any) -> Commissioning:
    model = DDPG(YannPolicy, Cart(), seed=0, device="cpu")
    options = {"batch": 5, "updates": 200, "max_correction": 0.2} | options
    return Commissioning(model, env, log_path=path, **options)


@cache
def recorded(batches: int, bound: float) -> Path:
    """Return the folder of a record of so many batches; in the first of them the MPC acts."""
    folder = Path(tempfile.mkdtemp())
    commission(folder, max_correction=bound).run(batches)
    return folder


@pytest.fixture
def begun(tmp_path: Path) -> Any:
    """Return a function of options to a commissioning that goes on after some batches."""

    def begin(batches: int = 1, bound: float = 0.2, **options: Any) -> Commissioning:
        folder = tmp_path / "plant"
        if not folder.exists():
            shutil.copytree(recorded(batches, bound), folder)
        return commission(folder, max_correction=bound, **options)

    return begin


def policys_turn(run: Commissioning) -> int:
    """Return the first episode of the second batch in which the policy acts."""
    return run.batch + int(np.random.default_rng([run.seed, 1, 0]).integers(2))


class Faulty(gym.Wrapper[Any, Any, Any, Any]):
    """A plant with a fault from a step of an episode on."""

    def __init__(self, env: Cart, episode: int, fault: str, step: int = 5) -> None:
        super().__init__(env)
        self.at = (episode, step)
        self.fault = fault
        self.numbers = [-1, 0]
        self.applied: list[float] = []

    def reset(self, **kwargs):
        self.numbers = [self.numbers[0] + 1, 0]
        self.applied = []
        return self.env.reset(**kwargs)

    def step(self, action):
        self.applied.append(float(action[0]))
        observation, reward, terminated, over, info = self.env.step(action)
        self.numbers[1] += 1
        if self.numbers[0] == self.at[0] and self.numbers[1] >= self.at[1]:
            if self.fault == "nan":
                observation = np.append(observation[:1], np.float32(np.nan))
            elif self.fault == "violation":
                info = {**info, "violation": self.numbers[1] == self.at[1]}
            else:
                info = {**info, "is_success": True}
                terminated = True
        return observation, reward, terminated, over, info


def test_the_first_batch_is_the_mpcs_and_the_next_is_better_and_within_its_bound(begun) -> None:
    run = begun()
    first, second = run.run(2)
    assert (first.acted, first.verdict) == ("MPC", "accepted")
    assert second.acted == "batch 1" and second.max_correction == 0.2
    assert [first.episodes, second.episodes] == [5, 10]
    law = problem().explicit()
    m = problem()
    for k, each in enumerate(run.episodes):
        apart = np.abs(each.actions - law(each.thetas[:-1])) / (m.u_max - m.u_min)
        assert apart.max() <= (1e-6 if k < 5 else 0.2 + 1e-6)
    assert second.cost < second.mpc  # the MPC's own, in turns, from the same starts
    assert sum(run.journal.by_policy[5:]) == 5
    for one, other in ((5, 6), (7, 8)):
        np.testing.assert_array_equal(run.episodes[one].thetas[0], run.episodes[other].thetas[0])
    pairs = [run.journal.by_policy[k : k + 2] for k in (5, 7, 9, 11, 13)]
    assert all(sorted(each) == [False, True] for each in pairs) and len({*map(tuple, pairs)}) == 2
    assert second.predicted == pytest.approx(second.cost, rel=0.1)


def test_only_accepted_policies_act(begun, tmp_path) -> None:
    begun().run(2)
    path = tmp_path / "plant" / "commissioning.jsonl"
    events = [json.loads(line) for line in path.read_text().splitlines()]
    accepted = {"MPC": None}
    holds = "MPC"
    for event in events[1:]:
        if event["event"] == "batch":
            holds, saved = event["from_here"]["acting"][:2]
            if event["verdict"] == "accepted":
                accepted[holds] = saved
        if event["event"] != "episode":
            continue
        assert event["acts"] in ("MPC", holds)
        if accepted[event["acts"]] is None:
            continue
        model = DDPG.load(path.with_name(accepted[event["acts"]]))
        theta = np.array(event["thetas"], np.float32)[:-1]
        acted = model.predict(theta, deterministic=True)[0]
        np.testing.assert_allclose(event["actions"], acted, atol=1e-6)
    assert len(accepted) > 1


def test_a_kill_at_any_moment_changes_nothing(tmp_path, monkeypatch) -> None:
    short = {"batch": 2, "updates": 100}
    whole = commission(tmp_path / "whole.jsonl", **short)
    whole.run(2)
    path = tmp_path / "cut.jsonl"
    played = 0
    while True:
        run = commission(path, **short)
        assert len(run.episodes) == played
        env = Cart()
        count = 0

        def step(action, env=env, own=Cart.step):
            nonlocal count
            count += 1
            if count > 100:  # amid the second episode
                raise KeyboardInterrupt
            return own(env, action)

        monkeypatch.setattr(env, "step", step)
        run.plant_env = env
        try:
            run.run(2)
            break
        except KeyboardInterrupt:
            played += 1
            with path.open("ab") as file:
                file.write(b'{"event": "epis')  # the write that was cut off
    assert played == 5
    assert run.batches == whole.batches or str(run.batches) == str(whole.batches)
    for one, other in zip(run.episodes, whole.episodes, strict=True):
        np.testing.assert_array_equal(one.thetas, other.thetas)
    theta = np.float32([[0.5, 0.2], [-1.0, 0.1]])
    np.testing.assert_array_equal(run.model.predict(theta)[0], whole.model.predict(theta)[0])
    again = commission(path, **short)
    np.testing.assert_array_equal(again.model.predict(theta)[0], whole.model.predict(theta)[0])
    assert again.run(2) == again.batches and len(again.episodes) == 6


def test_a_decision_that_is_cut_off_leaves_the_accepted_policy(begun, monkeypatch) -> None:
    run = begun()
    before = [each.clone() for each in run.policy.actor.parameters()]
    bound = run.policy.max_correction

    def cut(model, *args, **kwargs):
        with th.no_grad():
            for each in model.policy.actor.parameters():
                each.add_(1.0)
        raise KeyboardInterrupt

    monkeypatch.setattr(commissioning, "improve", cut)
    monkeypatch.setattr(commissioning, "is_kept", lambda _: True)
    with pytest.raises(KeyboardInterrupt):
        run.run(2)
    assert all(th.equal(a, b) for a, b in zip(before, run.policy.actor.parameters(), strict=True))
    assert run.policy.max_correction == bound


def test_a_reading_that_is_no_number_gives_the_plant_to_the_mpc_at_once(begun) -> None:
    turn = policys_turn(commission())
    run = begun(env=Faulty(Cart(), turn - 5, "nan", step=1))
    run.run(2)
    episode = run.episodes[turn]
    law = problem().explicit()
    assert episode.alarm is not None and episode.alarm.kind == "not a number"
    assert episode.alarm.message == "It reads x[1] = nan." and episode.step == 0
    u = np.clip(law(episode.thetas[1:-1]), -1, 1)  # on what the model predicts
    np.testing.assert_allclose(episode.actions[1:], u, atol=1e-5)
    assert np.isfinite(episode.thetas).all()
    assert run.journal.by_policy[turn : turn + 2] == [True, False]  # the MPC until one is quiet
    assert turn not in run.journal.log


@pytest.mark.parametrize("change", [{"horizon": 4}, {"gamma": 0.9}, {"x_max": [4.0, 3.0]}])
def test_a_record_of_another_mpc_is_refused(begun, tmp_path: Path, change: dict) -> None:
    begun()
    mpc = replace(problem(), **change)
    model = DDPG(YannPolicy, Cart(), policy_kwargs={"problem": mpc}, seed=0, device="cpu")
    with pytest.raises(ValueError, match="problem"):
        settings = {"batch": 5, "updates": 200, "max_correction": 0.2}
        Commissioning(model, Cart, log_path=tmp_path / "plant", **settings)


def test_a_violation_takes_the_policy_back(begun) -> None:
    turn = policys_turn(commission())
    run = begun(env=Faulty(Cart(), turn - 5, "violation"))
    assert run.journal.accepted
    run.run(2)
    assert [k for k, each in enumerate(run.journal.by_policy) if each] == [turn]
    assert "taken back" in run.batches[1].reason
    assert run.episodes[turn].violations == run.episodes[turn].unsafe == 1


def test_steps_of_the_mpc_beyond_a_bound_are_counted_and_alarm_nobody() -> None:
    mpc = replace(problem(), x_max=[1.0, 3.0])
    model = DDPG(YannPolicy, Cart(), policy_kwargs={"problem": mpc}, seed=0, device="cpu")
    plant = Plant(Cart(), model)
    seed = next(seed for seed in range(50) if plant.begin(seed)[0] > 1.3)
    played = plant.play(plant.begin(seed), plant.mpc, None)
    assert played.violations == np.sum(played.thetas[1:, 0] > 1.0) > 0 == played.unsafe
    assert played.alarm is None
    ours = plant.play(plant.begin(seed), plant.policy, None, allowed=0.0)
    assert ours.unsafe > 0 and ours.alarm.kind == "violation"


def test_an_end_that_is_a_success_alarms_nobody() -> None:
    plant = Plant(Faulty(Cart(), 0, "success"), DDPG(YannPolicy, Cart(), device="cpu"))
    played = plant.play(plant.begin(0), plant.policy, None, allowed=0.0)
    assert len(played.actions) == 5 and played.alarm is None
    assert played.unsafe == played.violations == 0


def test_a_policy_that_costs_more_than_the_mpc_is_taken_back(monkeypatch) -> None:
    run = commission(max_correction=1.0)
    run.run(1)
    run._become(run._acting, 1.0)
    with th.no_grad():  # what was accepted turns out to be bad: the plant says so
        for each in run.policy.actor.parameters():
            each.add_(0.5 * th.randn(each.shape, generator=th.Generator().manual_seed(0)))
    run._acting = whole_policy(run.policy)
    monkeypatch.setattr(commissioning, "improve", lambda *_, **__: found)
    found = Improvement((Check(1, False, "nothing", 0.0, 0.0, True),), 0.0, False)
    last = run.run(2)[-1]
    assert last.cost > last.mpc and "taken back" in last.reason
    assert last.verdict == "the MPC acts" and is_mpc(run.model)


def test_what_the_plant_confirmed_stays_where_nothing_better_is_found(begun, monkeypatch) -> None:
    run = begun()
    assert is_mpc(run.model)  # until the plant has confirmed it
    assert not run.model.commissioned.accepted
    run._become(run._acting, bound := run.policy.max_correction)
    before = [each.clone() for each in run.policy.actor.parameters()]
    refused = Check(0, False, "start 3 violates a limit", 0.0, 0.0, False)
    found = Improvement((refused,), 0.0, False, refused)
    monkeypatch.setattr(commissioning, "improve", lambda *_, **__: found)
    monkeypatch.setattr(commissioning, "is_kept", lambda _: True)
    assert run.run(2)[-1].verdict == "stays"
    assert all(th.equal(a, b) for a, b in zip(before, run.policy.actor.parameters(), strict=True))
    assert run.policy.max_correction == bound
    assert run.model.commissioned.accepted and is_confirmed(run.model)
    monkeypatch.setattr(commissioning, "is_kept", lambda _: False)
    assert run.run(3)[-1].verdict == "stays"  # it has been kept
    table, _, rest = run.report().partition("The policy of batch 1 surely costs less than the MPC")
    assert len(table.splitlines()) == 4 and "\n  change       " in rest
    assert rest.endswith("\n  next         run(batches=4) plays 40 episodes more")


def test_weights_that_nobody_accepted_never_act(begun) -> None:
    run = begun()
    run._become(run._acting, 0.2)
    accepted = [each.clone() for each in run.policy.actor.parameters()]
    with th.no_grad():
        for each in run.policy.actor.parameters():
            each.add_(1.0)
    run.policy.limit_correction(None)
    with one_env(Cart) as env:
        run._play(Plant(env, run.model))
    assert all(th.equal(a, b) for a, b in zip(accepted, run.policy.actor.parameters(), strict=True))
    assert run.policy.max_correction == 0.2 and run.episodes[-1].apart <= 0.2 + 1e-6


def test_a_plant_that_trips_under_the_policy_gets_the_mpc(begun) -> None:
    class Trips(Cart):
        def step(self, action):
            if abs(action[0] - problem().explicit()(self.x)[0]) > 1e-4:
                raise RuntimeError("emergency stop")
            return super().step(action)

    for _ in range(2):
        with pytest.raises(RuntimeError, match="emergency stop"):
            begun(env=Trips).run(2)
    last = begun(env=Trips).run(2)[-1]
    assert "never ended" in last.reason and last.verdict == "the MPC acts"


def test_a_policy_with_alarms_is_taken_back(begun, monkeypatch) -> None:
    run = begun()
    alarm = Alarm("drift", "as a test has it")
    monkeypatch.setattr(run.watchdog, "watch", lambda *_, **__: alarm if run_is_policys() else None)

    def run_is_policys() -> bool:
        return run.journal._open != "MPC"

    last = run.run(2)[-1]
    assert last.alarms >= 2 and "had an alarm" in last.reason and is_mpc(run.model)


def costs(more: float, error: float, pairs: int, look: int = 1) -> Costs:
    return Costs(10.0 + more, np.nan, 10.0, Difference(more, error, pairs), look)


def test_a_policy_is_taken_back_where_it_surely_costs_more_or_shows_no_gain() -> None:
    played = SimpleNamespace(unsafe=0, alarm=None)
    journal = SimpleNamespace(batch=[(played, True)], cut_off=0)
    said = "it cost 10.3, the MPC in turns with it 10"
    assert said in why_taken_back(journal, costs(0.3, 0.15, 8))  # Student's t: 1.895
    assert why_taken_back(journal, costs(0.3, 0.2, 8)) == ""
    assert why_taken_back(journal, costs(0.3, np.inf, 1)) == ""  # one pair shows nothing
    assert why_taken_back(journal, costs(0.6, 1.0, 8)) != ""  # more than five per cent in any case
    assert why_taken_back(journal, costs(np.nan, 1.0, 8)) != ""
    said = "no pair of episodes shows what it costs"
    assert why_taken_back(journal, costs(np.nan, np.inf, 0)) == said
    assert why_taken_back(journal, costs(0.11, 0.1, 10)) == "10 pairs show no gain"
    assert why_taken_back(journal, costs(0.11, 0.1, 9)) == ""
    assert why_taken_back(journal, costs(-0.01, 0.1, 10)) == ""


def test_a_policy_is_kept_where_it_surely_costs_less_at_the_level_of_the_look() -> None:
    # Student's t of 7 degrees of freedom: 2.36 at 2.5 %, 3.13 at .83 %.
    assert is_kept(costs(-0.3, 0.12, 8)) and not is_kept(costs(-0.3, 0.13, 8))
    assert is_kept(costs(-0.3, 0.09, 8, look=2)) and not is_kept(costs(-0.3, 0.1, 8, look=2))
    assert not is_kept(costs(-0.3, np.inf, 1)) and not is_kept(costs(np.nan, 0.1, 8))


def test_pairs_of_all_batches_of_a_trial_decide_together(begun) -> None:
    run = begun(3, bound=0.1)
    journal = run.journal
    second, third = run.batches[1:]
    assert second.acted == third.acted == "batch 1"
    assert second.verdict == "stays" and (second.pairs, third.pairs) == (5, 15)
    assert sum(journal.by_policy) == 15
    assert third.verdict == "accepted" and "15 pairs show that it costs less" in third.reason
    assert third.max_correction == 0.1 < run.journal.state.max_correction == 0.2


def test_a_policy_that_is_taken_back_gives_way_to_the_one_that_was_kept(begun, monkeypatch) -> None:
    run = begun(3, bound=0.1)
    kept = [each.clone() for each in run.policy.actor.parameters()]
    monkeypatch.setattr(commissioning, "why_taken_back", lambda *_: "a test")
    last = run.run(4)[-1]
    assert last.acted == "batch 3" and last.verdict == "stays" and "taken back" in last.reason
    assert run.journal.state.policy == "batch 1" and run.policy.max_correction == 0.1
    for ours, theirs in zip(run.policy.actor.parameters(), kept, strict=True):
        assert th.equal(ours, theirs)


def test_while_no_policy_is_on_trial_every_other_episode_is_moved_at_random() -> None:
    run = commission(excite=0.03, shadow=True)
    run.run(1)
    law = problem().explicit()
    for number, each in enumerate(run.episodes):
        apart = np.abs(each.actions - law(each.thetas[:-1])) / 2  # the range is 2
        assert each.excited == bool(number % 2)
        assert (1e-3 < apart.max() <= 0.03 + 1e-6) if each.excited else apart.max() < 1e-6
    quiet = [each for each in run.episodes if not each.excited]
    expected = [np.sum(problem().stage_cost(e.thetas[:-1], e.actions)) for e in quiet]
    assert run.batches[0].mpc == pytest.approx(np.mean(expected))
    assert "; 2 moved at random do not count in costs" in run.report()


def test_shadow_computes_and_does_not_act() -> None:
    run = commission(shadow=True)
    run.run(2)
    assert run.journal.by_policy == [False] * 15
    law = problem().explicit()
    for each in run.episodes:
        np.testing.assert_allclose(each.actions, law(each.thetas[:-1]), atol=1e-6)
    assert run.episodes[0].apart < 1e-6
    assert run.episodes[7].apart > 1e-3  # what it would have done
    assert is_mpc(run.model)  # nothing was confirmed


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"batch": 1}, "batch = 1"),
        ({"max_correction": 0.0}, "max_correction = 0"),
        ({"env": 3}, "plant_env = 3"),
        ({"updates": 0}, "updates = 0"),
        ({"seed": -1}, "seed = -1"),
    ],
)
def test_bad_input_is_named(options, says) -> None:
    with pytest.raises((TypeError, ValueError), match=says):
        commission(**options)


def test_another_commissionings_record_is_refused(tmp_path) -> None:
    commission(tmp_path)
    assert (tmp_path / "commissioning.jsonl").exists()
    with pytest.raises(ValueError, match="begun with batch = 5"):
        commission(tmp_path, batch=4)
    path = tmp_path / "other.csv"
    strangers = {"episode,cost\n1,2\n": "line 1", '{"my": "settings"}': "no record"}
    for stranger, said in strangers.items():
        path.write_text(stranger)
        with pytest.raises(ValueError, match=said):
            commission(path)
        assert path.read_text() == stranger


def test_another_plant_and_what_is_no_model_are_refused() -> None:
    with pytest.raises(ValueError, match="Give it a simulator of this plant, or the plant"):
        commission(env="CSTR-v0").run(1)
    with pytest.raises(TypeError, match="must be a DDPG or TD3 model"):
        Commissioning(None, Cart)


def test_a_first_reading_that_is_no_number_is_an_error(tmp_path) -> None:
    class Blind(Cart):
        def reset(self, **kwargs):
            observation, info = super().reset(**kwargs)
            return np.full_like(observation, np.nan), info

    run = commission(tmp_path, env=Blind)
    with pytest.raises(ValueError, match=r"first reading has x\[0\] = nan, x\[1\] = nan"):
        run.run(1)
    assert not run.episodes
    assert "start" not in (tmp_path / "commissioning.jsonl").read_text()  # nothing was played


def test_a_plant_that_its_model_describes_keeps_the_mpc(tmp_path) -> None:
    class Described(Cart):
        def step(self, action):
            now = self.x
            found = super().step(action)
            self.x = problem().model.A @ now + problem().model.B @ np.asarray(action, float)
            return self.x.astype(np.float32), *found[1:]

    found = commission(tmp_path / "record", Described()).run(2)
    assert [each.acted for each in found] == ["MPC"] * 2


def test_a_reward_of_its_own_decides_what_is_kept() -> None:
    class Paid(Cart):
        """Pays for the distance from the MPC's input, which no stage cost knows."""

        def step(self, action):
            law = float(problem().explicit()(self.x)[0])
            observation, _, *rest = super().step(action)
            return observation, -7.0 * abs(float(action[0]) - law), *rest

    run = commission(env=Paid)
    second = run.run(2)[-1]
    assert "by the plant's reward" in second.reason and second.verdict == "the MPC acts"
    assert second.cost > second.mpc and is_mpc(run.model)
    policys = np.array(run.journal.by_policy)
    rewards = np.array([each.reward for each in run.episodes])
    assert second.cost == pytest.approx(-rewards[policys].mean())
    assert pays_its_own(problem(), run.episodes)


def test_a_reward_that_is_the_stage_cost_up_to_a_line_is_no_reward_of_its_own() -> None:
    run = commission(updates=1)
    run.run(1)
    assert not pays_its_own(problem(), run.episodes)
    for factor, offset in ((0.01, 0.0), (3.0, -50.0), (0.0, 0.0)):
        paid = [replace(e, reward=factor * e.reward + offset) for e in run.episodes]
        assert not pays_its_own(problem(), paid)
    assert pays_its_own(problem(), [replace(e, reward=-e.reward) for e in run.episodes])
