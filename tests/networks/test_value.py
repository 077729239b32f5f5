"""The critics: exactly the value of the law on the linear plant at first, and they learn."""

from typing import Any

import numpy as np
import pytest
import torch as th

from sample_laws import (
    PROBLEMS,
    box_points,
    critic_of,
    in_physical_units,
    law_of,
    random_rows,
    ranges_of,
    solved,
    to_action,
)
from sb3_yann.networks import QuadraticStateActionValue

GAMMAS = pytest.mark.parametrize("gamma", [0.9, 0.99, 1 - 1e-3])
EVERY_PROBLEM = pytest.mark.parametrize("name", PROBLEMS)


def papers(name: str, gamma: float = 0.99) -> QuadraticStateActionValue:
    return QuadraticStateActionValue(solved(name).state_action_terms(gamma).P, ranges_of(name))


BOTH = pytest.mark.parametrize("kind", [critic_of, papers])


def train(value: Any, rows: th.Tensor, target: th.Tensor, steps: int) -> float:
    """Adam steps of 1e-3 towards the target; the last loss."""
    optimizer = th.optim.Adam(value.parameters(), 1e-3)
    for _ in range(steps):
        optimizer.zero_grad()
        loss = (value(rows) - target).square().mean()
        loss.backward()
        optimizer.step()
    return loss.item()


@GAMMAS
@EVERY_PROBLEM
@BOTH
def test_value_is_the_quadratic_form_to_the_rounding_of_float32(
    name: str, gamma: float, kind: Any
) -> None:
    rows = random_rows(name, 2000)
    z = np.hstack(in_physical_units(name, rows))
    exact = -np.einsum("bi,ij,bj->b", z, solved(name).state_action_terms(gamma).P, z)[:, None]
    with th.no_grad():
        got = kind(name, gamma)(rows)
    assert got.shape == (2000, 1)
    assert got.dtype == th.float32
    np.testing.assert_allclose(got.numpy(), exact, rtol=np.finfo(np.float32).eps, atol=0)


@GAMMAS
@EVERY_PROBLEM
def test_gradient_of_the_action_is_that_of_the_quadratic_form(name: str, gamma: float) -> None:
    law = law_of(name)
    rows = random_rows(name, 256).requires_grad_()
    critic_of(name, gamma)(rows).sum().backward()
    assert rows.grad is not None
    z = np.hstack(in_physical_units(name, rows.detach()))
    slope = -2 * z @ solved(name).state_action_terms(gamma).P
    scale = np.concatenate([np.ones(law.n_theta), (law.u_max - law.u_min) / 2])
    expected = (slope * scale)[:, law.n_theta :]
    slopes = rows.grad.numpy()[:, law.n_theta :]
    np.testing.assert_allclose(slopes, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


@EVERY_PROBLEM
@BOTH
def test_value_at_rest_is_zero_and_stays_so(name: str, kind: Any) -> None:
    law = law_of(name)
    value = kind(name)
    rows = random_rows(name, 256)
    action = to_action(law, np.zeros((1, law.n_inputs)))
    rest = th.cat([th.zeros(1, law.n_theta), action.float()], dim=1)
    exact = kind is papers and name in ("pendulum", "reactor")
    for steps in (50, 1):
        # u = 0 may be an action such as -1/3, which float32 rounds.
        rounding = 0.0 if exact else 1e-6 * value(rows).abs().mean().item()
        assert abs(value(rest).item()) <= rounding
        train(value, rows, 0.7 * value(rows).detach() - 3, steps=steps)
    assert abs(value(rest).item()) <= rounding


def test_training_fits_a_cost_to_go_that_is_not_quadratic() -> None:
    value = critic_of("pendulum")
    rows = random_rows("pendulum", 512)
    law = law_of("pendulum")
    theta = box_points(law, 256).double() / 2
    with th.no_grad():
        assert (value.value(2 * theta) - 4 * value.value(theta)).abs().max() < 1e-9
    # A cost to go that is even and flattens out: its share of the discounted return.
    bend = 30 * th.tanh(4 * (rows[:, :1] / law.theta_max[0]) ** 2)
    target = value(rows).detach() - bend
    before = bend.square().mean().item()
    assert train(value, rows, target, steps=600) < 0.2 * before
    with th.no_grad():
        assert (value.value(2 * theta) - 4 * value.value(theta)).abs().max() > 5


def test_twenty_steps_of_adam_do_not_flip_the_sign_of_the_reactors_smallest_entry() -> None:
    # Raw entries would: M_uu is of the order of 1e-4, one step of Adam is 1e-3.
    value = papers("reactor")
    rows = random_rows("reactor", 256)

    def diagonal() -> th.Tensor:
        return (value.quadratic.entries.detach() * value.quadratic.root**2).diag()

    before = diagonal()
    assert before.min() < 1e-3
    train(value, rows, 0.7 * value(rows).detach() - 3, steps=20)
    change = diagonal() / before - 1
    assert change.abs().max() < 0.021
    assert change.abs().min() > 0


class Halving(th.nn.Module):
    """A model with a parameter, in a module of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.inner = th.nn.Linear(2, 2, bias=False, dtype=th.float64)
        with th.no_grad():
            self.inner.weight.copy_(0.5 * th.eye(2))

    def forward(self, theta: th.Tensor, u: th.Tensor) -> th.Tensor:
        return self.inner(theta) + 0 * u


def test_model_that_is_given_says_where_the_value_is_taken() -> None:
    rows = random_rows("pendulum", 100)
    theta, u = in_physical_units("pendulum", rows)
    P = solved("pendulum").value_matrix(0.99)
    mpc = solved("pendulum")
    expected = mpc.stage_cost(theta, u) + 0.99 * np.einsum("bi,ij,bj->b", theta, P, theta) / 4
    for model in (Halving(), lambda theta, u: theta / 2 + 0 * u):
        q = critic_of("pendulum", model=model)(rows).detach().numpy()[:, 0]
        np.testing.assert_allclose(q, -expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (lambda theta, u: theta.detach(), "no gradient with respect to u"),
        (lambda theta, u: theta / 0 + u, "returned \\[nan"),
        (lambda theta, u: theta[:, :1] + u, "must return the next theta, shape"),
        (lambda theta, u: [theta, u], "returned list"),
    ],
)
def test_a_prediction_model_is_tried_when_it_is_given(model, message) -> None:
    with pytest.raises(ValueError, match=message):
        critic_of("pendulum", model=model)
