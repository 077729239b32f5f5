"""Reinforcement learning that starts as a linear MPC: a Stable-Baselines3 plugin.

Importing registers the environments ``CSTR-v0`` and ``ClippedPendulum-v0`` with Gymnasium, and the
policy alias ``"YannPolicy"`` with TD3, DDPG, SAC, PPO and TQC. Names are loaded at their first use
(PEP 562), so that ``import sb3_yann.control`` loads neither PyTorch nor Stable-Baselines3.

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
from typing import Any

import sb3_yann_envs

__version__ = "0.2.0"

_NAMES = {
    "sb3_yann.audit": "CostAudit CostFinding CostMismatchError CostMismatchWarning",
    "sb3_yann.callbacks": "ControlDiagnostics NoActionNoise SimulatedEpisodes",
    "sb3_yann.commissioning": "Batch Commissioning",
    "sb3_yann.control": "DisturbanceBounds DisturbanceObserver ExplicitLimitError "
    "ExplicitSolutionError Identified IdentifiedOutputs LinearCost LinearMPC LinearModel "
    "MixedBounds OnlineLaw OnlineLawWarning OutputBounds PiecewiseAffine RateLimits SoftBounds "
    "StateEstimator Terminal Tracking identify identify_outputs offset_free "
    "with_extra",
    "sb3_yann.deployment.describe": "Checks",
    "sb3_yann.deployment.controller": "Controller",
    "sb3_yann.deployment.exporting": "Exported export",
    "sb3_yann.improvement": "Headroom Improvement headroom improve",
    "sb3_yann.log": "Log",
    "sb3_yann.guard": "AcceptanceRule Decision ImprovementGuard StepSize restore_accepted",
    "sb3_yann.policy": "AffineObservation CriticOptions NonFiniteWarning YannActor YannCritic "
    "YannPolicy register_problem retarget",
    "sb3_yann.reporting": "report",
    "sb3_yann.twin": "PlantTwin UntrustedTwinError",
    "sb3_yann.wrappers": "PlantEnv",
    "sb3_yann_envs": "ActionRepeat",
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names.split()}
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


_POLICIES = {"stable_baselines3": "sb3_yann.policy", "sb3_contrib": "sb3_yann.policy.tqc"}
"""Packages whose algorithms have a policy of ours, and the module that registers its name."""


class _AliasFinder(importlib.abc.MetaPathFinder):
    """Registers the alias when a package of algorithms is imported, however late."""

    def __init__(self, package: str) -> None:
        self.package = package

    def find_spec(self, name: str, *place: Any) -> Any:
        if name != self.package:
            return None
        others = (finder for finder in sys.meta_path if finder is not self)
        spec = next(filter(None, (finder.find_spec(name, *place) for finder in others)), None)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module

            def load_and_register(module: ModuleType) -> None:
                load(module)
                sys.meta_path.remove(self)
                importlib.import_module(_POLICIES[name])

            spec.loader.exec_module = load_and_register  # type: ignore[method-assign]
        return spec


for _package, _module in _POLICIES.items():
    if _package in sys.modules:
        importlib.import_module(_module)
    else:
        sys.meta_path.insert(0, _AliasFinder(_package))

sb3_yann_envs.register_envs()
