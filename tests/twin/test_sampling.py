"""When a log was sampled, and in which units: cut, refused by name, or not trusted."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sb3_yann import PlantTwin
from sb3_yann.evaluation import evaluate
from sb3_yann.twin.log import as_episodes
from sb3_yann.twin.sampling import cut_at_gaps
from sb3_yann_envs import cstr, problems
from twin_samples import DT, log, problem


def clock(episodes, first: float = 0.0):
    return [first + DT * np.arange(len(states)) for states, _ in episodes]


def test_a_log_without_gaps_is_that_of_one_without_times() -> None:
    found = PlantTwin.fit(problem(), log(3), time=clock(log(3), first=1e5), residuals=["none"])
    assert [len(each) for each in found.episodes] == [60, 60, 60] and found.notes == ()


def test_an_episode_is_cut_at_gaps_and_what_is_too_short_is_left_out_and_said() -> None:
    times = clock(log(3))
    times[1][21:] += 0.6 * DT
    times[1][24:] += 100.0
    times[2] = times[2] + 0.04 * DT * (-1.0) ** np.arange(61)  # no clock is exact
    found = PlantTwin.fit(problem(), log(3), time=times, residuals=["none"])
    assert [len(each) for each in found.episodes] == [60, 20, 36, 60]
    states, actions = log(3)[1]
    np.testing.assert_array_equal(found.episodes[1].thetas, states[:21])
    np.testing.assert_array_equal(found.episodes[2].thetas, states[24:])
    np.testing.assert_allclose(found.episodes[2].actions, actions[24:])
    assert "Cut at 2 gaps; 1 pieces of less than 5 steps left out, 4 of 180" in found.report()


@pytest.mark.parametrize(("longer", "parts"), [(0.49, [20]), (0.51, [7, 12]), (-0.51, [7, 12])])
def test_a_step_half_of_dt_too_long_or_too_short_is_a_gap(longer, parts) -> None:
    (episode,) = as_episodes(problem(), [(x[:21], u[:20]) for x, u in log(1)])
    times = DT * np.arange(21)
    times[8:] += longer * DT
    kept, notes = cut_at_gaps((episode,), [times], DT)
    assert [len(each) for each in kept] == parts
    np.testing.assert_array_equal(kept[0].thetas, episode.thetas[: parts[0] + 1])
    np.testing.assert_array_equal(kept[-1].actions, episode.actions[-parts[-1] :])
    said = "Cut at 1 gaps; 0 pieces of less than 5 steps left out, 1 of 20 steps in all."
    assert notes == ((said,) if len(parts) > 1 else ())


@pytest.mark.parametrize("slower", [1.049, 0.951, 1.051, 0.949])
def test_a_clock_may_be_five_per_cent_off_and_no_more(slower) -> None:
    episodes = as_episodes(problem(), log(1))
    times = [slower * DT * np.arange(61)]
    if 0.95 < slower < 1.05:
        (whole,), notes = cut_at_gaps(episodes, times, DT)
        assert len(whole) == 60 and notes == ()
    else:
        with pytest.raises(ValueError, match="the median"):
            cut_at_gaps(episodes, times, DT)


def test_pieces_of_five_steps_are_kept() -> None:
    (episode,) = as_episodes(problem(), [(x[:21], u[:20]) for x, u in log(1)])
    times = DT * np.arange(21)
    times[6:] += DT  # after the fifth step
    times[11:] += DT  # and four more
    kept, notes = cut_at_gaps((episode,), [times], DT)
    assert [len(each) for each in kept] == [5, 9]
    assert notes[0].startswith("Cut at 2 gaps; 1 pieces") and "6 of 20" in notes[0]


def broken(change):
    def times():
        found = clock(log(2))
        change(found)
        return found

    return times


@pytest.mark.parametrize(
    ("times", "message"),
    [
        (broken(lambda t: t.pop()), "time has 1 entries for 2 episodes"),
        (broken(lambda t: t.append(t[0])), "time has 3 entries for 2 episodes"),
        (broken(lambda t: t.__setitem__(1, t[1][1:])), r"episode 1: time has shape \(60,\)"),
        (broken(lambda t: t[1].__setitem__(7, np.nan)), "episode 1: time is nan in row 7"),
        (broken(lambda t: t[1].__setitem__(8, t[1][7])), "does not increase after row 7: 0.7, 0.7"),
        (broken(lambda t: t[1].__setitem__(8, 0.65)), r"not increase after row 7: 0\.7, 0\.65"),
        (
            broken(lambda t: t[1].__imul__(1.06)),
            r"episode 1: a step takes 0.106 \(the median\), .* dt = 0.1\. .* resample the log",
        ),
        (broken(lambda t: t[0].__imul__(1000)), "episode 0: a step takes 100 .* the unit of dt"),
    ],
)
def test_times_that_are_none_are_refused_by_name(times, message) -> None:
    with pytest.raises(ValueError, match=message):
        PlantTwin.fit(problem(), log(2), time=times())


def test_a_log_of_gaps_alone_is_refused() -> None:
    times = [t + 10.0 * (np.arange(len(t)) // 4) for t in clock(log(2))]
    with pytest.raises(ValueError, match="at 30 gaps into pieces of less than 5 steps"):
        PlantTwin.fit(problem(), log(2), time=times)


@cache
def reactor():
    played = evaluate(problems.cstr().explicit(), "CSTR-v0", seeds=range(3))
    return [*zip(played.observations, played.actions, strict=True)]


KELVIN = np.array([0.0, 0.0, *cstr.X_SS[2:]])
PER_CENT = np.array([100.0, 100.0, 1.0, 1.0])


def refuse_or_doubt(mpc, episodes) -> None:
    try:
        found = PlantTwin.fit(mpc, episodes)
    except ValueError as refused:
        assert "A log is in plant units where" in str(refused)
    else:
        assert not found.trusted and "Compare units" in " ".join(found.trust.advice)


@pytest.mark.parametrize(
    "change",
    [
        lambda x, u: (x + cstr.X_SS, u),
        lambda x, u: (x + KELVIN, u),
        lambda x, u: (PER_CENT * x, u),
        lambda x, u: (x, u + cstr.U_SS),
    ],
    ids=["absolute", "kelvin", "per cent", "absolute input"],
)
def test_a_reactor_s_log_in_other_units_is_refused_or_not_trusted(change) -> None:
    refuse_or_doubt(problems.cstr(), [change(x, u) for x, u in reactor()])


@pytest.mark.parametrize(
    "change",
    [
        lambda x, u: (x + np.array([20.0, 0.0]), u),
        lambda x, u: (100 * x, u),
        lambda x, u: (x, 100 * u),
    ],
    ids=["absolute place", "per cent", "input in per cent"],
)
def test_the_cart_s_log_in_other_units_is_refused_or_not_trusted(change) -> None:
    refuse_or_doubt(problem(), [change(x, u) for x, u in log(3)])


def test_what_is_missing_in_a_poor_log_is_advised() -> None:
    one, still = reactor()[:1], [(x, 0 * u + 0.1) for x, u in reactor()]
    for episodes, advice in (
        (one, "Log at least one episode more"),
        (still, "Make a small step test on U,"),
    ):
        found = PlantTwin.fit(problems.cstr(), episodes, residuals=["none", "linear"])
        assert not found.trusted and advice in found.report()


def test_the_input_of_an_mpc_in_a_closed_loop_is_not_its_own() -> None:
    law = problems.cstr().explicit()
    found = PlantTwin.fit(problems.cstr(), [(x, law(x[:-1])) for x, _ in reactor()])
    assert found.trust.excitation < 1e-9  # though it is no linear function of the state
    assert "0.00 %: its gain rests on the given B" in found.report()
    rng = np.random.default_rng(0)
    dithered = [(x, np.clip(u + rng.normal(0, 10, u.shape), -55, 55)) for x, u in reactor()]
    assert PlantTwin.fit(problems.cstr(), dithered).trust.excitation > 0.02


def test_an_episode_cut_in_two_is_one() -> None:
    (x, u), *_ = log(1)
    found = PlantTwin.fit(problem(), [(x[:31], u[:30]), (x[30:], u[30:])])
    assert not found.trusted and "There is one episode" in found.report()
    assert PlantTwin.fit(problem(), log(3)).trusted


def test_a_spike_is_named_where_a_log_is_not_trusted() -> None:
    episodes = log(4)
    episodes[2][0][17, 1] += 50.0
    found = PlantTwin.fit(problem(), episodes)
    said = f"Look at where x[1] is about {episodes[2][0][17, 1]:.6g}:"
    assert not found.trusted and said in found.report()
