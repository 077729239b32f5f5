"""One network beside a law: the law at first, bounded, pinned, continuous, and it trains."""

import copy
from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
import torch as th

from general_problems import servo
from sample_laws import (
    EVERY_LAW,
    box_points,
    facet_points,
    law_of,
    scrambled,
    smallest_slack,
    train,
)
from sb3_yann.control import LinearModel, LinearMPC, PiecewiseAffine
from sb3_yann.networks import SharedYannLayer
from sb3_yann.networks.paper_yann import PaperYann
from sb3_yann_envs import problems

LAWS = pytest.mark.parametrize("kind", ["explicit", "online"])


@cache
def reactor() -> LinearMPC:
    return problems.cstr()


def layer_of(mpc: LinearMPC, kind: str, **options) -> SharedYannLayer:
    rate = (mpc.rate.du_min, mpc.rate.du_max) if mpc.has_rate_bounds else None
    return SharedYannLayer(mpc.law(kind), (8, 8), rate=rate, **options)


def drawn(mpc: LinearMPC, count: int = 64) -> th.Tensor:
    theta = np.random.default_rng(0).uniform(mpc.theta_min, mpc.theta_max, (count, mpc.n_theta))
    return th.as_tensor(theta)


def test_the_equilibrium_stays_where_it_is_unless_it_is_not_pinned() -> None:
    origin = th.zeros(1, 4)
    rest = layer_of(reactor(), "online")(origin)
    assert th.equal(scrambled(layer_of(reactor(), "online"))(origin), rest)
    assert not th.equal(scrambled(layer_of(reactor(), "online", pinned=False))(origin), rest)


@LAWS
def test_its_gradient_by_theta_is_its_slope(kind) -> None:
    mpc = servo()
    layer = scrambled(layer_of(mpc, kind), 0.3).double()
    layer.theta_half = layer.theta_half.double()
    theta = drawn(mpc, 40).requires_grad_()
    layer(theta).sum().backward()
    step = 1e-6
    slopes = []
    for j in range(mpc.n_theta):
        shift = th.zeros(mpc.n_theta).double()
        shift[j] = step
        slopes.append((layer(theta + shift) - layer(theta - shift)).detach()[:, 0] / (2 * step))
    inside = layer(theta).detach().abs()[:, 0] < 0.999
    assert inside.sum() > 10
    assert th.allclose(theta.grad[inside], th.stack(slopes, 1)[inside], atol=1e-4)


@LAWS
def test_loops_do_not_stand_in_where_a_gradient_by_theta_is_asked_for(kind) -> None:
    layer = scrambled(layer_of(servo(), kind), 0.3)
    theta = drawn(servo(), 40).float()
    assert layer.network.compiles
    found = []
    for compiles in (True, False):
        layer.network.has_loops = compiles
        asked = theta.clone().requires_grad_()
        layer(asked).sum().backward()
        found.append(asked.grad)
    assert found[0].abs().sum() > 0 and th.equal(*found)


def test_it_learns_and_copies() -> None:
    layer = layer_of(reactor(), "online")
    theta = drawn(reactor())
    other = copy.deepcopy(layer)
    train(layer, theta, 0.5, steps=30)
    assert other.base_law is layer.base_law
    assert not layer.network.is_zero()
    assert other.network.is_zero()
    other.load_state_dict(layer.state_dict())
    assert th.equal(other(theta), layer(theta))
    assert layer.n_networks == 1
    assert layer.regions(theta).tolist() == [0] * len(theta)


@pytest.mark.filterwarnings("ignore")
def test_it_says_that_it_cannot_be_traced() -> None:
    with pytest.raises(RuntimeError, match="cannot be traced"):
        th.jit.trace(layer_of(reactor(), "online"), drawn(reactor()).float())


def test_inputs_without_bounds_are_refused() -> None:
    mpc = LinearMPC(
        LinearModel([[0.5]], [[1.0]], 1), Q=[[1]], R=[[1]], horizon=2, x_min=-1, x_max=1
    )
    with pytest.raises(ValueError, match="finite bounds on every input"):
        SharedYannLayer(mpc.online())


@pytest.fixture
def float64() -> Iterator[None]:
    before = th.get_default_dtype()
    th.set_default_dtype(th.float64)
    yield
    th.set_default_dtype(before)


def well_inside(law: PiecewiseAffine, count: int, margin: float) -> th.Tensor:
    """Points at least ``margin`` away from every facet of their region."""
    theta = box_points(law, count)
    return theta[th.as_tensor(smallest_slack(law, theta).max(axis=1) > margin)]


@pytest.mark.parametrize(
    ("name", "width", "total", "trainable"),
    # Braniff & Tian, Sections 5.1 and 5.2: the parameter counts of the two YANN-actors.
    [("pendulum", 16, 15_188, 12_880), ("reactor", 8, 5_320, 3_416)],
)
def test_parameter_counts_are_those_of_the_paper(
    name: str, width: int, total: int, trainable: int
) -> None:
    parameters = list(PaperYann(law_of(name), width).parameters())
    assert sum(p.numel() for p in parameters) == total
    assert sum(p.numel() for p in parameters if p.requires_grad) == trainable


@EVERY_LAW
@pytest.mark.parametrize("width", [1, 7, 16])
@pytest.mark.usefixtures("float64")
def test_network_is_the_law_away_from_facets(name: str, width: int) -> None:
    law = law_of(name)
    theta = well_inside(law, 5000, margin=1e-6).double()
    assert len(theta) > 1000
    u = PaperYann(law, width)(theta).detach().numpy()
    np.testing.assert_allclose(u, law(theta.numpy()), rtol=0, atol=1e-9)


@pytest.mark.usefixtures("float64")
def test_network_doubles_or_drops_the_law_on_facets() -> None:
    # The known defect of step indicators: on a shared facet two regions are active, or none.
    law = law_of("pendulum")
    theta = facet_points(law, 20_000).double()
    # To the facet itself: from the float32 point along its normal, in float64.
    slack = law.b - theta.numpy() @ law.A.T
    nearest = np.argmin(np.abs(slack), axis=1)
    normal = law.A[nearest] / np.sum(law.A[nearest] ** 2, axis=1, keepdims=True)
    on_facet = theta.numpy() + slack[np.arange(len(theta)), nearest, None] * normal
    u = law(on_facet)[:, 0]
    got = PaperYann(law, 8)(th.as_tensor(on_facet)).detach().numpy()[:, 0]
    clear = np.abs(u) > 0.1
    ratio = got[clear] / u[clear]
    doubled = np.abs(ratio - 2) < 1e-6
    dropped = np.abs(ratio) < 1e-6
    assert np.all(doubled | dropped | (np.abs(ratio - 1) < 1e-6))
    assert np.mean(doubled | dropped) > 0.1


@EVERY_LAW
def test_inactive_regions_stay_suppressed_whatever_is_learnt(name: str) -> None:
    law = law_of(name)
    network = PaperYann(law, 16)
    for weight in (network.first_weight, network.first_bias, network.second_weight):
        th.nn.init.normal_(weight, std=100.0)  # every node at its bound of 1
    theta = box_points(law, 5000, stretch=1.02)
    theta = theta[th.as_tensor(smallest_slack(law, theta).max(axis=1) < -1e-4)]
    assert len(theta) > 20
    assert not th.any(network(theta))
