"""What the layers around a law share: ranges, the bound of a correction, and that of the rate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_yann._validation import Array, half_widths
from sb3_yann.control.law import PiecewiseAffine
from sb3_yann.control.mpc.choice import Law
from sb3_yann.networks.zero_output import ZeroOutputNetwork, register_constants

Rate = tuple[Array, Array]
ALL, NONE = 1.0, 1.25
"""Within how many half-widths of a box a correction counts in full, and beyond how many not."""
LEAST = 0.01
"""The least half-width of such a box, in those of the problem's."""


class LawLayer(nn.Module):
    """theta -> input in [-1, 1]: a law, and what networks add to it within bounds."""

    theta_half: th.Tensor
    middle: th.Tensor
    half_range: th.Tensor
    change: th.Tensor
    confines: th.Tensor
    rated: bool
    network: ZeroOutputNetwork
    reach: float | None
    constants: tuple[Array, Array, float]
    row_gradients: bool

    @property
    def n_networks(self) -> int:
        """How many networks there are: one for each region, or one."""
        return len(self.network.pinned)

    def law(self, theta: th.Tensor) -> th.Tensor:
        """Return the law alone, in [-1, 1], whatever has been learnt; (batch, m)."""
        raise NotImplementedError

    def regions(self, theta: th.Tensor) -> NDArray[np.int64]:
        """Return which network each row of theta (batch, n) goes through."""
        raise NotImplementedError

    def slopes_of_law(self, theta: Array) -> Array:
        """Return the derivatives (rows, m, n) of the law in [-1, 1], zero where it is clipped."""
        raise NotImplementedError

    @property
    def explicit_law(self) -> PiecewiseAffine | None:
        """The law in use; None where it is solved online, or no longer that of the constructor."""
        raise NotImplementedError

    @property
    def packed(self) -> tuple[Any, ...] | None:
        """Law, ranges and networks for compiled code, None where there is none for them.

        They are as `layer_loops.forward` takes them, and those of now: weights share their memory.
        """
        law, network = self.explicit_law, self.network
        if law is None or not network.compiles:
            return None
        from sb3_yann.networks._kernels.mlp import to_numpy  # which loads numba

        weights = map(to_numpy, network.weights())
        return (*law.packed, *self.constants, *weights, network.pinned_array)

    def frozen(self) -> Callable[[Array], NDArray[Any]]:
        """Return the layer of now, on the CPU, as a function of theta (batch, n): (batch, m).

        It is faster for small batches where there is compiled code: it does without torch.
        """
        if self.packed is not None:
            return self._frozen(*self.packed)

        @th.no_grad()
        def act(theta: Array) -> NDArray[Any]:
            found: NDArray[Any] = self(th.as_tensor(theta)).double().numpy()
            return found

        return act

    def _frozen(self, *packed: Any) -> Callable[[Array], NDArray[Any]]:
        raise NotImplementedError

    def limit(self, max_correction: float | None) -> None:
        """Bound the network's output to a fraction of the input range, or not at all."""
        # The input range is 2 here. A little is left for the float32 rounding of what follows, and
        # for what the rate's own room may take from the law.
        left = 2e-6 if self.rated else 1e-6
        self.reach = None if max_correction is None else max(0.0, 2 * max_correction - left)
        self.constants = (*self.constants[:2], np.inf if self.reach is None else self.reach)

    def confine(self, low: Array | None, high: Array | None) -> None:
        """Let the network's output count in a box of theta only, or everywhere for None.

        It counts in full within, and falls to nothing at a quarter of a half-width beyond.
        """
        size = len(self.theta_half)
        box: Array = np.zeros((2, size))  # its middle, and one over its half-widths
        if low is not None and high is not None:
            least = LEAST * self.theta_half.double().cpu().numpy()
            box = np.stack([(high + low) / 2, 1 / np.maximum((high - low) / 2, least)])
        self.confines.copy_(th.as_tensor(box))
        self._keep_confines()

    def confined(self, theta: th.Tensor) -> th.Tensor:
        """Return the part (batch, 1), from 1 to 0, of the network's output that counts."""
        beyond = ((theta - self.confines[0]).abs() * self.confines[1]).amax(1, keepdim=True)
        return ((NONE - beyond) / (NONE - ALL)).clamp(0, 1).to(self.theta_half)

    def _keep_confines(self) -> None:
        confines = self.confines.cpu().numpy().ravel()
        scaling = self.constants[0][: -len(confines) - 2]
        # As data: a constant of another file stays what it was in code that has been compiled.
        self.constants = (np.concatenate([scaling, confines, [ALL, NONE]]), *self.constants[1:])

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *rest: Any) -> None:
        nowhere = th.zeros_like(self.confines)  # weights that were saved before there were boxes
        state_dict.setdefault(f"{prefix}confines", nowhere)
        super()._load_from_state_dict(state_dict, prefix, *rest)
        self._keep_confines()

    def _set_ranges(self, law: Law, rate: Rate | None, always: bool = False) -> None:
        """Keep the ranges of a law and, with a rate, by how much an input may change.

        ``always`` keeps the ranges of the inputs without a rate too.
        """
        middle, reach = (law.u_max + law.u_min) / 2, (law.u_max - law.u_min) / 2
        half = half_widths(law.theta_min, law.theta_max)
        self.register_buffer("theta_half", th.as_tensor(half, dtype=th.float32))
        self.rated, self.row_gradients = rate is not None, False
        if rate is None and always:
            register_constants(self, middle=middle, half_range=reach)
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
        self.register_buffer("confines", th.zeros((2, law.n_theta), dtype=th.float64))
        nowhere = np.zeros(2 * law.n_theta)
        scaling = np.concatenate([1 / half, middle, 1 / reach, nowhere, [ALL, NONE]])
        change = self.change.numpy() if self.rated else np.empty((0, law.n_inputs))
        self.constants = (scaling, change, np.inf)  # for compiled code

    def _with_correction(
        self, theta: th.Tensor, law: th.Tensor, correction: th.Tensor
    ) -> th.Tensor:
        """Return the action (batch, m): law and correction, each within its bounds."""
        if self.reach is not None:
            # The bound holds for weights that overflow, or are no numbers, as well.
            correction = correction.nan_to_num(0.0, self.reach, -self.reach)
            correction = clamp_with_inward_gradient(correction, -self.reach, self.reach)
        part = self.confined(theta)
        output = law + th.where(part > 0, correction * part, 0.0)
        # As compiled: where theta is not finite nothing is passed off as an input.
        output = output.masked_fill(~theta.isfinite().all(1, keepdim=True), th.nan)
        bounds = self.reachable(theta) if self.rated else (-1.0, 1.0)
        return clamp_with_inward_gradient(output, *bounds)

    @th.no_grad()
    def reachable(self, theta: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the bounds (batch, m) that the rate leaves of [-1, 1]."""
        previous = (theta[:, -len(self.middle) :] - self.middle) / self.half_range
        low, high = (previous + self.change[:, None]).clamp(-1, 1).to(self.theta_half)
        return low, high


def require_finite_inputs(law: Law) -> None:
    """Raise unless the inputs of a law have bounds, which -1 and 1 stand for."""
    if not np.all(np.isfinite([law.u_min, law.u_max])):
        raise ValueError(
            f"The law has u_min = {law.u_min.tolist()} and u_max = {law.u_max.tolist()}; "
            "a policy needs finite bounds on every input. Pass u_min and u_max to LinearMPC."
        )


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
