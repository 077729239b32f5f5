"""The YANN layers: a law, exactly, plus trainable networks that are zero at first."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib import import_module
from typing import Any, ClassVar

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_yann._validation import Array, half_widths
from sb3_yann.control.law import PiecewiseAffine
from sb3_yann.control.mpc.invariant_sets import KeptSet
from sb3_yann.control.online import Law
from sb3_yann.networks.zero_output import Activation, RowAdam, ZeroOutputNetwork, register_constants
from sb3_yann.units import FLOAT32_ROUNDING, KEPT_ROUNDING

ChangeBounds = tuple[Array, Array]
FADE_START = 1.0
"""Within how many half-widths of a box a correction counts in full."""
FADE_END = 1.25
"""Beyond how many half-widths of a box a correction does not count."""


class LawLayer(nn.Module):
    """theta -> input in [-1, 1]: a law, and what networks add to it within bounds."""

    theta_half: th.Tensor
    middle: th.Tensor
    half_range: th.Tensor
    change: th.Tensor
    confines: th.Tensor
    margin: th.Tensor
    clamped: th.Tensor | None
    network: ZeroOutputNetwork
    reach: float | None
    constants: tuple[Array, Array, Array, float]  # for compiled code

    HIDDEN: ClassVar[tuple[int, ...]]  # widths of a network, if nothing is said

    def __init__(
        self,
        law: Law,
        hidden: tuple[int, ...] | None = None,
        activation: Activation = th.tanh,
        max_correction: float | None = None,
        pinned: bool = True,
        rate: ChangeBounds | None = None,
        kept: KeptSet | None = None,
    ) -> None:
        super().__init__()
        # Now, not in the midst of learn: Ctrl-C while numba begins would break it for good.
        import_module("sb3_yann.networks._kernels.yann_layer")
        if not np.all(np.isfinite([law.u_min, law.u_max])):
            raise ValueError(
                f"The law has u_min = {law.u_min.tolist()} and u_max = {law.u_max.tolist()}; "
                "a policy needs finite bounds on every input. Pass u_min and u_max to LinearMPC."
            )
        self.base_law = law
        self.rated = rate is not None or law.moving is not None
        self.row_gradients = False
        middle = (law.u_max + law.u_min) / 2
        half_range = (law.u_max - law.u_min) / 2
        half = half_widths(law.theta_min, law.theta_max)
        self.register_buffer("theta_half", th.as_tensor(half, dtype=th.float32))
        change: Array = np.full((2, law.n_inputs), np.inf) * [[-1.0], [1.0]]
        self.moving = law.moving
        ends = None if law.clamped is None else th.as_tensor(np.array(law.clamped))
        self.register_buffer("clamped", ends, persistent=False)
        if rate is not None:
            if np.shape(rate) != (2, law.n_inputs) or law.n_theta < law.n_inputs:
                raise ValueError(
                    f"rate has shape {np.shape(rate)}, expected (2, {law.n_inputs}) and a theta "
                    f"that ends with the {law.n_inputs} previous inputs; it has {law.n_theta}."
                )
            # In both directions a little is left for the rounding of actions and observations.
            room = np.maximum(np.stack([-rate[0], rate[1]]) / half_range - 1e-6, 0.0)
            change = room * [[-1.0], [1.0]]
        if self.rated:
            register_constants(self, change=change)
        if self.moving is not None:  # bounds in theta: their entries below the change
            change = np.concatenate([change, self.moving])
        if self.rated or not isinstance(self, YannLayer):
            register_constants(self, middle=middle, half_range=half_range)
        self.register_buffer("confines", th.zeros((2, law.n_theta), dtype=th.float64))
        self.scaling = np.concatenate([1 / half, middle, 1 / half_range])
        self.changes = change if self.rated else change[:0]
        none: Array = np.empty((0, law.n_theta + law.n_inputs + 2))
        self.rows = none if kept is None else _kept_in_actions(kept, middle, half_range)
        # Below zero the rows are left out.
        self.register_buffer("margin", th.tensor(0.0 if kept else -1.0, dtype=th.float64))
        at_origin = self._register_law(law)
        self.network = ZeroOutputNetwork(
            law.n_theta,
            law.n_inputs,
            self.HIDDEN if hidden is None else hidden,
            activation=activation,
            pinned=th.as_tensor(at_origin & pinned),
        )
        self.limit(max_correction)

    def _register_law(self, law: Any) -> NDArray[np.bool_]:
        """Register what a layer keeps of the law; return which networks count at the origin."""
        raise NotImplementedError

    @property
    def n_networks(self) -> int:
        """How many networks there are: one for each region, or one."""
        return len(self.network.pinned)

    def law(self, theta: th.Tensor) -> th.Tensor:
        """Return the law alone, in [-1, 1], whatever has been learnt; (batch, m)."""
        raise NotImplementedError

    def regions(self, theta: th.Tensor) -> NDArray[np.int64]:
        """Return which network each row of theta (batch, n) goes through: here the only one."""
        return np.zeros(len(theta), np.int64)

    def _correction(self, theta: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the law and what the networks put out, by torch's operations, both (batch, m)."""
        raise NotImplementedError

    def _for_loops(self, theta: Array) -> tuple[Array, NDArray[np.int64], Array, Array]:
        """Return the law, packed, room for its inputs, theta; or nothing packed, and the inputs."""
        raise NotImplementedError

    def forward(self, theta: th.Tensor) -> th.Tensor:
        """Return the input in [-1, 1], shape (batch, m), for theta of shape (batch, n)."""
        network: Any = self._modules["network"]  # an attribute of a module takes a microsecond
        if theta.device.type == "cpu" and not theta.requires_grad and network.compiles:
            from sb3_yann.networks._kernels.yann_layer import layer_on_cpu  # compiled once

            own = network.weights(), network.pinned_array
            return layer_on_cpu(self._for_loops, theta, self.constants, *own, self.row_gradients)
        theta = clamp_theta(theta, self.clamped)
        law, correction = self._correction(theta)
        if self.reach is not None:
            # The bound holds for weights that overflow, or are no numbers, as well.
            correction = correction.nan_to_num(0.0, self.reach, -self.reach)
            ends = -self.reach, self.reach
            correction = _InwardGradientClamp.apply(correction, *ends)  # type: ignore[no-untyped-call]
        part = self.confined(theta)
        output: th.Tensor = law + th.where(part > 0, correction * part, 0.0)
        # As compiled: where theta is not finite nothing is passed off as an input.
        output = output.masked_fill(~theta.isfinite().all(1, keepdim=True), th.nan)
        bounds = self.reachable(theta) if self.rated else (-1.0, 1.0)
        adds = (output != law).any(1, keepdim=True)
        output = _InwardGradientClamp.apply(output, *bounds)  # type: ignore[no-untyped-call]
        if len(self.constants[2]) == 0:
            return output
        rows = th.as_tensor(self.constants[2], device=theta.device)
        given = law.detach(), theta.detach(), adds, rows, bounds, self.constants[3]
        kept: th.Tensor = _Kept.apply(output, *given)  # type: ignore[no-untyped-call]
        return kept

    def descend(
        self,
        theta: th.Tensor,
        wanted: th.Tensor,
        largest: float,
        steps: Iterable[tuple[NDArray[np.int64], float]],
    ) -> None:
        """Take steps of Adam towards actions (rows, m) that are wanted at theta (rows, n).

        Each step names rows and a rate. Errors count by their square, beyond the ``largest`` by
        their size: Huber's loss. Networks without data stay as they are.
        """
        network = self.network
        weights = network.weights()
        if theta.device.type == "cpu" and network.compiles:
            from sb3_yann.networks._kernels.yann_layer import descend

            own = self.constants, weights, network.pinned_array
            descend(self._for_loops, theta, wanted.numpy(), largest, steps, *own)
            return
        optimizer = RowAdam(weights)
        for rows, optimizer.param_groups[0]["lr"] in steps:
            optimizer.zero_grad()
            actions = self(theta[rows])
            errors = (actions.detach() - wanted[rows]).clamp(-largest, largest)
            actions.backward(errors / len(rows))
            optimizer.step()
        optimizer.zero_grad()

    @th.no_grad()
    def reachable(self, theta: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the bounds (batch, m) that rate and bounds in theta leave of [-1, 1]."""
        previous = (theta[:, -len(self.middle) :] - self.middle) / self.half_range
        slowest = (previous + self.change[:, None]).clamp(-1, 1)
        low, high = slowest
        if self.moving is not None:
            low, high = (
                th.where(
                    th.as_tensor(at >= 0, device=theta.device),
                    ((theta[:, at] - self.middle) / self.half_range).clamp(-1, 1),
                    side,
                )
                for at, side in zip(self.moving, (-1.0, 1.0), strict=True)
            )
            high = th.maximum(low, high).clamp(*slowest)
            low = low.clamp(*slowest)
        return low.to(self.theta_half), high.to(self.theta_half)

    def slopes_of_law(self, theta: Array) -> Array:
        """Return the derivatives (rows, m, n) of the law in [-1, 1], zero where it is clipped."""
        law = self.base_law
        slopes: Array = law.gain(theta) / ((law.u_max - law.u_min) / 2)[:, None]
        u = law(theta)
        slopes[(u <= law.u_min) | (u >= law.u_max)] = 0.0
        if isinstance(law, PiecewiseAffine) and law.infeasible == "zero_input":
            slopes[~law.in_domain(theta)] = 0.0  # as the gain of an online law is
        return slopes

    def frozen(self) -> Callable[[Array], NDArray[Any]]:
        """Return the layer of now as a function of theta (batch, n): (batch, m), without torch."""
        if self.network.compiles:
            from sb3_yann.networks._kernels.yann_layer import frozen_layer

            own = self.network.weights(), self.network.pinned_array
            return frozen_layer(self._for_loops, self.constants, *own)

        @th.no_grad()
        def act(theta: Array) -> NDArray[Any]:
            points = th.as_tensor(theta, device=self.theta_half.device)
            found: NDArray[Any] = self(points).double().cpu().numpy()
            return found

        return act

    def limit(self, max_correction: float | None) -> None:
        """Bound the network's output to a fraction of the input range, or not at all."""
        # The input range is 2 here. A little is left for the float32 rounding of what follows, and
        # for what the rate's own room may take from the law.
        left = 2e-6 if self.rated else 1e-6
        self.reach = None if max_correction is None else max(0.0, 2 * max_correction - left)
        self._keep_constants()

    def keep(self, margin: float | None) -> None:
        """Let inputs keep so far from the rows that they keep, in half-widths; None is off.

        A prediction may be off by the margin in each state, and the row is kept all the same.
        """
        self.margin.fill_(-1.0 if margin is None else margin)
        self._keep_constants()

    def confine(self, low: Array | None, high: Array | None) -> None:
        """Let the network's output count in a box of theta only, or everywhere for None.

        It counts in full within, and falls to nothing at a quarter of a half-width beyond.
        """
        box: Array = np.zeros((2, len(self.theta_half)))  # its middle, and one over its half-widths
        if low is not None and high is not None:
            least = 0.01 * self.theta_half.double().cpu().numpy()  # of the problem's half-widths
            box = np.stack([(high + low) / 2, 1 / np.maximum((high - low) / 2, least)])
        self.confines.copy_(th.as_tensor(box))
        self._keep_constants()

    def confined(self, theta: th.Tensor) -> th.Tensor:
        """Return the part (batch, 1), from 1 to 0, of the network's output that counts."""
        beyond = ((theta - self.confines[0]).abs() * self.confines[1]).amax(1, keepdim=True)
        return ((FADE_END - beyond) / (FADE_END - FADE_START)).clamp(0, 1).to(self.theta_half)

    def _keep_constants(self) -> None:
        confines = self.confines.cpu().numpy().ravel()
        # As data: a constant of another file stays what it was in code that has been compiled.
        scaling = np.concatenate([self.scaling, confines, [FADE_START, FADE_END]])
        margin = float(self.margin)
        kept = self.rows.copy() if margin >= 0 else self.rows[:0]
        kept[:, -1] *= margin + FLOAT32_ROUNDING
        limit = np.inf if self.reach is None else self.reach
        self.constants = (scaling, self.changes, kept, limit)

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *rest: Any) -> None:
        super()._load_from_state_dict(state_dict, prefix, *rest)
        self._keep_constants()


def clamp_theta(theta: th.Tensor, ends: th.Tensor | None) -> th.Tensor:
    """Return theta (batch, n) between ends (2, n), NaN where infinite; as it is for None."""
    if ends is None:
        return theta
    theta = theta.double()
    return th.where(theta.isfinite(), theta.clamp(ends[0], ends[1]), th.nan)


def _kept_in_actions(kept: KeptSet, middle: Array, half_range: Array) -> Array:
    """Return rows [a, b, c, half-width], that inputs move, for actions in [-1, 1]; |b| = 1."""
    m = len(middle)
    a, b, c = np.split(kept.ahead, [-m - 1, -1], axis=1)
    c = c - (b @ middle)[:, None]
    b = b * half_range
    length = np.linalg.norm(b, axis=1, keepdims=True)
    moved = length[:, 0] > FLOAT32_ROUNDING
    return np.ascontiguousarray(np.hstack([a, b, c, np.ones_like(c)])[moved] / length[moved])


class YannLayer(LawLayer):
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
    kept : KeptSet, optional
        What networks add never makes the model's next theta leave it, nor go further beyond one of
        its half-spaces than the law does.

    Examples
    --------
    >>> from sb3_yann_envs import problems
    >>> law = problems.cstr().explicit()
    >>> layer, theta = YannLayer(law), np.full(4, 0.1)
    >>> u = layer(th.as_tensor(theta)[None]).detach().numpy()[0] * law.u_max  # from [-1, 1]
    >>> bool(np.allclose(u, law(theta), atol=1e-5))
    True
    """

    HIDDEN = (16, 16)
    base_law: PiecewiseAffine
    gains: th.Tensor
    offsets: th.Tensor
    half_space_A: th.Tensor
    half_space_b: th.Tensor
    resting: th.Tensor

    def _register_law(self, law: PiecewiseAffine) -> NDArray[np.bool_]:
        middle = (law.u_max + law.u_min) / 2
        half_range = (law.u_max - law.u_min) / 2
        own, rows, ends = law.open_rows
        A, b = padded_rows(law.starts, rows, np.where(own, ends, np.inf))
        # Float64: in float32 points near a facet fall into the wrong region, and the large terms
        # of a stiff law do not cancel to the 1e-5 of the input range that is promised.
        register_constants(
            self,
            gains=law.gains / half_range[:, None],
            offsets=(law.offsets - middle) / half_range,
            resting=np.clip(-middle / half_range, -1, 1),
            half_space_A=A.T.reshape(law.n_theta, -1),  # the first of every region, the second, ...
            half_space_b=b.T.ravel(),
        )
        return np.asarray(np.minimum.reduceat(law.b, law.starts) >= -law.tolerance)

    def law(self, theta: th.Tensor) -> th.Tensor:
        """Return the law alone, in [-1, 1], whatever has been learnt; (batch, m)."""
        theta = clamp_theta(theta, self.clamped)
        return self._law(theta, *self.locate(theta))

    def regions(self, theta: th.Tensor) -> NDArray[np.int64]:
        """Return the region in use for each row of theta (batch, n), the first if not finite."""
        points = theta.detach().double().cpu().numpy()
        finite = np.isfinite(points).all(axis=1)
        found = np.zeros(len(points), dtype=np.int64)
        found[finite] = self.base_law.locate(points[finite])
        return found

    @th.no_grad()
    def locate(self, theta: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the region in use and whether it holds theta, both (batch,)."""
        slack = th.addmm(self.half_space_b, theta.double(), self.half_space_A, alpha=-1)
        slack = th.unflatten(slack, 1, (-1, len(self.gains))).amin(1)
        largest = slack.amax(-1)
        nearly = largest - self.base_law.tie_tolerance * (1 + largest.abs())
        middle, per_half = self.half_space_A.new_tensor(self.base_law.box)
        room = 1 - ((theta.double() - middle).abs() * per_half).amax(-1)
        inside = th.minimum(largest, room) >= -self.base_law.tolerance
        return (slack >= nearly[:, None]).byte().argmax(-1), inside

    def _correction(self, theta: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        region, inside = self.locate(theta)
        correction = self.network((theta / self.theta_half).to(self.theta_half), region)
        return self._law(theta, region, inside), correction

    def _law(self, theta: th.Tensor, region: th.Tensor, inside: th.Tensor) -> th.Tensor:
        u = (self.gains[region] * theta[:, None]).sum(-1) + self.offsets[region]
        if self.base_law.infeasible == "zero_input":
            u = th.where(inside[:, None], u, self.resting)
        u = u.clamp(-1, 1).to(self.theta_half)
        return u.clamp(*self.reachable(theta)) if self.rated else u

    def _for_loops(self, theta: Array) -> tuple[Array, NDArray[np.int64], Array, Array]:
        inputs: Array = np.empty((len(theta), self.base_law.n_inputs))
        known = np.where(np.isfinite(theta), theta, np.nan)  # clamping hides what is infinite
        return *self.base_law.packed, inputs, self.base_law.clamp(known)

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *rest: Any) -> None:
        constants = "gains", "offsets", "resting", "half_space_A", "half_space_b"
        own = {name: self.get_buffer(name).clone() for name in constants}
        super()._load_from_state_dict(state_dict, prefix, *rest)
        # Compiled code and regions go by the law that was given, to the last bit; that it is the
        # same one is for the policy to see.
        for name, ours in own.items():
            self.get_buffer(name).copy_(ours)


def padded_rows(starts: NDArray[np.int64], rows: Array, ends: Array) -> tuple[Array, Array]:
    """Return half-spaces of regions, (p, q_max, n) and (p, q_max), from those in a row.

    Regions with fewer than q_max are filled up with half-spaces that never bind.
    """
    counts = np.diff([*starts, len(ends)])
    used = np.arange(counts.max()) < counts[:, None]
    A: Array = np.zeros((*used.shape, rows.shape[1]))
    b: Array = np.full(used.shape, np.inf)
    A[used] = rows
    b[used] = ends
    return A, b


class SharedYannLayer(LawLayer):
    """theta -> input in [-1, 1]: a law, exactly, plus one network for all of it.

    At first the network is exactly zero and the layer is the law, to float32 rounding. The network
    does not grow with the law, and leaves it as continuous as it is.

    The law is evaluated by numpy, on the processor. The state_dict holds samples of it, by which
    parameters of another law are recognized.

    Parameters
    ----------
    law : PiecewiseAffine or OnlineLaw
        With finite input bounds, which map to -1 and 1.
    hidden : tuple of int, default (64, 64)
        Widths of the network.
    activation, max_correction, pinned, rate, kept
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

    HIDDEN = (64, 64)
    samples: th.Tensor

    def _register_law(self, law: Law) -> NDArray[np.bool_]:
        law(np.zeros(law.n_theta))  # compiled now, not in the midst of learn
        theta = sample_points(law)
        register_constants(self, samples=np.hstack([theta, self._actions(theta)]))
        return np.array([True])

    def law(self, theta: th.Tensor) -> th.Tensor:
        """Return the law alone, in [-1, 1], whatever has been learnt; (batch, m)."""
        if th.jit.is_tracing() or th.compiler.is_compiling():  # type: ignore[attr-defined, no-untyped-call]
            raise RuntimeError(
                "A law beside a shared network is evaluated outside of torch: it cannot be traced "
                "or compiled by it. Trace a policy with networks='per_region'."
            )
        theta = clamp_theta(theta, self.clamped)
        u: th.Tensor = _Law.apply(theta, self)  # type: ignore[no-untyped-call]
        return u.clamp(*self.reachable(theta)) if self.rated else u

    def inputs(self, theta: Array) -> Array:
        """Return the law's inputs (batch, m), NaN where theta (batch, n) is not finite."""
        finite = np.isfinite(theta).all(axis=1)
        u: Array = np.full((len(theta), self.base_law.n_inputs), np.nan)
        u[finite] = self.base_law(theta[finite])
        return u

    def _correction(self, theta: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        correction = self.network((theta / self.theta_half).to(self.theta_half))
        return self.law(theta), correction

    def _for_loops(self, theta: Array) -> tuple[Array, NDArray[np.int64], Array, Array]:
        return np.empty(0), np.empty(0, np.int64), self.inputs(theta), self.base_law.clamp(theta)

    def _actions(self, theta: Array) -> Array:
        middle = self.middle.double().cpu().numpy()
        actions: Array = (self.base_law(theta) - middle) / self.half_range.double().cpu().numpy()
        return actions

    def answers_as(self, samples: th.Tensor, rounding: float) -> bool:
        """Return whether rows ``[theta, action]`` are the law's, where the MPC has a solution."""
        rows: Array = samples.double().cpu().numpy()
        if not np.isfinite(rows).all():
            return False
        theta, actions = np.split(rows, [self.base_law.n_theta], axis=1)
        apart = np.abs(self._actions(theta) - actions).max(1)
        return bool(np.all(apart[self.base_law.in_domain(theta)] <= rounding))


def sample_points(law: Law) -> Array:
    """Return points (rows, n) in a law's box, most near its middle: afar many laws are a bound."""
    bounded = np.isfinite(law.theta_min) & np.isfinite(law.theta_max)
    middle = np.where(bounded, law.theta_max / 2 + law.theta_min / 2, 0.0)
    shares = np.random.default_rng(0).uniform(-1, 1, (32, law.n_theta))
    near = 2.0 ** -(np.arange(len(shares)) % 8)[:, None]
    points: Array = middle + near * shares * half_widths(law.theta_min, law.theta_max)
    return points


class _Law(th.autograd.Function):
    """A law in [-1, 1], with its gain for a gradient where theta has one."""

    @staticmethod
    def forward(ctx: Any, theta: th.Tensor, layer: SharedYannLayer) -> th.Tensor:
        ctx.layer = layer
        ctx.save_for_backward(theta)
        points = theta.detach().double().cpu().numpy()
        u = th.as_tensor(layer.inputs(points), device=theta.device)
        return ((u - layer.middle) / layer.half_range).to(layer.theta_half)

    @staticmethod
    @th.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[th.Tensor, None]:
        (theta,) = ctx.saved_tensors
        points = theta.detach().double().cpu().nan_to_num(0.0, 0.0, 0.0).numpy()
        slopes = th.as_tensor(ctx.layer.slopes_of_law(points), device=theta.device)
        return (gradients[0].double()[:, None] @ slopes)[:, 0].to(theta), None


class _InwardGradientClamp(th.autograd.Function):
    """Clamp to [low, high]; backward, stop only what would push further out."""

    @staticmethod
    def forward(ctx: Any, x: th.Tensor, low: Any, high: Any) -> th.Tensor:
        ctx.save_for_backward(x)
        ctx.low = low
        ctx.high = high
        return x.clamp(low, high)

    @staticmethod
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[th.Tensor, None, None]:
        (x,) = ctx.saved_tensors
        (gradient,) = gradients
        # Descent moves x against its gradient.
        outward = ((x >= ctx.high) & (gradient < 0)) | ((x <= ctx.low) & (gradient > 0))
        return gradient.masked_fill(outward, 0.0), None, None


class _Kept(th.autograd.Function):
    """Move actions to where the rows allow, see `forward` of the kernels; backward, as inward."""

    @staticmethod
    def forward(
        ctx: Any,
        actions: th.Tensor,
        law: th.Tensor,
        theta: th.Tensor,
        adds: th.Tensor,
        rows: th.Tensor,
        bounds: Any,
        limit: float,
    ) -> th.Tensor:
        a, b, c, margin = th.split(rows, [theta.shape[1], law.shape[1], 1, 1], 1)
        slack = c.T - theta.double() @ a.T - law.double() @ b.T
        room = (slack - margin.T).clamp(min=0)

        def pushed(actions: th.Tensor) -> th.Tensor:
            return (actions - law).double() @ b.T

        most, worst = (pushed(actions) - th.minimum(slack, room)).max(1, keepdim=True)
        held = adds & (most > 0)
        ctx.along = b[worst[:, 0]] * held
        moved = (actions - most * ctx.along).clamp(law - limit, law + limit)
        moved = moved.to(actions).clamp(*bounds)
        push = pushed(moved)
        share = ((room + KEPT_ROUNDING) / push.clamp(min=KEPT_ROUNDING)).amin(1, keepdim=True)
        moved = (law + share.clamp(max=1) * (moved - law)).to(actions).clamp(*bounds)
        kept: th.Tensor = th.where(held, moved, actions)
        return kept

    @staticmethod
    def backward(ctx: Any, *gradients: th.Tensor) -> Any:
        (gradient,) = gradients
        # Descent moves actions against it.
        along = (gradient * ctx.along).sum(1, keepdim=True).clamp(max=0)
        moves = (gradient - along * ctx.along).to(gradient)
        return moves, None, None, None, None, None, None
