"""Compiled code does what the operations of torch do, forward and backward."""

import copy

import numpy as np
import pytest
import torch as th

from sample_laws import box_points, critic_of, law_of
from sb3_yann.networks import AfterstateValue, YannLayer
from weights import network_of, shake

NAMES = ["pendulum", "reactor", "two inputs", "asymmetric bounds"]


def by_torch(module: th.nn.Module) -> th.nn.Module:
    """Return a copy that has no compiled code."""
    plain = copy.deepcopy(module)
    network_of(plain).has_loops = False
    assert not network_of(plain).compiles
    return plain


def gradients(output: th.Tensor, module: th.nn.Module) -> list[th.Tensor]:
    weights = th.linspace(-1, 1, output.numel()).view(output.shape)
    return th.autograd.grad((output * weights).sum(), list(module.parameters()))


def assert_close(ours: th.Tensor, theirs: th.Tensor, factor: float = 1e-5) -> None:
    size = float(theirs.detach().abs().max())
    assert th.allclose(ours, theirs, rtol=0, atol=factor * size + 1e-12)


def rate_of(law) -> tuple[np.ndarray, np.ndarray]:
    width = law.u_max - law.u_min
    return -0.1 * width, 0.2 * width


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("infeasible", ["nearest_region", "zero_input"])
@pytest.mark.parametrize("options", [{}, {"max_correction": 0.1}, {"pinned": False}, "rate"])
@pytest.mark.parametrize("size", [0.1, 0.5])
def test_the_layer_is_that_of_torch_inside_and_outside_the_domain(
    name: str, infeasible: str, options, size: float
) -> None:
    law = law_of(name, infeasible)
    options = {"rate": rate_of(law)} if options == "rate" else options
    layer = YannLayer(law, **options)
    shake(layer, size)
    plain = by_torch(layer)
    theta = box_points(law, 400, stretch=1.5)
    ours = layer(theta)
    theirs = plain(theta)
    assert_close(ours, theirs)
    assert th.any(theirs.abs() == 1)
    for one, other in zip(gradients(ours, layer), gradients(theirs, plain), strict=True):
        assert_close(one, other, 1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_gradients_by_row_are_those_of_the_regions_in_use_and_nothing_else(name: str) -> None:
    layer = YannLayer(law_of(name))
    shake(layer, 0.1)
    theta = box_points(law_of(name), 30, stretch=1.5)
    dense = gradients(layer(theta), layer)
    layer.row_gradients = True
    regions = law_of(name).locate(theta.double().numpy())
    assert layer.regions(theta).tolist() == regions.tolist()
    for sparse, full in zip(gradients(layer(theta), layer), dense, strict=True):
        assert sorted(sparse.coalesce().indices()[0].tolist()) == np.unique(regions).tolist()
        assert th.equal(sparse.to_dense(), full)
    theta[1, 0] = th.nan
    assert layer.regions(theta)[1] == 0 and len(layer.regions(theta)) == 30


def test_a_theta_that_needs_a_gradient_gets_one() -> None:
    layer = YannLayer(law_of("reactor"))
    shake(layer, 0.1)
    theta = box_points(law_of("reactor"), 10).requires_grad_()
    layer(theta).sum().backward()
    assert theta.grad is not None and th.any(theta.grad != 0)


def test_weights_that_change_before_the_backward_pass_are_noticed() -> None:
    layer = YannLayer(law_of("reactor"))
    actions = layer(box_points(law_of("reactor"), 10))
    shake(layer, 0.1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        actions.sum().backward()


def value(pinned: bool, hidden=(64, 64)) -> AfterstateValue:
    return critic_of("reactor", hidden=hidden, pinned=pinned)


@pytest.mark.parametrize("pinned", [True, False])
@pytest.mark.parametrize("hidden", [(64, 64), (3, 200)])
@pytest.mark.parametrize("dtype", [th.float32, th.float64])
def test_the_value_is_that_of_torch(pinned: bool, hidden, dtype: th.dtype) -> None:
    ours = value(pinned, hidden)
    shake(ours, 0.1)
    plain = by_torch(ours)
    theta = box_points(law_of("reactor"), 100)
    points = th.cat([theta, th.linspace(-1, 1, 100)[:, None]], 1).to(dtype)
    points[7] = 0
    found = []
    for each in (ours, plain):
        x = points.clone().requires_grad_()
        q = each(x)
        by = th.autograd.grad(q.square().sum(), [x, *each.parameters()])
        found.append([q, *by])
    for one, other in zip(*found, strict=True):
        assert one.dtype == other.dtype
        assert_close(one, other)
    with th.no_grad():
        assert th.equal(ours(points), found[0][0])


def test_a_fixed_value_has_a_gradient_by_the_action_alone() -> None:
    ours = value(True)
    points = th.rand(8, 5).requires_grad_()
    ours.requires_grad_(False)
    q = ours(points)
    assert th.equal(q, ours(points))
    q.sum().backward()
    assert points.grad is not None
    assert all(each.grad is None for each in ours.parameters())


@pytest.mark.parametrize("shape", [(3, 3), (3, 6), (4,), (2, 3, 4)])
def test_shapes_that_do_not_fit_are_refused_before_compiled_code_reads_them(shape) -> None:
    for module in (YannLayer(law_of("reactor")), value(True)):
        with pytest.raises(ValueError, match=r"shape \(\d.*expected \(batch, [45]\)"):
            module(th.zeros(shape))


@pytest.mark.filterwarnings("ignore")
def test_what_torch_traces_still_depends_on_the_state() -> None:
    for module, n in ((YannLayer(law_of("reactor")), 4), (value(True), 5)):
        shake(network_of(module), 0.1)
        one, other = th.rand(2, 6, n)
        with th.no_grad():
            traced = th.jit.trace(module, one)
            assert_close(traced(other), module(other))


def test_a_value_notices_a_change_of_its_model() -> None:
    ours = value(True)
    points = th.rand(20, 5)
    ours(points)
    ours.model.A.mul_(1.1)
    ours.gamma = 0.5
    assert_close(ours(points), by_torch(ours)(points))


def test_autocast_runs_the_operations_of_torch() -> None:
    layer = YannLayer(law_of("reactor"))
    shake(layer, 0.1)
    theta = box_points(law_of("reactor"), 20)
    exact = layer(theta)
    with th.autocast("cpu"):
        assert not network_of(layer).compiles
        assert th.allclose(layer(theta), exact, atol=0.05)
    small = theta.bfloat16()  # a type that numpy does not have
    assert th.equal(layer(small), layer(small.double()))
