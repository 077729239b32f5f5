"""The re-identified MPC becomes the weights of an actor, and is a candidate like any other."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from stable_baselines3 import DDPG

from sb3_yann import ExplicitSolutionError, YannPolicy, improve
from sb3_yann.commissioning import distillation
from sb3_yann.commissioning.distillation import distill, law_today
from sb3_yann.twin.gradient import actor
from twin_samples import Cart, problem, twin
from weights import is_mpc


def model() -> DDPG:
    return DDPG(YannPolicy, Cart(), seed=0, device="cpu")


def test_the_law_of_today_is_that_of_the_reidentified_mpc() -> None:
    rows, law = twin().starts.rows, law_today(twin())
    assert law is not None
    np.testing.assert_allclose(law(rows), twin().reidentified().explicit()(rows), atol=1e-12)
    assert np.abs(law(rows) - problem().explicit()(rows)).max() > 0.02


def test_a_layer_learns_it_where_it_comes() -> None:
    layer, law = copy.deepcopy(model().actor.mu), law_today(twin())
    assert law is not None and distill(layer, twin(), seed=0)
    starts = twin().starts.draw(20, np.random.default_rng(5))
    rows = twin().dynamics.roll_out(law, starts[None].repeat(5, 0), 40)[0].reshape(-1, 2)
    left = actor(layer, problem())(rows) - law(rows)
    apart = problem().explicit()(rows) - law(rows)
    assert np.sqrt(np.mean(left**2)) < 0.2 * np.sqrt(np.mean(apart**2))


def test_without_a_better_model_there_is_no_law_of_today(monkeypatch) -> None:
    monkeypatch.setattr(type(twin()), "reidentified", lambda self: self.problem)
    assert law_today(twin()) is None
    layer = copy.deepcopy(model().actor.mu)
    assert not distill(layer, twin(), seed=0) and is_mpc(layer)


def test_a_law_of_today_that_would_be_much_larger_is_left_out(monkeypatch) -> None:
    today = twin().reidentified()  # with more regions than the one that it may have here
    monkeypatch.setattr(type(twin()), "reidentified", lambda self: today)
    monkeypatch.setattr(distillation, "LARGER", 1 / problem().explicit().n_regions)
    assert law_today(twin()) is None


def test_a_law_of_today_that_fails_its_check_is_left_out(monkeypatch) -> None:
    def failing(*arguments, **options):
        raise ExplicitSolutionError("The explicit solution failed its check.")

    assert law_today(twin()) is not None
    monkeypatch.setattr(distillation, "_choose_law", failing)
    assert law_today(twin()) is None


def test_the_better_of_two_searches_is_taken() -> None:
    plain, today = model(), model()
    one = improve(plain, twin(), iterations=20, reidentify=False)
    both = improve(today, twin(), iterations=60)  # the first leg of both is 20
    assert both.change <= one.change
    assert both.accepted == (not is_mpc(today))


def test_it_must_be_a_flag() -> None:
    with pytest.raises(TypeError, match="reidentify"):
        improve(model(), twin(), reidentify="yes")
