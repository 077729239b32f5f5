"""The layer on a CUDA device and on the processor: from which batch on the device pays.

``python -m benchmarks.gpu LAW.npz ...`` runs it alone on laws that `PiecewiseAffine.save` wrote. It
needs torch, numpy, scipy, numba and this repository, and neither Stable-Baselines3 nor a solver.
"""

from __future__ import annotations

import importlib.util
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch as th

from benchmarks.timing import Array, Stopwatch, Task, quartiles

if TYPE_CHECKING:
    from sb3_yann.control import PiecewiseAffine

BATCHES = (1, 256, 10_000, 100_000)
SECTION = "devices"
BACKWARD = "forward and backward"


def devices() -> list[str]:
    """Return the processor and, if torch sees one, the CUDA device."""
    return ["cpu", "cuda"] if th.cuda.is_available() else ["cpu"]


def measure(
    law: PiecewiseAffine, watch: Stopwatch, where: list[str] | None = None
) -> Iterator[tuple[str, str, int, Array]]:
    """Yield what, device, batch and seconds per call of a layer of single precision."""
    from sb3_yann.networks import YannLayer

    th.manual_seed(0)
    layer = YannLayer(law)
    with th.no_grad():
        for parameter in layer.parameters():
            parameter.add_(0.01 * th.randn(parameter.shape))
    rng = np.random.default_rng(0)
    for batch in BATCHES:
        points = rng.uniform(law.theta_min, law.theta_max, (batch, law.n_theta))
        for device in where or devices():
            theta = th.as_tensor(points, dtype=th.float32, device=device)
            yield "forward", device, batch, _seconds(layer.to(device), theta, watch, False)
            yield BACKWARD, device, batch, _seconds(layer.to(device), theta, watch, True)


def _seconds(layer: th.nn.Module, theta: th.Tensor, watch: Stopwatch, backward: bool) -> Array:
    def call(theta: th.Tensor) -> None:
        with th.set_grad_enabled(backward):
            u = layer(theta)
            if backward:
                layer.zero_grad(set_to_none=True)
                u.sum().backward()
        if theta.is_cuda:
            th.cuda.synchronize()

    return watch.compare({"layer": Task(call, [theta])})["layer"]


def pays_from(found: dict[tuple[str, int], Array]) -> int | None:
    """Return the smallest batch from which on the device is faster, None if there is none."""
    ahead = [batch for batch in BATCHES if _ahead(found, batch)]
    behind = [batch for batch in BATCHES if batch not in ahead]
    later = [batch for batch in ahead if batch > max(behind, default=0)]
    return min(later, default=None)


def _ahead(found: dict[tuple[str, int], Array], batch: int) -> bool:
    return bool(np.median(found["cuda", batch]) < np.median(found["cpu", batch]))


def _without_learners() -> None:
    """Make `sb3_yann.control` and `sb3_yann.networks` importable where SB3 is missing."""
    if importlib.util.find_spec("stable_baselines3") is None:
        package = types.ModuleType("sb3_yann")
        package.__path__ = [str(Path(__file__).parents[1] / "sb3_yann")]
        sys.modules["sb3_yann"] = package


def main(paths: list[str]) -> int:
    """Measure the laws of some files, and print what was found."""
    _without_learners()
    from sb3_yann.control.law.piecewise_affine import PiecewiseAffine

    th.set_num_threads(1)
    print(f"torch {th.__version__}, devices: {', '.join(devices())}")
    if th.cuda.is_available():
        print(th.cuda.get_device_name())
    for path in paths:
        law = PiecewiseAffine.load(path)
        print(f"{law.n_regions} regions")
        found: dict[str, dict[tuple[str, int], Array]] = {}
        for what, device, batch, seconds in measure(law, Stopwatch(seconds=2.0)):
            low, middle, high = (1e6 * each for each in quartiles(seconds))
            print(
                f"  {what:20} {device:4} {batch:7,} {middle:12,.1f} us ({low:,.1f} to {high:,.1f})"
            )
            found.setdefault(what, {})[device, batch] = seconds
        if th.cuda.is_available():
            for what, each in found.items():
                print(f"  {what}: the device pays from a batch of {pays_from(each)}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
