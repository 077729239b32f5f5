"""The plants of PC-Gym for a linear MPC and for learners: seeded, absolute, truncated, fast.

PC-Gym is optional: ``pip install 'sb3-yann[pcgym]'``. Importing this module does not import it.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from sb3_yann.control import LinearModel, Tracking
from sb3_yann_envs._problem_env import asked_start, not_reset
from sb3_yann_envs.pcgym_flow import flow_of, rate_of

Array = NDArray[np.float64]
Single = NDArray[np.float32]

Parameters = dict[str, Any]

DISTURBED = 0.1  # of half a state's range: what a disturbance of 1 adds to it in a sample


def _stairs(values: Sequence[float], steps: int) -> list[float]:
    """Return a schedule of ``steps`` entries that holds each value equally long."""
    return [value for value in values for _ in range(steps // len(values))]


def _cstr() -> Parameters:
    """Return the reactor: 26 min in 120 samples, C_A follows its set-point by the jacket."""
    return {
        "model": "cstr",
        "N": 120,
        "tsim": 26.0,
        "SP": {"Ca": _stairs([0.85, 0.9, 0.87], 120)},
        "o_space": {"low": np.array([0.7, 300, 0.8]), "high": np.array([1, 350, 0.9])},
        "a_space": {"low": np.array([295.0]), "high": np.array([302.0])},
        "x0": np.array([0.8, 330, 0.8]),
        "r_scale": {"Ca": 1e3},
    }


def _four_tank() -> Parameters:
    """Return the four tanks: 1,000 s in 60 samples, both upper levels follow set-points."""
    return {
        "model": "four_tank",
        "N": 60,
        "tsim": 1000.0,
        "SP": {"h3": _stairs([0.5, 0.1], 60), "h4": _stairs([0.2, 0.3], 60)},
        "o_space": {"low": np.zeros(6), "high": np.array([0.5] * 6)},
        "a_space": {"low": np.array([0.1, 0.1]), "high": np.array([10.0, 10.0])},
        "x0": np.array([0.141, 0.112, 0.072, 0.42, 0.5, 0.2]),
        "r_scale": {"h3": 1e3, "h4": 1e3},
    }


def _multistage_extraction() -> Parameters:
    """Return the extraction column: 60 h in 60 samples, X5 follows its set-point by two flows."""
    return {
        "model": "multistage_extraction",
        "N": 60,
        "tsim": 60.0,
        "SP": {"X5": _stairs([0.3, 0.4, 0.3], 60)},
        "o_space": {"low": np.array([0.0] * 10 + [0.3]), "high": np.array([1.0] * 10 + [0.4])},
        "a_space": {"low": np.array([5.0, 10.0]), "high": np.array([500.0, 1000.0])},
        "x0": np.array([0.55, 0.3, 0.45, 0.25, 0.4, 0.2, 0.35, 0.15, 0.25, 0.1, 0.3]),
        "r_scale": {"X5": 1e3},
    }


CASES: dict[str, Callable[[], Parameters]] = {
    "cstr": _cstr,
    "four_tank": _four_tank,
    "multistage_extraction": _multistage_extraction,
}
"""Makers of PC-Gym's parameters. Two weights of the error, which PC-Gym has at 1, are 1,000."""

UNITS: dict[str, dict[str, str]] = {
    "cstr": {"Ca": "mol/L", "T": "K", "Tc": "K"},
    "four_tank": {**dict.fromkeys(["h1", "h2", "h3", "h4"], "m"), "v1": "V", "v2": "V"},
    "multistage_extraction": {
        **{f"{phase}{stage}": "kg/m³" for phase in "XY" for stage in range(1, 6)},
        "L": "m³/h",
        "G": "m³/h",
    },
}
"""Units of the states and inputs of PC-Gym's models, by the model's name."""

NEEDED = ("N", "tsim", "SP", "o_space", "a_space", "x0")
NOT_HERE = ("a_delta", "disturbances", "uncertainty_percentages")
"""What PC-Gym adds to theta or to the plant in ways of its own."""


class PCGymEnv(gymnasium.Env[Single, Single]):
    """A plant of PC-Gym, in its own units, with set-points that are drawn in each episode.

    ## Description

    The equations, the input bounds, the start and the metric are PC-Gym's. A Runge-Kutta method
    replaces its integrator where it is as accurate. ``reset(seed=...)`` determines an episode.

    ## Action Space

    The plant's inputs (m,), float32, between ``a_space``'s bounds; clipped to them.

    ## Observation Space

    The plant's states (n,), then the set-points (p,) in force, float32. With ``noise`` in the
    parameters each shown state is off by a normal ``noise_percentage`` of itself, as in PC-Gym.

    ## Rewards

    PC-Gym's metric: ``r_scale`` times the squared distance from the set-points at the end of the
    step, or its ``custom_reward``. ``sb3_yann.wrappers.StageCost`` puts an MPC's stage cost in its
    place. The `info` of a step holds ``pcgym_cost`` (minus that reward), ``violation`` (whether a
    constraint of the parameters is violated) and ``state``, the states in float64.

    ## Starting State

    PC-Gym's ``x0``. ``reset(options={"state": x})`` starts from x, shape (n,).

    ## Episode End

    Truncated after N - 1 steps, where PC-Gym terminates.

    Parameters
    ----------
    parameters : str or mapping
        A name in ``sb3_yann_envs.pcgym.CASES``, or the mapping that ``pcgym.make_env`` takes.
        ``normalise_a`` and ``normalise_o`` play no part.
    set_points : mapping from name to (low, high), optional
        Ranges to draw from, uniformly. The default is the range of each one's schedule ``SP``.
    draw : bool, default True
        Whether set-points are drawn anew where the schedules change; else the schedules are played.

    Raises
    ------
    ImportError
        If PC-Gym is not installed.
    ValueError, TypeError
        For an unknown name, missing parameters, and parameters that are not supported here.

    Examples
    --------
    >>> env = PCGymEnv("cstr")
    >>> observation, _ = env.reset(seed=0)
    >>> env.state_names, env.input_names, observation.shape
    (('Ca', 'T'), ('Tc',), (3,))
    >>> env.linear_model().A.shape
    (2, 2)
    """

    metadata = {"render_modes": []}

    def __init__(
        self,
        parameters: str | Mapping[str, Any],
        *,
        set_points: Mapping[str, tuple[float, float]] | None = None,
        draw: bool = True,
    ) -> None:
        given = _playable(_checked(parameters))
        # do-mpc warns of what of it is not installed, CasADi of the way PC-Gym calls it.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self.plant = _make_env()(given)
            info = self.plant.model.info()
            self._rate = rate_of(self.plant.model, len(info["states"]), len(info["inputs"]))
        self.state_names = tuple(info["states"])
        self.input_names = tuple(info["inputs"])
        self.units = UNITS.get(given.get("model", ""), {})
        n = len(self.state_names)
        self.dt = float(self.plant.dt)
        self.draw = draw
        self.x0: Array = np.array(given["x0"], np.float64)[:n]
        self.outputs = [self.state_names.index(name) for name in given["SP"]]
        self.schedule: Array = np.array([*given["SP"].values()], np.float64).T  # (N, p)
        self.r_min, self.r_max = _ranges(given["SP"], set_points)
        self.x_min, self.x_max = (np.array(given["o_space"][s][:n], float) for s in ("low", "high"))
        self.u_min, self.u_max = (np.array(given["a_space"][s], float) for s in ("low", "high"))
        self.noise = float(given.get("noise_percentage", 0)) if given.get("noise") else 0.0
        self._flow = flow_of(self._rate, self.dt, self.x0, *self._box())
        self.observation_space = spaces.Box(
            np.concatenate([self.x_min, self.r_min]).astype(np.float32),
            np.concatenate([self.x_max, self.r_max]).astype(np.float32),
            dtype=np.float32,
        )
        self.action_space = spaces.Box(
            self.u_min.astype(np.float32), self.u_max.astype(np.float32), dtype=np.float32
        )
        self.state: Array | None = None
        self.taken = 0
        self.wanted = self.schedule

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Single, dict[str, Any]]:
        """Start an episode, from PC-Gym's x0 or from ``options["state"]``, shape (n,)."""
        super().reset(seed=seed)
        start = asked_start(options)
        x = self.x0.copy() if start is None else np.array(start, np.float64)
        if x.shape != self.x0.shape or not np.all(np.isfinite(x)):
            raise ValueError(
                f"options['state'] = {x.tolist()} must be {len(self.x0)} finite numbers: "
                f"{', '.join(self.state_names)}."
            )
        self.state = x
        self.taken = 0
        self.wanted = self._drawn() if self.draw else self.schedule
        names = self.plant.SP
        self.plant.SP = dict(zip(names, self.wanted.T, strict=True))  # PC-Gym's reward reads it
        return self._seen(), {"state": x.copy()}

    def step(self, action: Single) -> tuple[Single, float, bool, bool, dict[str, Any]]:
        """Hold the inputs (m,) for one sample; the reward is minus PC-Gym's cost."""
        if self.state is None:
            raise not_reset("step", "there is no state yet")
        u = np.clip(np.asarray(action, np.float64), self.u_min, self.u_max)
        if u.shape != self.u_min.shape or np.isnan(u).any():
            raise ValueError(
                f"action = {np.asarray(action).tolist()} must be {len(self.u_min)} numbers: "
                f"{', '.join(self.input_names)}."
            )
        self.state = self.advance(self.state, u)
        violation = self._violates(u)
        self.taken += 1
        reward = self._reward(u, violation)
        info = {"pcgym_cost": -reward, "violation": violation, "state": self.state.copy()}
        return self._seen(), reward, False, self.taken >= len(self.schedule) - 1, info

    def advance(self, x: ArrayLike, u: ArrayLike) -> Array:
        """Return the state (n,) one sample after x (n,), with the inputs u (m,) held.

        It takes batches, x (batch, n) and u (batch, m), as well. Raises FloatingPointError where
        the equations have no value.
        """
        reached = self._flow(x, u)
        if not np.all(np.isfinite(reached)):
            raise FloatingPointError(
                f"The plant cannot be integrated from x = {np.asarray(x).tolist()} with u = "
                f"{np.asarray(u).tolist()}: its equations have no value there. Start elsewhere, or "
                "narrow the inputs."
            )
        return reached

    def rate(self, x: ArrayLike, u: ArrayLike) -> Array:
        """Return dx/dt (n,), by PC-Gym's equations; for :meth:`LinearModel.from_dynamics`."""
        return np.array(self._rate(x, u), np.float64).ravel()

    def steady_state(self, set_point: ArrayLike | None = None) -> tuple[Array, Array]:
        """Return x (n,) and u (m,) that rest at a set-point (p,), by default the middle one.

        Of several steady states the one near the start is returned, with inputs near the middle of
        their ranges. Raises ValueError where none is found within the bounds.

        Examples
        --------
        >>> x, u = PCGymEnv("four_tank").steady_state([0.3, 0.25])
        >>> x.round(3).tolist()[2:]
        [0.3, 0.25]
        """
        n = len(self.x0)
        (low, width) = self._box()
        r = (self.r_min + self.r_max) / 2 if set_point is None else np.asarray(set_point, float)

        def errors(z: Array, pull: float) -> Array:
            x, u = np.split(low + width * z, [n])
            # A state drifts over a sample; the rest is relative to what it may be.
            drift = self.dt * self.rate(x, u) / width[:n]
            return np.concatenate(
                [drift, (x[self.outputs] - r) / width[self.outputs], pull * (z[n:] - 0.5)]
            )

        z = np.concatenate([(self.x0 - low[:n]) / width[:n], np.full(len(self.u_min), 0.5)])
        for pull in (1e-3, 0.0):  # towards the middle of the inputs, then exactly
            z = np.clip(z, 1e-6, 1 - 1e-6)
            z = least_squares(errors, z, bounds=(0, 1), args=(pull,), xtol=1e-14, ftol=1e-15).x
        if np.max(np.abs(errors(z, 0.0))) > 1e-6:
            raise ValueError(
                f"No steady state was found at the set-point {r.tolist()}, within o_space and "
                "a_space. Pass another set_point, or wider spaces."
            )
        x, u = np.split(low + width * z, [n])
        return x, u

    @property
    def tracking(self) -> Tracking:
        """The outputs that follow set-points, and the box of these, in plant units."""
        return Tracking(self.outputs, self.r_min, self.r_max)

    @property
    def bounds(self) -> dict[str, Array]:
        """Bounds of a :class:`LinearMPC`: of the inputs, and the box of states, in plant units."""
        return {
            "u_min": self.u_min,
            "u_max": self.u_max,
            "theta_min": self.x_min,
            "theta_max": self.x_max,
        }

    def linear_model(
        self, set_point: ArrayLike | None = None, *, offset_free: bool = False
    ) -> LinearModel:
        """Return the plant's equations, linearized at :meth:`steady_state`, with names and units.

        With ``offset_free`` each state has an unmeasured disturbance d, for an observer to
        estimate; d = 1 moves it in a sample by a twentieth of its range.

        Examples
        --------
        >>> print(PCGymEnv("cstr").linear_model().state_names)
        ('Ca', 'T')
        """
        x, u = self.steady_state(set_point)
        scale = self._box()[1] / 2
        model = LinearModel.from_dynamics(self.rate, x, u, self.dt, scale=scale)
        if offset_free:
            E = np.diag(DISTURBED * scale[: len(x)])
            own = {"E": E, "d_ss": np.zeros(len(x)), "estimated": range(len(x))}
            model = LinearModel(**{**vars(model), **own})
        return model.named(self.state_names, self.input_names, self.units)

    def _box(self) -> tuple[Array, Array]:
        """Return the lowest states and inputs (n + m,), and the width of their ranges."""
        low = np.concatenate([self.x_min, self.u_min])
        return low, np.concatenate([self.x_max, self.u_max]) - low

    def _drawn(self) -> Array:
        """Return set-points (N, p), drawn anew where a schedule changes."""
        moves = np.any(np.diff(self.schedule, axis=0) != 0, axis=1)
        piece = np.concatenate([[0], np.cumsum(moves)])
        drawn = self.np_random.uniform(self.r_min, self.r_max, (piece[-1] + 1, len(self.r_min)))
        return np.array(drawn[piece])

    def _seen(self) -> Single:
        """Return what is observed: the states, and the set-points for the next action."""
        assert self.state is not None  # after a reset
        x = self.state
        if self.noise:
            x = x * (1 + self.noise * self.np_random.standard_normal(x.shape))
        return np.asarray(np.concatenate([x, self.wanted[self.taken]]), np.float32)

    def _violates(self, u: Array) -> bool:
        """Tell whether PC-Gym finds a constraint violated, by its own function."""
        plant = self.plant
        if not (plant.constraint_active or plant.custom_constraint_active):
            return False
        plant.t = self.taken
        return bool(plant.constraint_check(self.state, u))

    def _reward(self, u: Array, violation: bool) -> float:
        """Return PC-Gym's reward, by its own function."""
        plant = self.plant
        shown = self.wanted[self.taken - 1]
        plant.t = self.taken
        state = np.concatenate([self.state, shown])
        if plant.custom_reward:
            return float(np.squeeze(plant.custom_reward_f(plant, state, u, violation)))
        return float(np.squeeze(plant.reward_fn(state, violation)))


class _Split:
    """A model of PC-Gym that unpacks its states, which CasADi's vectors do not allow.

    Parameters
    ----------
    model : object
        Of ``pcgym.model_classes``.
    """

    def __init__(self, model: Any) -> None:
        self.model = model
        self.int_method = "casadi"

    def __call__(self, x: Any, u: Any) -> Any:
        """Return dx/dt for vectors of CasADi."""
        import casadi

        return self.model(casadi.vertsplit(x), casadi.vertsplit(u))

    def info(self) -> Any:
        """Return what the model tells of itself."""
        return self.model.info()


def _playable(given: dict[str, Any]) -> dict[str, Any]:
    """Return PC-Gym's parameters, with a model that PC-Gym cannot make by name made for it."""
    name = given.get("model")
    if given.get("custom_model") is not None or not isinstance(name, str):
        return given
    _make_env()
    from pcgym import model_classes

    made = getattr(model_classes, name, None)
    if made is None or "int_method" in inspect.signature(made).parameters:
        return given
    return {**given, "custom_model": _Split(made())}


def _make_env() -> Any:
    """Return PC-Gym's class of environments."""
    try:
        from pcgym import make_env
    except ImportError as error:
        raise ImportError(
            f"PC-Gym cannot be imported ({error}). It needs Python 3.11 or newer: "
            "pip install 'sb3-yann[pcgym]'."
        ) from error
    return make_env


def _checked(given: str | Mapping[str, Any]) -> Parameters:
    """Return PC-Gym's parameters, checked, for absolute values and its CasADi integrator."""
    if isinstance(given, str):
        if given not in CASES:
            raise ValueError(
                f"parameters = {given!r} must be one of {sorted(CASES)}, or the mapping that "
                "pcgym.make_env takes."
            )
        given = CASES[given]()
    if not isinstance(given, Mapping):
        raise TypeError(f"parameters = {given!r} must be a name or a mapping.")
    missing = [key for key in NEEDED if key not in given]
    unknown = [key for key in NOT_HERE if given.get(key) is not None]
    if missing or unknown:
        raise ValueError(
            f"parameters lack {missing} and hold {unknown}, which is not supported here. Give what "
            "is missing; for the rest pass a custom_model of the plant as it is."
        )
    return {**given, "normalise_a": False, "normalise_o": False, "integration_method": "casadi"}


def _ranges(
    schedules: Mapping[str, ArrayLike], asked: Mapping[str, tuple[float, float]] | None
) -> tuple[Array, Array]:
    """Return the lowest and highest set-points (p,)."""
    asked = {} if asked is None else asked
    unknown = sorted(set(asked) - set(schedules))
    if unknown:
        raise ValueError(f"set_points holds {unknown}; the plant's are {sorted(schedules)}.")
    both = [asked.get(k, (np.min(v), np.max(v))) for k, v in schedules.items()]
    low, high = np.array(both, np.float64).T
    if not np.all(low <= high):  # nor is NaN
        raise ValueError(f"set_points = {dict(asked)} must hold pairs (low, high) in this order.")
    return low, high
