"""Networks that are exactly zero at first and train all the same (Theorems 1 and 2)."""

import copy
from collections.abc import Callable

import pytest
import torch as th
from torch.nn import functional as F

from sb3_yann.networks import RowAdam, ZeroOutputNetwork, zero_output

ACTIVATIONS: dict[str, Callable[[th.Tensor], th.Tensor]] = {
    "tanh": th.tanh,
    "relu": th.relu,
    "elu": F.elu,
    "softsign": F.softsign,
    "sin": th.sin,
    "gelu": F.gelu,
}
HIDDEN = [(1,), (16,), (7,), (16, 16), (7, 5), (8, 3)]
OPTIMIZERS: dict[str, Callable[[ZeroOutputNetwork], th.optim.Optimizer]] = {
    "sgd": lambda net: th.optim.SGD(net.parameters(), 0.1),
    "adam": lambda net: th.optim.Adam(net.parameters(), 1e-3),
}


def pins(*flags: bool) -> th.Tensor:
    return th.tensor(flags)


def square(count: int = 256, dtype: th.dtype = th.float32) -> th.Tensor:
    """Points of the square [-1, 1]^2."""
    return th.rand(count, 2, dtype=dtype) * 2 - 1


def curved(x: th.Tensor) -> th.Tensor:
    """x1 x2 + x1^2: even, so that an odd network cannot fit it; 0 at 0."""
    return x[:, :1] * x[:, 1:] + x[:, :1] ** 2


def train(
    net: ZeroOutputNetwork,
    optimizer: th.optim.Optimizer,
    steps: int,
    x: th.Tensor,
    target: th.Tensor,
    index: th.Tensor | None = None,
) -> None:
    for _ in range(steps):
        optimizer.zero_grad()
        F.mse_loss(net(x, index), target).backward()
        optimizer.step()


def is_positive_zero(x: th.Tensor) -> bool:
    return not bool(th.any(x != 0)) and not bool(th.any(th.signbit(x)))


@pytest.mark.parametrize("dtype", [th.float32, th.float64])
@pytest.mark.parametrize("stack", [1, 3])
@pytest.mark.parametrize("hidden", HIDDEN)
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_output_is_zero_bit_for_bit_at_first(
    activation: str, hidden: tuple[int, ...], stack: int, dtype: th.dtype
) -> None:
    net = ZeroOutputNetwork(
        3, 2, hidden, activation=ACTIVATIONS[activation], pinned=pins(True, False, True)[:stack]
    ).to(dtype)
    for size in (1.0, 1e3, 1e6):
        x = size * (2 * th.rand(200, 3, dtype=dtype) - 1)
        output = net(x, th.randint(stack, (200,)))
        assert output.shape == (200, 2)
        assert is_positive_zero(output)


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
@pytest.mark.parametrize("hidden", [(6,), (5, 6)])
@pytest.mark.parametrize("activation", ["tanh", "gelu"])
@pytest.mark.parametrize("pinned", [False, True])
def test_every_entry_has_moved_after_the_second_update(
    pinned: bool, activation: str, hidden: tuple[int, ...], optimizer: str
) -> None:
    # Every single entry, weights and biases; only the output bias of a pinned network cancels.
    # In float64: the biases of a pinned tanh network have a gradient of the order (W x)^2.
    net = ZeroOutputNetwork(
        2, 1, hidden, activation=ACTIVATIONS[activation], pinned=pins(pinned)
    ).double()
    before = copy.deepcopy(net)
    x = square(dtype=th.float64)
    train(net, OPTIMIZERS[optimizer](net), 2, x, curved(x) + 0.3 * x.sum(1, keepdim=True))
    moved = [(a != b) for a, b in zip(net.parameters(), before.parameters(), strict=True)]
    assert bool(moved[-1][..., -1]) is not pinned
    moved[-1][..., -1] = True
    assert all(bool(entries.all()) for entries in moved)


@pytest.mark.parametrize("hidden", [(16,), (16, 16)])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_pinned_output_at_zero_stays_exactly_zero(activation: str, hidden: tuple[int, ...]) -> None:
    # With a target that is not 0 there, and in batches of odd sizes, where vectorized kernels
    # round differently from entry to entry.
    net = ZeroOutputNetwork(
        2, 1, hidden, activation=ACTIVATIONS[activation], pinned=pins(True, True)
    )
    x = square()
    index = th.randint(2, (256,))
    train(net, th.optim.Adam(net.parameters(), 1e-2), 100, x, curved(x) + 1, index)
    for count in (1, 2, 7, 33, 256):
        x = square(count)
        x[::2] = 0
        output = net(x, th.randint(2, (count,)))
        assert not th.any(output[::2])
        assert th.all(output[1::2] != 0)


@pytest.mark.parametrize("activation", [th.sigmoid, F.softplus, th.cos, th.nn.Sigmoid()])
def test_activation_that_is_not_zero_at_zero_is_refused(
    activation: Callable[[th.Tensor], th.Tensor],
) -> None:
    with pytest.raises(ValueError, match=r"activation\(0\) = (0\.5|0\.693147|1), but .*torch.tanh"):
        ZeroOutputNetwork(2, 1, activation=activation)


@pytest.mark.parametrize("hidden", HIDDEN)
def test_a_stack_too_large_to_be_multiplied_as_a_whole_does_the_same(hidden, monkeypatch) -> None:
    stack = 5
    net = ZeroOutputNetwork(3, 2, hidden, pinned=pins(True, False, True, False, True))
    with th.no_grad():
        for parameter in net.parameters():
            parameter += th.randn_like(parameter)
    x = th.randn(64, 3)
    index = th.randint(stack, (64,))
    x[:8] = 0
    outcomes = []
    for few in (stack, stack - 1):
        monkeypatch.setattr(zero_output, "FEW", few)
        net.zero_grad()
        output = net(x, index)
        output.square().sum().backward()
        outcomes.append([output.detach(), *(each.grad.clone() for each in net.parameters())])
    for whole, gathered in zip(*outcomes, strict=True):
        assert bool(whole.abs().max() > 0)
        th.testing.assert_close(whole, gathered, rtol=1e-4, atol=1e-4)


ROWS = 5


def steps(dense: bool, count: int = 20) -> list[th.Tensor]:
    """Gradients (ROWS, 2, 3) in which two rows or three are not zero."""
    generator = th.Generator().manual_seed(0)
    found = []
    for i in range(count):
        rows = th.tensor([[0, 1], [1, 3, 0]][i % 2])
        values = th.randn(len(rows), 2, 3, generator=generator)
        sparse = th.sparse_coo_tensor(rows[None], values, (ROWS, 2, 3), check_invariants=True)
        found.append(sparse.to_dense() if dense else sparse)
    return found


def trained(dense: bool, count: int = 20) -> th.Tensor:
    parameter = th.nn.Parameter(th.ones(ROWS, 2, 3))
    optimizer = RowAdam([parameter], lr=0.01)
    for gradient in steps(dense, count):
        parameter.grad = gradient
        optimizer.step()
    return parameter.detach()


@pytest.mark.parametrize("dense", [False, True])
def test_each_row_is_trained_as_if_it_had_an_adam_of_its_own(dense: bool) -> None:
    rows = [th.nn.Parameter(th.ones(2, 3)) for _ in range(ROWS)]
    optimizers = [th.optim.Adam([row], lr=0.01) for row in rows]
    for gradient in steps(dense=True):
        for row, optimizer, own in zip(rows, optimizers, gradient, strict=True):
            row.grad = own if own.any() else None
            optimizer.step()
    expected = th.stack([row.detach() for row in rows])
    assert th.allclose(trained(dense), expected, atol=1e-6)


def test_it_goes_on_from_a_saved_state() -> None:
    gradients = steps(dense=False)
    one = th.nn.Parameter(th.ones(ROWS, 2, 3))
    first = RowAdam([one], lr=0.01)
    for gradient in gradients[:10]:
        one.grad = gradient
        first.step()
    two = th.nn.Parameter(one.detach().clone())
    second = RowAdam([two], lr=0.5)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    for gradient in gradients[10:]:
        for parameter, optimizer in ((one, first), (two, second)):
            parameter.grad = gradient
            optimizer.step()
    assert th.equal(one, two)


@pytest.mark.parametrize("hidden", [(), (4, 4, 4), -1, (0,), (8, -1)])
def test_widths_that_are_none_are_named(hidden) -> None:
    with pytest.raises(ValueError, match=r"hidden = .* must"):
        ZeroOutputNetwork(2, 1, hidden)
