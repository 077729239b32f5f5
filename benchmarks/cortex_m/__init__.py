"""A controller's C code on a microcontroller that is emulated: its size, and its instructions."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_yann import Controller, export
from sb3_yann.deployment.code import insensitive, sample_observations, table

HERE = Path(__file__).parent
COMPILER = "arm-none-eabi-gcc"
EMULATOR = "qemu-system-arm"
TOOLS = COMPILER, "arm-none-eabi-size", EMULATOR
POINTS = 200
CORE = ["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"]

BOARD = ["-M", "mps2-an386", "-nographic", "-monitor", "none", "-serial", "none"]


@dataclass(frozen=True)
class Emulated:
    """What was found.

    Attributes
    ----------
    flash : int
        Bytes of the whole firmware but the observations that it is tried at: code, tables, libm.
    memory : int
        Bytes of what is kept between steps.
    mean, worst : int
        Instructions of a step, of :data:`POINTS` of them.
    wrong : int
        Actions that are not those of the :class:`~sb3_yann.Controller`.
    """

    flash: int
    memory: int
    mean: int
    worst: int
    wrong: int


def missing() -> list[str]:
    """Return which of the tools are not there."""
    return [each for each in TOOLS if shutil.which(each) is None]


def emulate(given: Any, folder: Path, precision: str = "float") -> Emulated:
    """Export a model or a law, build firmware around it in a folder, and run it.

    Parameters
    ----------
    given : model, policy or law
        As :func:`sb3_yann.export` takes it.
    folder : Path
        Where everything is written.
    precision : {"float", "double"}
        A Cortex-M4F has instructions for floats only.
    """
    export(given, folder / "plant.c", precision=precision)
    export(given, folder / "plant.npz")
    controller = Controller.load(folder / "plant.npz")
    drawn = sample_observations(controller, 4 * POINTS).astype(np.float32).astype(np.float64)
    obs = insensitive(controller, drawn, "float")[:POINTS]
    answers = controller.evaluate(obs)
    room = 1e-5 * 2 * controller.data["action_scale"].min()
    lines = [
        f"#define N_POINTS {len(obs)}",
        f"#define ROOM {room:.3e}f",
        table("plant_real", "points", obs, precision),
        table("plant_real", "answers", answers, precision),
    ]
    (folder / "points.h").write_text("\n".join(lines) + "\n")
    build = [COMPILER, *CORE, "-std=gnu99", "-Os", "-Wall", "-Wextra", "-Werror"]
    build += ["-ffunction-sections", "-fdata-sections", "-nostartfiles", "-Wl,--gc-sections"]
    sources = [str(HERE / "firmware.c"), str(folder / "plant.c")]
    firmware = str(folder / "firmware.elf")
    link = [f"-I{folder}", f"-T{HERE / 'link.ld'}", "--specs=nosys.specs", "-lm", "-o", firmware]
    _run([*build, *sources, *link])
    size = _run(["arm-none-eabi-size", firmware]).splitlines()[1].split()
    text, data, bss = map(int, size[:3])
    width = 4 if precision == "float" else 8
    tried = width * (obs.size + answers.size)
    printed = _run([EMULATOR, *BOARD, "-icount", "shift=0", "-semihosting", "-kernel", firmware])
    found = dict(line.split() for line in printed.splitlines())
    numbers = {name: int(found[name]) for name in ("mean", "worst", "wrong")}
    return Emulated(flash=text + data - tried, memory=data + bss, **numbers)


def _run(command: list[str]) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    if done.returncode:
        raise RuntimeError(f"{command[0]}: {done.stderr or done.stdout}")
    return done.stdout + done.stderr  # semihosting prints to the latter
