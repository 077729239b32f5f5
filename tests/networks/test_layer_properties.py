"""What holds for the layers around the law of any problem, with any weights."""

from typing import Any

import numpy as np
import torch as th
from hypothesis import given
from hypothesis import strategies as st

from random_problems import as_range, edges, examples, mixture, problems, steepest
from sb3_yann import LinearMPC
from sb3_yann.networks import SharedYannLayer, YannLayer
from sb3_yann.networks.yann import LawLayer
from weights import LARGEST, redrawn

SEEDS = st.integers(0, 2**32 - 1)
KINDS = st.sampled_from(["per region", "shared", "shared, online"])
HIDDEN = st.sampled_from([(4, 3), (5,)])  # compiled loops, operations of torch


def layer_of(mpc: LinearMPC, kind: str, hidden: tuple[int, ...], **options: Any) -> LawLayer:
    rate = (mpc.rate.du_min, mpc.rate.du_max) if mpc.has_rate_bounds else None
    law = mpc.online() if kind == "shared, online" else mpc.explicit()
    layer = YannLayer if kind == "per region" else SharedYannLayer
    return layer(law, hidden, rate=rate, **options)  # type: ignore[arg-type]


def far_and_near(mpc: LinearMPC, seed: int) -> th.Tensor:
    """Points in the box and beyond, on facets, and as far away as float32 goes."""
    points = mixture(mpc, seed)[:: 1 + len(mixture(mpc, seed)) // 150]
    away = np.sign(points[:20]) * 10.0 ** np.random.default_rng(seed).uniform(3, 38, (20, 1))
    return th.as_tensor(np.vstack([points, away]).clip(-LARGEST, LARGEST), dtype=th.float32)


@examples(15)
@given(problems(), SEEDS, KINDS, HIDDEN)
def test_layer_is_its_law_at_first_and_no_more_jumps_than_it(
    mpc: LinearMPC, seed: int, kind: str, hidden: tuple[int, ...]
) -> None:
    layer = layer_of(mpc, kind, hidden)
    theta = th.as_tensor(mixture(mpc, seed))
    law = mpc.online() if kind == "shared, online" else mpc.explicit()
    with th.no_grad():
        actions = layer(theta)
    assert th.equal(actions, layer.law(theta))
    u = law(theta.numpy())
    found = (law.u_min + law.u_max) / 2 + actions.double().numpy() * (law.u_max - law.u_min) / 2
    inside = law.in_domain(theta.numpy()) | (not mpc.has_rate_bounds)
    # The rounding of the output to float32; a law keeps its rate to 1e-6 of the range less.
    assert np.all(as_range(law, found - u)[inside] <= (1e-6 if mpc.has_rate_bounds else 1e-7))


@examples(15)
@given(problems(), SEEDS, st.sampled_from([1e-9, 1e-6, 1e-4]), st.sampled_from([0.1, 0.5]))
def test_shared_network_leaves_no_jump_whatever_its_weights(
    mpc: LinearMPC, seed: int, step: float, size: float
) -> None:
    at, ways = edges(mpc.explicit(), seed, each=2)
    for kind in ("shared", "shared, online"):
        layer = redrawn(layer_of(mpc, kind, (4, 3)), size, seed)
        law: Any = layer.base_law  # type: ignore[attr-defined]
        one = at - step * ways
        other = at + step * ways
        kept = law.in_domain(one) & law.in_domain(other)
        with th.no_grad():
            change = layer(th.as_tensor(other[kept])) - layer(th.as_tensor(one[kept]))
        slope = 1.0  # of the network, in half-widths of the box
        for matrix in layer.network.matrices():
            slope *= float(matrix.detach()[..., :-1].abs().sum(-1).max())
        most = 2 * step * (2 * steepest(mpc.explicit()) + slope) + 1e-6 * (1 + slope)
        assert np.all(np.abs(change.double().numpy()) <= most)


POISON = st.sampled_from([None, np.nan, np.inf, -np.inf, LARGEST])
SIZES = st.sampled_from([0.0, 1e-3, 1.0, 1e6, 1e30, LARGEST])


def bounds_hold(layer: LawLayer, theta: th.Tensor, bound: float | None) -> None:
    """Assert what a layer promises for any weights."""
    for graph in (False, True):
        with th.set_grad_enabled(graph):
            actions = layer(theta).detach().double()
            law = layer.law(theta).double()
        sure = actions.isfinite().all(1)
        assert bool(sure.all()) or bound is None  # else the actor takes the law
        assert not actions.isinf().any()
        assert bool((actions[sure].abs() <= 1).all())
        if bound is not None:
            assert bool(((actions - law).abs() <= 2 * bound).all())
        if layer.rated:
            low, high = (each.double() for each in layer.reachable(theta))
            assert bool(((low <= actions) & (actions <= high))[sure].all())


@examples(25)
@given(problems(), SEEDS, KINDS, HIDDEN, st.sampled_from([None, 0.0, 0.05, 1.0]), SIZES, POISON)
def test_bounds_hold_for_any_weights(
    mpc: LinearMPC,
    seed: int,
    kind: str,
    hidden: tuple[int, ...],
    bound: float | None,
    size: float,
    poison: float | None,
) -> None:
    layer = layer_of(mpc, kind, hidden, max_correction=bound)
    bounds_hold(redrawn(layer, size, seed, poison), far_and_near(mpc, seed), bound)


@examples(15)
@given(problems(), st.data(), KINDS, HIDDEN, st.sampled_from([None, 0.1]))
def test_what_is_not_finite_is_not_passed_off_as_an_input(
    mpc: LinearMPC, data: Any, kind: str, hidden: tuple[int, ...], bound: float | None
) -> None:
    rows = st.lists(st.floats(width=32), min_size=mpc.n_theta, max_size=mpc.n_theta)
    theta = th.as_tensor(np.float32(data.draw(st.lists(rows, min_size=1, max_size=6))))
    layer = redrawn(layer_of(mpc, kind, hidden, max_correction=bound), 0.3, 0)
    with th.no_grad():
        actions = layer(theta)
    finite = theta.isfinite().all(1)
    assert bool(actions[~finite].isnan().all())
    if bound is None:  # beyond float32 in half-widths of the box, which the actor takes care of
        finite &= (theta / layer.theta_half).isfinite().all(1)
    assert bool((actions[finite].abs() <= 1).all())
