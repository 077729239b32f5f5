"""The YANN layer: the active region's affine law plus that region's own trainable network."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_yann.control._validation import Array
from sb3_yann.control.piecewise_affine import PiecewiseAffine
from sb3_yann.networks.zero_output import Activation, ZeroOutputNetwork


class YannLayer(nn.Module):
    """theta -> input in [-1, 1]: a piecewise affine law, exactly, plus a network per region.

    At first the networks are exactly zero and the layer is the law (to float32 rounding). Only
    the active region's law and network are computed. In a region that holds the origin the
    network is zero at the origin for good, so the equilibrium stays where it is.

    Neighbouring regions have networks of their own: once trained, the layer may jump where it
    passes from one region to the next.

    Parameters
    ----------
    law : PiecewiseAffine
        With finite input bounds, which map to -1 and 1.
    hidden : tuple of int, default (16, 16)
        Widths of each region's network.
    activation : callable, default torch.tanh

    Raises
    ------
    ValueError
        If an input of the law has no bound.
    """

    gains: th.Tensor
    offsets: th.Tensor
    half_space_A: th.Tensor
    half_space_b: th.Tensor
    theta_half: th.Tensor
    resting: th.Tensor

    def __init__(
        self,
        law: PiecewiseAffine,
        hidden: tuple[int, ...] = (16, 16),
        activation: Activation = th.tanh,
    ) -> None:
        super().__init__()
        if not np.all(np.isfinite([law.u_min, law.u_max])):
            raise ValueError(
                f"The law has u_min = {law.u_min.tolist()} and u_max = {law.u_max.tolist()}; "
                "a policy needs finite bounds on every input. Pass u_min and u_max to LinearMPC."
            )
        self.outside, self.tolerance = law.outside, law.tolerance
        middle, reach = (law.u_max + law.u_min) / 2, (law.u_max - law.u_min) / 2
        A, b = _padded_half_spaces(law)
        self._constant("gains", law.gains / reach[:, None])
        self._constant("offsets", (law.offsets - middle) / reach)
        self._constant("resting", np.clip(-middle / reach, -1, 1))
        # Location stays in float64: float32 puts points near a facet into the wrong region.
        self._constant("half_space_A", A, th.float64)
        self._constant("half_space_b", b, th.float64)
        self._constant("theta_half", (law.theta_max - law.theta_min) / 2)
        at_origin = np.minimum.reduceat(law.b, law.starts) >= -law.tolerance
        self.network = ZeroOutputNetwork(
            law.n_theta,
            law.n_inputs,
            hidden,
            activation=activation,
            pinned=th.as_tensor(at_origin),
        )

    def forward(self, theta: th.Tensor) -> th.Tensor:
        """Return the input in [-1, 1], shape (batch, m), for theta of shape (batch, n)."""
        region, inside = self.locate(theta)
        correction = self.network(theta / self.theta_half, region)
        return clamp_alive(self._law(theta, region, inside) + correction)

    def law(self, theta: th.Tensor) -> th.Tensor:
        """Return the law alone, in [-1, 1], whatever has been learnt; (batch, m)."""
        return self._law(theta, *self.locate(theta))

    @th.no_grad()
    def locate(self, theta: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the region in use and whether it holds theta, both (batch,)."""
        slack = self.half_space_b - th.einsum("pqn,bn->bpq", self.half_space_A, theta.double())
        largest, region = slack.amin(-1).max(-1)
        return region, largest >= -self.tolerance

    def _law(self, theta: th.Tensor, region: th.Tensor, inside: th.Tensor) -> th.Tensor:
        u = th.einsum("bmn,bn->bm", self.gains[region], theta) + self.offsets[region]
        if self.outside == "zero":
            u = th.where(inside[:, None], u, self.resting)
        return u.clamp(-1, 1)

    def _constant(self, name: str, value: Any, dtype: th.dtype = th.float32) -> None:
        # A buffer, not a parameter: optimizers and SB3's target updates leave it alone.
        self.register_buffer(name, th.as_tensor(np.array(value), dtype=dtype))


def _padded_half_spaces(law: PiecewiseAffine) -> tuple[Array, Array]:
    """Return (p, q_max, n) and (p, q_max): each region's half-spaces, then rows that never bind."""
    counts = np.diff([*law.starts, law.n_halfspaces])
    A = np.zeros((law.n_regions, counts.max(), law.n_theta))
    b = np.full((law.n_regions, counts.max()), np.inf)
    for i, (start, count) in enumerate(zip(law.starts, counts, strict=True)):
        A[i, :count] = law.A[start : start + count]
        b[i, :count] = law.b[start : start + count]
    return A, b


class _ClampAlive(th.autograd.Function):
    """Clamp to [-1, 1]; backward, stop only what would push further out."""

    @staticmethod
    def forward(ctx: Any, x: th.Tensor) -> th.Tensor:
        ctx.save_for_backward(x)
        return x.clamp(-1, 1)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: th.Tensor) -> th.Tensor:
        (x,) = ctx.saved_tensors
        (grad,) = grad_outputs
        # Descent moves x against its gradient.
        outward = ((x >= 1) & (grad < 0)) | ((x <= -1) & (grad > 0))
        return grad.masked_fill(outward, 0.0)


def clamp_alive(x: th.Tensor) -> th.Tensor:
    """Return x clamped to [-1, 1], with a gradient that can still lead back inside.

    The gradient of `torch.clamp` vanishes beyond the bounds, so a saturated region would never
    learn to leave its bound.
    """
    clamped: th.Tensor = _ClampAlive.apply(x)  # type: ignore[no-untyped-call]
    return clamped
