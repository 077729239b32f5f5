"""Pictures of seeded episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from sb3_yann._drawing import COLORS, new_figure, save_figure
from sb3_yann._validation import Array, check_bool, check_type
from sb3_yann.control import LinearMPC
from sb3_yann.control.model.labels import with_units
from sb3_yann.evaluation.episodes import Episodes, as_played


def save_trajectories(
    path: str | PathLike[str],
    runs: Mapping[str, Episodes],
    states: Mapping[int, str],
    inputs: Sequence[str],
    dt: float,
    time_unit: str,
    limits: Mapping[int, tuple[float, str]] | None = None,
    references: Mapping[int, int] | None = None,
) -> Path:
    """Save a picture of states and all inputs over time, a color for each run; return its path.

    Parameters
    ----------
    path : path-like
        Folders are made as needed. Without a suffix it gets ``.png``.
    runs : mapping of str to Episodes
        Every episode of every run is drawn.
    states : mapping of int to str
        The entries of the observation to draw, with their labels.
    inputs : sequence of str
        Labels of the inputs.
    dt : float
        Sampling time, in ``time_unit``.
    time_unit : str
        For the label of the axis.
    limits : mapping of int to (float, str), optional
        A limit of an entry of the observation, and its label.
    references : mapping of int to int, optional
        The entry of the observation that is the set-point of another, drawn as a dashed line.

    Examples
    --------
    >>> import tempfile
    >>> from sb3_yann.evaluation import evaluate
    >>> runs = {"no input": evaluate(lambda _: [0.0], "CSTR-v0", [0])}
    >>> folder = tempfile.mkdtemp()
    >>> save_trajectories(f"{folder}/run.png", runs, {0: "level"}, ["flow"], 1.0, "s").name
    'run.png'
    """
    runs = _as_runs(runs)
    figure = new_figure(8, 2.4 * (len(states) + len(inputs)))
    panels = figure.subplots(len(states) + len(inputs), 1, sharex=True, squeeze=False)[:, 0]
    _draw(panels, runs, [*states], dt, references or {})
    for panel, i in zip(panels, states, strict=False):
        if limits and i in limits:
            panel.axhline(limits[i][0], color="black", linestyle="--", label=limits[i][1])
            panel.legend(loc="best")
    for panel, label in zip(panels, [*states.values(), *inputs], strict=True):
        panel.set_ylabel(label)
        panel.grid(alpha=0.3)
    panels[0].legend(loc="best")
    panels[-1].set_xlabel(f"time ({time_unit})")
    return save_figure(figure, path, dpi=120)


def save_plant_trajectories(
    path: str | PathLike[str],
    runs: Mapping[str, Episodes],
    problem: LinearMPC,
    time_unit: str,
    entries: Sequence[int] | None = None,
    labels: Mapping[int, str] | None = None,
    limits: Mapping[int, tuple[float, str]] | None = None,
    absolute: bool = False,
) -> Path:
    """Save a picture in the plant's own units, with the model's names; return its path.

    A state with a set-point shows it as a dashed line.

    Parameters
    ----------
    path : path-like
        Folders are made as needed. Without a suffix it gets ``.png``.
    runs : mapping of str to Episodes
        Their observations are theta.
    problem : LinearMPC
        Its model has the operating point, the sampling time, names and units.
    time_unit : str
        For the label of the axis.
    entries : sequence of int, optional
        The entries of theta to draw; all states by default.
    labels : mapping of int to str, optional
        Labels of entries that the model has no name for.
    limits : mapping of int to (float, str), optional
        A limit of an entry as the plant shows it, and its label.
    absolute : bool, default False
        Whether the episodes are in the plant's units already.

    Raises
    ------
    ValueError
        If observations or actions have another size than theta and the inputs.

    Examples
    --------
    >>> import tempfile
    >>> import gymnasium
    >>> from sb3_yann.evaluation import evaluate
    >>> runs = {"no input": evaluate(lambda _: [0.0], "CSTR-v0", [0])}
    >>> mpc = gymnasium.make("CSTR-v0").observation_space.problem
    >>> folder = tempfile.mkdtemp()
    >>> save_plant_trajectories(f"{folder}/run.png", runs, mpc, "h", entries=[3]).name
    'run.png'
    """
    check_type("problem", problem, LinearMPC, "a LinearMPC")
    whole = 0 if check_bool("absolute", absolute) else 1
    shift = whole * problem.theta_ss, whole * problem.model.u_ss
    shown = [*range(problem.model.n_states)] if entries is None else [*entries]
    names = dict(enumerate(problem.labels(units=True))) | dict(labels or {})
    return save_trajectories(
        path,
        {name: shifted(name, episodes, *shift) for name, episodes in _as_runs(runs).items()},
        {i: names[i] for i in shown},
        with_units(problem.model)[1],
        problem.model.dt,
        time_unit,
        limits,
        {i: r for i, r in problem.set_points.items() if i in shown},
    )


def shifted(name: str, episodes: Episodes, theta_ss: Array, u_ss: Array) -> Episodes:
    """Return episodes with an operating point added.

    Parameters
    ----------
    name : str
        Of the episodes, for an error.
    episodes : Episodes
        Their observations are theta.
    theta_ss, u_ss : ndarray, shapes (n_theta,) and (m,)
        What is added.
    """
    for x, u in zip(episodes.observations, episodes.actions, strict=True):
        if x.shape[1:] != theta_ss.shape or u.shape[1:] != u_ss.shape:
            raise ValueError(
                f"An episode of {name!r} has observations {x.shape} and actions {u.shape}, but "
                f"theta has {theta_ss.size} entries and there are {u_ss.size} inputs. Draw what "
                "the env shows by save_trajectories."
            )
    return replace(
        episodes,
        observations=tuple(x + theta_ss for x in episodes.observations),
        actions=tuple(u + u_ss for u in episodes.actions),
    )


def _as_runs(runs: Mapping[str, Episodes]) -> dict[str, Episodes]:
    """Return runs by their names, else raise TypeError."""
    check_type("runs", runs, Mapping, "a mapping of names to episodes: {'MPC': evaluate(...)}")
    return {name: as_played(f"runs[{name!r}]", each) for name, each in runs.items()}


def _draw(
    panels: Any, runs: Mapping[str, Episodes], states: Sequence[int], dt: float, references: Any
) -> None:
    for color, (label, episodes) in enumerate(runs.items()):
        style = {"color": COLORS[color % len(COLORS)], "alpha": 0.7, "linewidth": 1.2}
        for k, (x, u) in enumerate(zip(episodes.observations, episodes.actions, strict=True)):
            style["label"] = label if k == 0 else "_nolegend_"
            for panel, i in zip(panels, states, strict=False):
                panel.plot(dt * np.arange(len(x)), x[:, i], **style)
                if i in references and color == 0:  # the same in every run
                    r = x[:, references[i]].copy()
                    r[-1] = r[-2:][0]  # that of a step that nobody takes
                    panel.step(dt * np.arange(len(x)), r, "k--", where="post", linewidth=1.0)
            for j, panel in enumerate(panels[len(states) :]):
                panel.step(dt * np.arange(len(u)), u[:, j], where="post", **style)
