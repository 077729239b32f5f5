"""What a plant does beyond its linear model, as a function of states, disturbances and inputs.

A residual is fitted and asked in scaled coordinates: features z, and outputs in the units of what
the linear model leaves unexplained.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import combinations_with_replacement
from typing import Any, Protocol

import numpy as np
from scipy import linalg

from sb3_yann._validation import Array, check_int

STEP = 1e-4
"""Of a finite difference, in scaled coordinates."""


class Residual(Protocol):
    """A function from z (batch, k) to the residual (batch, n)."""

    def predict(self, z: Array) -> Array:
        """Return the residual (batch, n)."""

    def jacobian(self, z: Array) -> Array:
        """Return its derivatives (batch, n, k)."""


class ZeroResidual:
    """The linear model as it is."""

    def __init__(self, n: int) -> None:
        self.n = n

    def predict(self, z: Array) -> Array:
        """Return zeros (batch, n)."""
        return np.zeros((len(z), self.n))

    def jacobian(self, z: Array) -> Array:
        """Return zeros (batch, n, k)."""
        return np.zeros((len(z), self.n, z.shape[1]))


@dataclass(frozen=True)
class Monomials:
    """All monomials of k variables up to a degree, without the constant one.

    Attributes
    ----------
    k, degree : int
    parents, variables : tuple of ndarray
        Of each degree from 2 on: monomial i is ``parents[i]`` of the degree below, times one of
        the variables.
    """

    k: int
    degree: int
    parents: tuple[Any, ...] = field(init=False)
    variables: tuple[Any, ...] = field(init=False)

    def __post_init__(self) -> None:
        parents, variables = [], []
        below: dict[tuple[int, ...], int] = {(j,): j for j in range(self.k)}
        for degree in range(2, self.degree + 1):
            powers = [*combinations_with_replacement(range(self.k), degree)]
            parents.append(np.array([below[each[:-1]] for each in powers]))
            variables.append(np.array([each[-1] for each in powers]))
            below = {each: i for i, each in enumerate(powers)}
        object.__setattr__(self, "parents", tuple(parents))
        object.__setattr__(self, "variables", tuple(variables))

    def holding(self, first: int) -> Array:
        """Return which monomials hold a variable from number ``first`` on, as bools (size,)."""
        blocks = [np.arange(self.k) >= first]
        for parents, variables in zip(self.parents, self.variables, strict=True):
            blocks.append(blocks[-1][parents] | (variables >= first))
        return np.concatenate(blocks)

    def values(self, z: Array) -> Array:
        """Return the monomials at z (..., k): (..., size)."""
        blocks = [z]
        for parents, variables in zip(self.parents, self.variables, strict=True):
            blocks.append(blocks[-1][..., parents] * z[..., variables])
        return np.concatenate(blocks, axis=-1)

    def slopes(self, z: Array, weights: Array) -> Array:
        """Return the derivatives (..., k, n) at z (..., k) of ``values(z) @ weights``.

        Backward: what a monomial is worth passes to its parent and to its variable.
        """
        blocks = [z]
        for parents, variables in zip(self.parents, self.variables, strict=True):
            blocks.append(blocks[-1][..., parents] * z[..., variables])
        n = weights.shape[-1]
        edges = np.cumsum([0, *(each.shape[-1] for each in blocks)])
        out = np.zeros((*z.shape, n))
        worth = np.broadcast_to(weights[..., edges[-2] :, :], (*blocks[-1].shape, n))
        for level in range(len(blocks) - 1, 0, -1):
            parents, variables = self.parents[level - 1], self.variables[level - 1]
            below = blocks[level - 1]
            to_variable = worth * below[..., parents, None]
            to_parent = worth * z[..., variables, None]
            select = np.zeros((self.k, len(variables)))
            select[variables, np.arange(len(variables))] = 1.0
            out += select @ to_variable
            gather = np.zeros((below.shape[-1], len(parents)))
            gather[parents, np.arange(len(parents))] = 1.0
            worth = gather @ to_parent + weights[..., edges[level - 1] : edges[level], :]
        return out + worth


class Polynomial:
    """A polynomial without a constant term: the equilibrium stays where it is.

    Its coefficients are those of a ridge regression, shrunk towards the linear model.

    Parameters
    ----------
    degree : int
    shrinkage : float
        Weight of the squared coefficients, times the number of samples.
    offset : bool, default False
        Whether there is a constant term after all.
    inputs : tuple of int and float, default (0, 1)
        How many of the last variables are inputs, and how many times as strongly what holds one of
        them is shrunk: the log of a closed loop tells little about them.
    towards : ndarray, shape (k, n), optional
        The linear coefficients that it is shrunk towards.
    """

    def __init__(
        self,
        degree: int,
        shrinkage: float,
        offset: bool = False,
        inputs: tuple[int, float] = (0, 1.0),
        towards: Array | None = None,
    ) -> None:
        self.degree, self.shrinkage = check_int("degree", degree), shrinkage
        self.offset, self.inputs, self.towards = offset, inputs, towards

    @classmethod
    def stack(cls, members: Sequence[Polynomial]) -> Polynomial:
        """Return fitted ones as one, from z (members, batch, k) to (members, batch, n)."""
        first = members[0]
        found = cls(first.degree, first.shrinkage, first.offset, first.inputs)
        found.monomials = first.monomials
        found.weights = np.array([each.weights for each in members])
        return found

    def fit(self, z: Array, y: Array) -> Polynomial:
        """Fit to residuals y (N, n) at z (N, k)."""
        self.solve(*self.moments(z, y))
        return self

    def moments(self, z: Array, y: Array) -> tuple[Monomials, Array, Array, int]:
        """Return the monomials, and the sums of their products with each other and with y."""
        self.monomials = Monomials(z.shape[1], self.degree)
        F = self._features(z)
        return self.monomials, F.T @ F, F.T @ y, len(z)

    def solve(self, monomials: Monomials, gram: Array, cross: Array, count: int) -> None:
        """Fit to the moments of some data, which polynomials of other shrinkages may share.

        Parameters
        ----------
        monomials, gram, cross, count : Monomials, ndarray, ndarray and int
            As :meth:`moments` returns them.
        """
        self.monomials = monomials
        number, factor = self.inputs
        own = self.monomials.holding(self.monomials.k - number)
        ridge = self.shrinkage * count * np.where(own, factor, 1.0)
        if self.offset:
            ridge = np.append(ridge, 1e-9 * count)  # a constant is not shrunk
        matrix = linalg.cho_factor(gram + np.diag(ridge + 1e-12 * count))
        about, k = np.zeros(cross.shape), self.monomials.k
        if self.towards is not None:
            about[:k] = self.towards
        self.weights = about + np.asarray(linalg.cho_solve(matrix, cross - gram @ about))

    def _features(self, z: Array) -> Array:
        F = self.monomials.values(z)
        return np.concatenate([F, np.ones((*F.shape[:-1], 1))], axis=-1) if self.offset else F

    def predict(self, z: Array) -> Array:
        """Return the residual (batch, n)."""
        return np.asarray(self._features(z) @ self.weights)

    def jacobian(self, z: Array) -> Array:
        """Return its derivatives (batch, n, k)."""
        weights = self.weights[..., :-1, :] if self.offset else self.weights
        # Between the members of a stack and their monomials is the batch.
        slopes = self.monomials.slopes(z, np.expand_dims(weights, -3))
        return np.asarray(np.swapaxes(slopes, -1, -2))


def as_polynomials(members: Sequence[Any], k: int) -> tuple[Any, Any, Array] | None:
    """Return residuals of k variables as arrays for compiled code, None where one is no polynomial.

    Monomial k + i is monomial ``parents[i]`` times variable ``variables[i]``, its weights are
    ``weights[:, k + i]`` (members, n). A constant one comes last, if there is one.
    """
    none, first = np.empty(0, np.int64), members[0]
    if all(isinstance(each, ZeroResidual) for each in members):
        return none, none, np.zeros((len(members), k, first.n))
    if not all(isinstance(each, Polynomial) for each in members):
        return None
    below, parents, found = 0, [none], first.monomials
    for each, size in zip(found.parents, [k, *map(len, found.parents)], strict=False):
        parents.append(below + each)
        below += size
    weights = np.array([each.weights for each in members])
    return np.concatenate(parents), np.concatenate([none, *found.variables]), weights


class Regressor:
    """Anything with ``fit`` and ``predict``, as scikit-learn has it; differences for derivatives.

    Parameters
    ----------
    make : callable
        Returns a new one.
    """

    def __init__(self, make: Callable[[], Any]) -> None:
        self.make = make

    def fit(self, z: Array, y: Array) -> Regressor:
        """Fit to residuals y (N, n) at z (N, k)."""
        self.estimator, self.n = self.make(), y.shape[1]
        if not all(callable(getattr(self.estimator, name, None)) for name in ("fit", "predict")):
            raise TypeError(
                f"residuals holds a function that made {self.estimator!r}; it must make a "
                "regressor with fit(z, y) and predict(z), as scikit-learn has it."
            )
        self.estimator.fit(z, y)
        return self

    def predict(self, z: Array) -> Array:
        """Return the residual (batch, n)."""
        found = np.asarray(self.estimator.predict(z), np.float64)
        if found.size != len(z) * self.n:
            raise ValueError(
                f"A residual of residuals= predicts shape {found.shape} for {len(z)} rows, "
                f"expected ({len(z)}, {self.n})."
            )
        return found.reshape(len(z), self.n)

    def jacobian(self, z: Array) -> Array:
        """Return its derivatives (batch, n, k), by central differences."""
        batch, k = z.shape
        moved = z + STEP * np.concatenate([np.eye(k), -np.eye(k)])[:, None]
        found = self.predict(moved.reshape(-1, k)).reshape(2, k, batch, self.n)
        return np.moveaxis((found[0] - found[1]) / (2 * STEP), 0, -1)
