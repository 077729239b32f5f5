"""The YANN layer: the active region's affine law plus that region's own trainable network.

It puts out actions in [-1, 1], which stand for ``u_min`` and ``u_max`` of the law.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_yann._validation import Array
from sb3_yann.control.law.piecewise_affine import PiecewiseAffine
from sb3_yann.networks.zero_output import Activation, ZeroOutputNetwork, register_constants


class YannLayer(nn.Module):
    """theta -> input in [-1, 1]: a piecewise affine law, exactly, plus a network per region.

    At first the networks are exactly zero and the layer is the law, to float32 rounding. Once
    trained, it may jump from one region to the next: each has a network of its own.

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
        Whether training leaves the equilibrium where it is: networks stay zero at the origin.
    rate : pair of ndarray, shape (m,), optional
        ``du_min`` and ``du_max``: the input, the law's too, never moves by more from the previous
        one, the last m entries of theta.

    Examples
    --------
    >>> from sb3_yann_envs import problems
    >>> law = problems.cstr().explicit()
    >>> layer, theta = YannLayer(law), np.full(4, 0.1)
    >>> u = layer(th.as_tensor(theta)[None]).detach().numpy()[0] * law.u_max  # from [-1, 1]
    >>> bool(np.allclose(u, law(theta), atol=1e-5))
    True
    """

    gains: th.Tensor
    offsets: th.Tensor
    half_space_A: th.Tensor
    half_space_b: th.Tensor
    theta_half: th.Tensor
    resting: th.Tensor
    middle: th.Tensor
    half_range: th.Tensor
    change: th.Tensor

    def __init__(
        self,
        law: PiecewiseAffine,
        hidden: tuple[int, ...] = (16, 16),
        activation: Activation = th.tanh,
        max_correction: float | None = None,
        pinned: bool = True,
        rate: tuple[Array, Array] | None = None,
    ) -> None:
        super().__init__()
        # Now, not in the midst of learn: Ctrl-C while numba begins would break it for good.
        import_module("sb3_yann.networks._kernels.yann_layer")
        if not np.all(np.isfinite([law.u_min, law.u_max])):
            raise ValueError(
                f"The law has u_min = {law.u_min.tolist()} and u_max = {law.u_max.tolist()}; "
                "a policy needs finite bounds on every input. Pass u_min and u_max to LinearMPC."
            )
        self.infeasible, self.piecewise_affine, self.row_gradients = law.infeasible, law, False
        self.tolerance, self.tie_tolerance = law.tolerance, law.tie_tolerance
        middle, reach = (law.u_max + law.u_min) / 2, (law.u_max - law.u_min) / 2
        # Float64: in float32 points near a facet fall into the wrong region, and the large terms
        # of a stiff law do not cancel to the 1e-5 of the input range that is promised.
        register_constants(self, **_constants(law))
        half = (law.theta_max - law.theta_min) / 2
        self.register_buffer("theta_half", th.as_tensor(half, dtype=th.float32))
        self.rated = rate is not None
        if rate is not None:
            if np.shape(rate) != (2, law.n_inputs) or law.n_theta < law.n_inputs:
                raise ValueError(
                    f"rate has shape {np.shape(rate)}, expected (2, {law.n_inputs}) and a theta "
                    f"that ends with the {law.n_inputs} previous inputs; it has {law.n_theta}."
                )
            # In both directions a little is left for the rounding of actions and observations.
            room = np.maximum(np.stack([-rate[0], rate[1]]) / reach - 1e-6, 0.0)
            change = room * [[-1.0], [1.0]]
            register_constants(self, middle=middle, half_range=reach, change=change)
        at_origin = np.minimum.reduceat(law.b, law.starts) >= -law.tolerance
        stay, sizes = th.as_tensor(at_origin & pinned), (law.n_theta, law.n_inputs)
        self.network = ZeroOutputNetwork(*sizes, hidden, activation=activation, pinned=stay)
        scaling = np.concatenate([2 / (law.theta_max - law.theta_min), middle, 1 / reach])
        change = self.change.numpy() if self.rated else np.empty((0, law.n_inputs))
        self.constants = (scaling, change, np.inf)  # for compiled code
        self.limit(max_correction)
        self.has_its_law = True

    def limit(self, max_correction: float | None) -> None:
        """Bound the network's output to a fraction of the input range, or not at all."""
        # The input range is 2 here. A little is left for the float32 rounding of what follows.
        self.reach = None if max_correction is None else max(0.0, 2 * max_correction - 1e-6)
        self.constants = (*self.constants[:2], np.inf if self.reach is None else self.reach)

    def forward(self, theta: th.Tensor) -> th.Tensor:
        """Return the input in [-1, 1], shape (batch, m), for theta of shape (batch, n)."""
        fixed = theta.device.type == "cpu" and not theta.requires_grad
        if fixed and self.has_its_law and self.network.compiles:
            return self._compiled(theta)
        region, inside = self.locate(theta)
        correction = self.network((theta / self.theta_half).to(self.theta_half), region)
        if self.reach is not None:
            # The bound holds for weights that overflow, or are no numbers, as well.
            correction = correction.nan_to_num(0.0, self.reach, -self.reach)
            correction = clamp_with_inward_gradient(correction, -self.reach, self.reach)
        output = self._law(theta, region, inside) + correction
        # As compiled: where theta is not finite nothing is passed off as an input.
        output = output.masked_fill(~theta.isfinite().all(1, keepdim=True), th.nan)
        bounds = self.reachable(theta) if self.rated else (-1.0, 1.0)
        return clamp_with_inward_gradient(output, *bounds)

    def _compiled(self, theta: th.Tensor) -> th.Tensor:
        from sb3_yann.networks._kernels.yann_layer import layer_on_cpu  # compiled once

        network: Any = self._modules["network"]  # an attribute of a module takes a microsecond
        law, own = self.piecewise_affine.packed, (network.weights(), network.pinned_array)
        return layer_on_cpu(theta, law, self.constants, *own, self.row_gradients)

    def law(self, theta: th.Tensor) -> th.Tensor:
        """Return the law alone, in [-1, 1], whatever has been learnt; (batch, m)."""
        return self._law(theta, *self.locate(theta))

    def regions(self, theta: th.Tensor) -> NDArray[np.int64]:
        """Return the region in use for each row of theta (batch, n), the first if not finite."""
        if not self.has_its_law:
            by_torch: NDArray[np.int64] = self.locate(theta)[0].cpu().numpy()
            return by_torch
        points = theta.detach().double().cpu().numpy()
        finite = np.isfinite(points).all(axis=1)
        found = np.zeros(len(points), dtype=np.int64)
        found[finite] = self.piecewise_affine.locate(points[finite])
        return found

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
        if self.infeasible == "zero_input":
            u = th.where(inside[:, None], u, self.resting)
        u = u.clamp(-1, 1).to(self.theta_half)
        return u.clamp(*self.reachable(theta)) if self.rated else u

    @th.no_grad()
    def reachable(self, theta: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the bounds (batch, m) that the rate leaves of [-1, 1]."""
        previous = (theta[:, -len(self.middle) :] - self.middle) / self.half_range
        low, high = (previous + self.change[:, None]).clamp(-1, 1).to(self.theta_half)
        return low, high

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        super()._load_from_state_dict(state_dict, prefix, *args)
        # What is compiled goes by the law that was given: with another one it must not be used.
        self.has_its_law = all(
            np.array_equal(value, self.get_buffer(name).cpu())
            for name, value in _constants(self.piecewise_affine).items()
        )


def _constants(law: PiecewiseAffine) -> dict[str, Array]:
    """Return the law for actions in [-1, 1], as the layer keeps it."""
    middle, reach = (law.u_max + law.u_min) / 2, (law.u_max - law.u_min) / 2
    A, b = _padded_half_spaces(law)
    return {
        "gains": law.gains / reach[:, None],
        "offsets": (law.offsets - middle) / reach,
        "resting": np.clip(-middle / reach, -1, 1),
        "half_space_A": A,
        "half_space_b": b,
    }


def _padded_half_spaces(law: PiecewiseAffine) -> tuple[Array, Array]:
    """Return (n, q_max p) and (q_max p,): the first half-space of every region, the second, ..."""
    # Regions with fewer than q_max are filled up with half-spaces that never bind.
    counts = np.diff([*law.starts, law.n_halfspaces])
    A = np.zeros((law.n_theta, counts.max(), law.n_regions))
    b = np.full((counts.max(), law.n_regions), np.inf)
    for i, (start, count) in enumerate(zip(law.starts, counts, strict=True)):
        A[:, :count, i] = law.A[start : start + count].T
        b[:count, i] = law.b[start : start + count]
    return A.reshape(law.n_theta, -1), b.ravel()


class _InwardGradientClamp(th.autograd.Function):
    """Clamp to [low, high]; backward, stop only what would push further out."""

    @staticmethod
    def forward(ctx: Any, x: th.Tensor, low: Any, high: Any) -> th.Tensor:
        ctx.save_for_backward(x)
        ctx.low, ctx.high = low, high
        return x.clamp(low, high)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: th.Tensor) -> tuple[th.Tensor, None, None]:
        (x,), (grad,) = ctx.saved_tensors, grad_outputs
        # Descent moves x against its gradient.
        outward = ((x >= ctx.high) & (grad < 0)) | ((x <= ctx.low) & (grad > 0))
        return grad.masked_fill(outward, 0.0), None, None


def clamp_with_inward_gradient(x: th.Tensor, low: Any = -1.0, high: Any = 1.0) -> th.Tensor:
    """Return x clamped to numbers or tensors, with a gradient that can still lead inside."""
    clamped: th.Tensor = _InwardGradientClamp.apply(x, low, high)  # type: ignore[no-untyped-call]
    return clamped
