"""A law, or the policy of a model, as plain arrays: every format of an export is made of them."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from sb3_yann._validation import Array, check_bounds, check_int, check_positive, warn
from sb3_yann.control import LinearMPC, OnlineLaw, PiecewiseAffine, StateEstimator
from sb3_yann.control.linear_system import (
    labels_of,
    labels_of_outputs,
    missing_observer,
    with_units,
)
from sb3_yann.deployment.code import scale_within
from sb3_yann.deployment.controller import FORMAT
from sb3_yann.networks import YannLayer
from sb3_yann.networks.yann import FADE_END, FADE_START, LawLayer
from sb3_yann.policy.checkpoint import is_confirmed
from sb3_yann.policy.observations import AffineObservation, keeps_entries
from sb3_yann.policy.policies import StartsAsMPC
from sb3_yann.units import ActionUnits


@dataclass(frozen=True)
class Checks:
    """What a controller takes for a fault, and how it falls back.

    Parameters
    ----------
    obs_min, obs_max : array_like, shape (n_obs,), or float, optional
        Limits of the readings, in the units of the export. None is no limit. Readings are what the
        sensors say, not what an estimator makes of them.
    frozen_after : int, default 0
        A state that stays the same to the bit for so many steps in which another reading moves, or
        the output is 1 % of its range from what it was when one moved last, is frozen. 0 checks
        nothing: only you know how coarse a sensor is, and how long the dead time.
    missing : int or list of int, default 0
        For how many steps in a row a reading may be NaN before that is a fault, one number or one
        for each: 60 for a laboratory's hourly value among readings of every minute. An estimator
        goes on without it, elsewhere the last good one stands in.
    late_after : float, optional
        A step is late when more time has passed since the last one, in units of dt, 1.5 by default.
        It is checked where a step is passed the time. None checks nothing.
    hold : int, default 5
        Steps with a faulty reading that the last good one stands in for; then the output is held.
    recover : int, default 10
        The policy acts again at so many steps without a fault. The MPC's law acts until then.
    transfer : int, default 5
        Steps within which a change of who acts fades.

    Examples
    --------
    >>> Checks(obs_min=[-2, -60], obs_max=[2, 20], frozen_after=30).hold
    5
    """

    obs_min: ArrayLike | None = None
    obs_max: ArrayLike | None = None
    frozen_after: int = 0
    missing: int | Sequence[int] = 0
    late_after: float | None = 1.5
    hold: int = 5
    recover: int = 10
    transfer: int = 5

    def __post_init__(self) -> None:
        self.arrays(max(map(np.size, vars(self).values())))

    def arrays(self, size: int) -> dict[str, Any]:
        """Return them for ``size`` readings; TypeError or ValueError where one is wrong."""
        low, high = check_bounds("obs", self.obs_min, self.obs_max, size)
        counts: dict[str, Any] = {
            name: np.int64(check_int(name, getattr(self, name), 0))
            for name in ("frozen_after", "hold", "recover", "transfer")
        }
        late = np.inf
        if self.late_after is not None:
            late = check_positive("late_after", self.late_after, "None checks nothing.")
        given = np.ravel(self.missing).tolist()
        if len(given) not in (1, size):
            wanted = f"one number, or one for each of the {size} readings"
            raise ValueError(f"missing = {self.missing} must be {wanted}.")
        missing = [check_int("missing", each, 0) for each in given]
        counts["missing"] = np.resize(np.array(missing, np.int64), size)
        return {"obs_min": low, "obs_max": high, "late_after": np.float64(late), **counts}


Estimator = StateEstimator | str | None


def estimator_arrays(
    problem: LinearMPC,
    estimator: StateEstimator,
    seen: list[str],
    seen_rest: Array,
    units: ActionUnits,
    order: NDArray[np.intp],
) -> dict[str, Any]:
    """Return the arrays of an estimator, and where each entry of what the policy sees comes from.

    Entry i of that is entry ``order[i]`` of theta.

    A step of the filter is ``[A B E c] [x; u; d; 1]``, and a correction by ``gain (y - C x)``, both
    in plant units. Of what the policy sees, x and estimated disturbances come from the filter, the
    previous input is the controller's own, and the rest are readings, behind the outputs.
    """
    model = problem.model
    layout = problem.layout
    estimator = _beside_extra(estimator, problem)
    estimator.require_model(model)
    if estimator.n_estimated != len(model.estimated):
        raise ValueError(
            f"The estimator estimates {estimator.n_estimated} disturbances, and the problem's "
            f"model has estimated = {[*model.estimated]}: name them there."
        )
    q = estimator.n_measured
    size = len(estimator.A)
    n_known = estimator.n_known
    estimated = [*range(n_known, model.n_disturbances)]
    x = np.concatenate([model.x_ss, model.d_ss[estimated]])
    y = estimator.C_aug @ x
    driven = np.concatenate([model.u_ss, model.d_ss[:n_known]])
    step = np.hstack([estimator.A, estimator.B, estimator.E])
    smallest = np.zeros((size, q))
    smallest[: model.n_states] = np.linalg.pinv(estimator.C)

    entries = np.argsort(order)
    in_d = entries[layout.disturbance]
    from_filter = np.concatenate([entries[layout.state], in_d[len(in_d) - len(estimated) :]])
    previous = entries[layout.previous]
    read = np.delete(np.arange(len(seen)), np.concatenate([from_filter, previous]))
    n_read = q + len(read)
    source = np.empty(len(seen), np.int64)
    source[read] = q + np.arange(len(read))
    source[from_filter] = n_read + np.arange(size)
    source[previous] = n_read + size + np.arange(len(previous))
    limits = np.full(model.n_states, np.inf)
    d_min, d_max = (getattr(problem.disturbances, side)[n_known:] for side in ("d_min", "d_max"))
    states = [seen[i] for i in entries[layout.state]]
    names = [*labels_of_outputs(estimator.C, states), *(seen[i] for i in read)]
    scale = 1 / units.scale
    return {
        "est_next": _affine(step, np.concatenate([x, driven]), x),
        "est_rest": _affine(estimator.resting, np.concatenate([y, driven]), x),
        "est_first": _affine(smallest, y, x),
        "est_C": estimator.C_aug,
        "est_gain": estimator.gain,
        "est_input": np.array([scale, model.u_ss - units.shift * scale]),
        "est_loads": source[in_d[:n_known]],
        "est_box": np.array([[*-limits, *d_min], [*limits, *d_max]]),
        "source": source,
        "obs_names": np.array(names),
        "obs_rest": np.concatenate([y, seen_rest[read]]),
        "watched": np.arange(n_read) < q,
    }


def _beside_extra(estimator: StateEstimator, problem: LinearMPC) -> StateEstimator:
    """Return the same estimator with a policy's extra signals as loads that move nothing."""
    model = problem.model
    more = model.n_disturbances - estimator.model.n_disturbances
    if not 0 < more <= len(problem.extra):
        return estimator
    ignored = problem.extra[-more:] - problem.layout.disturbance.start
    if not np.array_equal(estimator.model.E, np.delete(model.E, ignored, axis=1)):
        return estimator
    estimator.require_model(model, ("A", "B", "x_ss", "u_ss"))
    found = copy.copy(estimator)
    vars(found).pop("resting", None)
    found.model = model
    found.E = np.zeros((len(found.A), len(model.measured)))
    found.E[: model.n_states] = model.E[:, model.measured]
    return found


def _affine(matrix: Array, given_ss: Array, found_ss: Array) -> Array:
    """Return ``[matrix, c]``: a map of deviations, for what counts from these operating points."""
    return np.column_stack([matrix, found_ss - matrix @ given_ss])


Exportable = BaseAlgorithm | StartsAsMPC | LinearMPC | PiecewiseAffine | OnlineLaw


def describe(
    given: Exportable, name: str, checks: Checks, estimator: Estimator = None
) -> dict[str, Any]:
    """Return the arrays of a controller."""
    policy = given.policy if isinstance(given, BaseAlgorithm) else given
    if not isinstance(policy, StartsAsMPC | LinearMPC | PiecewiseAffine | OnlineLaw):
        raise TypeError(
            f"{type(given).__name__} cannot be exported: pass a model with a YannPolicy, a "
            "LinearMPC, or a law from LinearMPC.explicit()."
        )
    problem = policy.problem if isinstance(policy, StartsAsMPC) else None
    problem = policy if isinstance(policy, LinearMPC) else problem
    own = estimator if isinstance(estimator, StateEstimator) else None
    notes = _lacks(policy, problem, estimator), _unconfirmed(given), _normalized(given)
    note = " ".join(filter(None, notes))
    layer = policy.actor.mu if isinstance(policy, StartsAsMPC) else None
    base: Any = policy.law() if isinstance(policy, LinearMPC) else policy
    law, program = _with_regions(base if layer is None else layer.base_law)
    change: Array = np.empty((0, law.n_inputs))
    if layer is not None and layer.rated:
        change = layer.change.cpu().numpy()
    elif layer is None and law.rate is not None:
        change = law.rate / _input_range(law)[2]

    n = law.n_theta
    state_names: list[str] = []
    input_names = [f"u[{i}]" for i in range(law.n_inputs)]
    if law.model is not None:
        state_names, input_names = labels_of(law.model)
    states = np.arange(n) < len(state_names)
    labels = [*state_names, *(f"theta[{i}]" for i in range(len(state_names), n))]
    rest: Array = np.zeros(n)
    if problem is not None:
        labels = _with_sources(problem) if own is None else [*problem.labels()]
        rest = problem.theta_rest

    matrix, offset, scale, shift = _signal_maps(policy, law)
    watched = states
    order = _order_of_theta(policy)
    if order is not None:
        labels = [labels[i] for i in order]
        watched = states[order]
    elif isinstance(policy, StartsAsMPC) and not keeps_entries(policy.actor.features_extractor):
        labels = [f"obs[{i}]" for i in range(matrix.shape[1])]
        shown = matrix != 0  # entries are watched that say what states are, and nothing else
        watched = shown[states].any(0) & ~shown[~states].any(0)
    seen_rest = np.asarray(np.linalg.lstsq(matrix, rest - offset, rcond=None)[0], np.float64)
    signals = {
        "source": np.arange(matrix.shape[1]),
        "obs_names": np.array(labels),
        "obs_rest": seen_rest,
        "watched": watched,
    }
    if own is not None and problem is not None and order is not None:
        units = ActionUnits("plant", np.ones(law.n_inputs), problem.model.u_ss)
        units = policy.action_units if isinstance(policy, StartsAsMPC) else units
        signals = estimator_arrays(problem, own, labels, seen_rest, units, order)
    limits = checks.arrays(len(signals["obs_rest"]))
    if own is not None:  # what is read now and then is not missing in between
        slow = limits["missing"][: own.n_measured]
        np.maximum(slow, own.every - 1, out=slow)
    if problem is not None and problem.units.shifted:
        _warn_of_limits(limits, signals)
    return {
        **_law_arrays(law),
        **program,
        **_network_arrays(layer, law),
        **signals,
        **limits,
        "change": change,
        "moving": np.empty((0, law.n_inputs), np.int64) if law.moving is None else law.moving,
        "format": np.int64(FORMAT),
        "name": name,
        "dt": np.float64(0.0 if law.model is None else law.model.dt),
        "obs_matrix": matrix,
        "obs_offset": offset,
        "action_scale": scale,
        "action_shift": shift,
        "action_names": np.array([*input_names]),
        "labels": _labels(policy, problem, law.model),
        "time_unit": "" if law.model is None else law.model.time_unit,
        "note": note,
    }


def _warn_of_limits(limits: dict[str, Any], signals: dict[str, Any]) -> None:
    """Warn of limits of a reading that leave out the operating point."""
    low = limits["obs_min"]
    high = limits["obs_max"]
    rest = signals["obs_rest"]
    for i in np.flatnonzero((rest < low) | (rest > high)):
        warn(
            f"Checks: obs_min = {low[i]:g} and obs_max = {high[i]:g} of {signals['obs_names'][i]} "
            f"leave out the operating point, {rest[i]:g}: there the controller takes its reading "
            "for a fault. Have they the same units, and the order of the readings?"
        )


def _lacks(policy: Any, problem: LinearMPC | None, estimator: Estimator) -> str:
    """Return what the controller leaves to its caller; raise where an estimator has no place."""
    model = policy.model if problem is None else problem.model
    if isinstance(estimator, StateEstimator):
        if problem is None or _order_of_theta(policy) is None:
            raise ValueError(
                "A law alone, and a policy whose observation mixes entries of theta, do not say "
                "where estimates belong. Pass the LinearMPC, or a model whose observation is theta."
            )
        return ""
    if estimator not in (None, "caller"):
        raise ValueError(f'estimator = {estimator!r} must be a StateEstimator or "caller".')
    note = "" if model is None else missing_observer(model)
    if estimator is None and note:
        raise ValueError(
            f"{note} Have it exported too: export(..., estimator=observer), the one of "
            "offset_free, of found.estimator(), or of the env. Where your code runs it: "
            'estimator="caller".'
        )
    return note


def _labels(policy: Any, problem: LinearMPC | None, model: Any) -> NDArray[np.str_]:
    """Return names of what is read and put out in plant units, and the same with units, (k, 2)."""
    found: list[tuple[str, str]] = []
    if model is not None and _order_of_theta(policy) is not None:
        states = labels_of(model)[0], with_units(model)[0]
        theta = problem and (problem.labels(), problem.labels(units=True))
        found += zip(*(theta or states), strict=True)
    scaled = isinstance(policy, StartsAsMPC) and policy.action_units.kind != "plant"
    if model is not None and not scaled:
        found += zip(labels_of(model)[1], with_units(model)[1], strict=True)
    return np.array([each for each in found if each[0] != each[1]], str).reshape(-1, 2)


def _order_of_theta(policy: Any) -> NDArray[np.intp] | None:
    """Return which entry of theta each that is seen is, None where these are not theta's own."""
    if not isinstance(policy, StartsAsMPC):
        return np.arange(policy.n_theta)
    n = policy.problem.n_theta
    if (seen := policy.to_theta) is None:
        return np.arange(n)
    order = np.asarray(seen.matrix.argmax(axis=0))
    is_theta = np.array_equal(np.sort(order), np.arange(n))
    is_theta &= np.array_equal(seen.matrix.T, np.eye(n)[order])
    return order if is_theta and np.allclose(seen.offset, -policy.problem.theta_ss) else None


def _with_sources(problem: LinearMPC) -> list[str]:
    """Return the names of theta's entries, with the source of a disturbance."""
    labels = [*problem.labels()]
    layout = problem.layout
    for i, name in enumerate(layout.names):
        if i in problem.extra:
            labels[i] += " (a signal that the law ignores)"
        elif layout.disturbance.start <= i < layout.disturbance.stop:
            is_estimated = int(name[:-1].partition("[")[2]) in problem.model.estimated
            who = "observer" if is_estimated else "sensor or observer"
            labels[i] += f" ({'estimated by' if is_estimated else 'from'} the caller's {who})"
    return labels


def _unconfirmed(given: Exportable) -> str:
    """Return whether a model has learnt what nothing has confirmed; empty if not, and of others."""
    policy = given.policy if isinstance(given, BaseAlgorithm) else None
    if not isinstance(policy, StartsAsMPC) or policy.actor.mu.network.is_zero():
        return ""
    if is_confirmed(given):
        return ""
    if getattr(given, "guard_state", None) is None:
        return "Neither a guard nor improve nor a commissioning has confirmed this policy."
    return (
        "The guard has not accepted this policy: it is a candidate, or was changed since. "
        "restore_accepted(model) gives the accepted one."
    )


def _normalized(given: Exportable) -> str:
    """Return whether a model takes what a VecNormalize shows; empty if not, and of others."""
    seen = getattr(given, "sees_normalized", False)
    return "It takes observations as VecNormalize shows them, not the plant's readings." * seen


def _signal_maps(policy: Any, law: PiecewiseAffine) -> tuple[Array, Array, Array, Array]:
    """Return theta's matrix and offset of obs, an action's scale and shift of y in [-1, 1]."""
    seen = AffineObservation(np.eye(law.n_theta), -law.units.theta_ss)
    if isinstance(policy, StartsAsMPC):
        seen = policy.to_theta or AffineObservation.identity(law.n_theta)
        box: Any = policy.action_space
        low = np.asarray(box.low, np.float64)
        high = np.asarray(box.high, np.float64)
        half = (high - low) / 2
        shift = (high + low) / 2
    else:
        finite, middle, half = _input_range(law)
        low = np.where(finite, law.u_min, -1.0) + law.units.u_ss
        high = np.where(finite, law.u_max, 1.0) + law.units.u_ss
        shift = law.units.u_ss + middle
    return seen.matrix, seen.offset, scale_within(half, shift, low, high), shift


def _with_regions(law: Any) -> tuple[PiecewiseAffine, dict[str, Any]]:
    """Return an explicit law, or that without constraints and the program of what these take."""
    if isinstance(law, PiecewiseAffine):
        return law, {}
    dual = law.dual
    free = PiecewiseAffine(
        gains=dual.K[None],
        offsets=dual.k0[None],
        A=np.zeros((1, law.n_theta)),
        b=np.ones(1),
        starts=np.zeros(1, np.int64),
        u_min=law.u_min,
        u_max=law.u_max,
        theta_min=law.theta_min,
        theta_max=law.theta_max,
        infeasible=law.infeasible,
    )
    if law.model is not None and law.theta_ss is not None:
        free = free.on_plant(law.model, law.theta_ss, law.rate, law.moving, law.clamped)
    program = {
        "qp_D": dual.D,
        "qp_d0": dual.d0,
        "qp_gram": dual.gram,
        "qp_E": dual.E / _input_range(free)[2],
        "qp_softness": dual.softness,
        "qp_fixed": np.column_stack(dual.fixed),
        "qp_most": np.int64(max(1, min(len(dual.d0), dual.n_variables))),
    }
    return free, program


def _law_arrays(law: PiecewiseAffine) -> dict[str, Any]:
    """Return a law for inputs in [-1, 1], or as they are where they have no bounds."""
    finite, middle, half = _input_range(law)
    A, b, starts, neighbors = law.open_regions
    box = np.array([law.theta_min, law.theta_max])
    arrays: dict[str, Any] = {
        "gains": law.gains / half[:, None],
        "offsets": (law.offsets - middle) / half,
        "bounds": np.array([(law.u_min - middle) / half, (law.u_max - middle) / half]),
        "A": A,
        "b": b,
        "starts": starts,
        "zero_input": np.bool_(law.infeasible == "zero_input"),
        "disjoint": np.bool_(law.disjoint),
        "tolerances": np.array([law.tolerance, law.tie_tolerance]),
        "box": np.where(np.isfinite(box), box, [[-1.0], [1.0]]),
        "per_input": 1 / half,
        "middle": middle / half,
    }
    arrays["box_middle"], arrays["box_per_half"] = law.box
    # Beyond 1e12 times theta's box slacks would overflow.
    far = 1e12 * np.abs(arrays["box"]).max(0)
    arrays["ends"] = np.array([law.clamp(-far), law.clamp(far)])
    arrays["bounds"][:, finite] = [[-1.0], [1.0]]  # to the bit
    arrays["resting"] = np.clip(-middle / half, *arrays["bounds"])
    arrays |= {"neighbors": np.empty(0, np.int64), "walk_slack": np.empty(0), "walk_from": 0}
    if law.walks:
        region, point = law.start_of_walk()
        arrays |= {"neighbors": neighbors, "walk_from": np.int64(region)}
        arrays["walk_slack"] = b - A @ point
    return arrays


def _input_range(law: PiecewiseAffine) -> tuple[Any, Array, Array]:
    """Return which inputs (m,) are bounded, the middles of their ranges and half-widths."""
    finite = np.isfinite(law.u_min) & np.isfinite(law.u_max)
    low = np.where(finite, law.u_min, -1.0)
    high = np.where(finite, law.u_max, 1.0)
    return finite, (high + low) / 2, (high - low) / 2


def _network_arrays(layer: LawLayer | None, law: PiecewiseAffine) -> dict[str, Any]:
    """Return the networks of a layer that are not zero, and which of them each region has."""
    n = law.n_theta
    found: dict[str, Any] = {
        "per_theta": np.ones(n),
        "network_of": np.full(law.n_regions, -1),
        "n_layers": np.int64(0),
        "pinned": np.empty(0, bool),
        "activation": "tanh",
        "reach": np.inf,
        "confines": np.zeros((2, n)),
        "kept": np.empty((0, n + law.n_inputs + 2)),
        "fades": np.array([FADE_START, FADE_END]),
    }
    if layer is None:
        return found
    network = layer.network
    nodes, *rest = (each.detach().double().cpu().numpy() for each in network.weights())
    layers = [nodes.sum(1), *rest]
    pinned = network.pinned[:, 0].cpu().numpy() > 0
    if not all(np.all(np.isfinite(each)) for each in layers):
        raise ValueError(
            "The actor's weights hold NaN or infinite entries: there is nothing to export. Load an "
            "earlier save of the model, or export the law, model.policy.problem.explicit()."
        )
    zero = np.array([_is_zero([each[i] for each in layers], pinned[i]) for i in range(len(pinned))])
    kept = np.flatnonzero(~zero)
    number = np.full(len(zero), -1)
    number[kept] = np.arange(len(kept))
    per_region = isinstance(layer, YannLayer)
    found |= {
        "per_theta": 1 / layer.theta_half.double().cpu().numpy(),
        "network_of": number if per_region else np.full(law.n_regions, number[0]),
        "pinned": pinned[kept],
        "activation": _activation(network.activation),
        "reach": np.inf if layer.reach is None else layer.reach,
        "confines": layer.confines.cpu().numpy(),
    }
    if len(kept):
        found |= {f"layer{i}": each[kept] for i, each in enumerate(layers)}
        found |= {"n_layers": np.int64(len(layers)), "kept": layer.constants[2]}
    return found


def _activation(given: Any) -> str:
    """Return the name of an activation; raise ValueError for one that no export knows."""
    known: dict[type[nn.Module], str] = {nn.Tanh: "tanh", nn.ReLU: "relu", nn.ELU: "elu"}
    own = getattr(given, "args", (given,))[0]  # of a partial, which is alive at zero
    name = known.get(type(own))
    if name is None or (name == "elu" and own.alpha != 1):
        names = ", ".join(each.__name__ for each in known)
        raise ValueError(
            f"activation_fn = {own} cannot be exported. Train with one of {names} (alpha = 1)."
        )
    return name


def _is_zero(layers: list[Array], pinned: bool) -> bool:
    """Return whether a network puts out zero whatever it is given."""
    biases = [each[:, -1] for each in layers[1:-1]] + ([] if pinned else [layers[-1][:, -1]])
    silent = not np.any(layers[0]) and not any(map(np.any, biases))
    return silent or not np.any(layers[-1][:, :-1] if pinned else layers[-1])
