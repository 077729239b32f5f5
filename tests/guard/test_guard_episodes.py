"""What came of a policy's episodes, and what starts say of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sb3_yann import StepSize
from sb3_yann.guard import simulator_acceptance as module
from sb3_yann.guard.episodes import Evidence, Outcome, Starts
from sb3_yann.guard.options import AcceptanceRule
from sb3_yann.guard.session import GuardSession
from sb3_yann.guard.simulator_acceptance import SimulatorAcceptance
from sb3_yann.guard.state import Decision
from sb3_yann.guard.statistics import Tolerance

STRICT = Tolerance(1.0)


def outcome(costs: Any, unsafe: Any = None, visits: Any = None) -> Outcome:
    n = len(costs)
    unsafe = np.zeros((n, 7)) if unsafe is None else np.array(unsafe, float)
    unsafe = np.pad(unsafe, ((0, 0), (0, 7 - unsafe.shape[1])))
    visits = np.ones((n, 2)) if visits is None else visits
    return Outcome(np.array(costs, float), unsafe, np.array(visits, bool))


def starts(costs: Any, tolerance: Tolerance = STRICT, sure: float = 0.0, **more: Any) -> Starts:
    found = outcome(costs, **more)
    return Starts((*range(100, 100 + len(costs)),), found, tolerance, len(costs), sure)


def test_a_large_step_of_an_input_breaks_nothing_and_all_else_does() -> None:
    calm = outcome([1.0, 2.0])
    for column in range(6):
        unsafe = np.zeros((2, 7))
        unsafe[1, column] = 1
        worse = outcome([1.0, 2.0], unsafe)
        assert worse.breaks_more_than(calm) == (column != 3)
        assert not calm.breaks_more_than(worse) and not worse.breaks_more_than(worse)
        assert starts([1.0, 2.0]).more_unsafe(worse).tolist() == [False, True]
        assert starts([1.0, 2.0], unsafe=unsafe).more_unsafe(worse).tolist() == [False, False]


def test_episodes_are_picked_joined_and_replaced() -> None:
    one = outcome([1.0, 2.0, 3.0], visits=[[1, 0], [0, 1], [1, 1]])
    assert one.at([2, 0]).costs.tolist() == [3, 1]
    assert one.at([2, 0]).visits.tolist() == [[True, True], [True, False]]
    longer = one.extended_by(outcome([7.0]))
    assert longer.costs.tolist() == [1, 2, 3, 7] and len(longer.unsafe) == len(longer.visits) == 4
    other = one.replaced([1], outcome([9.0], [[1, 2, 3, 4]], [[0, 0]]))
    assert other.costs.tolist() == [1, 9, 3] and other.unsafe[1, :4].tolist() == [1, 2, 3, 4]
    assert other.visits[1].tolist() == [False, False]
    assert one.costs.tolist() == [1, 2, 3]  # as it was


def test_some_starts_stand_for_all_and_starts_join() -> None:
    some = starts([1.0, 2.0, 3.0], sure=2.0).at([2, 0])
    assert some.seeds == (102, 100) and some.mpc.costs.tolist() == [3, 1]
    assert (some.n_starts, some.sure) == (3, 2.0)
    both = some.joined_with(starts([5.0]))
    assert both.seeds == (102, 100, 100) and both.n_starts == 4 and both.sure == 0.0
    assert both.mpc.costs.tolist() == [3, 1, 5]


def test_starts_lose_by_cost_or_by_what_is_unsafe() -> None:
    given = starts([10.0, 10.0])
    assert given.lost(outcome([11.0, 11.1])).tolist() == [False, True]
    assert given.excess(outcome([11.0, np.nan])).tolist() == [1.0, np.inf]
    assert given.loses(outcome([11.1, 0.0])) and not given.loses(outcome([11.0, 10.0]))
    assert given.loses(outcome([0.0, 0.0], [[0, 0, 0, 1], [0, 0, 0, 0]]))
    # With a tail, of more starts than these: the worst tenth of twenty is two.
    many = Starts((1, 2), outcome([10.0, 10.0]), Tolerance(1.0, 0.1, 10.0), 20)
    assert not many.loses(outcome([11.5, 10.0])) and many.loses(outcome([11.5, 10.6]))


def test_the_mean_must_not_be_above_the_mpc_s_by_more_than_rounding() -> None:
    given = starts([10.0, -30.0])
    for more, above in ((0.9e-6, False), (1.1e-6, True)):
        assert given.mean_is_above(outcome([10.0, -30.0 + 2 * 20.0 * more])) == above
    assert given.mean_is_above(outcome([10.0, np.nan]))
    change = np.array([-3.0, 1.0, -1.0, -1.0])
    edge = 1.0 / (change.std() / 2)  # standard errors that the mean is below
    for sure, above in ((0.99 * edge, False), (1.01 * edge, True)):
        surely = starts([10.0] * 4, Tolerance(9.0), sure)
        assert surely.mean_is_above(outcome(10 + change)) == above


def test_the_reason_names_the_hardest_start_and_how_many_are_lost() -> None:
    given = starts([10.0, 10.0, 10.0])
    said = given.objection(outcome([12.0, 9.0, 13.5]))
    assert said == "2 of 3 new starts lose against the MPC, seed 102 costs 3.5 more"
    unsafe = np.zeros((3, 4))
    unsafe[1, 0] = 1
    said = given.objection(outcome([9.0, 9.0, 12.0], unsafe))
    assert said == (
        "2 of 3 new starts lose against the MPC, seed 101 costs -1 more and violates a limit"
    )
    unsafe[1] = [0, 0, 0, 1]
    assert given.objection(outcome([9.0] * 3, unsafe)).endswith("more and moves an input too far")
    assert given.objection(outcome([10.5, 10.0, 10.0])) == (
        "mean cost 10.1667 on 3 new starts, MPC 10"
    )
    assert given.objection(outcome([10.0, 10.0, 10.0003])) == (
        "mean cost 10.0001 on 3 new starts, MPC 10"
    )
    near = given.objection(outcome([10.0, 10.0, 10.00006]))
    assert near == "mean cost 10.00002 on 3 new starts, MPC 10"
    assert given.objection(outcome([10.0, 10.0, 10.0])) == ""
    surely = starts([10.0] * 4, Tolerance(9.0), 50.0)
    assert surely.objection(outcome([9.0, 9.0, 9.9, 10.0])) == (
        "mean cost 9.475 on 4 new starts, MPC 10: not surely below"
    )


def test_the_ten_hardest_are_kept() -> None:
    given = starts([10.0] * 15)
    costs = 12.0 + np.arange(15.0)
    assert given.hardest(outcome(costs)).tolist() == [*range(14, 4, -1)]
    assert len(given.hardest(outcome([10.0] * 15))) == 0


def test_the_evidence_pairs_the_accepted_policy_with_the_mpc() -> None:
    mpc, accepted = outcome([1.0, 2.0]), outcome([0.5, 1.5], visits=[[1, 0], [0, 0]])
    evidence = Evidence((1, 2), mpc, STRICT, 7, accepted=accepted)
    paired = evidence.paired
    assert paired.mpc_costs is mpc.costs and paired.costs is accepted.costs
    assert np.array_equal(paired.unsafe, accepted.unsafe)
    assert (paired.tolerance, paired.n_starts) == (STRICT, 7)
    assert evidence.visits is accepted.visits


class Model:
    """Takes what a session records."""

    num_timesteps = 12

    def __init__(self) -> None:
        self.recorded: dict[str, float] = {}
        self.dumped: list[int] = []
        self.logger = self

    def record(self, name: str, value: float) -> None:
        self.recorded[name] = value

    def dump(self, step: int) -> None:
        self.dumped.append(step)


@pytest.mark.parametrize(
    ("verdict", "restored", "before", "after"),
    [
        ("accepted", False, 0.4, 0.6), ("accepted", False, 0.9, 1.0),
        ("rejected", True, 0.8, 0.4), ("rejected", True, 0.3, 0.2), ("rejected", True, 0.05, 0.05),
        ("rejected", False, 0.8, 0.8), ("accepted in part", True, 0.8, 0.8),
    ],
)  # fmt: skip
def test_the_step_grows_with_an_acceptance_and_shrinks_with_a_restoration(
    verdict: Any, restored: bool, before: float, after: float
) -> None:
    class Session(GuardSession):
        state: Any = None

        def __init__(self) -> None:
            self.model, self.log_path, self.verbose = Model(), None, 0
            self.step_size, self.log_lacks_rows = StepSize(0.5, 1.5, 0.2), True
            self.policy = Model()

    session = Session()
    session.state = Model()
    session.state.step, session.state.episodes, session.state.decisions = before, 5, []
    session.decide(verdict, "why", restored, (3.0, 2.0, 1.0), 0.5, (4, 6), share=0.25)
    assert session.state.step == session.policy.actor_step == pytest.approx(after)
    (found,) = session.state.decisions
    step = session.state.step
    assert found == Decision(
        12, 5, verdict, "why", restored, 3.0, 2.0, 1.0, 0.5, (4, 6), step, 0.25
    )
    assert not session.log_lacks_rows and session.model.dumped == [12]
    refused = float(verdict == "rejected")
    assert session.model.recorded == {
        "guard/candidate_cost": 3.0, "guard/accepted_cost": 2.0, "guard/mpc_cost": 1.0,
        "guard/worst_start": 0.5, "guard/step": step, "guard/rejected": refused,
        "guard/accepted": 1 - refused, "guard/candidate_change_percent": 200.0,
        "guard/accepted_change_percent": 100.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("margin", (0.0, 5.0), (-1e-9, np.inf)), ("tail", (0.0, 1.0), (-0.1, 1.1)),
        ("largest_step", (1.0, 7.0, None), (0.99, np.inf)),
        ("significance", (0.0, 0.5), (-0.1, 0.51)), ("by_region", (True, False), (1, "no")),
        ("retreat", (True, False), (0, None)),
    ],
)  # fmt: skip
def test_what_a_rule_may_be_ends_where_it_says(name: str, good: Any, bad: Any) -> None:
    for value in good:
        assert getattr(AcceptanceRule(**{name: value}), name) == value
    for value in bad:
        with pytest.raises((ValueError, TypeError), match=name):
            AcceptanceRule(**{name: value})


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [("shrink", (0.0, 1.0), (-0.1, 1.1)), ("grow", (1.0, 9.0), (0.9, np.inf)),
     ("smallest", (0.0, 1.0), (-0.1, 1.1))],
)  # fmt: skip
def test_what_a_step_size_may_be_ends_where_it_says(name: str, good: Any, bad: Any) -> None:
    for value in good:
        assert getattr(StepSize(**{name: value}), name) == value
    for value in bad:
        with pytest.raises(ValueError, match=name):
            StepSize(**{name: value})


def acceptance(**changes: Any) -> SimulatorAcceptance:
    """Return the acceptance of a guard's simulator with twelve known starts."""
    given: dict[str, Any] = {
        "name": "Plant", "seeds": range(12), "n_new_starts": 0, "n_final_starts": 0,
        "eval_every": 1, "patience": 2, "keep_if_worse": False, "rule": AcceptanceRule(),
    }  # fmt: skip
    return SimulatorAcceptance(**(given | changes))


@pytest.mark.parametrize(
    ("level", "times", "plus", "unsafe", "holds"),
    [
        (1e6, 1.0, 0.0, 0, True), (1e6, 1 + 0.9e-5, 0.0, 0, True), (1e6, 1 - 1.1e-5, 0.0, 0, False),
        # Near zero costs are compared in thousandths of the margin, which is 4.
        (1e-9, 1.0, 3.9e-3, 0, True), (1e-9, 1.0, 4.1e-3, 0, False),
        (1e6, 1.0, 0.0, 1, False), (1e6, 1.0, 0.0, -1, False),
    ],
)  # fmt: skip
def test_evidence_holds_where_five_of_its_starts_play_as_before(
    level: float, times: float, plus: float, unsafe: int, holds: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    accepted = outcome(np.full(12, level), np.ones((12, 4)))
    evidence = Evidence((*range(50, 62),), accepted, Tolerance(4.0), 12, accepted=accepted)

    def again(_: Any, rows: Any) -> Outcome:
        found = accepted.at(rows)
        found.costs[-1] = times * level + plus
        found.unsafe[-1, 2] += unsafe
        return found

    played: list[Any] = []

    def play(session: Any, checkpoint: Any, seeds: Any) -> Any:
        played.extend(seeds)
        return [seed - 50 for seed in seeds]

    monkeypatch.setattr(module, "play_episodes", play)
    monkeypatch.setattr(module, "outcome_of", again)
    session: Any = SimpleNamespace(state=SimpleNamespace(evidence=evidence, accepted=None))
    assert acceptance().still_holds(session) == holds
    assert played == [50, 52, 55, 58, 61]
    session.state.evidence = None
    assert acceptance().still_holds(session) is False


def test_a_trial_is_due_where_an_episode_ends_and_so_many_have_passed() -> None:
    class Counts(SimulatorAcceptance):
        tried: list[int]

        def try_candidate(self, session: GuardSession) -> None:
            self.tried.append(session.state.episodes)

    due = Counts(*vars(acceptance(eval_every=3)).values())
    due.tried = []
    session: Any = SimpleNamespace(state=SimpleNamespace(last_trial=None, episodes=0))
    for episodes, dones in enumerate([[0, 1], [1, 0], [0, 0], [1, 1], [1, 0], [1, 0], [1, 0]], 1):
        session.state.episodes = episodes
        due.step(session, np.array(dones, bool))
    assert due.tried == [1, 4, 7] and session.state.last_trial == 7
