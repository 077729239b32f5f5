"""Which law a problem takes, and that it keeps to it."""

from __future__ import annotations

import itertools
import pickle
import warnings

import numpy as np
import pytest

from benchmarks.online_problems import wide_plant
from general_problems import PROBLEMS, servo, solved, two_tanks
from sb3_yann import RateLimits
from sb3_yann.control import LinearMPC, OnlineLaw, OnlineLawWarning, PiecewiseAffine
from sb3_yann.control.explicit import budget, solve
from sb3_yann.control.explicit.certificate import ExplicitSolutionError
from sb3_yann.control.mpc import linear_mpc


def test_auto_is_the_explicit_law_where_it_is_soon_found() -> None:
    assert isinstance(servo().law(), PiecewiseAffine)


def test_auto_is_the_online_law_beyond_the_budget_and_says_so_once(monkeypatch) -> None:
    monkeypatch.setattr(linear_mpc, "REGIONS", 2)
    mpc = servo()
    with pytest.warns(OnlineLawWarning, match="more than region_limit = 2") as caught:
        law = mpc.law()
    assert caught[0].filename == __file__
    assert isinstance(law, OnlineLaw)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert mpc.law() is law
        assert isinstance(pickle.loads(pickle.dumps(mpc)).law(), OnlineLaw)


def test_regions_of_a_very_large_program_are_not_looked_for(monkeypatch) -> None:
    monkeypatch.setattr(LinearMPC, "_solved", None)
    with pytest.warns(OnlineLawWarning, match="801 constraints on 165 parameters, too many"):
        assert isinstance(wide_plant().law(), OnlineLaw)


def test_a_law_that_fails_its_check_is_not_taken(monkeypatch) -> None:
    def failing(self, *args, **kwargs):
        raise ExplicitSolutionError("It is wrong: somewhere.")

    monkeypatch.setattr(LinearMPC, "_solved", failing)
    with pytest.warns(OnlineLawWarning, match="It is wrong"):
        assert isinstance(servo().law(), OnlineLaw)


def test_what_was_solved_is_taken_whatever_its_size(monkeypatch) -> None:
    monkeypatch.setattr(linear_mpc, "REGIONS", 2)
    mpc = servo()
    explicit = mpc.explicit()
    assert mpc.law() is explicit
    assert mpc.law("online") is mpc.online()
    assert mpc.law("explicit") is explicit


def test_what_was_chosen_is_kept(monkeypatch) -> None:
    mpc = servo()
    assert isinstance(mpc.law("online"), OnlineLaw)
    monkeypatch.setattr(LinearMPC, "_solved", None)
    assert isinstance(mpc.law(), OnlineLaw)
    mpc.value_matrix(0.99)


def test_auto_gives_up_by_what_it_counts_and_not_by_the_clock(monkeypatch) -> None:
    monkeypatch.setattr(linear_mpc, "EFFORT", 0.01)
    messages = set()
    for speed in (0.0, 100.0):
        clock = itertools.count()
        monkeypatch.setattr(budget.time, "monotonic", lambda: next(clock) * speed)  # noqa: B023
        with pytest.warns(OnlineLawWarning, match="more effort") as caught:
            assert isinstance(two_tanks(rate=RateLimits(-0.8, 0.9)).law(), OnlineLaw)
        messages.add(str(caught[0].message).partition(" regions")[0])
    assert len(messages) == 1


def test_auto_takes_the_online_law_where_the_search_fails(monkeypatch) -> None:
    def failing(*args, **kwargs):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(solve, "walk", failing)
    with pytest.raises(ExplicitSolutionError, match="similar magnitudes"):
        servo().explicit()
    with pytest.warns(OnlineLawWarning, match="no solution in float64"):
        assert isinstance(servo().law(), OnlineLaw)


def test_an_unknown_kind_is_named() -> None:
    with pytest.raises(ValueError, match="kind"):
        servo().law("implicit")


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_value_of_both_laws_is_the_same(name) -> None:
    other = PROBLEMS[name]()
    other.law("online")
    expected = solved(name).value_matrix(0.95)
    assert np.abs(other.value_matrix(0.95) - expected).max() <= 1e-9 * np.abs(expected).max()


def test_the_report_says_that_it_is_solved_online() -> None:
    mpc = servo()
    mpc.law("online")
    assert "The law is solved online, with" in mpc.report(samples=20)
