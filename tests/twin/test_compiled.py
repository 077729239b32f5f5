"""Compiled steps and roll-outs are those of numpy and torch."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_yann import LinearModel, LinearMPC, PlantTwin
from sb3_yann.improvement.imitation import policy_of
from sb3_yann.networks import SharedYannLayer, YannLayer
from sb3_yann.networks.yann import LawLayer
from sb3_yann.twin.dynamics import Dynamics
from sb3_yann.twin.residuals import Polynomial, ZeroResidual
from twin_samples import log, problem, rated, twin


def two_inputs() -> PlantTwin:
    """A twin of random cubics with a constant term, of a problem with two inputs."""
    model = LinearModel([[1.0, 0.1], [0.0, 0.9]], [[0.1, 0.0], [0.0, 0.1]], 0.1)
    mpc = LinearMPC(
        model, Q=np.eye(2), R=0.1 * np.eye(2), horizon=2, u_min=[-1, -0.5], u_max=[1, 2],
        theta_min=[-3, -3], theta_max=[3, 3],
    )  # fmt: skip
    rng = np.random.default_rng(0)
    logged = [(rng.uniform(-2, 2, (30, 2)), rng.uniform(-0.5, 1, (29, 2))) for _ in range(3)]
    found = PlantTwin.fit(mpc, logged, residuals=["linear"])
    z = rng.uniform(-1, 1, (300, 4))
    members = tuple(
        Polynomial(3, 1e-3, offset=True).fit(z, 0.02 * rng.standard_normal((300, 2)))
        for _ in range(3)
    )
    object.__setattr__(found, "dynamics", Dynamics(mpc, found.dynamics.coordinates, members))
    return found


def plainly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do without compiled code."""
    monkeypatch.setattr(Dynamics, "packed", None)


def layer_of(found: PlantTwin, kind: Any, infeasible: str, confined: bool) -> LawLayer:
    mpc = found.problem
    rate = (mpc.rate.du_min, mpc.rate.du_max) if mpc.has_rate_bounds else None
    law = dataclasses.replace(mpc.explicit(), infeasible=infeasible)
    layer: LawLayer = kind(law, (8, 8), rate=rate, max_correction=0.3)
    generator = th.Generator().manual_seed(0)
    with th.no_grad():
        for each in layer.network.weights():
            each.add_(0.3 * th.randn(each.shape, generator=generator))
    if confined:
        layer.confine(0.3 * mpc.theta_min, 0.4 * mpc.theta_max)
    return layer


@pytest.mark.parametrize("infeasible", ["nearest_region", "zero_input"])
@pytest.mark.parametrize("confined", [False, True])
@pytest.mark.parametrize("kind", [YannLayer, SharedYannLayer])
@pytest.mark.parametrize("make", [twin, rated, two_inputs])
def test_runs_are_those_of_the_plain_way(
    make: Callable[[], PlantTwin],
    kind: Any,
    confined: bool,
    infeasible: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = make()
    mpc, dynamics = found.problem, found.dynamics
    layer = layer_of(found, kind, infeasible, confined)
    assert dynamics.packed is not None
    rng, size = np.random.default_rng(1), (len(dynamics.members), 20, mpc.n_theta)
    starts = rng.uniform(mpc.theta_min, mpc.theta_max, size)  # some of them without a solution
    outcomes = []
    for plain in (False, True):
        if plain:
            plainly(monkeypatch)
        outcomes.append(dynamics.roll_out(policy_of(layer, mpc), starts, 15))
    assert np.mean(np.abs(outcomes[0][1]) < 0.99 * mpc.u_max) > 0.2  # not all on a bound
    for ours, theirs in zip(*outcomes, strict=True):
        scale = np.abs(theirs).max()
        assert scale > 0
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=2e-5 * scale)


def test_the_linear_model_alone_and_rows_that_are_not_finite(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given = twin()
    dynamics = Dynamics(problem(), given.dynamics.coordinates, (ZeroResidual(2), ZeroResidual(2)))
    theta, u = np.random.default_rng(0).normal(size=(2, 3, 2)), np.ones((2, 3, 1))
    theta[1, 2, 0] = np.nan
    ours = dynamics.step(theta, u), given.dynamics.step(theta[[0, 0, 0, 1, 1]], u[[0] * 5])
    plainly(monkeypatch)
    theirs = dynamics.step(theta, u), given.dynamics.step(theta[[0, 0, 0, 1, 1]], u[[0] * 5])
    for each, expected in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(each, expected, rtol=1e-12)
    assert np.isnan(ours[0][1, 2, 0]) and np.isfinite(ours[0][0]).all()


class Bent:
    """A residual that is no polynomial."""

    def fit(self, z: np.ndarray, y: np.ndarray) -> None: ...

    def predict(self, z: np.ndarray) -> np.ndarray:
        return 0.01 * np.sin(z[:, :2])


def test_other_residuals_go_the_plain_way() -> None:
    found = PlantTwin.fit(problem(), log(4), residuals=[Bent])
    assert found.dynamics.packed is None
    starts = np.full((len(found.dynamics.members), 2, 2), 0.4)
    assert np.isfinite(found.dynamics.roll_out(problem().explicit(), starts, 5)[0]).all()


@pytest.mark.parametrize("kind", [YannLayer, SharedYannLayer])
def test_a_frozen_layer_acts_as_the_layer_and_refuses_another_width(kind: Any) -> None:
    layer = layer_of(twin(), kind, "nearest_region", True)
    theta = np.random.default_rng(0).uniform(-3, 3, (50, 2))
    theta[7] = np.inf
    with th.no_grad():
        np.testing.assert_array_equal(layer.frozen()(theta), layer(th.as_tensor(theta)).numpy())
    with pytest.raises(ValueError, match=r"theta has shape \(4, 3\), expected \(batch, 2\)"):
        layer.frozen()(np.zeros((4, 3)))
