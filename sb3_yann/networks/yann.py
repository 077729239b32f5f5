"""The YANN layer: the active region's affine law plus that region's own trainable network.

It puts out actions in [-1, 1], which stand for ``u_min`` and ``u_max`` of the law.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_yann._validation import Array
from sb3_yann.control.law import PiecewiseAffine
from sb3_yann.networks.law_layer import LawLayer, Rate, require_finite_inputs
from sb3_yann.networks.zero_output import Activation, ZeroOutputNetwork, register_constants


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
    resting: th.Tensor

    def __init__(
        self,
        law: PiecewiseAffine,
        hidden: tuple[int, ...] = (16, 16),
        activation: Activation = th.tanh,
        max_correction: float | None = None,
        pinned: bool = True,
        rate: Rate | None = None,
    ) -> None:
        super().__init__()
        # Now, not in the midst of learn: Ctrl-C while numba begins would break it for good.
        import_module("sb3_yann.networks._kernels.yann_layer")
        require_finite_inputs(law)
        self.infeasible, self.piecewise_affine = law.infeasible, law
        self.tolerance, self.tie_tolerance = law.tolerance, law.tie_tolerance
        # Float64: in float32 points near a facet fall into the wrong region, and the large terms
        # of a stiff law do not cancel to the 1e-5 of the input range that is promised.
        register_constants(self, **_constants(law))
        self._set_ranges(law, rate)
        at_origin = np.minimum.reduceat(law.b, law.starts) >= -law.tolerance
        stay, sizes = th.as_tensor(at_origin & pinned), (law.n_theta, law.n_inputs)
        self.network = ZeroOutputNetwork(*sizes, hidden, activation=activation, pinned=stay)
        self.limit(max_correction)
        self.has_its_law = True

    def forward(self, theta: th.Tensor) -> th.Tensor:
        """Return the input in [-1, 1], shape (batch, m), for theta of shape (batch, n)."""
        fixed = theta.device.type == "cpu" and not theta.requires_grad
        if fixed and self.has_its_law and self.network.compiles:
            return self._compiled(theta)
        region, inside = self.locate(theta)
        correction = self.network((theta / self.theta_half).to(self.theta_half), region)
        return self._with_correction(theta, self._law(theta, region, inside), correction)

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

    @property
    def explicit_law(self) -> PiecewiseAffine | None:
        """The law in use; None where weights with another one have been loaded."""
        return self.piecewise_affine if self.has_its_law else None

    def _frozen(self, *packed: Any) -> Callable[[Array], NDArray[Any]]:
        from sb3_yann.networks._kernels.yann_layer import frozen_layer

        return frozen_layer(*packed)

    def slopes_of_law(self, theta: Array) -> Array:
        """Return the derivatives (rows, m, n) of the law in [-1, 1], zero where it is clipped."""
        region = self.regions(th.as_tensor(theta))
        slopes: Array = self.gains[region].numpy().copy()
        raw = (slopes @ theta[..., None])[..., 0] + self.offsets[region].numpy()
        slopes[np.abs(raw) >= 1] = 0.0
        if self.infeasible == "zero_input":
            slopes[~self.piecewise_affine.in_domain(theta)] = 0.0
        return slopes

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
