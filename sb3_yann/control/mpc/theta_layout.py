"""What the parameter theta of a problem holds, and where."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ThetaLayout:
    """The layout of ``theta = [x, r, d, u_prev]`` with the parts that a problem uses.

    Attributes
    ----------
    n_states, n_references, n_disturbances : int
        Numbers of states x, tracked outputs r, and measured or estimated disturbances d.
    n_previous : int
        The inputs of the step before, ``u_prev``: all where their rate matters, or none.

    Examples
    --------
    >>> ThetaLayout(n_states=2, n_references=1).names
    ('x[0]', 'x[1]', 'r[0]')
    """

    n_states: int
    n_references: int = 0
    n_disturbances: int = 0
    n_previous: int = 0

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
        """The entries of r."""
        return slice(self.n_states, self.n_states + self.n_references)

    @property
    def disturbance(self) -> slice:
        """The entries of d."""
        return slice(self.reference.stop, self.reference.stop + self.n_disturbances)

    @property
    def constant(self) -> slice:
        """The entries of r and d, which the prediction holds constant."""
        return slice(self.n_states, self.disturbance.stop)

    @property
    def previous(self) -> slice:
        """The entries of the previous input."""
        return slice(self.disturbance.stop, self.disturbance.stop + self.n_previous)

    @property
    def names(self) -> tuple[str, ...]:
        """A name for each entry, such as ``x[0]``, ``r[0]``, ``d[0]`` or ``u_prev[0]``."""
        sizes = self.n_states, self.n_references, self.n_disturbances, self.n_previous
        parts = zip(("x", "r", "d", "u_prev"), sizes, strict=True)
        return tuple(f"{name}[{i}]" for name, size in parts for i in range(size))
