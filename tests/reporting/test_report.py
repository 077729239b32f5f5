"""The report: what it says is so, what it cannot say it leaves out, and it loads nothing."""

import copy
import re
from dataclasses import replace
from functools import cache, partial
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import Wrapper
from gymnasium.wrappers import TimeLimit, TransformObservation, TransformReward
from scipy import stats
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import guard_samples
import twin_samples
import unit_samples
from guard_samples import Slide, make_guard
from sample_plants import LinearPlant
from sb3_yann import (
    AffineObservation,
    Headroom,
    LinearModel,
    LinearMPC,
    NoActionNoise,
    PlantTwin,
    SoftBounds,
    StateEstimator,
    export,
    offset_free,
    report,
    reporting,
)
from sb3_yann.commissioning.commissioning import Commissioned
from sb3_yann.evaluation import evaluate
from sb3_yann.improvement.confirmation import Check
from sb3_yann.improvement.improving import Improvement
from sb3_yann.reporting import evidence_parts, problem_parts
from sb3_yann.reporting.subject import OF_MPC, OF_POLICY
from sb3_yann.wrappers import EstimateState, PlantEnv
from sb3_yann_envs import problems
from weights import last_layer, unpin

SEEDS = range(8)
# The sample plant pays otherwise, and ignores its input.
pytestmark = pytest.mark.filterwarnings(
    "ignore:The reward is not minus", r"ignore:u\[0\] moves the env otherwise.* 0 times"
)


class Outline(HTMLParser):
    """Reads a page as a browser does: its text, its elements, and whether they are balanced."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.open: list[str] = []
        self.texts: list[str] = []
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(page.read_text(encoding="utf-8"))
        self.close()
        assert self.open == []
        self.text = re.sub(r"\s+", " ", " ".join(self.texts))

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.texts.append(data)


@cache
def guarded():
    """Return a small model that has learnt under a guard, and the guard: not to be changed."""
    model = guard_samples.build()
    guard = make_guard(n_new_starts=3, n_final_starts=5)
    model.learn(80, callback=[NoActionNoise(), guard])
    return model, guard


def moved(by: float = 0.1):
    """Return a small model whose policy adds a constant to its MPC, at all points."""
    model = guard_samples.build()
    unpin(model)
    with th.no_grad():
        last_layer(model).zero_()
        last_layer(model)[..., -1] = by
    return model


def subject_of(model, **given):
    defaults = dict.fromkeys(("env", "guard", "twin", "headroom"))
    return reporting._subject(model, **{**defaults, "seeds": SEEDS, **given})


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[Path, DDPG]:
    kwargs = {"critic_warmup": 20}
    model = DDPG("YannPolicy", "ClippedPendulum-v0", policy_kwargs=kwargs, device="cpu", seed=0)
    guard = guard_samples.ImprovementGuard("ClippedPendulum-v0", n_eval_episodes=4, n_new_starts=0)
    model.learn(60, callback=[NoActionNoise(), guard])
    mpc = model.policy.problem
    log = evaluate(mpc.explicit(), "ClippedPendulum-v0", range(5))
    twin = PlantTwin.fit(mpc, log.pairs, n_members=1, residuals=twin_samples.POLYNOMIALS)
    costs = np.array([10.0, 20.0])
    room = Headroom(costs, costs, costs, costs - 0.5, 0.0, 0.0, 1 / 30, "learn", "a simulator")
    path = tmp_path_factory.mktemp("report") / "new folder" / "whole.html"
    return report(model, path, seeds=SEEDS, guard=guard, twin=twin, headroom=room), model


def test_it_is_one_small_file_that_loads_nothing_and_has_every_part(whole) -> None:
    path = whole[0]
    source = whole[0].read_text(encoding="utf-8")
    assert path.stat().st_size < 3_000_000 and [*path.parent.iterdir()] == [path]
    assert not re.search(
        r"https?://|url\(|@import|<(script|link|iframe|object)|javascript:", source
    )
    # Printed, what is not only a number may wrap: a reason beside it has its width.
    assert "td.number { white-space: normal; }" in source.partition("@media print")[2]
    outline = Outline(path)
    targets = {attributes.get("id") for _, attributes in outline.found}
    for tag, attributes in outline.found:
        assert not any(name.startswith("on") for name in attributes)
        if tag == "img":
            assert str(attributes["src"]).startswith("data:image/") and attributes["alt"]
        if tag == "a":
            assert str(attributes["href"]).removeprefix("#") in targets
    for title in (
        "Plant and problem", "Constraints register", "The law and how it was checked",
        "Closed loops against the MPC", "Statistics in words",
        "Where and how far the policy leaves the MPC", "Decisions of the guard",
        "The twin and its verdict", "Headroom", "To do it again", "Signatures",
    ):  # fmt: skip
        assert title in outline.text
    assert sum(tag == "img" for tag, _ in outline.found) == 8
    assert "was given" not in outline.text and "left out" not in outline.text


def test_names_units_limits_and_costs_are_the_plant_s(whole) -> None:
    path, model = whole
    text = Outline(path).text
    assert "torque (N m) -2 2 hard" in text and "angle (rad) -2 2 hard" in text
    assert "horizon 2 steps of 0.05 s" in text and "diag(1, 0.1)" in text
    for played in (model.policy.problem.explicit(), model):
        mean = evaluate(played, "ClippedPendulum-v0", SEEDS).costs.mean()
        assert f"{mean:.6g}"[:6] in text  # the policy's law rounds to float32


def test_every_decision_is_there_with_its_reason() -> None:
    model, guard = guarded()
    part = evidence_parts.guard_part(subject_of(model, guard=guard))
    text = unescape(re.sub(r"<[^>]+>", " ", part.content))
    assert guard.decisions
    for each in guard.decisions:
        assert each.reason in text and f"{each.candidate_cost:.6g}" in text
    assert f"All {len(guard.decisions)} decisions" in text
    assert [each.verdict for each in part.findings] == ["passed"]


def test_a_limit_that_both_exceed_is_said_first() -> None:
    subject = subject_of(guard_samples.build(), env=Slide)
    assert len(evidence_parts.loops_part(subject).findings) == 1
    for each in subject.loops.values():
        each.violations[:] = 1
        each.excess.largest[2] = 0.25
        each.excess.worst[2] = 0
    part = evidence_parts.loops_part(subject)
    said = "exceed a limit with the MPC, in 8 of 8: u[0] exceeds its bound by 0.25; with the policy"
    assert said in part.findings[1].text and part.findings[1].verdict == "look"
    page = str(reporting._body("title", [part]))
    assert page.index(said) < page.index("Episodes in which the policy violates more")


def test_a_sensor_that_fails_is_the_operating_point_to_the_mpc_too() -> None:
    actions = subject_of(guard_samples.build()).act_as_mpc(np.array([[np.nan]]))
    np.testing.assert_allclose(actions, [guard_samples.LAW([0.0])], atol=1e-6)


def test_a_policy_that_the_guard_has_not_accepted_is_named() -> None:
    model = copy.deepcopy(guarded()[0])
    with th.no_grad():
        last_layer(model).add_(0.01)
    (finding,) = evidence_parts.guard_part(subject_of(model)).findings
    assert finding.verdict == "failed" and "NOT the one" in finding.text


def test_what_is_not_given_is_left_out(tmp_path) -> None:
    model = DDPG("YannPolicy", "CSTR-v0")
    outline = Outline(report(model, tmp_path / "bare.html"))
    for note in ("No env was given: closed loops are left out.", "No guard was at work"):
        assert outline.text.count(note) == 1
    places = [attributes["id"] for tag, attributes in outline.found if "id" in attributes]
    assert places == [f"part-{k}" for k in range(1, 6)]
    for title in ("Decisions of the guard", "Headroom", "What improve did", "The twin and its"):
        assert title not in outline.text
    assert sum(tag == "img" for tag, _ in outline.found) == 2


HOSTILE = '<script>alert("x")</script>'
FORMULA = r"$\frac$ & 'T'"


@pytest.mark.filterwarnings("ignore:Glyph")  # fonts of matplotlib before 3.11
def test_hostile_names_stay_text(tmp_path) -> None:
    model = LinearModel(
        [[0.9, 0.1], [0, 0.8]], [[0], [1]], 1, state_names=[HOSTILE, FORMULA],
        input_names=["<b>u"], units=["<i>", "°C%", "\N{SNOWMAN}\N{PILE OF POO}"],
    )  # fmt: skip
    mpc = LinearMPC(model, Q=np.eye(2), R=[[1]], horizon=2, x_min=-5, x_max=5, u_min=-1, u_max=1)
    env = lambda: TimeLimit(LinearPlant(mpc), 10)  # noqa: E731
    policy = DDPG("YannPolicy", env(), policy_kwargs={"problem": mpc})
    title = HOSTILE + "a\x1b[31m\x00\ud800b"
    path = report(policy, tmp_path / "hostile.html", env=env, seeds=range(2), title=title)
    outline = Outline(path)
    assert {tag for tag, _ in outline.found}.isdisjoint({"script", "b", "i"})
    assert HOSTILE in outline.text and FORMULA in outline.text
    assert not set(path.read_text(encoding="utf-8")) & set("\x1b\x00")


def test_how_far_the_policy_leaves_the_mpc_is_in_the_inputs_units(tmp_path) -> None:
    model = moved(0.1)
    text = Outline(report(model, tmp_path / "moved.html", env=Slide, seeds=SEEDS)).text
    theta = np.linspace(-5, 5, 4001)[:, None]
    with th.no_grad():
        u = model.policy.actor.mu(th.as_tensor(theta)).double().numpy()
    largest = np.abs(u - guard_samples.LAW(theta)).max()
    told = [
        float(each)
        for each in re.findall(r"u\[0\] random points of the box (?:\S+ ){2}(\S+)", text)
    ]
    assert told == [pytest.approx(largest, rel=1e-2)]


def test_violations_of_the_policy_alone_fail(tmp_path) -> None:
    model = moved(-0.5)
    env = partial(Slide, limits=(-0.2, 1.1), low=3.0, high=4.0)
    assert guard_samples.LAW([3.5])[0] == -1.0
    opposite = partial(Slide, limits=(-1.1, -0.6), low=3.0, high=4.0)
    worse = Outline(report(moved(0.6), tmp_path / "a.html", env=opposite, seeds=SEEDS)).text
    assert "failed Episodes in which the policy violates more than the MPC" in worse
    assert re.search(r"\d+ of 8 episodes violate a limit", worse)
    alike = Outline(report(model, tmp_path / "b.html", env=env, seeds=SEEDS)).text
    assert "passed Episodes in which the policy violates more than the MPC" in alike


def test_inputs_beyond_a_bound_at_run_time_fail(monkeypatch) -> None:
    tank = LinearModel([[0.9]], [[0.5]], dt=1, x_ss=[12], u_ss=[3])
    mpc = LinearMPC(
        tank, Q=[[1]], R=[[1]], horizon=3, x_min=0, x_max=20, u_min=0, u_max=10,
        parametric_bounds=["u_max"],
    )  # fmt: skip
    outside = {"start_low": 20.3, "start_high": 20.4, "max_episode_steps": 20}
    with pytest.warns(UserWarning, match=r"x\[0\] may begin at 20.3 to 20.4, .*: 0 to 20. Change"):
        env = PlantEnv(lambda x, u: 0.1 * (15 - x) + 0.5 * (u - 3) - 0.3, mpc, **outside)
    model = DDPG("YannPolicy", env, policy_kwargs={"problem": mpc, "keep_bounds": False})
    layer = model.actor.mu
    text = "Inputs leave their bounds at random points of the box of parameters."
    for keeps in (True, False):
        subject = subject_of(model, env=env)
        part = evidence_parts.distance_part(subject)
        assert (text in [each.text for each in part.findings]) is not keeps
        for room in (2.0, 1e-3):  # half-widths that do not count
            monkeypatch.setattr(problem_parts, "EXCESS_ROOM", room)
            rows = str(problem_parts.constraints_part(subject).content).split("</tr>")[1:]
            of_u, of_x = (re.findall(r"<td[^>]*>(\d+)</td>", row)[-2:] for row in rows[:2])
            assert of_x == ["0", "0"]  # it begins beyond, and is within after a step
            assert (of_u[-1] == "0") is (keeps or room > 1)  # in closed loops
        # a layer without them, and with another law
        layer.moving = None
        layer.rated = False
        layer.constants = (layer.constants[0], np.empty((0, 1)), *layer.constants[2:])
        with th.no_grad():
            last_layer(model)[..., -1] = 0.5


def test_the_interval_is_that_of_paired_differences(tmp_path) -> None:
    model = moved(0.1)
    text = Outline(report(model, tmp_path / "r.html", env=Slide, seeds=SEEDS)).text
    before = evaluate(guard_samples.LAW, Slide, SEEDS)
    after = evaluate(model, Slide, SEEDS)
    scale = 100 / before.costs.mean()
    change = after.costs - before.costs
    ratio = change.mean() / before.costs.mean()
    of_mean = ratio * (before.costs - before.costs.mean())  # as their mean of the MPC moves
    low, high = stats.ttest_1samp(change - of_mean, 0).confidence_interval(0.9)
    assert f"between {scale * low:+.2f} and {scale * high:+.2f} %" in text
    assert "0 of 8 episodes violate a limit (0 with the MPC)" in text
    assert f"fewer than {100 * (1 - 0.05 ** (1 / 8)):.1f} % of such starts do" in text


def test_an_env_of_another_plant_is_refused() -> None:
    with pytest.raises(ValueError, match=r"of shape \(4,\) and Box.*, the model \(1,\) and Box"):
        _ = subject_of(moved(0.1), env="CSTR-v0").loops


def test_where_an_env_gives_no_reward_the_stage_cost_counts() -> None:
    model = moved(0.1)
    subject = subject_of(model, env=lambda: TransformReward(Slide(), lambda reward: 0.0))
    text = unescape(str(evidence_parts.loops_part(subject).content))
    assert "the sum of the MPC's stage cost: the env gives no reward" in text
    text = unescape(str(evidence_parts.loops_part(subject_of(model, env=Slide)).content))
    assert "the rewards, which is not the MPC's stage cost" in text
    cost = model.policy.problem.stage_cost
    for who, act in (("MPC", guard_samples.LAW), ("policy", model)):
        played = evaluate(act, Slide, subject.seeds)
        wanted = [cost(x[:-1], u).sum() for x, u in played.pairs]
        np.testing.assert_allclose(subject.loops[who].costs, wanted, rtol=1e-5)


def test_a_penalty_that_rounding_alone_makes_larger_is_no_failure() -> None:
    tank = LinearModel([[0.9]], [[0.5]], dt=1, x_ss=[12], u_ss=[3])
    box = {"x_max": 13, "u_min": 0, "u_max": 10, "theta_min": 0, "theta_max": 20}
    mpc = LinearMPC(tank, Q=[[1]], R=[[1]], horizon=3, soft=SoftBounds(1), **box)
    env = PlantEnv(lambda x, u: 0.1 * (32 - x) + 0.5 * (u - 3), mpc, start_low=13, start_high=14)
    model = DDPG("YannPolicy", env, policy_kwargs={"problem": mpc})
    unpin(model)
    for size, verdict in ((3e-7, "passed"), (1e-5, "failed")):  # of the input's half range
        with th.no_grad():
            last_layer(model)[..., -1] = size
        loops = subject_of(model, env=env).loops
        assert np.all(loops[OF_POLICY].excess.penalty > loops[OF_MPC].excess.penalty)
        assert problem_parts._bound_findings(mpc, loops)[1].verdict == verdict


@pytest.mark.parametrize("shows", ["plant", "normalized"])
def test_the_mpc_is_played_through_the_policy_s_own_maps(shows, tmp_path) -> None:
    mpc = unit_samples.plant_mpc()
    env = partial(unit_samples.plant, shows, "normalized")
    kwargs = {"problem": mpc, "observation": unit_samples.SAYS[shows]}
    model = DDPG("YannPolicy", env(), policy_kwargs=kwargs)
    page = report(model, tmp_path / "r.html", env=env, seeds=range(3))
    text = Outline(page).text
    law = mpc.explicit()
    same = evaluate(law, partial(unit_samples.plant, "plant", "plant"), range(3))
    assert "From these starts the policy costs what the MPC costs." in text
    assert f"mean cost {same.costs.mean():.5g}" in text
    assert "which is not the MPC's stage cost" not in text
    assert "temperature 340 360 hard" in text and "u[0] 38 45 hard" in text


def test_a_wrong_law_fails(tmp_path, monkeypatch) -> None:
    model = guard_samples.build()
    subject = subject_of(model)
    law = subject.law
    vars(subject)["law"] = replace(law, offsets=law.offsets + 1e-3)
    part = problem_parts.law_part(subject)
    assert [each.verdict for each in part.findings] == ["failed", "failed"]


@pytest.fixture(scope="module")
def improved(tmp_path_factory):
    """A saved and loaded model with what `improve` leaves in one that it has made better."""
    model = moved(0.1)
    settings = {"n_starts": 7, "updates": 1000}
    weights = evidence_parts.fingerprint(model.policy.actor)
    checks = Check(1, False, "it fell", -0.2, 0.07, True), Check(2, True, "", -0.1, 0.01, True)
    found = Improvement(
        checks, -0.1, True, source="a log", episodes=5, settings=settings, policy=weights
    )
    model.improvements = (found,)
    folder = tmp_path_factory.mktemp("improved")
    model.save(folder / "model.zip")
    loaded = DDPG.load(folder / "model.zip")
    return loaded, report(loaded, folder / "page.html", env=Slide, seeds=range(40, 43))


def test_how_far_inputs_move_is_beside_the_mpc_s(tmp_path) -> None:
    text = Outline(report(moved(0.1), tmp_path / "page.html", env=Slide, seeds=range(40, 43))).text
    largest = re.search(r"largest step of u\[0\] (\S+) (\S+) ", text)
    mean = re.search(r"mean step of u\[0\] (\S+) (\S+) ", text)
    both = zip(largest.groups(), mean.groups(), strict=True)
    assert all(0 < float(b) <= float(a) for a, b in both)


def test_what_improve_did_travels_with_the_model_and_is_on_the_page(improved) -> None:
    model, page = improved
    text = Outline(page).text
    (found,) = model.improvements
    for said in (
        "The policy is the one that improve accepted last, in the twin (5 episodes",
        *(line.split()[0] for line in found.report().splitlines()), found.source,
        "1.1 -20.00 % +7.00 % it fell 1.2 -10.00 % +1.00 % no objection",
        "n_starts 7 episodes for which the best inputs are planned", "updates 1000 steps of the",
    ):  # fmt: skip
        assert said in text
    assert "nothing has confirmed" not in text and found.settings["n_starts"] == 7
    assert "gamma 0.99 seed" in text and "learning starts" not in text  # nothing was learnt


def test_a_policy_that_was_changed_after_improve_fails(improved) -> None:
    changed = copy.deepcopy(improved[0])
    with th.no_grad():
        for each in changed.policy.actor.mu.network.parameters():
            each.add_(0.01)
    (finding,) = evidence_parts.improve_part(subject_of(changed)).findings
    assert finding.verdict == "failed" and "changed since" in finding.text
    found = evidence_parts.guard_part(subject_of(changed)).findings
    assert "nothing has confirmed" in found[0].text
    back = copy.deepcopy(improved[0])
    with th.no_grad():
        for each in back.policy.actor.mu.network.parameters():
            each.zero_()
    (finding,) = evidence_parts.improve_part(subject_of(back)).findings
    assert finding.verdict == "note" and "MPC again" in finding.text


def test_improve_after_a_guard_is_no_failure_and_one_that_found_nothing_is_a_note() -> None:
    model = copy.deepcopy(guarded()[0])
    model.improvements = (Improvement((), -0.1, True, policy="of another"),)
    (finding,) = evidence_parts.improve_part(subject_of(model)).findings
    assert finding.verdict == "note" and "guard has accepted another" in finding.text
    with th.no_grad():
        unpin(model)
        last_layer(model)[..., -1] = 0.2
    now = evidence_parts.fingerprint(model.policy.actor)
    model.improvements = (Improvement((), -0.1, True, policy=now),)
    (finding,) = evidence_parts.guard_part(subject_of(model)).findings
    assert finding.verdict == "note" and "improve has accepted another one" in finding.text
    check = Check(1, False, "a start costs more", 0.0, 0.0, True)
    model.improvements = (Improvement((check,), 0.0, False, source="Slide", episodes=9),)
    part = evidence_parts.improve_part(subject_of(model))
    assert part.findings[0].verdict == "note" and "a start costs more" in part.content
    del model.guard_state
    model.improvements = tuple(Improvement((), -0.1, True, policy=each) for each in (now, "later"))
    assert evidence_parts.improve_part(subject_of(model)).findings[0].verdict == "failed"


def test_what_the_plant_has_confirmed_travels_with_the_model_and_is_on_the_page(tmp_path) -> None:
    model = moved(0.1)
    now = evidence_parts.fingerprint(model.policy.actor)
    model.commissioned = Commissioned("batch 3", "12 pairs\n3 alarms", now)
    model.save(tmp_path / "model.zip")
    loaded = DDPG.load(tmp_path / "model.zip")
    text = Outline(report(loaded, tmp_path / "page.html", env=Slide, seeds=range(40, 43))).text
    with pytest.raises(ValueError, match="the page is HTML, name it"):
        report(loaded, tmp_path / "page.pdf")
    for said in ("one of batch 3, which the plant has confirmed", "12 pairs", "3 alarms"):
        assert said in text
    assert "nothing has confirmed" not in text
    assert export(loaded, tmp_path / "plant.npz").note == ""
    cases = [("batch 3", "of another", "failed", "NOT"), ("MPC", now, "note", "no other one")]
    for kept, policy, verdict, said in cases:
        loaded.commissioned = Commissioned(kept, "", policy)
        (finding,) = evidence_parts.commissioning_part(subject_of(loaded)).findings
        assert finding.verdict == verdict and said in finding.text
        assert export(loaded, tmp_path / "plant.npz").note.startswith("Neither a guard nor")


def test_the_page_says_that_an_observer_is_no_part_of_the_policy(tmp_path) -> None:
    mpc, _ = offset_free(twin_samples.problem())
    model = DDPG("YannPolicy", LinearPlant(mpc), policy_kwargs={"problem": mpc})
    env = gym.wrappers.TimeLimit(LinearPlant(mpc), 3)
    text = Outline(report(model, tmp_path / "p.html", env=env, seeds=range(2))).text
    assert "estimated disturbance" in text and "runs the observer" in text
    for said in (text, Improvement((), -0.02, True, model=model).report()):
        assert "Costs and bounds are those of the estimates, not of the plant." in said
    assert "measured disturbance" not in text


def test_bounds_that_are_counted_on_estimates_are_said_to_be() -> None:
    bounded = replace(problems.clipped_pendulum(), x_max=[2.0, 2.0])
    observer = StateEstimator(bounded.model, [[1.0, 0.0]])

    def make() -> gym.Env:
        angle = TransformObservation(LinearPlant(bounded), lambda x: x[:1], gym.spaces.Box(-9, 9))
        return TimeLimit(EstimateState(angle, observer), 3)

    model = DDPG("YannPolicy", make(), policy_kwargs={"problem": bounded})
    found = problem_parts.constraints_part(subject_of(model, env=make)).findings
    assert "Bounds count on an observer's estimates" in found[-1].text


class Untouchable(Wrapper):
    def __init__(self) -> None:
        raise AssertionError("it was played")


def test_a_path_that_cannot_be_written_is_told_before_anything_is_played(tmp_path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "report.html", tmp_path):
        with pytest.raises(OSError, match=r"cannot be written .* Name a file in a folder"):
            report(guard_samples.build(), path, env=Untouchable)


def test_a_report_that_fails_leaves_the_last_one_as_it_was(tmp_path) -> None:
    path = tmp_path / "report.html"
    path.write_text("before")
    with pytest.raises(AssertionError, match="it was played"):
        report(guard_samples.build(), path, env=Untouchable)
    assert path.read_text() == "before" and [*tmp_path.iterdir()] == [path]


def test_of_a_twin_alone_its_episodes_are_played_and_said_to_be_no_plant_s(tmp_path) -> None:
    twin = twin_samples.twin()
    model = DDPG("YannPolicy", twin.env())
    text = report(model, tmp_path / "r.html", twin=twin, seeds=range(2)).read_text()
    assert "The env is a twin, fitted to the plant&#x27;s log: the plant has played none" in text
    assert "Closed loops against the MPC" in text and "samples for which a move" not in text
    assert "The policy is the MPC: its networks add nothing." in text


def test_what_is_not_the_model_s_is_refused(tmp_path) -> None:
    model = guard_samples.build()
    path = tmp_path / "r.html"
    with pytest.raises(TypeError, match="needs a YannPolicy"):
        report(DDPG("MlpPolicy", Slide()), path)
    with pytest.raises(TypeError, match="twin = 3 must be a PlantTwin, or None"):
        report(model, path, twin=3)
    with pytest.raises(ValueError, match="has not watched this model"):
        report(model, path, guard=make_guard())
    with pytest.raises(ValueError, match="The twin is one of"):
        report(model, path, twin=twin_samples.twin())
    with pytest.raises(ValueError, match="seeds is empty"):
        report(model, path, seeds=[])
    with pytest.raises(ValueError, match=r"seeds = 0\.5 must be a whole number"):
        report(model, path, seeds=[0.5])
    with pytest.raises(TypeError, match=r"seeds = 20 must be .* range\(20\)"):
        report(model, path, seeds=20)
    assert not path.exists()


def test_observations_are_normalized_as_in_training(tmp_path) -> None:
    mpc = guard_samples.MPC
    venv = VecNormalize(DummyVecEnv([Slide]), norm_reward=False, training=False)
    venv.obs_rms.mean[:] = 0.5
    venv.obs_rms.var[:] = 4.0
    kwargs = {"problem": mpc, "observation": AffineObservation.from_vec_normalize(venv)}
    model = DDPG("YannPolicy", venv, policy_kwargs=kwargs)
    text = Outline(report(model, tmp_path / "r.html", env=Slide, seeds=range(3))).text
    assert "From these starts the policy costs what the MPC costs." in text
    mean = evaluate(guard_samples.LAW, Slide, range(3)).costs.mean()
    assert f"mean cost {mean:.5g}" in text


def test_a_law_that_is_solved_online_has_no_regions_to_show(tmp_path) -> None:
    mpc = problems.clipped_pendulum()
    kwargs = {"problem": mpc, "law": "online"}
    model = DDPG("YannPolicy", "ClippedPendulum-v0", policy_kwargs=kwargs)
    text = Outline(report(model, tmp_path / "r.html", env="ClippedPendulum-v0", seeds=[0])).text
    assert "The MPC's law is solved at each point" in text
    assert "A picture of regions needs an explicit law" in text


def test_starts_that_the_guard_knows_are_named() -> None:
    model, guard = guarded()
    known = subject_of(model, guard=guard, seeds=range(999_995, 1_000_003))
    text = evidence_parts.loops_part(known).content
    assert "3 of these starts are known to the guard" in text
    loops = evidence_parts.loops_part(subject_of(model, guard=guard))
    assert "known to the guard" not in loops.content


def test_starts_of_the_mpc_itself_need_no_rows_and_those_of_a_policy_are_counted() -> None:
    kwargs = {"problem": guard_samples.MPC}
    subject = subject_of(DDPG("YannPolicy", Slide(), policy_kwargs=kwargs), env=Slide)
    assert "Each costs what it costs with the MPC" in evidence_parts.loops_part(subject).content
    content = evidence_parts.statistics_part(subject).content
    assert "It costs less from 0 starts and more from 0 of" in content
    subject = subject_of(moved(), env=Slide)
    both = evidence_parts.OF_POLICY, evidence_parts.OF_MPC
    policy, mpc = (subject.loops[each].costs for each in both)
    assert "Each costs what" not in evidence_parts.loops_part(subject).content
    content = evidence_parts.statistics_part(subject).content
    counted = f"less from {np.sum(policy < mpc)} starts and more from {np.sum(policy > mpc)} of"
    assert f"It costs {counted} {len(mpc)}" in content
