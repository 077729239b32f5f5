"""A law, or the policy of a model, as plain arrays: what every format of an export is made of."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from sb3_yann._validation import Array, check_choice
from sb3_yann.control import LinearModel, LinearMPC, OnlineLaw, PiecewiseAffine
from sb3_yann.control.model.labels import labels_of, missing_observer
from sb3_yann.control.mpc.choice import Law
from sb3_yann.deployment.checks import Checks
from sb3_yann.deployment.controller import FORMAT
from sb3_yann.deployment.output_range import scale_within
from sb3_yann.networks import SharedYannLayer, YannLayer
from sb3_yann.networks.law_layer import ALL, NONE, LawLayer
from sb3_yann.policy._features import AffineFeatures, keeps_entries
from sb3_yann.policy.policies import YannPolicy

ACTIVATIONS: dict[type[nn.Module], str] = {nn.Tanh: "tanh", nn.ReLU: "relu", nn.ELU: "elu"}
NO_ONE, CALLER = "none", "caller"
"""Who runs an observer of disturbances."""
Arrays = dict[str, Any]
Exportable = BaseAlgorithm | YannPolicy | LinearMPC | PiecewiseAffine | OnlineLaw
Units = tuple[Array, Array, Array, Array]
"""theta = matrix @ obs + offset, and action = scale * (what lies in [-1, 1]) + shift."""


def describe(
    given: Exportable, name: str, checks: Checks, absolute: bool = False, observer: str = NO_ONE
) -> Arrays:
    """Return the arrays of a controller.

    Parameters
    ----------
    given : model, YannPolicy, LinearMPC or PiecewiseAffine
        Of an MPC or a law the controller takes theta and puts out u, of a model it does what
        `predict` does.
    name : str
        What the controller is called.
    checks : Checks
        Limits of the readings, and how to fall back.
    absolute : bool, default False
        Whether it takes theta and puts out inputs as the plant has them, not as the env or the
        law does.
    observer : {"none", "caller"}, default "none"
        Who runs the observer of estimated disturbances.

    Raises
    ------
    TypeError, ValueError
        If there is no export of it: the message says why.
    """
    policy = given.policy if isinstance(given, BaseAlgorithm) else given
    if not isinstance(policy, YannPolicy | LinearMPC | PiecewiseAffine | OnlineLaw):
        raise TypeError(
            f"{type(given).__name__} cannot be exported: pass a model with a YannPolicy, a "
            "LinearMPC, or a law from LinearMPC.explicit()."
        )
    note = _note(policy.problem.model if isinstance(policy, YannPolicy) else policy.model, observer)
    if isinstance(policy, YannPolicy):
        return _of_policy(policy, name, checks, absolute) | {"note": note}
    law = _explicit(policy.law() if isinstance(policy, LinearMPC) else policy)
    states, inputs = _names(law)
    shown = [*states, *(f"theta[{i}]" for i in range(len(states), law.n_theta))]
    if isinstance(policy, LinearMPC):
        shown = _labels(policy)
    arrays = {
        **law_arrays(law),
        **_no_networks(law),
        "change": _change(policy if isinstance(policy, LinearMPC) else None, law),
        **checks.arrays(law.n_theta),
        "watched": np.arange(law.n_theta) < len(states),
    }
    units = _plant_units(law) if absolute else _own_units(law)
    return arrays | _with_units(name, law, units, shown, inputs) | {"note": note}


def _note(model: LinearModel | None, observer: str) -> str:
    """Return what the export lacks; raise where nobody has said that he knows."""
    lacks = "" if model is None else missing_observer(model)
    if check_choice("observer", observer, (NO_ONE, CALLER)) == NO_ONE and lacks:
        raise ValueError(
            f"{lacks} An export does not hold it, and does not reach its set-points without it. If "
            "your code runs the observer and passes what it estimates: export(..., "
            'observer="caller").'
        )
    return lacks


def _labels(problem: LinearMPC) -> list[str]:
    """Return what the entries of theta are called, and whence disturbances come."""
    labels, first = [*problem.labels()], problem.layout.disturbance.start
    for i in range(problem.model.n_disturbances):
        estimated = i in problem.model.estimated
        labels[first + i] += (
            " (estimated by the caller's observer)"
            if estimated
            else " (from the caller's sensor or observer)"
        )
    return labels


def _of_policy(policy: YannPolicy, name: str, checks: Checks, absolute: bool) -> Arrays:
    layer, problem = policy.actor.mu, policy.problem
    law = _explicit(layer.given if isinstance(layer, SharedYannLayer) else layer.explicit_law)
    extractor = policy.actor.features_extractor
    matrix, offset = np.eye(law.n_theta), np.zeros(law.n_theta)
    if isinstance(extractor, AffineFeatures):
        matrix, offset = extractor.matrix.T.cpu().numpy(), extractor.offset.cpu().numpy()
    kept = keeps_entries(extractor) or absolute
    box: Any = policy.action_space
    low, high = np.asarray(box.low, np.float64), np.asarray(box.high, np.float64)
    half, middle = (high - low) / 2, (high + low) / 2
    units: Units = matrix, offset, scale_within(half, middle, low, high), middle
    if absolute:
        units = _plant_units(law)
    names = _labels(problem) if kept else [f"obs[{i}]" for i in range(matrix.shape[1])]
    states = np.zeros(law.n_theta, bool)
    states[problem.layout.state] = True
    arrays = {
        **law_arrays(law),
        **network_arrays(layer, law),
        "change": layer.change.cpu().numpy() if layer.rated else np.empty((0, law.n_inputs)),
        **checks.arrays(len(units[0][0])),
        "watched": states if kept else _show_states(units[0], states),
    }
    return arrays | _with_units(name, law, units, names, _names(law)[1])


def in_words(data: Arrays, put_out: str) -> list[str]:
    """Return a line for each entry of an observation and of what is put out: name and values.

    The values tell deviations from what the plant itself shows.
    """
    shift, scale = data["action_shift"], data["action_scale"]
    ends = data["bounds"] * scale + shift
    shown = zip(data["obs_names"], data["obs_rest"], strict=True)
    inputs = zip(data["action_names"], *ends, strict=True)
    return [
        *(f"obs[{i}]  {name}, {rest:.6g} at rest" for i, (name, rest) in enumerate(shown)),
        *(
            f"{put_out}[{i}]  {name}, {low:.6g} to {high:.6g}"
            for i, (name, low, high) in enumerate(inputs)
        ),
    ]


def _show_states(matrix: Array, states: Array) -> Array:
    """Return which entries of an observation say what states are, and nothing else of theta."""
    counts = matrix != 0
    shown: Array = counts[states].any(0) & ~counts[np.logical_not(states)].any(0)
    return shown


def _change(problem: LinearMPC | None, law: PiecewiseAffine) -> Array:
    """Return by how much an input may change, (2, m) in parts of its range, or nothing."""
    if problem is None or problem.rate is None or not problem.has_rate_bounds:
        return np.empty((0, law.n_inputs))
    half = input_range(law)[2]
    change: Array = np.array([problem.rate.du_min, problem.rate.du_max]) / half
    return change


def _explicit(law: Law | None) -> PiecewiseAffine:
    if law is None:
        raise ValueError(
            "The policy's weights hold another law than its problem's. Load the model with the "
            "problem that it was trained with."
        )
    if not isinstance(law, PiecewiseAffine):
        raise ValueError(
            "The law is solved online, by a quadratic program at each step; an export holds an "
            "explicit law, whose time is bounded. Solve problem.explicit() without a limit before "
            "the model is made, shorten the horizon, or run the model itself."
        )
    return law


def _names(law: PiecewiseAffine) -> tuple[list[str], list[str]]:
    """Return what states and inputs are called; no states where the law knows no plant."""
    if law.model is None:
        return [], [f"u[{i}]" for i in range(law.n_inputs)]
    return labels_of(law.model)


def law_arrays(law: PiecewiseAffine) -> Arrays:
    """Return a law for inputs in [-1, 1], or as they are where they have no bounds."""
    finite, middle, half = input_range(law)
    arrays: Arrays = {
        "gains": law.gains / half[:, None],
        "offsets": (law.offsets - middle) / half,
        "bounds": np.array([(law.u_min - middle) / half, (law.u_max - middle) / half]),
        "A": law.A,
        "b": law.b,
        "starts": law.starts,
        "zero_input": np.bool_(law.infeasible == "zero_input"),
        "disjoint": np.bool_(law.disjoint),
        "tolerances": np.array([law.tolerance, law.tie_tolerance]),
        "box": np.array(
            [
                np.where(np.isfinite(each), each, otherwise)
                for each, otherwise in ((law.theta_min, -1.0), (law.theta_max, 1.0))
            ]
        ),
        "per_input": 1 / half,
        "middle": middle / half,
    }
    arrays["bounds"][:, finite] = [[-1.0], [1.0]]  # to the bit
    arrays["resting"] = np.clip(-middle / half, *arrays["bounds"])
    arrays |= {"neighbors": np.empty(0, np.int64), "walk_slack": np.empty(0), "walk_from": 0}
    if law.walks:
        region, point = law.start_of_walk()
        arrays |= {"neighbors": law.neighbors, "walk_from": np.int64(region)}
        arrays["walk_slack"] = law.b - law.A @ point
    elif law.tree is not None:
        arrays |= {f"tree_{key}": each for key, each in vars(law.tree).items()}
    return arrays


def input_range(law: PiecewiseAffine) -> tuple[Any, Array, Array]:
    """Return which inputs (m,) are bounded, the middles of their ranges and half-widths."""
    finite = np.isfinite(law.u_min) & np.isfinite(law.u_max)
    low, high = np.where(finite, law.u_min, -1.0), np.where(finite, law.u_max, 1.0)
    return finite, (high + low) / 2, (high - low) / 2


def _no_networks(law: PiecewiseAffine) -> Arrays:
    n = law.n_theta
    return {
        "per_theta": np.ones(n),
        "network_of": np.full(law.n_regions, -1),
        "n_layers": np.int64(0),
        "pinned": np.empty(0, bool),
        "activation": "tanh",
        "reach": np.inf,
        "confines": np.zeros((2, n)),
        "fades": np.array([ALL, NONE]),
    }


def network_arrays(layer: LawLayer, law: PiecewiseAffine) -> Arrays:
    """Return the networks of a layer that are not zero, and which of them each region has."""
    network = layer.network
    nodes = network.first.nodes.detach().double().cpu().numpy()
    k = nodes.shape[1] // 2
    first = (nodes[:, :k] + nodes[:, k : 2 * k]).sum(1) + nodes[:, 2 * k :].sum(1)
    rest = [each.detach().double().cpu().numpy() for each in network.weights()[1:]]
    layers, pinned = [first, *rest], network.pinned_array > 0
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
    return {
        **_no_networks(law),
        "per_theta": 1 / layer.theta_half.double().cpu().numpy(),
        "network_of": number if per_region else np.full(law.n_regions, number[0]),
        "n_layers": np.int64(len(layers) if len(kept) else 0),
        **({f"layer{i}": each[kept] for i, each in enumerate(layers)} if len(kept) else {}),
        "pinned": pinned[kept],
        "activation": _activation(network.activation),
        "reach": np.inf if layer.reach is None else layer.reach,
        "confines": layer.confines.cpu().numpy(),
    }


def _activation(given: Any) -> str:
    own = getattr(given, "args", (given,))[0]  # of a partial, which is alive at zero
    called = ACTIVATIONS.get(type(own))
    if called is None or (called == "elu" and own.alpha != 1):
        known = ", ".join(each.__name__ for each in ACTIVATIONS)
        raise ValueError(
            f"activation_fn = {own} cannot be exported. Train with one of {known} (alpha = 1)."
        )
    return called


def _is_zero(layers: list[Array], pinned: bool) -> bool:
    """Return whether a network puts out zero whatever it is given."""
    biases = [each[:, -1] for each in layers[1:-1]] + ([] if pinned else [layers[-1][:, -1]])
    silent = not np.any(layers[0]) and not any(map(np.any, biases))
    return silent or not np.any(layers[-1][:, :-1] if pinned else layers[-1])


def _plant_units(law: PiecewiseAffine) -> Units:
    if law.model is None or law.theta_ss is None:
        raise ValueError(
            "absolute = True needs a law that knows its operating point: one from LinearMPC, not "
            "one built by hand."
        )
    return _own_units(law, -law.theta_ss, law.model.u_ss)


def _own_units(law: PiecewiseAffine, offset: Any = 0.0, u_ss: Any = 0.0) -> Units:
    """Return theta as observations, and inputs as outputs; or both from an operating point on."""
    finite, middle, half = input_range(law)
    low, high = np.where(finite, law.u_min, -1.0) + u_ss, np.where(finite, law.u_max, 1.0) + u_ss
    shift = u_ss + middle
    scale = scale_within(half, shift, low, high)
    return np.eye(law.n_theta), np.zeros(law.n_theta) + offset, scale, shift


def _with_units(
    name: str,
    law: PiecewiseAffine,
    units: Units,
    obs_names: Any,
    action_names: Any,
) -> Arrays:
    matrix, offset, scale, shift = units
    rest = np.linalg.lstsq(matrix, -offset, rcond=None)[0]  # what is seen at theta = 0
    dt = 0.0 if law.model is None else law.model.dt
    return {
        "format": np.int64(FORMAT),
        "name": name,
        "dt": np.float64(dt),
        "obs_matrix": matrix,
        "obs_offset": offset,
        "obs_rest": rest,
        "action_scale": scale,
        "action_shift": shift,
        "obs_names": np.array(list(obs_names)),
        "action_names": np.array(list(action_names)),
    }
