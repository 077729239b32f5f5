"""A policy or a law in production. It needs numpy and `_archive.py`, which needs numpy alone.

Copy both files into one folder, and they run without this package. A policy is evaluated in
float64, and every step checks the readings. The C code of an export does the same.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from enum import IntFlag
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np

try:
    from sb3_yann._archive import read_arrays
except ImportError:  # both files were copied
    from _archive import read_arrays  # type: ignore[import-not-found, no-redef]

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Array = NDArray[np.float64]

FORMAT = 5  # of the arrays: a reader takes no other
POLICY, MPC, MANUAL = MODES = ("policy", "mpc", "manual")
KEPT_ROUNDING = 2.5e-7  # that of `units`, which this file does without


class Status(IntFlag):
    """What a step found. The first four are faults, upon which the controller falls back."""

    NOT_FINITE = 1  # a reading, or manual where it counts, is NaN or infinite
    OUT_OF_RANGE = 2  # a reading is beyond the limits that the export was given
    FROZEN = 4  # a reading stays the same to the bit while others, or the output, move
    LATE = 8  # more time has passed since the last step than it may
    OUTSIDE = 16  # the MPC has no solution there; the law acts by its `infeasible` option
    NETWORK = 32  # a network's output is not finite; the law acted


DRIVING = 0.01  # of an input's range: an output that moves by more moves the plant
SENSOR = Status.NOT_FINITE | Status.OUT_OF_RANGE | Status.FROZEN
ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0),
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
}


def _as_readings(name: str, value: Any) -> Array:
    """Return numbers as float64, NaN where they are masked; raise TypeError if they are none."""
    try:
        if isinstance(value, np.ma.MaskedArray):
            wide: Any = value.astype(np.result_type(value, np.float64))
            value = wide.filled(np.nan)
        found = np.asarray(value)
        if found.dtype.kind == "c":
            raise TypeError("they are complex")
        return found.astype(np.float64, copy=False)
    except (OverflowError, RuntimeError, TypeError, ValueError) as error:
        raise TypeError(
            f"{name} must be real numbers ({error}). Pass floats, and NaN for a reading that is "
            "missing."
        ) from None


class Controller:
    """What runs in production: ``controller(obs)`` is the action, with a fallback at every step.

    With an estimator obs are the measured outputs y, then references and what else theta holds and
    nothing estimates: ``controller([*y, *r, *d])``.

    A faulty reading is replaced by the last good one, and the MPC's law acts alone. An estimator
    goes on without a faulty output. After ``hold``
    steps with a fault the output is held: manual. Once the readings are good again the law acts,
    and at the ``recover``-th good step the policy. At every change the output goes on from where it
    was, and the difference fades within ``transfer`` steps.

    Take it from :meth:`load`; the limits of the checks are in the file, see `export`.

    Attributes
    ----------
    request : {"policy", "mpc", "manual"}
        What the operator wants: the policy at first. "mpc" leaves the networks out.
    mode : {"policy", "mpc", "manual"}
        What acted at the last step.
    status : Status
        What the last step found; 0 for nothing.
    counters : dict of str to int
        Steps, those of each mode, those with each status, and changes of the mode.
    name : str
    obs_names, action_names : tuple of str
        What the entries of a step are called.
    note : str
        What it lacks, such as an estimator that the caller runs; empty where nothing.

    Examples
    --------
    >>> import sb3_yann
    >>> from stable_baselines3 import DDPG
    >>> model = DDPG("YannPolicy", "CSTR-v0", device="cpu")
    >>> _ = sb3_yann.export(model, "reactor.npz")
    >>> controller = Controller.load("reactor.npz")
    >>> action = controller([0.1, 0.0, 0.0, -5.0])
    >>> bool(np.allclose(action, model.predict(np.float32([0.1, 0, 0, -5]))[0], atol=1e-4))
    True
    >>> held = controller([np.nan, 0.0, 0.0, -5.0])
    >>> controller.mode, controller.status.name, bool(np.allclose(held, action))
    ('mpc', 'NOT_FINITE', True)
    """

    def __init__(self, data: Mapping[str, Any]) -> None:
        if not isinstance(data, Mapping):
            raise TypeError(
                f"data = {data!r} must be the arrays of an export by their names: take "
                "Controller.load(path)."
            )
        self.data = {name: np.asarray(each) for name, each in data.items()}
        try:
            if (version := int(self.data["format"])) != FORMAT:
                raise ValueError(
                    f"The controller has format {version}, this reader takes {FORMAT}. Export the "
                    "model again, or take the reader of the version that wrote it."
                )
            self.name = str(self.data["name"])
            self.activation = str(self.data["activation"])
            self.note = str(self.data.get("note", ""))
            self.obs_names = tuple(map(str, self.data["obs_names"]))
            self.action_names = tuple(map(str, self.data["action_names"]))
            self.reset()
            self(self.data["obs_rest"])  # arrays that do not fit together fail in a step
            self.reset()
        except KeyError as error:
            raise ValueError(
                f"data has no {error}: take all arrays that export wrote, by Controller.load(path)."
            ) from None
        except (IndexError, TypeError) as error:
            raise ValueError(f"The arrays do not fit together: {error}.") from None

    def __repr__(self) -> str:
        """Name the entries, who acted last, and what it lacks."""
        arguments = f"{self.name!r}, obs={[*self.obs_names]}, action={[*self.action_names]}"
        lacks = f", NOTE: {self.note}" if self.note else ""
        return f"Controller({arguments}, mode={self.mode!r}{lacks})"

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Controller:
        """Return the controller of a file that `export` wrote.

        Nothing of the file is executed. OSError if it cannot be read; ValueError if it holds no
        controller, was changed since it was written, or is of before files had digests.
        """
        try:
            return cls(read_arrays(path))
        except OSError:
            raise
        except Exception as error:  # arrays of a stranger raise nearly all there is
            what = str(error) or type(error).__name__
            raise ValueError(
                f"{path} holds no controller ({what}). Write it with export(model, path)."
            ) from None

    def reset(self) -> None:
        """Forget all steps, as at the start: the policy acts, from the operating point."""
        n_read = len(self.data["obs_rest"])
        m = len(self.data["action_scale"])
        self.request = self.mode = POLICY
        self.status = Status(0)
        found = [str(each.name).lower() for each in Status]
        self.counters = dict.fromkeys(["steps", *MODES, *found, "changes"], 0)
        self._good: Array = self.data["obs_rest"].astype(np.float64)  # the last good readings
        self._last: Array = np.full(n_read, np.nan)
        self._same: NDArray[np.int64] = np.zeros(n_read, np.int64)
        self._absent: NDArray[np.int64] = np.zeros(n_read, np.int64)
        self._faults = 0
        self._sound = int(self.data["recover"])
        rest = self.data["resting"] * self.data["action_scale"] + self.data["action_shift"]
        self._output: Array = rest  # u_ss, within its bounds
        self._estimate: Array | None = None  # x_hat, d_hat in plant units
        self._loads: Array = np.zeros(0)  # the measured disturbances that act until the next step
        self._bump = np.zeros(m)
        self._left = 0
        self._anchor: Array = self._output  # what came out when a reading moved last

    def evaluate(self, obs: ArrayLike, networks: bool = True) -> Array:
        """Return the policy's actions, without memory: (m,), or (batch, m) for a batch.

        ``obs`` (n_obs,) or (batch, n_obs) are in the units of the export; with an estimator, what
        the policy sees of it. What is not finite counts as at the operating point, and the law
        acts then, as in `model.predict`. Without ``networks`` it is the MPC's law.
        """
        rows, single = self._rows(obs, len(self.data["source"]))
        action: Array = self._act(rows, networks)[0]
        action = action * self.data["action_scale"] + self.data["action_shift"]
        return action[0] if single else action

    def in_domain(self, obs: ArrayLike) -> NDArray[np.bool_]:
        """Return where the MPC has a solution: a bool, or (batch,)."""
        rows, single = self._rows(obs, len(self.data["source"]))
        inside: NDArray[np.bool_] = self._act(rows, False)[3]
        return inside[0] if single else inside

    def __call__(
        self, obs: ArrayLike, elapsed: float | None = None, manual: ArrayLike | None = None
    ) -> Array:
        """Make one step; return the action (m,).

        Parameters
        ----------
        obs : array_like, shape (n_obs,)
            In the units of the export.
        elapsed : float, optional
            Time since the last step, in units of dt. None is in time.
        manual : array_like, shape (m,), optional
            The operator's output where he asks for it; otherwise it is held while manual. At the
            first step it is the plant's present input, whoever acts: the output goes on from it,
            and the estimator starts at rest there. Without it, it starts at the operating point.

        Raises
        ------
        ValueError
            If a shape is wrong, or ``request`` is none of the three.
        """
        rows, _ = self._rows(obs, len(self._good), batch=False)
        if self.request not in MODES:
            raise ValueError(f"request = {self.request!r} must be one of {MODES}.")
        data = self.data
        m = len(self._output)
        given, known, fault = self._by_hand(manual)
        faulty, status = self._readings(rows[0])
        if elapsed is not None and elapsed > float(data["late_after"]):
            status |= Status.LATE
        mode = self._mode(status)
        status |= fault  # no fault of a sensor, which mode would follow
        seen = self._seen(rows[0], faulty, known)
        action, low, high, inside, sound = self._act(seen[None], mode == POLICY)
        status |= Status(0) if inside[0] else Status.OUTSIDE
        status |= Status(0) if sound[0] else Status.NETWORK
        scale = data["action_scale"]
        shift = data["action_shift"]
        target = action[0] * scale + shift
        if mode == MANUAL:
            by_hand = np.isfinite(given) & (self.request == MANUAL)
            target = np.where(by_hand, given, self._output)
        if mode != self.mode or known:
            self.counters["changes"] += mode != self.mode
            self._left = int(data["transfer"])
            self._bump = self._output - target
        if mode == MANUAL:
            self._left = 0  # the operator's output is taken as it is
        if self._left > 0:
            target = target + self._bump * (self._left / int(data["transfer"]))
            self._left -= 1
        if len(data["change"]):
            shows_previous = data["source"][(data["obs_matrix"][-m:] != 0).any(0)]
            lost = self._good != rows[0]
            if lost[shows_previous[shows_previous < len(lost)]].any():
                last = (self._output - shift) / scale  # rates count from the own output then
                low, high = np.clip(last + data["change"], *data["bounds"])[:, None]
        self._output = np.clip(target, low[0] * scale + shift, high[0] * scale + shift)
        self._anchor = self._output if self._moved else self._anchor
        self.mode = mode
        self.status = status
        found = [str(each.name).lower() for each in Status if each in status]
        for name in ("steps", mode, *found):
            self.counters[name] += 1
        return self._output.copy()

    def _by_hand(self, manual: ArrayLike | None) -> tuple[Array, bool, Status]:
        """Return manual (m,), whether the output goes on from it, and what is wrong with it."""
        m = len(self._output)
        given = np.full(m, np.nan) if manual is None else _as_readings("manual", manual)
        if given.shape != (m,):
            raise ValueError(f"manual has shape {given.shape}, expected ({m},).")
        begins = self.counters["steps"] == 0
        finite = bool(np.isfinite(given).all())
        if begins and finite:
            self._warn_of_present(given)
            self._output = given.copy()
        wanted = manual is not None and (begins or self.request == MANUAL)
        fault = Status.NOT_FINITE if wanted and not finite else Status(0)
        return given, begins and finite, fault

    def _warn_of_present(self, given: Array) -> None:
        """Warn of a present input (m,) that is further beyond its bounds than half their width."""
        low, high = self.data["bounds"] * self.data["action_scale"] + self.data["action_shift"]
        room = (high - low) / 2
        for i in np.flatnonzero((given < low - room) | (given > high + room)):
            warnings.warn(
                f"The plant's present input, manual = {given[i]:g} of {self.action_names[i]}, is "
                f"far beyond its bounds, {low[i]:g} to {high[i]:g}: the output begins at one of "
                "them. Is it in another unit?",
                stacklevel=4,
            )

    def _readings(self, obs: Array) -> tuple[NDArray[np.bool_], Status]:
        """Keep the good readings; return which others there are, and what is wrong with them."""
        finite = np.isfinite(obs)
        status = Status(0)
        beyond = finite & ((obs < self.data["obs_min"]) | (obs > self.data["obs_max"]))
        moved = obs != self._last
        others = (moved & finite & np.isfinite(self._last)).any()  # NaN has not moved
        self._moved = bool(others) or not self.counters["steps"]
        least = DRIVING * np.ptp(self.data["bounds"], axis=0) * self.data["action_scale"]
        drives = (np.abs(self._output - self._anchor) > least).any()
        self._same = np.where(moved, 0, self._same + bool(self._moved or drives))
        self._last = obs.copy()  # a caller may fill the same array again
        after = int(self.data["frozen_after"])
        frozen = finite & self.data["watched"] & (self._same >= after) & (after > 0)
        self._absent = np.where(finite, 0, self._absent + 1)
        for which, flag in (
            (self._absent > self.data["missing"], Status.NOT_FINITE),
            (beyond, Status.OUT_OF_RANGE),
            (frozen, Status.FROZEN),
        ):
            status |= flag if which.any() else Status(0)
        faulty = ~finite | beyond | frozen
        self._good = np.where(faulty, self._good, obs)
        return faulty, status

    def _seen(self, obs: Array, faulty: NDArray[np.bool_], known: bool) -> Array:
        """Return what the policy sees: good readings, estimates and the last input in place."""
        data = self.data
        if "est_gain" not in data:
            return np.asarray(self._good[data["source"]])
        scale, shift = data["est_input"]
        u = self._output * scale + shift
        q = len(data["est_C"])
        y = np.where(faulty, np.nan, obs)[:q]
        loads = self._good[data["est_loads"]]
        rest = data["obs_rest"][:q]
        with np.errstate(over="ignore", invalid="ignore"):
            if self._estimate is not None:
                found = data["est_next"] @ [*self._estimate, *u, *self._loads, 1.0]
                left = y - data["est_C"] @ found
                found = found + data["est_gain"] @ np.where(np.isfinite(left), left, 0.0)
            elif known:
                found = data["est_rest"] @ [*np.where(np.isnan(y), rest, y), *u, *loads, 1.0]
            else:
                found = data["est_first"] @ [*np.where(np.isnan(y), rest, y), 1.0]
        if not np.isfinite(found).all():
            found = data["est_first"] @ [*rest, 1.0]
        self._estimate = np.clip(found, *data["est_box"])
        self._loads = loads
        shown = np.concatenate([self._good, self._estimate, u])
        return np.asarray(shown[data["source"]])

    def _mode(self, status: Status) -> str:
        self._faults = self._faults + 1 if status & SENSOR else 0
        recover = int(self.data["recover"])
        self._sound = 0 if status else min(self._sound + 1, recover)
        if self.request == MANUAL or self._faults > int(self.data["hold"]):
            return MANUAL
        return MPC if self.request == MPC or self._sound < recover else POLICY

    def _rows(self, obs: ArrayLike, size: int, batch: bool = True) -> tuple[Array, bool]:
        given = _as_readings("obs", obs)
        if given.ndim not in (1, 1 + batch) or given.shape[-1] != size:
            names = f": {', '.join(self.obs_names)}" * (size == len(self.obs_names))
            more = f" or (batch, {size})" if batch else ""
            wanted = f"expected ({size},){more}{names}"
            wanted += ". evaluate(obs) takes a batch" * (not batch and given.ndim > 1)
            raise ValueError(f"obs has shape {given.shape}, {wanted}.")
        return np.atleast_2d(given), given.ndim == 1

    def _act(self, obs: Array, networks: bool) -> tuple[Any, ...]:
        """Return actions in [-1, 1], their bounds, where the MPC has a solution, and a network one.

        All but the last two, (batch,), are (batch, m).
        """
        data = self.data
        lost = ~np.isfinite(obs)
        with np.errstate(over="ignore", invalid="ignore"):
            theta = np.where(lost, 0.0, obs) @ data["obs_matrix"].T + data["obs_offset"]
        theta[(lost @ (data["obs_matrix"] != 0).T) | np.isnan(theta)] = 0.0
        theta = np.clip(theta, *data["ends"])
        region, inside = self._locate(theta)
        law = (data["gains"][region] @ theta[..., None])[..., 0] + data["offsets"][region]
        if "qp_gram" in data:
            less, inside = _constrained(data, theta)
            law = law - less
        if data["zero_input"]:
            law = np.where(inside[:, None], law, data["resting"])
        low, high = np.broadcast_to(data["bounds"][:, None], (2, *law.shape))
        law = np.clip(np.nan_to_num(law), low, high)
        if len(data["moving"]):  # bounds in theta, the lower one first
            shown = theta[:, data["moving"]] * data["per_input"] - data["middle"]
            shown = np.clip(np.swapaxes(shown, 0, 1), low, high)
            low, high = np.where(data["moving"][:, None] >= 0, shown, [low, high])
            high = np.maximum(low, high)
        if len(data["change"]):  # these are reached as fast as the rate allows
            last = theta[:, -law.shape[1] :] * data["per_input"] - data["middle"]
            slowest = np.clip(last + data["change"][:, None], *data["bounds"])
            low = np.clip(low, *slowest)
            high = np.clip(high, *slowest)
        law = np.clip(law, low, high)
        sound = np.ones(len(law), bool)
        action = law
        if networks:
            middle, per_half, (full, none) = *data["confines"], data["fades"]
            beyond = (np.abs(theta - middle) * per_half).max(1)
            part = np.clip((none - beyond) / (none - full), 0, 1)  # of a correction that counts
            part = np.where(lost.any(1), 0.0, part)[:, None]
            added = self._networks(theta * data["per_theta"], data["network_of"][region])
            sound = np.isfinite(added).all(1) | (part[:, 0] == 0)
            added = np.clip(np.where(sound[:, None], added, 0.0), -data["reach"], data["reach"])
            total = law + np.where(part > 0, added * part, 0.0)
            action = np.clip(total, low, high)
            adds = (total != law).any(1)
            if len(data["kept"]) and adds.any():
                ends = law[adds], action[adds], low[adds], high[adds]
                action[adds] = self._kept(theta[adds], *ends)
        return action, low, high, inside, sound

    def _kept(self, theta: Array, law: Array, action: Array, low: Array, high: Array) -> Array:
        """Return actions that break no row further than the law: by the row they break most."""
        kept = self.data["kept"]
        n = theta.shape[1]
        a = kept[:, :n]
        b = kept[:, n:-2]
        c = kept[:, -2]
        margin = kept[:, -1]
        slack = c - theta @ a.T - law @ b.T
        room = np.maximum(slack - margin, 0)
        beyond = (action - law) @ b.T - np.minimum(slack, room)
        worst = beyond.argmax(1)
        most = beyond.max(1)[:, None]
        reach = self.data["reach"]
        moved = np.clip(action - most * b[worst], law - reach, law + reach)
        moved = np.clip(moved, low, high)
        push = (moved - law) @ b.T
        share = ((room + KEPT_ROUNDING) / np.maximum(push, KEPT_ROUNDING)).min(1)[:, None]
        moved = np.clip(law + np.minimum(share, 1) * (moved - law), low, high)
        return np.where(most > 0, moved, action)

    def _locate(self, theta: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the first region that theta violates least, and whether it holds theta."""
        data = self.data
        rows = max(1, 4_000_000 // len(data["b"]))  # entries of slacks in memory at a time
        tolerance, tie = data["tolerances"]
        region = np.empty(len(theta), np.int64)
        inside = np.empty(len(theta), bool)
        for i in range(0, len(theta), rows):
            slack = data["b"] - theta[i : i + rows] @ data["A"].T
            slack = np.minimum.reduceat(slack, data["starts"], axis=1)
            largest = slack.max(1)
            nearly = largest - tie * (1 + np.abs(largest))
            region[i : i + rows] = (slack >= nearly[:, None]).argmax(1)
            off = np.abs(theta[i : i + rows] - data["box_middle"]) * data["box_per_half"]
            inside[i : i + rows] = np.minimum(largest, 1 - off.max(1)) >= -tolerance
        return region, inside

    def _networks(self, x: Array, used: NDArray[np.int64]) -> Array:
        """Return (batch, m): what network number ``used`` puts out, zero for -1."""
        data = self.data
        act = ACTIVATIONS[self.activation]
        layers = [data[f"layer{i}"] for i in range(int(data["n_layers"]))]
        found = np.zeros((len(x), len(data["action_scale"])))
        for k in np.unique(used[used >= 0]):
            rows = used == k
            pinned = bool(data["pinned"][k])
            y = x[rows]
            at_zero = pinned & ~y.any(1, keepdims=True)
            with np.errstate(over="ignore", invalid="ignore"):
                for layer in layers[:-1]:
                    W = layer[k, :, :-1]
                    b = layer[k, :, -1]
                    y = act(y @ W.T + b) - (act(b) if pinned else 0.0)
                W = layers[-1][k, :, :-1]
                b = layers[-1][k, :, -1]
                y = y @ W.T + (0.0 if pinned else b)
            found[rows] = np.where(at_zero, 0.0, y)
        return found


def steps_of(data: Mapping[str, Any]) -> int:
    """Return the most steps in which the program of an online law is solved."""
    return 10 * (len(data["qp_d0"]) + 10)


def _constrained(data: Mapping[str, Any], theta: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return what constraints take from the law without any (batch, m), and what is feasible.

    Where there is no solution, constraints give way; where that cannot be solved either, within
    `steps_of`, nothing is taken.
    """
    d = data["qp_d0"] + theta @ data["qp_D"]
    free = theta @ data["qp_fixed"][:, :-1].T + data["qp_fixed"][:, -1]
    less = np.zeros((len(theta), data["qp_E"].shape[1]))
    feasible = np.all(free >= -1e-11, axis=1)
    for i, row in enumerate(d):
        found = _solve(data, row, np.zeros_like(row), int(data["qp_most"]))
        feasible[i] &= found is not None
        if not feasible[i] and not data["zero_input"]:
            found = _solve(data, row, data["qp_softness"], len(row))
        if found is not None:
            active, lam = found
            less[i] = lam @ data["qp_E"][active]
    return less, feasible


def _solve(
    data: Mapping[str, Any], d: Array, extra: Array, most: int
) -> tuple[list[int], Array] | None:
    """Return an active set and its multipliers, None where there is no certain answer.

    The dual method of Goldfarb & Idnani (Math. Programming 27, 1983).
    """
    gram = data["qp_gram"] + np.diag(extra)
    # Where constraints give way multipliers are a million times violations, and sums round.
    room = 1e-8 * (1 + max(-d.min(), 0.0)) if np.any(extra) else 1e-10 * (1 + np.abs(d))
    active: list[int] = []
    lam: Array = np.zeros(0)
    for _ in range(steps_of(data)):
        slack = d + lam @ data["qp_gram"][active]
        slack[active] = 0.0
        slack[slack >= -room] = 0.0
        entering = int(np.argmin(slack))
        if slack[entering] >= 0:
            return _certified(data, d, extra, gram, active)
        violation = -float(slack[entering])
        own = 0.0
        while True:
            step = np.linalg.solve(gram[np.ix_(active, active)], gram[active, entering])
            rest = float(gram[entering, entering] - gram[entering, active] @ step)
            ratios = np.divide(lam, step, out=np.full(len(lam), np.inf), where=step > 0)
            length = float(ratios.min(initial=np.inf))
            full = violation / rest if rest > 1e-11 else np.inf
            if not min(full, length) < np.inf or (full <= length and len(active) == most):
                return None
            lam = np.maximum(lam - min(full, length) * step, 0.0)
            own += min(full, length)
            if full <= length:
                active.append(entering)
                lam = np.append(lam, own)
                break
            violation -= length * rest if rest > 1e-11 else 0.0
            leaving = int(np.argmin(ratios))
            del active[leaving]
            lam = np.delete(lam, leaving)
    return None


def _certified(
    data: Mapping[str, Any], d: Array, extra: Array, gram: Array, active: list[int]
) -> tuple[list[int], Array] | None:
    """Return the active set in order with its multipliers, None where a condition fails.

    Where constraints give way multipliers are a million times as large as d, and sums round.
    """
    active = sorted(active)
    tolerance, size = (1e-6, np.abs(d).max()) if np.any(extra) else (1e-9, np.abs(d))
    try:  # transposed, as slacks are computed: large multipliers show the rounding of the two
        lam = np.linalg.solve(gram[np.ix_(active, active)].T, -d[active])
    except np.linalg.LinAlgError:
        return None
    if np.any(lam < -tolerance * (1 + np.abs(lam).max(initial=0.0))):
        return None
    lam = np.maximum(lam, 0.0)
    slack = d + lam @ data["qp_gram"][active]
    rest = slack[active] + extra[active] * lam
    slack[active] = 0.0
    room = np.broadcast_to(tolerance * (1 + size), d.shape)
    holds = np.all(np.abs(rest) <= room[active]) and np.all(slack >= -room)
    return (active, lam) if holds else None
