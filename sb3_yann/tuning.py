"""Search spaces for RL Zoo: ``--gym-packages sb3_yann.tuning`` puts them in the place of its own.

The Zoo's spaces for DDPG, TD3, SAC and TQC draw activations that are not zero at zero and networks
that YANN has not, and a trial loses the `policy_kwargs` of its entry, the problem with them. Trials
of a `YannPolicy` have these spaces; others keep the Zoo's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextvars import ContextVar
from functools import partial
from typing import Any

from rl_zoo3 import hyperparams_opt
from rl_zoo3.exp_manager import ExperimentManager

Space = Callable[..., dict[str, Any]]
WIDTHS = {"small": [8, 8], "paper": [16, 16], "large": [32, 32], "largest": [64, 64]}
POLICY_OPTIONS = "actor_lr_mult", "critic_warmup", "networks"
"""Those of the parameters that are the policy's."""

_entry: ContextVar[Mapping[str, Any] | None] = ContextVar("entry", default=None)


def sample(trial: Any) -> dict[str, Any]:
    """Return hyperparameters of a model with a YannPolicy, drawn by a trial of Optuna.

    There is no exploration to tune, and no discount: it is the problem's. `policy_kwargs` has only
    what is drawn.

    Examples
    --------
    >>> import optuna
    >>> found = sample(optuna.trial.FixedTrial(dict(learning_rate=1e-3, tau=0.01, batch_size=256,
    ...     gradient_steps=1, actor_lr_mult=0.1, critic_warmup=2000, networks="shared",
    ...     widths="paper", critic_widths="largest")))
    >>> found["policy_kwargs"]["net_arch"]
    {'pi': [16, 16], 'qf': [64, 64]}
    """
    drawn = {
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 1e-2, log=True),
        "tau": trial.suggest_float("tau", 1e-3, 5e-2, log=True),
        "batch_size": trial.suggest_categorical("batch_size", [64, 128, 256, 512]),
        "gradient_steps": trial.suggest_categorical("gradient_steps", [1, 2, 4]),
        "actor_lr_mult": trial.suggest_float("actor_lr_mult", 1e-2, 1.0, log=True),
        "critic_warmup": trial.suggest_categorical("critic_warmup", [500, 1000, 2000, 4000]),
        "networks": trial.suggest_categorical("networks", ["per_region", "shared"]),
        "widths": trial.suggest_categorical("widths", [*WIDTHS]),
        "critic_widths": trial.suggest_categorical("critic_widths", [*WIDTHS]),
    }
    return convert(drawn)


def convert(params: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of such a model for the parameters of a trial, as a study keeps them."""
    found = dict(params)
    widths = {"pi": WIDTHS[found.pop("widths")], "qf": WIDTHS[found.pop("critic_widths")]}
    policy_kwargs = {name: found.pop(name) for name in POLICY_OPTIONS if name in found}
    return {**found, "policy_kwargs": {**policy_kwargs, "net_arch": widths}}


def _sample(theirs: Space, trial: Any, *rest: Any) -> dict[str, Any]:
    """Draw for a YannPolicy, and keep what its entry says otherwise; else as the Zoo does."""
    entry = _entry.get()
    if entry is None or entry.get("policy") != "YannPolicy":
        return theirs(trial, *rest)
    drawn = sample(trial)
    kept = {**(entry.get("policy_kwargs") or {}), **drawn["policy_kwargs"]}
    return {**drawn, "policy_kwargs": kept}


def _convert(theirs: Space, params: Mapping[str, Any]) -> dict[str, Any]:
    return convert(params) if "critic_widths" in params else theirs(params)


def _objective(theirs: Callable[..., float], self: Any, trial: Any) -> float:
    token = _entry.set(self._hyperparams)
    try:
        return theirs(self, trial)
    finally:
        _entry.reset(token)


def _install() -> None:
    for name in ("ddpg", "td3", "sac", "tqc"):
        for table, ours in (
            (hyperparams_opt.HYPERPARAMS_SAMPLER, _sample),
            (hyperparams_opt.HYPERPARAMS_CONVERTER, _convert),
        ):
            table[name] = partial(ours, table[name])
    theirs = ExperimentManager.objective
    ExperimentManager.objective = lambda self, trial: _objective(theirs, self, trial)  # type: ignore[method-assign]


_install()
