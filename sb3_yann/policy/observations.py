"""What an env's observation says of the parameter of the law, theta: an affine map."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import ArrayLike
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize
from torch import nn

from sb3_yann._validation import Array, ReadOnlyArrays, check_array, check_int
from sb3_yann.control import LinearMPC, with_extra


@dataclass(frozen=True, eq=False)
class AffineObservation(ReadOnlyArrays):
    """The map ``theta = matrix @ obs + offset`` from an observation to theta in plant units.

    For ``policy_kwargs={"observation": ...}``. It flattens an observation in C order, and computes
    in float64. Maps compose like matrices: ``outer @ inner`` applies ``inner`` first.

    Parameters
    ----------
    matrix : array_like, shape (n_theta, n_obs)
    offset : array_like, shape (n_theta,), optional
        Zeros if left out.

    Examples
    --------
    The env shows ``(T - 400) / 20``.

    >>> seen = AffineObservation.normalized([400], [20])
    >>> seen([0.5])
    array([410.])
    """

    matrix: Array
    offset: Array = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        matrix = check_array("matrix", self.matrix, ("n_theta", "n_obs"))
        offset = np.zeros(len(matrix)) if self.offset is None else self.offset
        self._store(matrix=matrix, offset=check_array("offset", offset, (len(matrix),)))

    @classmethod
    def identity(cls, size: int) -> AffineObservation:
        """Return ``theta = obs``."""
        return cls(np.eye(check_int("size", size)))

    @classmethod
    def deviation(cls, x_ss: ArrayLike) -> AffineObservation:
        """Return ``theta = obs - x_ss``, for a problem about zero that is not the env's, (n,)."""
        steady = check_array("x_ss", x_ss, ("n",))
        return cls(np.eye(len(steady)), -steady)

    @classmethod
    def normalized(cls, mean: ArrayLike, std: ArrayLike) -> AffineObservation:
        """Return ``theta = std * obs + mean``: the env shows ``(theta - mean) / std``, (n,)."""
        middle = check_array("mean", mean, ("n",))
        spread = check_array("std", std, (len(middle),))
        if np.any(spread == 0):
            raise ValueError(f"std = {spread.tolist()} must not be zero: nothing would be seen.")
        return cls(np.diag(spread), middle)

    @classmethod
    def rescaled(
        cls, low: ArrayLike, high: ArrayLike, to: tuple[float, float] = (-1.0, 1.0)
    ) -> AffineObservation:
        """Return the map of an env that shows [low, high], (n,), as `RescaleObservation` does."""
        bottom = check_array("low", low, ("n",))
        top = check_array("high", high, (len(bottom),))
        start, end = check_array("to", to, (2,))
        if np.any(top <= bottom) or not end > start:
            raise ValueError(
                f"low = {bottom.tolist()} must lie below high = {top.tolist()}, and to = {to} rise."
            )
        slope = (top - bottom) / (end - start)
        return cls(np.diag(slope), bottom - slope * start)

    @classmethod
    def pick(cls, entries: Sequence[int], size: int) -> AffineObservation:
        """Return ``theta[i] = obs[entries[i]]``, of an observation with ``size`` entries."""
        return cls(_rows("entries", entries, size))

    @classmethod
    def minus_set_point(
        cls, entries: Sequence[int], set_points: Sequence[int | None], size: int
    ) -> AffineObservation:
        """Return ``theta[i] = obs[entries[i]] - obs[set_points[i]]``, None for no set-point."""
        matrix = _rows("entries", entries, size)
        if np.ndim(set_points) != 1 or len(set_points) != len(matrix):  # type: ignore[arg-type]
            raise ValueError(
                f"set_points = {set_points!r} must have an item for each of the {len(matrix)} "
                "entries; write None for an entry without a set-point."
            )
        for row, set_point in zip(matrix, set_points, strict=True):
            if set_point is not None:
                row -= _rows("set_points", [set_point], size)[0]
        return cls(matrix)

    @classmethod
    def newest_frame(cls, size: int, frames: int) -> AffineObservation:
        """Return ``theta = `` the newest, last, of ``frames`` observations of ``size`` entries."""
        frames = check_int("frames", frames)
        size = check_int("size", size)
        return cls.pick(range((frames - 1) * size, frames * size), frames * size)

    @classmethod
    def from_vec_normalize(cls, venv: VecEnv) -> AffineObservation:
        """Return the map that undoes the frozen statistics of a `VecNormalize`.

        The policy takes normalized observations from then on, also where it is loaded alone.
        """
        normalize = unwrap_vec_normalize(venv)
        if normalize is None:
            raise ValueError(f"venv = {venv} holds no VecNormalize; wrap it in one, or leave it.")
        require_frozen(normalize)
        require_outermost(normalize, venv.observation_space.shape)
        if not normalize.norm_obs:
            return cls.identity(int(np.prod(cast(tuple[int, ...], venv.observation_space.shape))))
        mean, var = statistics_of(normalize)
        return cls.normalized(np.ravel(mean), np.ravel(np.sqrt(var + normalize.epsilon)))

    @property
    def n_theta(self) -> int:
        """Number of parameters of the law."""
        return int(self.matrix.shape[0])

    @property
    def n_obs(self) -> int:
        """Number of entries of an observation."""
        return int(self.matrix.shape[1])

    def __call__(self, observation: ArrayLike) -> Array:
        """Return theta, (n_theta,) or (batch, n_theta), for (n_obs,) or (batch, n_obs)."""
        return np.asarray(np.asarray(observation, dtype=np.float64) @ self.matrix.T + self.offset)

    def __matmul__(self, inner: AffineObservation) -> AffineObservation:
        """Return the map that applies ``inner`` first and this one to what comes out."""
        if not isinstance(inner, AffineObservation):
            return NotImplemented
        if inner.n_theta != self.n_obs:
            raise ValueError(
                f"The inner map puts out {inner.n_theta} entries, the outer one takes {self.n_obs}."
            )
        return AffineObservation(self.matrix @ inner.matrix, self(inner.offset))

    def __hash__(self) -> int:
        """Return a hash that equal maps share."""
        return hash((self.matrix.tobytes(), self.offset.tobytes()))

    def __repr__(self) -> str:
        """Name the matrix and the offset, so that it can be pasted."""
        return f"AffineObservation(matrix={self.matrix.tolist()}, offset={self.offset.tolist()})"


def to_deviations(given: AffineObservation | None, problem: LinearMPC) -> AffineObservation | None:
    """Return the map from what an env shows to theta as the law takes it, None for the identity."""
    if not np.any(problem.theta_ss):
        return given
    shifted = AffineObservation.deviation(problem.theta_ss)
    return shifted if given is None else shifted @ given


def with_extra_shown(
    problem: LinearMPC, space: spaces.Space[Any], observation: AffineObservation | None, extra: int
) -> tuple[LinearMPC, AffineObservation | None]:
    """Return the problem with extra signals, and the map from what an env shows to its theta."""
    box: Any = space
    low, high = (np.ravel(side).astype(np.float64) for side in (box.low, box.high))
    size = len(low) - extra
    if size < 1 or not np.all(np.isfinite([low[size:], high[size:]])):
        raise ValueError(
            f"extra = {extra}, but the last entries of the observation space end at "
            f"{low[-extra:].tolist()} and {high[-extra:].tolist()}: networks need finite bounds of "
            "extra signals. Give the space such bounds, or the problem: with_extra(mpc, low, high)."
        )
    found = with_extra(problem, low[size:], high[size:])
    theta = AffineObservation.identity(problem.n_theta) if observation is None else observation
    if theta.n_obs != size:
        raise ValueError(
            f"The observation has {len(low)} entries, the last {extra} of them extra signals; "
            f"theta is made of {theta.n_obs} others. See extra= and observation=."
        )
    entries = found.extra[-extra:]
    rest = np.setdiff1d(np.arange(found.n_theta), entries)
    matrix = np.zeros((found.n_theta, len(low)))
    offset = np.zeros(found.n_theta)
    matrix[rest, :size] = theta.matrix
    offset[rest] = theta.offset
    matrix[entries, size:] = np.eye(extra)
    same = observation is None and np.array_equal(matrix, np.eye(len(low)))
    return found, None if same else AffineObservation(matrix, offset)


def normalized(model: BaseAlgorithm, observations: Any) -> Any:
    """Return observations as a model's policy has them, of an env below any VecNormalize."""
    normalize = model.get_vec_normalize_env()
    return observations if normalize is None else normalize.normalize_obs(np.asarray(observations))


IN_YAML = "In RL Zoo's hyperparameters leave normalize out."
"""The other way out of a VecNormalize, for those who never saw it made."""


def require_frozen(normalize: VecNormalize) -> None:
    """Raise if a VecNormalize changes what it has said, or changes the rewards."""
    if normalize.norm_reward:
        raise ValueError(
            "VecNormalize normalizes rewards: they are not the cost that the critic stands for. "
            "Set venv.norm_reward = False; CriticOptions(reward_scale=...) takes a constant "
            f"factor. {IN_YAML}"
        )
    if normalize.norm_obs and normalize.training:
        raise ValueError(
            "VecNormalize still moves its statistics: one observation means another state at each "
            f"step. Collect them first. Set venv.training = False then. {IN_YAML}"
        )


def statistics_of(normalize: VecNormalize) -> tuple[Array, Array]:
    """Return mean and variance of what a VecNormalize normalizes, as they are now."""
    statistics = cast(RunningMeanStd, normalize.obs_rms)  # a dict only for a space of dicts
    return statistics.mean.copy(), statistics.var.copy()


def require_same_statistics(model: BaseAlgorithm) -> None:
    """Raise if the VecNormalize of a model has changed since its policy was made."""
    normalize = model.get_vec_normalize_env()
    if normalize is None:
        return
    require_frozen(normalize)
    known = getattr(model, "vec_normalize_statistics", None) if normalize.norm_obs else None
    if known and not all(map(np.array_equal, known, statistics_of(normalize))):
        raise ValueError(
            "The statistics of VecNormalize are others than when the model was made, and the "
            "policy undoes those: it would take one state for another. Put them back "
            "(VecNormalize.load), or make the model anew."
        )


def require_outermost(normalize: VecNormalize, seen: tuple[int, ...] | None) -> None:
    """Raise unless the learner sees, in the shape ``seen``, what a VecNormalize shows."""
    if (shape := normalize.observation_space.shape) is None or shape != seen:
        raise ValueError(
            f"VecNormalize shows {shape}, but the learner sees {seen}. Make VecNormalize the last "
            "wrapper, outside VecFrameStack."
        )


def _rows(name: str, entries: Sequence[int], size: int) -> Array:
    """Return the rows (k, size) of the identity that pick so many entries of an observation."""
    size = check_int("size", size)
    found = [*entries] if isinstance(entries, Iterable) else [None]
    if not all(isinstance(each, int | np.integer) and 0 <= each < size for each in found):
        given = found if isinstance(entries, Iterable) else entries
        raise ValueError(f"{name} = {given!r} must be a list of indices from 0 to {size - 1}.")
    return np.eye(size)[found]


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


def without_entries(theta: th.Tensor, lost: th.Tensor, extractor: nn.Module) -> th.Tensor:
    """Return theta at the operating point where it depends on lost entries (batch, n_obs)."""
    if isinstance(extractor, AffineFeatures):
        lost = lost.double() @ (extractor.matrix != 0).double() > 0
    return theta.masked_fill(lost | ~theta.isfinite(), 0.0)


def keeps_entries(extractor: nn.Module) -> bool:
    """Tell whether each entry of theta is that of the observation, in whatever units."""
    if not isinstance(extractor, AffineFeatures):
        return True
    return bool(th.equal(extractor.matrix, extractor.matrix.diag().diag()))


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
