"""RowAdam is Adam for every row by itself, and leaves rows without a gradient alone."""

from __future__ import annotations

import copy

import pytest
import torch as th

from sb3_yann.networks import RowAdam

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


@pytest.mark.parametrize("dense", [False, True])
def test_rows_without_a_gradient_do_not_move_not_even_by_momentum(dense: bool) -> None:
    before, after = trained(dense, 10), trained(dense, 11)  # the eleventh step has rows 0 and 1
    moved = (before != after).flatten(1).any(1)
    assert moved.tolist() == [True, True, False, False, False]
    assert th.equal(after[2], th.ones(2, 3))


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
