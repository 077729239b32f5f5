"""Exported controllers beside the model that they come from, and on a microcontroller."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import DDPG

from benchmarks import cortex_m, networks, peers
from benchmarks.records import Bench, Figure, timed
from benchmarks.timing import Array, Task
from sb3_yann import Controller, LinearModel, LinearMPC, PlantEnv, export
from sb3_yann_envs import problems

SECTION = "export"
SMALL = "export, microcontroller"
OURS = "ours, C code in double"
SINGLE = "C code in float"
FREE = "the same without keep_bounds"
READER = "Controller in numpy"
BATCH = 256
FORMS = {"a network per region": "per_region", "a shared network": "shared"}
LOOP = """
#include "plant.h"
void many(const plant_real *obs, int count, plant_real *action)
{
    for (int k = 0; k < count; k++) {
        (void)plant_policy(obs + k * PLANT_N_OBS, action + k * PLANT_N_INPUTS);
    }
}
"""


def deployment(bench: Bench) -> None:
    """Measure the reactor's policy, with weights that are not zero."""
    mpc = problems.cstr()
    solve = peers.daqp_online(mpc.online().program, 1)
    theta = np.random.default_rng(0).uniform(mpc.theta_min, mpc.theta_max, (1024, 4))
    for column, form in FORMS.items():
        model = learnt(form)
        with TemporaryDirectory() as folder:
            at = Path(folder)
            export(model, at / "plant.npz")
            controller = Controller.load(at / "plant.npz")
            rows = [*theta]
            tasks = {
                READER: Task(controller, rows),
                networks.PREDICT: Task(networks.predictor(model), [*theta.astype(np.float32)]),
                f"{peers.DAQP}: the MPC alone": Task(solve, rows),
            }
            code = {}
            if shutil.which("gcc"):
                for name, kind in ((OURS, "double"), (SINGLE, "float")):
                    export(model, at / "plant.c", precision=kind)
                    many = compiled(at, kind)
                    code[name] = Task(many, [*theta.reshape(-1, BATCH, 4)])
            found = bench.watch.compare({**code, **tasks})
            per_call = {name: each / (BATCH if name in code else 1) for name, each in found.items()}
            bench.figures.add(timed(SECTION, column, per_call))
            _emulated(bench, model, column, at)
    if shutil.which("gcc"):
        _bounds_kept(bench)


def _bounds_kept(bench: Bench) -> None:
    """Measure what it costs to keep the bounds of a cart with a speed limit."""
    cart = LinearModel([[1, 0.1], [0, 1]], [[0.005], [0.1]], 0.1)
    limits = {"x_min": [-5, -1], "x_max": [5, 1], "u_min": -1, "u_max": 1}
    mpc = LinearMPC(cart, Q=np.eye(2), R=[[0.1]], horizon=5, **limits)
    theta = np.random.default_rng(0).uniform(mpc.theta_min, mpc.theta_max, (1024, 2))
    code = {}
    with TemporaryDirectory() as folder:
        for name, kept in ((OURS, True), (FREE, False)):
            options = {"problem": mpc, "keep_bounds": kept}
            env = PlantEnv(lambda x, u: np.array([x[1], u[0]]), mpc)
            model = noisy(DDPG("YannPolicy", env, device="cpu", policy_kwargs=options))
            at = Path(folder) / str(kept)
            at.mkdir()
            export(model, at / "plant.c")
            code[name] = Task(compiled(at, "double"), [*theta.reshape(-1, BATCH, 2)])
        found = bench.watch.compare(code)
    per_call = {name: each / BATCH for name, each in found.items()}
    bench.figures.add(timed(SECTION, "a cart with a speed limit", per_call))


def learnt(form: str, size: float = 0.4) -> DDPG:
    """Return the reactor's model, whose networks are noise: none of them can be left out."""
    options = {"networks": form}
    return noisy(DDPG("YannPolicy", "CSTR-v0", device="cpu", policy_kwargs=options), size)


def noisy(model: DDPG, size: float = 0.4) -> DDPG:
    """Return a model with noise added to its networks."""
    generator = th.Generator().manual_seed(0)
    with th.no_grad():
        for weight in model.actor.parameters():
            weight.add_(size * th.randn(weight.shape, generator=generator))
    return model


def compiled(folder: Path, kind: str) -> Callable[[Array], object]:
    """Return the C code of a folder as a function of many observations."""
    (folder / "many.c").write_text(LOOP)
    library = folder / f"{kind}.so"
    sources = [str(folder / each) for each in ("plant.c", "many.c")]
    command = ["gcc", "-std=c99", "-O2", "-shared", "-fPIC", *sources, "-lm", "-o", str(library)]
    subprocess.run(command, check=True)
    code = ctypes.CDLL(str(library))
    real = np.float64 if kind == "double" else np.float32

    def many(obs: Array) -> Any:
        seen = np.ascontiguousarray(obs, real)
        actions = np.empty((len(obs), 1), real)
        code.many(seen.ctypes.data_as(ctypes.c_void_p), len(obs),
                  actions.ctypes.data_as(ctypes.c_void_p))  # fmt: skip
        return actions

    return many


def _emulated(bench: Bench, model: DDPG, column: str, folder: Path) -> None:
    if missing := cortex_m.missing():
        bench.console.print(f"No {', '.join(missing)}: nothing is emulated.")
        return
    for kind in ("float", "double"):
        found = cortex_m.emulate(model, folder, kind)
        rows = {
            "flash of the firmware": ("bytes", found.flash),
            "memory": ("bytes", found.memory),
            "instructions of a step, mean": ("count", found.mean),
            "instructions of a step, most of 200": ("count", found.worst),
            "wrong actions of 200": ("count", found.wrong),
        }
        bench.figures.add(
            Figure(SMALL, f"Cortex-M4F, {kind}: {name}", column, np.array([float(value)]), what)
            for name, (what, value) in rows.items()
        )
