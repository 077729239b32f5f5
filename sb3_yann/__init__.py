"""Reinforcement learning that starts as a linear MPC: a Stable-Baselines3 plugin.

Importing registers the environments ``CSTR-v0`` and ``ClippedPendulum-v0`` with Gymnasium, and the
policy alias ``"YannPolicy"`` with TD3 and DDPG. Names are loaded at their first use (PEP 562), so
that ``import sb3_yann.control`` loads neither PyTorch nor Stable-Baselines3.

Examples
--------
>>> import gymnasium, sb3_yann
>>> env = gymnasium.make("CSTR-v0")
>>> env.observation_space.problem.explicit().n_regions
7
"""

import importlib
import importlib.abc
import importlib.util
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

import sb3_yann_envs

if TYPE_CHECKING:
    from sb3_yann.audit import CostAudit as CostAudit
    from sb3_yann.audit import CostFinding as CostFinding
    from sb3_yann.audit import CostMismatchError as CostMismatchError
    from sb3_yann.audit import CostMismatchWarning as CostMismatchWarning
    from sb3_yann.callbacks import ControlDiagnostics as ControlDiagnostics
    from sb3_yann.callbacks import NoActionNoise as NoActionNoise
    from sb3_yann.control import DisturbanceBounds as DisturbanceBounds
    from sb3_yann.control import DisturbanceObserver as DisturbanceObserver
    from sb3_yann.control import ExplicitLimitError as ExplicitLimitError
    from sb3_yann.control import ExplicitSolutionError as ExplicitSolutionError
    from sb3_yann.control import Identified as Identified
    from sb3_yann.control import LinearModel as LinearModel
    from sb3_yann.control import LinearMPC as LinearMPC
    from sb3_yann.control import OutputBounds as OutputBounds
    from sb3_yann.control import PiecewiseAffine as PiecewiseAffine
    from sb3_yann.control import RateLimits as RateLimits
    from sb3_yann.control import SoftBounds as SoftBounds
    from sb3_yann.control import Terminal as Terminal
    from sb3_yann.control import Tracking as Tracking
    from sb3_yann.control import identify as identify
    from sb3_yann.guard import AcceptanceRule as AcceptanceRule
    from sb3_yann.guard import Decision as Decision
    from sb3_yann.guard import ImprovementGuard as ImprovementGuard
    from sb3_yann.guard import StepSize as StepSize
    from sb3_yann.guard import restore_accepted as restore_accepted
    from sb3_yann.policy import AffineObservation as AffineObservation
    from sb3_yann.policy import CriticOptions as CriticOptions
    from sb3_yann.policy import NonFiniteWarning as NonFiniteWarning
    from sb3_yann.policy import YannActor as YannActor
    from sb3_yann.policy import YannCritic as YannCritic
    from sb3_yann.policy import YannPolicy as YannPolicy
    from sb3_yann.policy import register_problem as register_problem
    from sb3_yann_envs import ActionRepeat as ActionRepeat

__version__ = "0.1.0"

_NAMES = {
    "sb3_yann.audit": ["CostAudit", "CostFinding", "CostMismatchError", "CostMismatchWarning"],
    "sb3_yann.callbacks": ["ControlDiagnostics", "NoActionNoise"],
    "sb3_yann.control": [
        "DisturbanceBounds",
        "DisturbanceObserver",
        "ExplicitLimitError",
        "ExplicitSolutionError",
        "Identified",
        "LinearMPC",
        "LinearModel",
        "OutputBounds",
        "PiecewiseAffine",
        "RateLimits",
        "SoftBounds",
        "Terminal",
        "Tracking",
        "identify",
    ],
    "sb3_yann.guard": [
        "AcceptanceRule",
        "Decision",
        "ImprovementGuard",
        "StepSize",
        "restore_accepted",
    ],
    "sb3_yann.policy": [
        "AffineObservation",
        "CriticOptions",
        "NonFiniteWarning",
        "YannActor",
        "YannCritic",
        "YannPolicy",
        "register_problem",
    ],
    "sb3_yann_envs": ["ActionRepeat"],
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    """Load a public name, or a submodule, at its first use."""
    if name in _HOMES:
        value = globals()[name] = getattr(importlib.import_module(_HOMES[name]), name)
        return value
    if not name.startswith("_") and importlib.util.find_spec(f"{__name__}.{name}") is not None:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})


class _AliasFinder(importlib.abc.MetaPathFinder):
    """Registers the alias when Stable-Baselines3 is imported, however late."""

    def find_spec(self, name: str, *place: Any) -> Any:
        if name != "stable_baselines3":
            return None
        others = (finder for finder in sys.meta_path if finder is not self)
        spec = next(filter(None, (finder.find_spec(name, *place) for finder in others)), None)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def load_and_register(module: ModuleType) -> None:
                load(module)
                sys.meta_path.remove(self)
                importlib.import_module("sb3_yann.policy")

            spec.loader.exec_module = load_and_register  # type: ignore[method-assign]
        return spec


if "stable_baselines3" in sys.modules:
    importlib.import_module("sb3_yann.policy")
else:
    sys.meta_path.insert(0, _AliasFinder())

sb3_yann_envs.register_envs()
