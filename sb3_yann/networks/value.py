"""The state-action value of the linear plant, exactly, plus a network that is zero at first."""

from __future__ import annotations

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from sb3_yann.networks.zero_output import Activation, ZeroOutputNetwork


class QuadraticStateActionValue(nn.Module):
    """``Q(theta, a) = -[theta; u]' M [theta; u] + network``: u now, the law ever after.

    ``u`` is the input in physical units for an action ``a`` in [-1, 1]. Both parts are zero at
    ``theta = 0, u = 0`` and stay so.

    M is trained in scaled entries, ``M = D M^ D`` with ``D = sqrt(|diag M|)`` kept constant: the
    raw entries of a real plant span many orders of magnitude, and a step of Adam, which is the
    same for every entry, would flip the sign of the smallest. Those of ``M^`` are about 1.

    Parameters
    ----------
    M : ndarray, shape (n + m, n + m)
        From :meth:`LinearMPC.state_action_matrix`.
    theta_half : ndarray, shape (n,)
        Half the width of the box of theta, by which the network scales its input.
    u_min, u_max : ndarray, shape (m,)
        The inputs at action -1 and 1.
    hidden : tuple of int, default (64, 64)
    activation : callable, default torch.tanh
    """

    root: th.Tensor
    to_input: th.Tensor
    middle: th.Tensor
    network_scale: th.Tensor

    def __init__(
        self,
        M: NDArray[np.float64],
        theta_half: NDArray[np.float64],
        u_min: NDArray[np.float64],
        u_max: NDArray[np.float64],
        hidden: tuple[int, ...] = (64, 64),
        activation: Activation = th.tanh,
    ) -> None:
        super().__init__()
        n, m = len(theta_half), len(u_min)
        diagonal = np.abs(np.diag(M))
        root = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        # Float64: along the law the terms of the form cancel, by a factor of up to some hundreds.
        self.entries = nn.Parameter(th.as_tensor(M / np.outer(root, root), dtype=th.float64))
        reach = (u_max - u_min) / 2
        constants = {
            "root": root,
            "to_input": np.concatenate([np.ones(n), reach]),
            "middle": np.concatenate([np.zeros(n), (u_max + u_min) / 2]),
            "network_scale": 1 / np.concatenate([theta_half, reach]),
        }
        for name, value in constants.items():
            self.register_buffer(name, th.as_tensor(value, dtype=th.float64))
        self.network = ZeroOutputNetwork(
            n + m, 1, hidden, activation=activation, pinned=th.ones(1, dtype=th.bool)
        )

    def forward(self, theta_and_action: th.Tensor) -> th.Tensor:
        """Return Q, shape (batch, 1), for rows ``[theta, a]`` of shape (batch, n + m)."""
        z = theta_and_action * self.to_input + self.middle
        weighted = z * self.root
        quadratic = ((weighted @ self.entries) * weighted).sum(-1, keepdim=True)
        learnt: th.Tensor = self.network((z * self.network_scale).float())
        return learnt - quadratic.float()
