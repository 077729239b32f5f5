"""One network beside a law: continuous as the law is, and for any law that can be evaluated."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_yann._validation import Array, half_widths
from sb3_yann.control.law import PiecewiseAffine
from sb3_yann.control.mpc.choice import Law
from sb3_yann.networks.law_layer import LawLayer, Rate, require_finite_inputs
from sb3_yann.networks.zero_output import Activation, ZeroOutputNetwork, register_constants

SAMPLES = 32


class SharedYannLayer(LawLayer):
    """theta -> input in [-1, 1]: a law, exactly, plus one network for all of it.

    At first the network is exactly zero and the layer is the law, to float32 rounding. The network
    does not grow with the law, and leaves it as continuous as it is.

    The law is evaluated by numpy, on the processor. Of it the state_dict has some answers alone, by
    which parameters of another law are told.

    Parameters
    ----------
    law : PiecewiseAffine or OnlineLaw
        With finite input bounds, which map to -1 and 1.
    hidden : tuple of int, default (64, 64)
        Widths of the network.
    activation, max_correction, pinned, rate
        As in :class:`YannLayer`.

    Examples
    --------
    >>> from sb3_yann_envs import problems
    >>> law = problems.cstr().online()
    >>> layer, theta = SharedYannLayer(law), np.full(4, 0.1)
    >>> u = layer(th.as_tensor(theta)[None]).detach().numpy()[0] * law.u_max  # from [-1, 1]
    >>> bool(np.allclose(u, law(theta), atol=1e-5))
    True
    """

    samples: th.Tensor

    def __init__(
        self,
        law: Law,
        hidden: tuple[int, ...] = (64, 64),
        activation: Activation = th.tanh,
        max_correction: float | None = None,
        pinned: bool = True,
        rate: Rate | None = None,
    ) -> None:
        super().__init__()
        require_finite_inputs(law)
        self.given = law
        import_module("sb3_yann.networks._kernels.yann_layer")
        law(np.zeros(law.n_theta))  # compiled now, not in the midst of learn: see YannLayer
        self._set_ranges(law, rate, always=True)
        theta = sample_points(law)
        register_constants(self, samples=np.hstack([theta, self._actions(theta)]))
        stay, sizes = th.tensor([pinned]), (law.n_theta, law.n_inputs)
        self.network = ZeroOutputNetwork(*sizes, hidden, activation=activation, pinned=stay)
        self.limit(max_correction)

    def forward(self, theta: th.Tensor) -> th.Tensor:
        """Return the input in [-1, 1], shape (batch, m), for theta of shape (batch, n)."""
        fixed = theta.device.type == "cpu" and not theta.requires_grad
        if fixed and self.network.compiles:
            return self._compiled(theta)
        correction = self.network((theta / self.theta_half).to(self.theta_half))
        return self._with_correction(theta, self.law(theta), correction)

    def _compiled(self, theta: th.Tensor) -> th.Tensor:
        from sb3_yann.networks._kernels.yann_layer import shared_layer_on_cpu  # compiled once

        network: Any = self._modules["network"]  # an attribute of a module takes a microsecond
        u = self._inputs_or_nan(theta)
        own = network.weights(), network.pinned_array
        return shared_layer_on_cpu(theta, u, self.constants, *own)

    def law(self, theta: th.Tensor) -> th.Tensor:
        """Return the law alone, in [-1, 1], whatever has been learnt; (batch, m)."""
        tracing = th.jit.is_tracing() or th.compiler.is_compiling()  # type: ignore[attr-defined, no-untyped-call]
        if tracing:
            raise RuntimeError(
                "A law beside a shared network is evaluated outside of torch: it cannot be traced "
                "or compiled by it. Trace a policy with networks='per_region'."
            )
        u: th.Tensor = _Law.apply(theta, self)  # type: ignore[no-untyped-call]
        return u.clamp(*self.reachable(theta)) if self.rated else u

    def regions(self, theta: th.Tensor) -> NDArray[np.int64]:
        """Return zeros: all rows of theta (batch, n) go through the one network."""
        return np.zeros(len(theta), np.int64)

    def _inputs_or_nan(self, theta: th.Tensor | Array) -> Array:
        u, finite = self.inputs(theta)
        if not finite.all():
            u[~finite] = np.nan
        return u

    def inputs(self, theta: th.Tensor | Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return the law's inputs (batch, m), zeros where theta is not finite, and where it is."""
        from sb3_yann.networks._kernels.mlp import to_numpy  # which loads numba

        points = to_numpy(th.as_tensor(theta), np.float64)
        finite = np.isfinite(points).all(axis=1)
        if finite.all():
            return self.given(points), finite
        u = np.zeros((len(points), self.given.n_inputs))
        u[finite] = self.given(points[finite])
        return u, finite

    def _actions(self, theta: Array) -> Array:
        middle, half = self.middle.double().cpu().numpy(), self.half_range.double().cpu().numpy()
        actions: Array = (self.given(theta) - middle) / half
        return actions

    def answers_as(self, samples: th.Tensor, rounding: float) -> bool:
        """Return whether rows ``[theta, action]`` are the law's, where the MPC has a solution."""
        rows: Array = samples.double().cpu().numpy()
        if not np.isfinite(rows).all():
            return False
        theta, actions = np.split(rows, [self.given.n_theta], axis=1)
        apart = np.abs(self._actions(theta) - actions).max(1)
        return bool(np.all(apart[self.given.in_domain(theta)] <= rounding))

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *rest: Any) -> None:
        # Weights that were saved before there were samples.
        state_dict.setdefault(f"{prefix}samples", self.samples)
        super()._load_from_state_dict(state_dict, prefix, *rest)

    @property
    def explicit_law(self) -> PiecewiseAffine | None:
        """The law in use; None where it is solved online."""
        return self.given if isinstance(self.given, PiecewiseAffine) else None

    def _frozen(self, *packed: Any) -> Callable[[Array], NDArray[Any]]:
        from sb3_yann.networks._kernels.yann_layer import frozen_shared_layer

        return frozen_shared_layer(self._inputs_or_nan, *packed[2:])

    def slopes_of_law(self, theta: Array) -> Array:
        """Return the derivatives (rows, m, n) of the law in [-1, 1], zero where it is clipped."""
        middle, half = self.middle.cpu().numpy(), self.half_range.cpu().numpy()
        slopes: Array = self.given.gain(theta) / half[:, None]
        slopes[np.abs((self.given(theta) - middle) / half) >= 1] = 0.0
        if isinstance(self.given, PiecewiseAffine) and self.given.infeasible == "zero_input":
            slopes[~self.given.in_domain(theta)] = 0.0  # as the gain of an online law is
        return slopes


def sample_points(law: Law) -> Array:
    """Return points (rows, n) in the box of a law, most of them near its middle.

    Far from there many laws have the same answer: a bound.
    """
    bounded = np.isfinite(law.theta_min) & np.isfinite(law.theta_max)
    middle = np.where(bounded, law.theta_max / 2 + law.theta_min / 2, 0.0)
    shares = np.random.default_rng(0).uniform(-1, 1, (SAMPLES, law.n_theta))
    near = 2.0 ** -(np.arange(SAMPLES) % 8)[:, None]
    points: Array = middle + near * shares * half_widths(law.theta_min, law.theta_max)
    return points


class _Law(th.autograd.Function):
    """A law in [-1, 1], with its gain for a gradient where theta has one."""

    @staticmethod
    def forward(ctx: Any, theta: th.Tensor, layer: SharedYannLayer) -> th.Tensor:
        ctx.layer = layer
        ctx.save_for_backward(theta)
        u = th.as_tensor(layer.inputs(theta)[0], device=theta.device)
        return ((u - layer.middle) / layer.half_range).to(layer.theta_half)

    @staticmethod
    @th.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[th.Tensor, None]:
        (theta,), (by_u,) = ctx.saved_tensors, gradients
        points = theta.detach().double().cpu().nan_to_num(0.0, 0.0, 0.0).numpy()
        slopes = th.as_tensor(ctx.layer.slopes_of_law(points), device=theta.device)
        return (by_u.double()[:, None] @ slopes)[:, 0].to(theta), None
