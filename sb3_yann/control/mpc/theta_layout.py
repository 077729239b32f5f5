"""What the parameter theta of a problem holds, and where."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sb3_yann._validation import Array


@dataclass(frozen=True)
class ThetaLayout:
    """The layout of ``theta = [x, r, d, bounds, u_prev]`` with the parts that a problem uses.

    With a preview r holds the references of the present sample, then those of the next, and so on.
    So does d; estimated disturbances, which have no preview, come last in it.

    Attributes
    ----------
    n_states, n_references, n_disturbances : int
        Numbers of states x, tracked outputs, and measured or estimated disturbances.
    n_previous : int
        The inputs of the step before, ``u_prev``: all where their rate matters, or none.
    n_estimated : int
        How many of the disturbances are estimated.
    previews : tuple of int
        How many samples ahead references and measured disturbances are known.
    bounds : tuple of str
        The bounds that change at run time.

    Examples
    --------
    >>> ThetaLayout(n_states=1, n_references=1, previews=(1, 0)).names
    ('x[0]', 'r[0]', 'r_1[0]')
    """

    n_states: int
    n_references: int = 0
    n_disturbances: int = 0
    n_previous: int = 0
    n_estimated: int = 0
    previews: tuple[int, int] = (0, 0)
    bounds: tuple[str, ...] = ()

    @property
    def size(self) -> int:
        """Number of entries of theta."""
        return int(self.previous.stop)

    @property
    def has_constants(self) -> bool:
        """Whether theta holds a reference or a disturbance: it has many steady states then."""
        return self.n_references + self.n_disturbances > 0

    @property
    def state(self) -> slice:
        """The entries of x."""
        return slice(0, self.n_states)

    @property
    def reference(self) -> slice:
        """The entries of r, with those of the preview."""
        return _after(self.state, self.n_references * (1 + self.previews[0]))

    @property
    def disturbance(self) -> slice:
        """The entries of d, with those of the preview."""
        return _after(self.reference, self.n_disturbances + self.previews[1] * self._loads)

    @property
    def limits(self) -> slice:
        """The entries of the bounds that change at run time."""
        return _after(self.disturbance, len(self.bounds))

    @property
    def constant(self) -> slice:
        """The entries of r, d and bounds, which an episode prescribes."""
        return slice(self.n_states, self.limits.stop)

    @property
    def previous(self) -> slice:
        """The entries of the previous input."""
        return _after(self.limits, self.n_previous)

    @cached_property
    def now(self) -> NDArray[np.intp]:
        """The entries of r and d of the present sample, (p + d,)."""
        return self.sample(0)

    @cached_property
    def last(self) -> NDArray[np.intp]:
        """The entries of r and d of the last sample that is known, which stay, (p + d,)."""
        return self.sample(max(self.previews))

    @property
    def _loads(self) -> int:
        return self.n_disturbances - self.n_estimated

    @property
    def _known_ahead(self) -> tuple[tuple[int, int, int], ...]:
        """Return the first entry, the number and the preview of references and of loads."""
        first = self.reference.start, self.disturbance.start
        counts = self.n_references, self._loads
        return tuple(zip(first, counts, self.previews, strict=True))

    def sample(self, ahead: int) -> NDArray[np.intp]:
        """Return the entries of r and d so many samples ahead, of the last that are known."""
        parts = [
            np.arange(count) + first + count * min(known, ahead)
            for first, count, known in self._known_ahead
        ]
        until = self.disturbance.stop
        parts.append(np.arange(until - self.n_estimated, until))
        return np.asarray(np.concatenate(parts), np.intp)

    @property
    def settled(self) -> ThetaLayout:
        """The layout without previews."""
        return replace(self, previews=(0, 0))

    @cached_property
    def settles(self) -> NDArray[np.intp]:
        """The entries of theta that make up that of :attr:`settled`, with the last r and d."""
        every = np.arange(self.size)
        rest = self.limits.start
        return np.asarray(np.concatenate([every[self.state], self.last, every[rest:]]), np.intp)

    @cached_property
    def lift(self) -> Array:
        """The map (n_theta, n_settled) to the theta whose r and d do not change."""
        found = np.zeros((self.size, len(self.settles)))
        found[self.settles, np.arange(len(self.settles))] = 1.0
        for first, count, ahead in self._known_ahead:
            stays = found[first + count * ahead : first + count * (ahead + 1)]
            found[first : first + count * ahead] = np.tile(stays, (ahead, 1))
        return found

    @cached_property
    def next(self) -> NDArray[np.intp]:
        """Which entry of theta takes the place of each one sample later (n_theta,)."""
        found = np.arange(self.size)
        for first, count, ahead in self._known_ahead:
            found[first : first + count * ahead] += count
        return found

    @property
    def names(self) -> tuple[str, ...]:
        """A name for each entry, such as ``x[0]``, ``r[0]``, ``r_2[0]``, ``d[0]``, ``u_prev[0]``.

        ``r_2`` is the reference two samples ahead.
        """
        parts = [("x", range(self.n_states))]
        for name, (_, count, ahead) in zip("rd", self._known_ahead, strict=True):
            parts += [(f"{name}_{k}" if k else name, range(count)) for k in range(ahead + 1)]
        parts.append(("d", range(self._loads, self.n_disturbances)))
        found = [f"{name}[{i}]" for name, numbers in parts for i in numbers]
        return (*found, *self.bounds, *(f"u_prev[{i}]" for i in range(self.n_previous)))


def _after(part: slice, size: int) -> slice:
    return slice(part.stop, part.stop + size)
