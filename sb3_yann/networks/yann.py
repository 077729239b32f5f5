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
    network is zero at the origin for good, so the equilibrium stays where it is; unless it is
    not ``pinned``.

    Neighbouring regions have networks of their own: once trained, the layer may jump where it
    passes from one region to the next.

    Parameters
    ----------
    law : PiecewiseAffine
        With finite input bounds, which map to -1 and 1.
    hidden : tuple of int, default (16, 16)
        Widths of each region's network.
    activation : callable, default torch.tanh
    max_correction : float, optional
        The output is never further from the law than this fraction of the input range, whatever
        the networks become. The default is no bound but those of the input.
    pinned : bool, default True
        Whether training must leave the equilibrium where it is. A law whose steady-state input is
        wrong has to be free to move it.

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
        max_correction: float | None = None,
        pinned: bool = True,
    ) -> None:
        super().__init__()
        if not np.all(np.isfinite([law.u_min, law.u_max])):
            raise ValueError(
                f"The law has u_min = {law.u_min.tolist()} and u_max = {law.u_max.tolist()}; "
                "a policy needs finite bounds on every input. Pass u_min and u_max to LinearMPC."
            )
        self.outside = law.outside
        # The input range is 2 here. A little is left for the float32 rounding of what follows.
        self.reach = None if max_correction is None else max(0.0, 2 * max_correction - 1e-6)
        self.tolerance, self.tie_tolerance = law.tolerance, law.tie_tolerance
        middle, reach = (law.u_max + law.u_min) / 2, (law.u_max - law.u_min) / 2
        A, b = _padded_half_spaces(law)
        # Float64: in float32 points near a facet fall into the wrong region, and the large terms
        # of a stiff law do not cancel to the 1e-5 of the input range that is promised.
        self._constant("gains", law.gains / reach[:, None])
        self._constant("offsets", (law.offsets - middle) / reach)
        self._constant("resting", np.clip(-middle / reach, -1, 1))
        self._constant("half_space_A", A)
        self._constant("half_space_b", b)
        self._constant("theta_half", (law.theta_max - law.theta_min) / 2, th.float32)
        at_origin = np.minimum.reduceat(law.b, law.starts) >= -law.tolerance
        self.network = ZeroOutputNetwork(
            law.n_theta,
            law.n_inputs,
            hidden,
            activation=activation,
            pinned=th.as_tensor(at_origin & pinned),
        )

    def forward(self, theta: th.Tensor) -> th.Tensor:
        """Return the input in [-1, 1], shape (batch, m), for theta of shape (batch, n).

        Theta of float64 reaches the law as it is, and rounded the network.
        """
        region, inside = self.locate(theta)
        correction = self.network((theta / self.theta_half).to(self.theta_half), region)
        if self.reach is not None:
            # The bound holds for weights that overflow, or are no numbers, as well.
            correction = correction.nan_to_num(0.0, self.reach, -self.reach)
            correction = clamp_alive(correction, self.reach)
        return clamp_alive(self._law(theta, region, inside) + correction)

    def law(self, theta: th.Tensor) -> th.Tensor:
        """Return the law alone, in [-1, 1], whatever has been learnt; (batch, m)."""
        return self._law(theta, *self.locate(theta))

    @th.no_grad()
    def locate(self, theta: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the region in use and whether it holds theta, both (batch,)."""
        slack = th.addmm(self.half_space_b, theta.double(), self.half_space_A, alpha=-1)
        slack = th.unflatten(slack, 1, (-1, len(self.gains))).amin(1)
        largest = slack.amax(-1)
        nearly = largest - self.tie_tolerance * (1 + largest.abs())
        return (slack >= nearly[:, None]).byte().argmax(-1), largest >= -self.tolerance

    def _law(self, theta: th.Tensor, region: th.Tensor, inside: th.Tensor) -> th.Tensor:
        u = (self.gains[region] * theta[:, None]).sum(-1) + self.offsets[region]
        if self.outside == "zero":
            u = th.where(inside[:, None], u, self.resting)
        return u.clamp(-1, 1).to(self.theta_half)

    def _constant(self, name: str, value: Array, dtype: th.dtype = th.float64) -> None:
        # A buffer, not a parameter: optimizers and SB3's target updates leave it alone.
        self.register_buffer(name, th.as_tensor(np.array(value), dtype=dtype))


def _padded_half_spaces(law: PiecewiseAffine) -> tuple[Array, Array]:
    """Return (n, q_max p) and (q_max p,): the first half-space of every region, the second, ...

    Regions with fewer than q_max are filled up with half-spaces that never bind.
    """
    counts = np.diff([*law.starts, law.n_halfspaces])
    A = np.zeros((law.n_theta, counts.max(), law.n_regions))
    b = np.full((counts.max(), law.n_regions), np.inf)
    for i, (start, count) in enumerate(zip(law.starts, counts, strict=True)):
        A[:, :count, i] = law.A[start : start + count].T
        b[:count, i] = law.b[start : start + count]
    return A.reshape(law.n_theta, -1), b.ravel()


class _ClampAlive(th.autograd.Function):
    """Clamp to [-limit, limit]; backward, stop only what would push further out."""

    @staticmethod
    def forward(ctx: Any, x: th.Tensor, limit: float) -> th.Tensor:
        ctx.save_for_backward(x)
        ctx.limit = limit
        return x.clamp(-limit, limit)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: th.Tensor) -> tuple[th.Tensor, None]:
        (x,) = ctx.saved_tensors
        (grad,) = grad_outputs
        # Descent moves x against its gradient.
        outward = ((x >= ctx.limit) & (grad < 0)) | ((x <= -ctx.limit) & (grad > 0))
        return grad.masked_fill(outward, 0.0), None


def clamp_alive(x: th.Tensor, limit: float = 1.0) -> th.Tensor:
    """Return x clamped to [-limit, limit], with a gradient that can still lead back inside.

    The gradient of `torch.clamp` vanishes beyond the bounds, so a saturated region would never
    learn to leave its bound.
    """
    clamped: th.Tensor = _ClampAlive.apply(x, limit)  # type: ignore[no-untyped-call]
    return clamped
