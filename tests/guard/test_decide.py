"""What becomes of a candidate: whole, in part, on new starts, at the end, or not at all."""

from functools import partial

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG, TD3

from guard_samples import (
    FIRST,
    LAW,
    LEFT,
    REGION,
    RIGHT,
    STEPS,
    At,
    CutOff,
    Slide,
    accepted_bits,
    actor_bits,
    better,
    bits,
    build,
    correct,
    make_guard,
    train,
    tried,
    verdicts,
)
from sb3_yann import restore_accepted
from sb3_yann.policy.checkpoint import ActorCheckpoint
from sb3_yann.policy.policies import YannPolicy
from sb3_yann.rollout import evaluate
from weights import first_layer, is_learnt, is_mpc, last_layer

WHOLE = {"by_region": False}


class OftenRight(Slide):
    """Starts on the right, but for some seeds beyond the guard's own.

    And for the first of its own, from which no input makes a difference.
    """

    def __init__(self, left_of: int = 3, after: int = FIRST + 10, **kwargs) -> None:
        super().__init__(**kwargs)
        self.left_of = left_of
        self.after = after

    def reset(self, *, seed=None, options=None):
        self.indifferent = seed == FIRST
        left = seed is not None and seed >= self.after and seed % self.left_of == 0
        left |= self.indifferent
        self.low, self.high = (-4.0, -2.0) if left else (2.0, 4.0)
        return super().reset(seed=seed, options=options)

    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, -1.0 if self.indifferent else reward, *rest


def spoil_left(policy, right: float = 0.5) -> None:
    """Make the right better than the MPC, and the left, where no known start shows it, worse."""
    correct(policy, RIGHT, right)
    correct(policy, LEFT, -2.0)


class Awkward(Slide):
    """Starts on the right; from one seed any other input than the MPC's costs much."""

    def __init__(self, at: int | None = None) -> None:
        super().__init__(low=2.0, high=4.0)
        self.at = at

    def reset(self, *, seed=None, options=None):
        self.here = seed == self.at
        return super().reset(seed=seed, options=options)

    def step(self, action):
        apart = float(action[0] - LAW(self.x)[0])
        seen, reward, *rest = super().step(action)
        return seen, -1 - 9 * apart**2 if self.here else reward, *rest


def test_a_policy_accepted_by_few_known_starts_must_pass_on_all_of_them_at_the_end() -> None:
    options = {"n_new_starts": 0, "n_final_starts": 10, "rule": WHOLE}
    model, guard = tried(better, env=Awkward, **options)
    assert verdicts(guard) == ["accepted"] and not is_mpc(model.policy)
    assert guard.decisions[0].played[0] == 5  # of ten
    known = guard.state.evidence.starts.seeds
    model, guard = tried(better, env=partial(Awkward, known[-1]), **options)
    assert verdicts(guard) == ["accepted", "rejected"] and is_mpc(model.policy)
    assert f"start {known[-1]} costs" in guard.decisions[1].reason


class Narrow(Slide):
    """Starts on the right; on the final ones inputs far from the MPC's cost much."""

    def __init__(self) -> None:
        super().__init__(low=2.0, high=4.0)

    def reset(self, *, seed=None, options=None):
        self.final = seed is not None and seed >= FIRST + 15
        return super().reset(seed=seed, options=options)

    def step(self, action):
        far = max(0.0, abs(float(action[0] - LAW(self.x)[0])) - 0.4)
        seen, reward, *rest = super().step(action)
        return seen, reward - 20 * far * self.final, *rest


def test_at_the_end_the_best_of_parts_and_earlier_policies_takes_the_place() -> None:
    options = {"n_new_starts": 5, "n_final_starts": 10, "rule": WHOLE | {"backtrack": True}}
    acts = [partial(correct, region=RIGHT, value=each) for each in (0.3, 0.5)]
    model, guard = tried(*acts, env=Narrow, **options)
    assert verdicts(guard)[:2] == ["accepted", "accepted"]
    assert "an earlier policy is restored" in guard.decisions[-1].reason
    value = last_layer(model.policy)[REGION[RIGHT], :, -1]
    np.testing.assert_allclose(value.detach(), 0.3)  # half of the correction is 0.25


def test_a_policy_that_loses_on_new_starts_is_accepted_without_the_regions_that_lose() -> None:
    model, guard = tried(spoil_left, env=OftenRight, n_new_starts=20)
    decision = guard.decisions[0]
    assert decision.verdict == "accepted in part"
    said = "on 5 new starts, start 1000011 costs 89.9 % of the mean cost more than with the MPC"
    assert decision.reason == said
    assert decision.regions == (REGION[RIGHT],)
    weights = last_layer(model)[:, :, -1]
    assert not weights[REGION[LEFT]].any() and weights[REGION[RIGHT]].any()
    starts = guard.state.evidence.starts
    hard = starts.seeds[: starts.n_hard]
    assert sorted(starts.seeds[starts.n_hard :]) == [*range(FIRST, FIRST + 10)]
    assert hard and all(seed % 3 == 0 for seed in hard)


def test_starts_that_were_lost_once_are_tried_with_every_later_candidate() -> None:
    _, guard = tried(spoil_left, spoil_left, env=OftenRight, n_new_starts=20, rule=WHOLE)
    first, second = guard.decisions[:2]
    assert "new starts" in first.reason
    assert "new starts" not in second.reason and "costs" in second.reason
    evidence = guard.state.evidence
    assert evidence.next_seed == FIRST + 15
    hard = evidence.starts.seeds[: evidence.starts.n_hard]
    assert evidence.lost and {seed % 3 for seed in evidence.lost} == {0}
    assert {*evidence.lost, *hard} == {*evidence.to_learn}


def test_what_was_accepted_before_gives_way_to_the_mpc_where_it_loses_as_well() -> None:
    # The first five new starts show the right only: all of it is accepted.
    options = {"env": partial(OftenRight, after=FIRST + 15), "n_new_starts": 20, "rule": WHOLE}
    model, guard = tried(partial(spoil_left, right=0.4), good, **options)
    assert verdicts(guard) == ["accepted", "accepted", "rejected"]  # the last one at the end
    assert actor_bits(model.policy) == accepted_bits(guard)
    assert is_mpc(model)
    assert guard.decisions[-1].accepted_cost == pytest.approx(guard.decisions[-1].mpc_cost)


GENTLE = {"cvar_alpha": 0.05, "backtrack": True}


def test_of_a_step_too_far_half_is_accepted() -> None:
    too_far = partial(push, size=1.2)
    model, guard = tried(too_far, actor={"networks": "shared"}, n_new_starts=0, rule=GENTLE)
    decision, *_ = guard.decisions
    assert (decision.verdict, decision.share) == ("accepted in part", 0.5)
    assert decision.candidate_cost > decision.accepted_cost < decision.mpc_cost
    assert not is_mpc(model)


def test_at_the_end_half_of_a_correction_is_kept_that_loses() -> None:
    """On the left, which only the last starts show, the whole costs more, and half costs less."""
    options = {"n_new_starts": 0, "n_final_starts": 60, "rule": GENTLE | WHOLE}
    model, guard = tried(push_left, env=OftenRight, **options)
    last = guard.decisions[-1]
    assert last.reason.startswith("at the end") and "50 % of its correction is kept" in last.reason
    assert last_layer(model)[:, :, -1].abs().max().item() == pytest.approx(0.6)


def push_left(policy) -> None:
    correct(policy, RIGHT, 0.5)
    correct(policy, LEFT, -1.2)  # the best is -.5


def test_the_guard_counts_the_steps_of_its_simulator_in_all_runs(tmp_path) -> None:
    class Counted(Slide):
        steps = 0

        def step(self, action):
            Counted.steps += 1
            return super().step(action)

    model, guard = tried(spoil_left, spoil_left, env=Counted)
    for runs in (1, 2):
        assert guard.steps == Counted.steps
        for said in (f"{guard.steps} of the guard's simulator", f"in {1 + runs} episodes"):
            assert said in guard.summary()
        model.save(tmp_path / "model")
        model = DDPG.load(tmp_path / "model", env=Slide(), device="cpu")
        guard = make_guard(Counted)
        train(model, STEPS, At([STEPS], spoil_left), guard)


@pytest.mark.parametrize("rule", [{}, {"least_gain": 0.0}, {"cvar_alpha": 0}])
def test_what_gains_little_is_refused_at_no_cost_of_patience_but_where_any_gain_will_do(
    rule,
) -> None:
    model = build(gradient_steps=0)
    guard = make_guard(n_final_starts=60, rule={**GENTLE, **rule}, patience=1)
    train(model, STEPS + 1, At([STEPS], lambda policy: correct(policy, RIGHT, 1e-4)), guard)
    first = guard.decisions[0]
    assert (first.verdict == "accepted") is bool(rule)
    assert is_mpc(model) is not bool(rule)
    if not rule:
        assert first.reason == "too little a gain over the accepted policy" and not first.restored


def rows(checkpoint: ActorCheckpoint, region: int) -> list[object]:
    """Return what belongs to a region: parameters of actor and target, and moments."""
    parts = [checkpoint.actor, checkpoint.target, *checkpoint.optimizer["state"].values()]
    tensors = [
        value
        for part in parts
        for key, value in part.items()
        if str(key).startswith("exp_avg") or is_learnt(str(key))
    ]
    return [bits(value[region]) for value in tensors]


@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_the_good_region_is_the_candidate_s_and_the_others_are_as_before(algorithm) -> None:
    model = build(algorithm)
    guard = make_guard(rule={"margin": 0.03})
    checkpoints: dict[str, ActorCheckpoint] = {}

    def change(policy) -> None:
        checkpoints["accepted"] = guard.state.accepted
        spoil_left(policy)
        checkpoints["candidate"] = ActorCheckpoint.of(policy)

    step = 3 * STEPS  # the first candidate, from the first episode, is accepted with its moments
    seen: list[bool] = []
    look = At([step], lambda policy: seen.append(actor_bits(policy) == accepted_bits(guard)))
    keep = At([step], lambda policy: checkpoints.update(mixed=ActorCheckpoint.of(policy)))
    fix = At([STEPS], lambda policy: correct(policy, LEFT, -0.2))
    train(model, step, fix, At([step], change), guard, look, keep)
    assert checkpoints["accepted"].optimizer["state"]
    (decision,) = [each for each in guard.decisions if each.timestep == step][:1]
    assert decision.verdict == "accepted in part"
    assert REGION[RIGHT] in decision.regions
    assert REGION[LEFT] not in decision.regions
    assert "costs" in decision.reason
    for region in REGION.values():
        source = "candidate" if region in decision.regions else "accepted"
        assert rows(checkpoints["mixed"], region) == rows(checkpoints[source], region)
    assert rows(checkpoints["candidate"], 0) != rows(checkpoints["accepted"], 0)
    assert seen == [True]


def test_the_evidence_is_that_of_the_policy_that_was_put_together() -> None:
    model, guard = tried(spoil_left)
    assert guard.decisions[0].regions == (REGION[RIGHT],)
    played = evaluate(model, Slide, guard.settings.seeds)
    evidence = guard.state.evidence
    order = np.argsort(evidence.starts.seeds)
    np.testing.assert_allclose(evidence.scores.costs[order], played.costs, atol=1e-5)
    assert guard.decisions[0].accepted_cost == pytest.approx(played.costs.mean())
    assert guard.decisions[0].accepted_cost < guard.decisions[0].mpc_cost
    assert guard.decisions[0].candidate_cost > guard.decisions[0].mpc_cost
    assert guard.decisions[0].step == 1  # neither shrinks nor grows


def test_a_candidate_in_another_box_is_accepted_with_it_or_leaves_the_old() -> None:
    box = 2 * np.ones(build().policy.problem.n_theta)

    def confined(change, policy) -> None:
        change(policy)
        policy.confine_correction(-box, box)

    for change, verdict, kept in ((spoil_left, "rejected", False), (good, "accepted", True)):
        model = build(gradient_steps=0)
        guard = make_guard()
        before = ActorCheckpoint.of(model.policy)
        train(model, STEPS + 1, At([STEPS], partial(confined, change)), guard)
        assert guard.decisions[0].verdict == verdict
        assert bool(model.actor.mu.confines.any()) == kept
        assert before.changed_regions(guard.state.accepted).all() == kept


def good(policy: YannPolicy) -> None:
    correct(policy, RIGHT, 0.5)


def weights(model) -> np.ndarray:
    return last_layer(model)[:, 0, -1].detach().numpy().copy()


class LateLosses(Slide):
    """Of the starts from a seed on, on some the left costs a lot, and on some any correction."""

    late = FIRST + 10 + 10

    def reset(self, *, seed=None, options=None):
        late = seed is not None and seed >= self.late
        self.left = late and seed % 5 < 2
        self.touchy = late and seed % 5 == 2
        self.indifferent = seed == FIRST  # a known start on the left, where all inputs cost alike
        self.low, self.high = (-4.0, -2.0) if self.left or self.indifferent else (2.0, 4.0)
        return super().reset(seed=seed, options=options)

    def step(self, action):
        away = abs(float(np.asarray(action)[0]) - float(LAW(self.x)[0]))
        observation, reward, *rest = super().step(action)
        reward -= 3 * away if self.touchy else 0
        return observation, -1.0 if self.indifferent else reward, *rest


def test_what_is_put_back_at_the_end_is_tried_on_all_of_the_new_starts() -> None:
    def left_as_well(policy) -> None:
        correct(policy, LEFT, -3.0)

    model = build(gradient_steps=0)
    guard = make_guard(LateLosses, n_new_starts=20)
    first = At([1], partial(correct, region=RIGHT, value=0.4))
    train(model, 2 * STEPS, first, At([STEPS + 1], left_as_well), guard)
    assert guard.decisions[-1].reason.startswith("at the end, on ")
    seeds = range(FIRST + 10 + 10, FIRST + 10 + 10 + 200)
    costs, mpc = (evaluate(each, LateLosses, seeds).costs for each in (model, build()))
    assert np.all(costs <= mpc + guard.state.evidence.starts.tolerance.margin)
    assert costs.mean() <= mpc.mean() + 1e-6


@pytest.mark.parametrize("how", ["one learn", "two", "a load in between"])
def test_what_was_accepted_in_an_earlier_learn_can_be_gone_back_to(how, tmp_path) -> None:
    class LaterLeft(LateLosses):
        late = FIRST + 10 + (5 if how == "one learn" else 5 + 200)

        def reset(self, *, seed=None, options=None):
            observation = super().reset(seed=seed, options=options)
            self.touchy = False
            return observation

    good = partial(correct, region=RIGHT, value=0.4)
    model = build(gradient_steps=0)
    options = {"n_new_starts": 20, "rule": {"by_region": False}}
    if how == "one learn":
        moves = At([1], good), At([STEPS + 1], spoil_left)
        train(model, 2 * STEPS, *moves, guard := make_guard(LaterLeft, **options))
    else:
        train(model, STEPS, At([1], good), make_guard(LaterLeft, **options))
        if how == "a load in between":
            model.save(tmp_path / "model")
            model = DDPG.load(tmp_path / "model", env=Slide(), device="cpu")
        train(model, STEPS, At([1], spoil_left), guard := make_guard(LaterLeft, **options))
    assert guard.decisions[-1].reason.endswith("; an earlier policy is restored")
    assert weights(model)[REGION[RIGHT]] == np.float32(0.4)
    assert weights(model)[REGION[LEFT]] == 0


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
@pytest.mark.parametrize("at", [FIRST + 12, FIRST + 10 + 5 + 7], ids=["a trial", "the end"])
def test_a_trial_that_is_cut_off_accepts_nothing_and_leaves_the_candidate(error, at) -> None:
    def stop() -> None:
        raise error("stopped")

    simulator = partial(CutOff, at, stop)
    model = build(gradient_steps=0)
    guard = make_guard(simulator, n_new_starts=5)
    with pytest.raises(error):
        train(model, 2 * STEPS, At([1], better), guard)
    assert weights(model)[REGION[RIGHT]] == 0.5
    passed_once = at > FIRST + 15
    assert len(guard.decisions) == len(guard.state.evidence.passed) == passed_once
    restore_accepted(model)
    assert is_mpc(model) != passed_once
    assert actor_bits(model.policy) == accepted_bits(guard)


@pytest.mark.parametrize("alone", [True, False], ids=["alone", "beside an improvement"])
@pytest.mark.parametrize("when", ["before training", "as a candidate"])
def test_a_region_that_no_start_comes_through_stays_as_it_was(alone, when) -> None:
    def sabotage(policy) -> None:
        correct(policy, LEFT, -7.0)
        if not alone:
            correct(policy, RIGHT, 0.4)

    model = build(gradient_steps=0)
    guard = make_guard(partial(Slide, low=2.0), n_new_starts=5)
    if when == "before training":
        sabotage(model.policy)
    train(model, STEPS, At([1], sabotage), guard)
    assert weights(model)[REGION[LEFT]] == 0
    assert weights(model)[REGION[RIGHT]] == np.float32(0 if alone else 0.4)
    assert actor_bits(model.policy) == accepted_bits(guard)


def test_an_error_of_the_simulator_under_a_candidate_alone_is_a_refusal() -> None:
    class Brittle(Slide):
        def step(self, action):
            if abs(float(action[0])) < 0.7 and self.x[0] > 1.9:
                raise FloatingPointError("integrator failed")
            return super().step(action)

    model = build(gradient_steps=0)
    guard = make_guard(partial(Brittle, low=2.0))
    train(model, 2 * STEPS, At([1], partial(correct, region=RIGHT, value=0.5)), guard)
    (decision,) = guard.decisions
    assert decision.reason.startswith("the simulator failed: FloatingPointError: ")
    assert "in step 1 of the episode from the seed 10000" in decision.reason
    assert decision.restored
    assert is_mpc(model)


SHARED = pytest.mark.parametrize("actor", [{"networks": "shared"}, {"law": "online"}])


@th.no_grad()
def push(policy: YannPolicy, size: float) -> None:
    """Add ``size tanh(x / 5)`` to the law, against its own sign."""
    first_layer(policy).zero_()
    last_layer(policy).zero_()
    first_layer(policy)[0, 0, 0, 0] = 1.0
    last_layer(policy)[0, 0, 0] = size


@SHARED
def test_a_better_network_is_accepted_and_a_worse_one_is_not(actor) -> None:
    moves = [partial(push, size=size) for size in (0.4, -0.4)]
    model, guard = tried(*moves, actor=actor, n_new_starts=0)
    first, second = guard.decisions[:2]
    assert first.verdict == "accepted"
    assert first.accepted_cost < first.mpc_cost
    assert second.verdict not in ("accepted", "accepted in part")
    assert not is_mpc(model)
    assert actor_bits(model.policy) == accepted_bits(guard)


def restless(policy) -> None:
    """Cost less in both saturated regions, and enter the middle one with a larger step."""
    correct(policy, LEFT, -0.7)
    correct(policy, RIGHT, 0.7)


def decided(max_input_step):
    return tried(restless, rule={"max_input_step": max_input_step, **WHOLE}, n_new_starts=50)


@pytest.mark.parametrize("max_input_step", [None, 3.0])
def test_a_cheaper_policy_is_accepted_without_a_bound_or_within_it(max_input_step) -> None:
    model, guard = decided(max_input_step)
    assert guard.decisions[0].verdict == "accepted"
    assert float(last_layer(model)[REGION[RIGHT], 0, -1].detach()) == np.float32(0.7)


def test_beyond_the_bound_it_is_refused_with_the_reason() -> None:
    model, guard = decided(1.0)
    assert guard.decisions[0].verdict == "rejected"
    assert "an input that moves too far in one step" in guard.decisions[0].reason
    assert is_mpc(model)
    assert not guard.state.evidence.starts.mpc.unsafe[:, 3].any()  # the MPC itself never counts


def test_at_the_end_ten_times_as_many_new_starts_are_tried() -> None:
    # Only the very last of them shows the left.
    simulator = partial(OftenRight, left_of=1, after=FIRST + 10 + 5 + 199)
    model, guard = tried(spoil_left, env=simulator, n_new_starts=20)
    whole, end = guard.decisions
    assert whole.verdict == "accepted"
    assert end.verdict == "accepted in part" and end.reason.startswith("at the end, on 200 new")
    assert not last_layer(model)[REGION[LEFT], :, -1].any()
    assert actor_bits(model.policy) == accepted_bits(guard)
    assert guard.state.evidence.starts.seeds[0] == FIRST + 10 + 5 + 199


@pytest.mark.parametrize(("final", "seeds"), [(None, 0), (30, 30)])
def test_what_passes_for_want_of_new_starts_is_found_on_those_at_the_end(final, seeds) -> None:
    options = {"n_new_starts": 0, "n_final_starts": final, "rule": WHOLE}
    model, guard = tried(spoil_left, env=OftenRight, **options)
    assert guard.state.evidence.next_seed == FIRST + 10 + seeds
    assert is_mpc(model) == (final is not None)
    if final is not None:
        assert guard.decisions[-1].reason.startswith("at the end, on 30 new starts, start 1000")
