"""The YANN actor layer by layer as Braniff & Tian draw it: a reference, not the working path.

It is slower than :class:`YannLayer`, doubles the output on facets (where two regions are active)
and loses digits to the suppression constant. Its count of parameters is that of the paper.
"""

from __future__ import annotations

import numpy as np
import torch as th
from torch import nn

from sb3_yann.control.law import PiecewiseAffine


class PaperYann(nn.Module):
    """theta -> u in physical units, (batch, n) -> (batch, m), zero outside every region.

    Three layers identify the region, beside all affine laws with both signs and a network of
    ``p h`` nodes in two layers. A layer of ReLUs suppresses inactive regions; the last layer adds
    up the rest. The network's second layer is dense across regions, as the paper's count demands.

    Parameters
    ----------
    law : PiecewiseAffine
        p regions, q half-spaces.
    width : int
        Nodes h for each region and layer.

    Examples
    --------
    >>> from sb3_yann_envs import problems
    >>> PaperYann(problems.cstr().explicit(), width=4)(th.zeros(2, 4)).shape
    torch.Size([2, 1])
    """

    def __init__(self, law: PiecewiseAffine, width: int) -> None:
        super().__init__()
        p = law.n_regions
        m = law.n_inputs
        n = law.n_theta
        counts = np.diff([*law.starts, law.n_halfspaces])
        owner = np.repeat(np.eye(p), counts, axis=1)  # (p, q): which region a half-space bounds
        sign = np.array([1.0, -1.0])
        gains = np.concatenate([s * law.gains.reshape(p * m, n) for s in sign])
        offsets = np.concatenate([s * law.offsets.reshape(p * m) for s in sign])

        # Rows of the suppression layer: (sign, region, output). It takes the indicators, the
        # signed laws and the nodes of the network; node j of a region serves output j mod m.
        middle = (law.theta_max + law.theta_min) / 2
        radius = (law.theta_max - law.theta_min) / 2
        largest = np.abs(law.gains @ middle + law.offsets) + np.abs(law.gains) @ radius
        suppression = largest.max() + width  # the nodes of a region add up to at most width
        active = np.tile(np.kron(np.eye(p), np.ones((m, 1))), (2, 1))
        share = np.array([[float(j % m == i) for j in range(width)] for i in range(m)])
        nodes = np.concatenate([s * np.kron(np.eye(p), share) for s in sign])
        suppress = np.hstack([suppression * active, np.eye(2 * p * m), nodes])

        fixed = {
            "half_spaces": -law.A,
            "half_spaces_bias": law.b,
            "all_hold": owner,
            "all_hold_bias": 0.5 - counts,
            "indicator": np.eye(p),
            "laws": gains,
            "laws_bias": offsets,
            "suppress": suppress,
            "suppress_bias": np.full(2 * p * m, -suppression),
            "add": np.kron(sign[None], np.tile(np.eye(m), p)),
        }
        dtype = th.get_default_dtype()
        values = {name: th.tensor(each, dtype=dtype) for name, each in fixed.items()}
        self.fixed = nn.ParameterDict(values).requires_grad_(False)
        half = width // 2
        order = np.arange(width)
        order[: 2 * half] = np.roll(order[: 2 * half], half)  # an odd node is left to itself
        partner = (np.arange(p)[:, None] * width + order).ravel()
        self.register_buffer("partner", th.as_tensor(partner), persistent=False)
        first = th.empty(p, width, n + 1).uniform_(-0.01, 0.01)
        first[:, half : 2 * half] = -first[:, :half]
        first[:, 2 * half :] = 0
        first = first.reshape(p * width, n + 1)
        self.first_weight = nn.Parameter(first[:, :-1].clone())
        self.first_bias = nn.Parameter(first[:, -1].clone())
        self.second_weight = nn.Parameter(th.empty(p * width, p * width).uniform_(-0.01, 0.01))

    partner: th.Tensor

    def forward(self, theta: th.Tensor) -> th.Tensor:
        """Return u, shape (batch, m), for theta of shape (batch, n)."""
        w = self.fixed
        holds = (theta @ w["half_spaces"].T + w["half_spaces_bias"] >= 0).to(theta)
        active = (holds @ w["all_hold"].T + w["all_hold_bias"] >= 0).to(theta) @ w["indicator"].T
        laws = theta @ w["laws"].T + w["laws_bias"]
        weight = self.first_weight + self.first_weight[self.partner]
        bias = self.first_bias + self.first_bias[self.partner]
        nodes = th.tanh(th.tanh(theta @ weight.T + bias) @ self.second_weight.T)
        joined = th.cat([active, laws, nodes], dim=1)
        u: th.Tensor = th.relu(joined @ w["suppress"].T + w["suppress_bias"]) @ w["add"].T
        return u
