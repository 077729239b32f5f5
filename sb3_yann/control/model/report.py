"""The report of a linear model: poles, controllability, scaling and sampling in words."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from sb3_yann._validation import Array
from sb3_yann.control.gains import CURVED, NORMAL, ON_CIRCLE, SURE_ERRORS, UNTOLD, Gains
from sb3_yann.control.linear_system import LinearSystem, combination, labels_of, with_units
from sb3_yann.log import in_names

MAY_INTEGRATE = f"may integrate: it is 1 within {SURE_ERRORS:g} standard errors"
GONE = 0.1  # time constant, in samples, below which a mode counts as a delay


def describe(model: LinearSystem) -> str:
    """Return the report of `LinearModel.report`."""
    others = _beside(model, model.gains)
    modes = [
        f"  {_number(pole)}: " + (_mode(pole, model) if np.any(pole == others) else MAY_INTEGRATE)
        for pole in poles(model)
    ]
    lines = [*_head(model), "Poles:", *modes, _stability(model, others)]
    lines += [*_reach(model), *_scaling(model), *_gains(model), *_sampling(model)]
    names = {"x": model.state_names, "u": model.input_names, "d": model.disturbance_names}
    return "\n".join([*lines, *(f"Note: {in_names(note, **names)}" for note in model.notes)])


def _head(model: LinearSystem) -> list[str]:
    counts = (model.n_states, model.n_inputs, model.n_disturbances)
    words = zip(counts, ("state", "input", "disturbance"), strict=True)
    sizes = ", ".join(f"{count} {word}{'s' * (count != 1)}" for count, word in words)
    if model.estimated:
        which = ", ".join(model.disturbance_labels[i] for i in model.estimated)
        sizes += f" (an observer estimates {which})"
    point = f"x_ss = {_vector(model.x_ss)}, u_ss = {_vector(model.u_ss)}"
    if model.n_disturbances:
        point += f", d_ss = {_vector(model.d_ss)}"
    head = [
        f"Linear model: {sizes}, sampled every {model.step_length}.",
        f"Operating point: {point}.",
    ]
    if model.state_names or model.input_names or model.units:
        states, inputs, loads = with_units(model)
        loads = loads[: len(model.disturbance_names)]
        named = {"States": states, "Inputs": inputs, "Disturbances": loads}
        head.insert(1, " ".join(f"{what}: {', '.join(of)}." for what, of in named.items() if of))
    return head


def poles(model: LinearSystem) -> Array:
    """Return the eigenvalues of A, the largest first, one of each complex pair."""
    values = np.linalg.eigvals(model.A)
    values = values[values.imag >= 0]
    return np.asarray(values[np.argsort(-np.abs(values), kind="stable")])


def time_constant(pole: complex) -> float:
    """Return the samples in which a mode changes by the factor e, negative where it grows."""
    size = abs(pole)
    if abs(size - 1) <= ON_CIRCLE:
        return np.inf
    return float(-1 / np.log(size)) if size > 0 else 0.0


def _mode(pole: complex, model: LinearSystem) -> str:
    """Return how the mode of a pole moves."""
    constant = time_constant(pole)
    unit = f" {model.time_unit}" if model.time_unit else ""
    lasting = f"{abs(constant) * model.dt:.4g}{unit} ({abs(constant):.3g} samples)"
    if np.isinf(constant):
        words = "integrates" if abs(pole - 1) <= ON_CIRCLE else "neither grows nor decays"
    elif abs(constant) < GONE:
        words = "gone within one sample"
    else:
        words = f"{'decays' if constant > 0 else 'grows'}, time constant {lasting}"
    angle = abs(np.angle(pole))
    if angle > 1e-9 and abs(pole) > 1e-9:
        period = 2 * np.pi / angle
        words += f", oscillates with period {period * model.dt:.4g}{unit} ({period:.3g} samples)"
    return words


def _stability(model: LinearSystem, others: Array) -> str:
    """Return whether the plant is stable; ``others`` are the poles beside those of integrators."""
    sizes = np.abs(others)
    growing = int(np.sum(sizes > 1 + ON_CIRCLE))
    largest = f"the largest magnitude of a pole is {np.max(sizes, initial=0.0):.6g}"
    if growing:
        return f"Unstable: {growing} of {model.n_states} poles grow, {largest}."
    if sizes.size < model.n_states:
        return "On the border of stability, as far as the log shows: it may integrate."
    if np.max(sizes) >= 1 - ON_CIRCLE:
        return f"On the border of stability: some modes do not decay, {largest}."
    return f"Stable: {largest}."


def reach(model: LinearSystem) -> tuple[Array, Array]:
    """Return the relative reach of the inputs (n,), largest first, and its directions (n, n).

    The directions, in rows, are the principal axes of the scaled controllability Gramian. In short
    samples ``B, AB, ...`` are nearly parallel: the rank of ``control.ctrb`` would mislead.
    """
    A = model.A
    B = model.B / np.maximum(np.linalg.norm(model.B, axis=0), np.finfo(float).tiny)
    radius = np.max(np.abs(np.linalg.eigvals(A)))
    if radius > 0.999:  # a smaller A has the same reachable subspace
        A = A * (0.999 / radius)
    gramian = B @ B.T
    power = A
    # Smith's doubling sums positive terms: bad scaling does not spoil it as it does an equation.
    for _ in range(16):  # doublings of the Gramian's horizon: 65,536 samples
        gramian = gramian + power @ gramian @ power.T
        power = power @ power
    moved = np.sqrt(np.maximum(np.diag(gramian), 0))
    # A state that no input moves must not be scaled up from its rounding.
    still = moved <= 1e-12 * np.max(moved, initial=0)
    unit = np.where(still, 1.0, moved)
    gramian[still, :] = gramian[:, still] = 0.0
    sizes, axes = np.linalg.eigh(gramian / np.outer(unit, unit))
    sizes = np.sqrt(np.maximum(sizes[::-1], 0))
    return sizes / (sizes[0] or 1.0), axes[:, ::-1].T / unit


def _reach(model: LinearSystem) -> list[str]:
    """Return the lines on controllability."""
    sizes, axes = reach(model)
    axes = np.array([axis / axis[np.argmax(np.abs(axis))] for axis in axes])
    axes[np.abs(axes) <= 1e-3] = 0.0
    words = [combination(axis, labels_of(model)[0], 3) for axis in axes]
    rank = int(np.sum(sizes > 1e-6))
    lines = [f"Controllability: the inputs reach {rank} of {sizes.size} directions of the state."]
    if rank < sizes.size:
        lines += [f"  Nothing moves {each}." for each in words[rank:]]
    elif sizes[-1] < 1e-3:  # motions of a direction by the inputs, relative to the largest
        lines.append(f"  {words[-1]} is moved {sizes[-1]:.1e} times as far as the most.")
    idle = np.flatnonzero(~np.any(model.B, axis=0))
    return lines + [f"  {labels_of(model)[1][i]} has no effect." for i in idle]


def _scaling(model: LinearSystem) -> list[str]:
    """Return the line on scaling."""
    _, (factors, _) = linalg.matrix_balance(model.A, permute=False, separate=True)
    spread = np.max(factors) / np.min(factors)
    sizes = np.abs(model.B)
    effects = sizes[sizes > 1e-12 * np.max(sizes, initial=0.0)]  # the rest is rounding
    if not effects.size:
        return []
    line = f"Scaling: entries of B from {np.min(effects):.2g} to {np.max(effects):.2g}"
    if spread > 2.0:  # factor of balancing up to which states are of one size
        line += f"; balancing A would rescale its states by up to {spread:.3g} against each other"
    return [f"{line}.{' Consider other units.' if spread > 1e3 else ''}"]


def _gains(model: LinearSystem) -> list[str]:
    """Return the lines on what held inputs do in the end."""
    gains = model.gains or Gains.of(model.A, model.B)
    known = np.any(gains.errors, axis=1)
    rows = np.flatnonzero(known if np.any(known) else np.ones_like(known))
    rounding = 1e-9 * np.max(np.abs(gains.values))
    values, width = (
        np.where(np.abs(each) < rounding, 0.0, each)
        for each in (gains.values, NORMAL * gains.errors)
    )
    states, inputs = labels_of(model)
    units = model.units or ("",) * (len(states) + len(inputs))
    pace, time = (model.dt, model.time_unit) if model.time_unit else (1.0, "sample")
    rates = "", f" per {time}", f" per {time}²"

    def effects(
        values: Array, width: Array, degrees: NDArray[np.int64], rows: NDArray[np.int64]
    ) -> list[str]:
        found = []
        for j, name in enumerate(with_units(model)[1]):
            each = []
            for i in rows:
                degree = degrees[i, j]
                value, doubt = (part[i, j] / pace**degree for part in (values, width))
                size = f"{value:+.4g}" if value else "0"
                size += f" ± {doubt:.2g}" * bool(doubt)
                each.append(f"{states[i]} {size} {units[i]}".rstrip() + rates[degree])
            found.append(f"  {name}: {', '.join(each)}.")
        return found

    # An unstable plant has this steady state but does not approach it.
    stable = np.all(np.abs(_beside(model, gains)) < 1 - ON_CIRCLE)
    verb = "does in the end" if stable else "would balance"
    lines = [f"What one unit more of an input, held, {verb}:"]
    lines += effects(values, width, gains.degrees, rows)
    moves_on = np.any(gains.degrees, axis=1)
    if np.any(moves_on[rows]):
        lines.append(
            f"  What integrates moves on, by so much per {time}: it has no steady-state gain."
        )
    # The gains beside a pole that may be 1 say more, or nothing.
    clearer = rows[(moves_on | np.all(gains.beside_errors < gains.errors, axis=1))[rows]]
    off_circle = np.abs(np.linalg.eigvals(model.A) - 1).min() > ON_CIRCLE
    if gains.integrators and clearer.size and off_circle:
        lines.append(
            "  A pole that may be 1 may be a load that drifts, and is not measured: then gains are "
            "about:"
        )
        lines += effects(
            gains.beside, NORMAL * gains.beside_errors, np.zeros_like(gains.degrees), clearer
        )
    if np.any(width):
        none = ", ".join(
            f"{inputs[j]} on {states[i]}{', its rate' * bool(gains.degrees[i, j])}"
            for i, j in np.argwhere((np.abs(values) <= width) & (width > 0))
        )
        noise = "process noise" if model.C is None else "process and sensor noise"
        text = f" Not distinguishable from zero: {none}." if none else ""
        if any(each.endswith(UNTOLD) for each in model.notes):
            noise += " alone: the notes say what there is besides, by which gains err more"
        elif model.C is not None:
            noise += ", if the order is right"
        if any(each.startswith(CURVED) for each in model.notes):
            text = f" It is of a linear fit, and does not cover the curvature.{text}"
        lines.append(f"  ± is a 95 % interval, under {noise}.{text}")
    return lines


def _beside(model: LinearSystem, gains: Gains | None) -> Array:
    """Return the poles beside those that integrate, as far as a log shows."""
    values = np.linalg.eigvals(model.A)
    count = gains.integrators if gains is not None else 0
    return np.asarray(values[np.argsort(np.abs(values - 1), kind="stable")][count:])


def _sampling(model: LinearSystem) -> list[str]:
    """Return the lines on the sampling time."""
    # Time constants, in samples, below which sampling is too slow, and above too fast. Åström and
    # Wittenmark (*Computer-Controlled Systems*) advise 4 to 10 samples per rise time.
    fast_sampling = 50.0
    found = poles(model)
    constants = [abs(time_constant(pole)) for pole in found]
    moving = [constant for constant in constants if GONE <= constant < np.inf]
    angles = [abs(np.angle(pole)) for pole in found if abs(pole) > 1e-9]
    period = 2 * np.pi / max(angles) if angles and max(angles) > 1e-9 else np.inf
    if all(constant < GONE for constant in constants):
        cure = "Is dt in the unit of time of the equations, or of the log?"
        return [f"Sampling: within one sample the plant has settled, but for dead time. {cure}"]
    if not moving and np.isinf(period):
        return ["Sampling: the plant only integrates or delays: no time scale to compare dt with."]
    lines = [f"Sampling: the shortest oscillation takes {period:.3g} samples."]
    if moving:
        lines = [
            f"Sampling: the fastest time constant is {min(moving):.3g} samples, the slowest "
            f"{max(moving):.3g}. A horizon of as many steps sees such a mode change e-fold."
        ]
    if min(moving, default=np.inf) < 1.0 or period < 6:
        lines.append(
            "  Slow: the fastest mode decays, or swings round, within so few samples that inputs "
            "come too late for it. Sample faster, or leave it out of the model. Is dt in the unit "
            "of time of the equations, or of the log?"
        )
    elif min(moving, default=0.0) > fast_sampling and period > 2 * np.pi * fast_sampling:
        lines.append(
            "  Fast: even the fastest mode hardly moves in one sample, and a short horizon sees "
            "little of the plant. Sample slower, or lengthen the horizon. Is dt in the unit of "
            "time of the equations, or of the log?"
        )
    return lines


def _number(value: complex) -> str:
    return f"{value.real:.4f}" + (f" ± {abs(value.imag):.4f}i" if value.imag else "")


def _vector(values: Array) -> str:
    return f"({', '.join(f'{value:.4g}' for value in values)})"
