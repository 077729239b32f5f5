"""The matrices of a linear plant about an operating point: sampling, names and units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sb3_yann._validation import Array, ReadOnlyArrays, check_type, is_text
from sb3_yann.control.gains import Gains


@dataclass(frozen=True, eq=False)
class LinearSystem(ReadOnlyArrays):
    """``x[k+1] = A x[k] + B u[k] + E d[k]`` about ``(x_ss, u_ss, d_ss)``: data, not validated.

    Linearization and identification return it; `LinearModel` validates it, and says what each
    field means.
    """

    A: Array
    B: Array
    dt: float
    x_ss: Array
    u_ss: Array
    E: Array
    d_ss: Array
    notes: tuple[str, ...] = ()
    drift: Array | None = None
    gains: Gains | None = None
    state_names: tuple[str, ...] = field(default=(), compare=False)
    input_names: tuple[str, ...] = field(default=(), compare=False)
    disturbance_names: tuple[str, ...] = field(default=(), compare=False)
    units: tuple[str, ...] = field(default=(), compare=False)
    estimated: tuple[int, ...] = field(default=(), compare=False)
    C: Array | None = None
    time_unit: str = field(default="", compare=False)

    @property
    def step_length(self) -> str:
        """The sampling time in words."""
        return f"{self.dt:.4g} {self.time_unit}".rstrip()

    @property
    def shown(self) -> Array:
        """The matrix (q, n) of the outputs that sensors show: C, or the identity."""
        return np.eye(self.n_states) if self.C is None else self.C

    @property
    def n_states(self) -> int:
        """Number of states n."""
        return int(self.A.shape[0])

    @property
    def n_inputs(self) -> int:
        """Number of inputs m."""
        return int(self.B.shape[1])

    @property
    def n_disturbances(self) -> int:
        """Number of disturbances d, measured and estimated."""
        return int(self.E.shape[1])

    @property
    def disturbance_labels(self) -> list[str]:
        """The names of the disturbances, ``d[i]`` where none is given."""
        plain = names((0, 0, self.n_disturbances))
        return [*self.disturbance_names, *plain[len(self.disturbance_names) :]]

    @property
    def measured(self) -> tuple[int, ...]:
        """Which disturbances are not said to be estimated."""
        return tuple(i for i in range(self.n_disturbances) if i not in self.estimated)


def names(sizes: Sequence[int]) -> list[str]:
    """Return ``x[0], ..., u[0], ..., d[0], ...`` for so many states, inputs and disturbances."""
    return [f"{k}[{i}]" for k, size in zip("xud", sizes, strict=False) for i in range(size)]


def combination(factors: Array, labels: Sequence[str], digits: int) -> str:
    """Return a linear combination in words, without the terms of factor 0."""
    kept = np.flatnonzero(factors)
    if kept.size == 1:
        return labels[int(kept[0])]
    return " ".join(f"{factors[i]:+.{digits}g} {labels[i]}" for i in kept).removeprefix("+")


def zero_order_hold(A: Array, B: Array, E: Array, dt: float) -> tuple[Array, Array, Array]:
    """Return A, B, E of ``dx/dt = A x + B u + E d`` in discrete time, u and d held for ``dt``."""
    import control  # imports matplotlib: only paid for where it is used

    m = B.shape[1]
    driven = np.hstack([B, E])
    plant = control.ss(A, driven, np.eye(len(A)), np.zeros(driven.shape))
    with np.errstate(all="ignore"):
        sampled = control.sample_system(plant, dt, method="zoh")
    if not np.all(np.isfinite(np.hstack([sampled.A, sampled.B]))):
        raise ValueError(
            f"Sampled every dt = {dt:g}, the continuous model has entries that are too large for "
            f"numbers; its poles are {np.linalg.eigvals(A)}. Look at the unit of time, sample more "
            "often, or give its states, inputs and disturbances other units."
        )
    return sampled.A, sampled.B[:, :m], sampled.B[:, m:]


Units = Mapping[str, str] | Sequence[str]


def as_names(what: str, given: Sequence[str], size: int) -> tuple[str, ...]:
    """Return so many different names, or none."""
    if isinstance(given, str) or not all(isinstance(each, str) for each in given):
        raise TypeError(f"{what} = {given!r} must be a list of str, one for each of the {size}.")
    found = tuple(given)
    if found and (len(found) != size or len(set(found)) != size or not all(found)):
        raise ValueError(
            f"{what} = {list(found)} must be {size} different names, or none: leave it out."
        )
    _require_text(what, found)
    return found


def _require_text(what: str, given: Sequence[str]) -> None:
    """Raise where a name holds what files in XML, HTML and UTF-8 cannot."""
    for each in given:
        if not all(map(is_text, each)):
            raise ValueError(
                f"{what}: {each!r} holds a character that is no text. Leave out line ends, escape "
                "sequences and other control characters."
            )


def as_units(given: Units, labels: Sequence[str], least: int) -> tuple[str, ...]:
    """Return the unit of each label, "" where there is none.

    Labels are states, inputs and named disturbances, which come after the ``least`` that need one.
    """
    if isinstance(given, Mapping):
        if unknown := [each for each in given if each not in labels]:
            raise ValueError(f"units has {unknown}, but the names are {list(labels)}.")
        given = [given.get(each, "") for each in labels]
    if isinstance(given, str) or not all(isinstance(each, str) for each in given):
        raise TypeError(f"units = {given!r} must map names to str, or list one for each.")
    found = tuple(given)
    if found and len(found) not in (least, len(labels)):
        raise ValueError(f"units = {list(found)} must have one entry for each of {list(labels)}.")
    _require_text("units", found)
    return found[: None if any(found[least:]) else least] if any(found) else ()


def as_unit(what: str, given: str) -> str:
    """Return one unit, which may be empty."""
    _require_text(what, [check_type(what, given, str, "a str, such as 's'")])
    return given


def labels_of(model: LinearSystem) -> tuple[list[str], list[str]]:
    """Return the names of states and of inputs, ``x[0]`` and ``u[0]`` where none is given."""
    plain = names((model.n_states, model.n_inputs))
    n = model.n_states
    return list(model.state_names) or plain[:n], list(model.input_names) or plain[n:]


def with_units(model: LinearSystem, units: bool = True) -> tuple[list[str], ...]:
    """Return the names of states, inputs and disturbances, with units in parentheses if any."""
    states, inputs = labels_of(model)
    found = [*states, *inputs, *model.disturbance_labels]
    for i, unit in enumerate(model.units if units else ()):
        found[i] += f" ({unit})" if unit else ""
    n, m = model.B.shape
    return found[:n], found[n : n + m], found[n + m :]


def labels_of_outputs(C: Array, states: Sequence[str]) -> list[str]:
    """Return what outputs ``C x`` are called: states by their names, if any, else ``y[i]``."""
    found = []
    for i, row in enumerate(C):
        at = np.flatnonzero(row)
        is_state = states and len(at) == 1 and row[at[0]] == 1
        found.append(states[at[0]] if is_state else f"y[{i}]")
    return found


def missing_observer(model: LinearSystem) -> str:
    """Return what a law or a policy of this model lacks; empty where nothing is estimated."""
    which = [model.disturbance_labels[i] for i in model.estimated]
    observer = "DisturbanceObserver" if which else "StateEstimator"
    if not np.array_equal(model.shown, np.eye(model.n_states)):
        which.insert(0, "The states")
    if not which:
        return ""
    verb = "are" if which[1:] or which[0] == "The states" else "is"
    return (
        f"{', '.join(which)} {verb} estimated: the {observer} is no part of the law or the policy. "
        "Whoever calls it runs the observer, and passes its estimates."
    )


def completed(
    model: LinearSystem, state_names: Sequence[str], input_names: Sequence[str], units: Units
) -> tuple[Sequence[str], Units]:
    """Return names of states and units with those of inputs on their way, where they are left out.

    Such are the last states of a model with dead time, named after an input with a lag: ``(k-1)``.
    """
    inputs = labels_of(model)[1]
    past = list[tuple[int, str]]()
    for label in reversed(model.state_names):
        name, lag, rest = label.partition("(k-")
        if name not in inputs or not rest.removesuffix(")").isdigit():
            break
        past.insert(0, (inputs.index(name), lag + rest))
    own = model.n_states - len(past)
    m = model.n_inputs
    if past and not isinstance(state_names, str) and len(state_names) == own and own:
        called = list(input_names) if len(input_names) == m else inputs
        state_names = [*state_names, *(called[j] + lag for j, lag in past)]
        if isinstance(units, Mapping):
            units = {called[j] + lag: units.get(called[j], "") for j, lag in past} | {**units}
    if past and not isinstance(units, str | Mapping) and len(units) == own + m:
        of_inputs = list(units[own:])
        units = [*units[:own], *(of_inputs[j] for j, _ in past), *of_inputs]
    return state_names, units
