"""How a map from observations to theta gets into SB3's actor and critic."""

from __future__ import annotations

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_yann.policy.observations import AffineObservation


class AffineFeatures(BaseFeaturesExtractor):
    """Observations (batch, ...) of any float type to theta (batch, n_theta) in float64."""

    matrix: th.Tensor
    offset: th.Tensor

    def __init__(
        self, observation_space: spaces.Space[Any], observation: AffineObservation
    ) -> None:
        super().__init__(observation_space, features_dim=observation.n_theta)
        self.register_buffer("matrix", th.as_tensor(observation.matrix.T.copy()))
        self.register_buffer("offset", th.as_tensor(observation.offset.copy()))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Return theta."""
        return th.addmm(self.offset, observations.flatten(1).double(), self.matrix)


def without_entries(
    theta: th.Tensor, lost: th.Tensor, extractor: BaseFeaturesExtractor | nn.Module
) -> th.Tensor:
    """Return theta at the operating point where it depends on entries that are lost.

    ``lost`` (batch, n_obs) names those of the observations.
    """
    if isinstance(extractor, AffineFeatures):
        lost = lost.double() @ (extractor.matrix != 0).double() > 0
    return theta.masked_fill(lost | ~theta.isfinite(), 0.0)


def keeps_entries(extractor: BaseFeaturesExtractor | nn.Module) -> bool:
    """Tell whether each entry of theta is that of the observation, in whatever units."""
    if not isinstance(extractor, AffineFeatures):
        return True
    matrix = extractor.matrix
    return matrix.shape[0] == matrix.shape[1] and bool(th.equal(matrix, matrix.diag().diag()))


class SeesTheta(BaseModel):
    """An actor or critic of SB3 whose features are theta, not rounded on the way."""

    def extract_features(
        self, obs: PyTorchObs, features_extractor: BaseFeaturesExtractor
    ) -> th.Tensor:
        """Return theta; SB3's preprocessing would round observations of float64 to float32."""
        if isinstance(features_extractor, AffineFeatures):
            theta: th.Tensor = features_extractor(obs)
            return theta
        if isinstance(obs, th.Tensor) and isinstance(features_extractor, FlattenExtractor):
            if obs.ndim == 2 and obs.dtype == th.float32:
                return obs  # what SB3 returns as well, after two dozen lines of Python
        return super().extract_features(obs, features_extractor)

    def set_training_mode(self, mode: bool) -> None:
        """Switch the mode, which SB3 asks for at every step, where it is another one."""
        if mode != self.training:
            super().set_training_mode(mode)
