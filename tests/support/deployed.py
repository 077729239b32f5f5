"""Policies to export, and their C code compiled and called."""

import copy
import ctypes
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

import general_problems
import sample_laws
from policy_samples import make_policy
from sb3_yann import (
    AffineObservation,
    Checks,
    LinearMPC,
    RateLimits,
    YannPolicy,
    export,
    with_extra,
)
from sb3_yann.deployment.controller import Controller
from weights import shake

COMPILERS = [each for each in ("gcc", "clang") if shutil.which(each)]
needs_compiler = pytest.mark.skipif(not COMPILERS, reason="no C compiler")
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O2"]


def disturbed(mpc: LinearMPC, size: float = 0.4, seed: int = 1, **kwargs: Any) -> YannPolicy:
    """Return a policy whose networks have learnt something: noise."""
    if "observation_space" not in kwargs:
        kwargs["observation_space"] = box(mpc.n_theta, np.float64)
    low = mpc.u_min.astype(np.float32)
    high = mpc.u_max.astype(np.float32)
    inputs = spaces.Box(low, high, dtype=np.float32)
    policy = make_policy(kwargs.pop("observation_space"), inputs, problem=mpc, **kwargs)
    shake(policy.actor, size, seed)
    return policy


def box(size: int, dtype: Any = np.float32) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (size,), dtype)


def _seen(mpc: LinearMPC, **kwargs: Any) -> YannPolicy:
    """The policy sees mixtures of theta, and one entry that says nothing."""
    generator = np.random.default_rng(5)
    n = mpc.n_theta
    matrix = np.hstack([np.eye(n) + 0.2 * generator.normal(size=(n, n)), np.zeros((n, 1))])
    shown = AffineObservation(matrix, generator.normal(size=n))
    return disturbed(mpc, observation=shown, observation_space=box(n + 1, np.float64), **kwargs)


def _zero_input() -> LinearMPC:
    return replaced(sample_laws.solved("two inputs"), infeasible="zero_input")


def replaced(mpc: LinearMPC, **changes: Any) -> LinearMPC:
    """Return a problem with other options, and its law."""
    found = replace(mpc, **changes)
    found.explicit()
    return found


CASES: dict[str, Callable[[], YannPolicy]] = {
    "reactor": lambda: disturbed(sample_laws.solved("reactor"), max_correction=0.2),
    "reactor, shared": lambda: disturbed(sample_laws.solved("reactor"), networks="shared"),
    "pendulum, by a walk": lambda: disturbed(sample_laws.solved("pendulum")),
    "asymmetric bounds, one layer": lambda: disturbed(
        sample_laws.solved("asymmetric bounds"), net_arch=[7], activation_fn=th.nn.ReLU
    ),
    "two inputs, zero input": lambda: disturbed(_zero_input(), activation_fn=th.nn.ELU),
    "references and rates": lambda: disturbed(general_problems.solved("servo with all of it")),
    "two tanks, by a walk": lambda: disturbed(general_problems.solved("two tanks, all parts")),
    "mixed observations": lambda: _seen(sample_laws.solved("two inputs"), max_correction=0.1),
    "confined": lambda: confined(disturbed(sample_laws.solved("reactor"), networks="shared")),
    "keeps its bounds": lambda: disturbed(general_problems.solved("level"), 3.0),
    "bounds in theta": lambda: disturbed(
        replaced(
            sample_laws.solved("two inputs"),
            horizon=1,
            parametric_bounds=["u_max[0]", "u_min[1]"],
            rate=RateLimits(-0.5, 0.5),
        ),
        keep_bounds=False,
    ),
    "extra signals": lambda: disturbed(with_extra(sample_laws.solved("reactor"), -1, 1)),
    "nothing learnt": lambda: disturbed(sample_laws.solved("reactor"), size=0.0),
}


def confined(policy: YannPolicy) -> YannPolicy:
    low = policy.problem.theta_min
    high = policy.problem.theta_max
    policy.confine_correction(0.5 * low, 0.6 * high)
    return policy


def in_float64(policy: YannPolicy) -> YannPolicy:
    """Return a copy that torch computes in float64, which policy.double() refuses to be."""
    wide = copy.deepcopy(policy)
    for each in (*wide.parameters(), *wide.buffers()):
        each.data = each.data.double() if each.is_floating_point() else each.data
    return wide


@cache
def policy_of(name: str) -> YannPolicy:
    return CASES[name]()


def observations(policy: YannPolicy, count: int, seed: int = 0) -> np.ndarray:
    """Return some in the box, some beyond it, some on facets, the operating point.

    There are fewer for a law of many regions, which numpy must all ask.
    """
    law = policy.problem.explicit()
    rng = np.random.default_rng(seed)
    count = count if law.n_regions < 100 else min(count, 2_000)
    middle = (law.theta_max + law.theta_min) / 2
    half = (law.theta_max - law.theta_min) / 2
    reach = np.where(np.arange(count) % 3, 1.0, 2.5)[:, None]
    theta = middle + reach * half * rng.uniform(-1, 1, (count, law.n_theta))
    on_facets = sample_laws.facet_points(law, count).numpy()[: count // 4]
    theta[: len(on_facets)] = on_facets
    theta[-1] = 0.0
    if policy.observation is None:
        return theta
    back = np.linalg.pinv(policy.observation.matrix)
    seen = (theta - policy.observation.offset) @ back.T
    return seen + rng.normal(size=seen.shape) * (policy.observation.matrix == 0).all(0)


def with_faults(policy: YannPolicy, steps: int) -> tuple[Checks, list[tuple[Any, ...]]]:
    """Return limits of the readings, and steps: (obs, elapsed, request, manual or None).

    Readings are lost, beyond their limits or frozen, steps late; the operator takes over.
    """
    obs = observations(policy, steps)
    generator = np.random.default_rng(3)
    low, high = np.percentile(obs, [5, 95], axis=0)
    calm = np.clip(obs, low, high)
    m = policy.problem.model.n_inputs
    found = []
    for k in range(steps):
        seen = calm[k // 2 % len(calm)].copy()
        if k % 40 > 30:
            seen[0] = calm[0, 0]  # frozen
        if generator.random() < 0.1:
            seen[generator.integers(len(seen))] = generator.choice([np.nan, np.inf, -np.inf, 1e9])
        elapsed = 2.0 if generator.random() < 0.05 else 1.0
        request = int(generator.choice([0, 1, 2], p=[0.9, 0.05, 0.05]))
        manual = generator.uniform(-1, 1, m) if generator.random() < 0.5 else None
        found.append((seen, elapsed, request, manual))
    return Checks(low, high, frozen_after=3, hold=2, recover=4, transfer=3), found


def error(found: np.ndarray, wanted: np.ndarray, controller: Controller) -> float:
    """Return the largest difference of inputs, in parts of an input's range."""
    return float(np.max(np.abs(found - wanted) / (2 * controller.data["action_scale"])))


def self_test(
    folder: Path, name: str = "plant", compiler: str = ""
) -> subprocess.CompletedProcess[str]:
    """Build the self-test of exported C code under sanitizers, and run it."""
    sources = [str(folder / f"{name}.c"), str(folder / f"{name}_selftest.c")]
    guards = ["-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    build = [compiler or COMPILERS[0], *STRICT, *guards, *sources]
    subprocess.run([*build, "-lm", "-o", str(folder / "test")], check=True)
    return subprocess.run([folder / "test"], capture_output=True, text=True)


class Compiled:
    """C code of an export, as a library."""

    def __init__(
        self,
        given: Any,
        folder: Path,
        precision: str = "double",
        compiler: str = "gcc",
        flags: list[str] | None = None,
        **options: Any,
    ) -> None:
        self.compiler = compiler if compiler in COMPILERS else COMPILERS[0]
        self.written = export(given, folder / "plant.c", precision=precision, **options)
        export(given, folder / "plant.npz", **options)
        self.controller = Controller.load(folder / "plant.npz")
        self.real = np.float64 if precision == "double" else np.float32
        library = folder / f"plant_{precision}_{self.compiler}.so"
        build = [self.compiler, *STRICT, *(flags or []), "-shared", "-fPIC"]
        subprocess.run(
            [*build, str(folder / "plant.c"), "-lm", "-o", str(library)],
            check=True,
            capture_output=True,
            text=True,
        )
        self.code = ctypes.CDLL(str(library))
        self.code.plant_policy.restype = self.code.plant_law.restype = ctypes.c_uint
        self.code.plant_step.restype = ctypes.c_uint
        self.m = len(self.controller.data["action_scale"])
        self.state = ctypes.create_string_buffer(1 << 16)

    def pointer(self, array: np.ndarray | None) -> Any:
        return None if array is None else array.ctypes.data_as(ctypes.c_void_p)

    def at(self, obs: np.ndarray, law: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Return actions (batch, m) and what was found (batch,)."""
        call = self.code.plant_law if law else self.code.plant_policy
        rows = np.ascontiguousarray(obs, self.real)
        actions = np.empty((len(rows), self.m), self.real)
        found = np.empty(len(rows), int)
        for i, row in enumerate(rows):
            found[i] = call(self.pointer(row), self.pointer(actions[i]))
        return actions, found

    def begin(self) -> None:
        self.code.plant_init(self.state)

    def step(
        self, obs: np.ndarray, elapsed: float, request: int, manual: np.ndarray | None
    ) -> tuple[np.ndarray, int]:
        """Return the action (m,) and what was found."""
        action = np.empty(self.m, self.real)
        seen = np.ascontiguousarray(obs, self.real)
        own = None if manual is None else np.ascontiguousarray(manual, self.real)
        kind = ctypes.c_double if self.real is np.float64 else ctypes.c_float
        found = self.code.plant_step(
            self.state, self.pointer(seen), kind(elapsed), request, self.pointer(own),
            self.pointer(action),
        )  # fmt: skip
        return action, found
