"""What a controller costs: its tables, and the operations of a step at worst."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_yann.deployment.describe import Arrays

TABLES = (
    "gains", "offsets", "bounds", "A", "b", "obs_matrix", "obs_offset", "obs_rest", "action_scale",
    "action_shift", "change", "per_theta", "confines", "layer0", "layer1", "layer2", "walk_slack",
    "tree_normals", "tree_levels", "resting", "obs_min", "obs_max",
)  # fmt: skip
INDICES = "starts", "network_of", "neighbors", "tree_children", "tree_leaf_starts"
WHOLE = (*INDICES, "tree_leaf_regions")


@dataclass(frozen=True)
class Cost:
    """What a controller needs at worst.

    Attributes
    ----------
    numbers : int
        Entries of its tables of numbers.
    indices : int
        Entries of its tables of whole numbers.
    multiplications : int
        Multiplications, each with an addition, of one step at worst: a search that must ask every
        region twice.
    activations : int
        Calls of tanh, or whatever the networks are made of.
    locals : int
        Numbers that a step keeps on the stack at most.
    """

    numbers: int
    indices: int
    multiplications: int
    activations: int
    locals: int

    def table_bytes(self, size: int) -> int:
        """Return the bytes of the tables, for numbers of ``size`` bytes."""
        return self.numbers * size + self.indices * index_bytes(self.indices)

    def __str__(self) -> str:
        """Say it in words."""
        return (
            f"tables: {self.numbers} numbers and {self.indices} indices "
            f"({self.table_bytes(8) / 1000:.1f} kB double, {self.table_bytes(4) / 1000:.1f} kB "
            f"float); a step at worst: {self.multiplications} multiplications with additions, "
            f"{self.activations} activations, some {self.locals} numbers on the stack"
        )


def index_bytes(count: int) -> int:
    """Return the bytes of an index into tables with so many entries."""
    return 2 if count < 2**15 else 4


def cost_of(data: Arrays) -> Cost:
    """Return what a controller of these arrays costs."""
    size = {name: int(np.size(data[name])) for name in (*TABLES, *WHOLE) if name in data}
    (_, m, n), q = data["gains"].shape, len(data["b"])
    widths = [data[f"layer{i}"].shape[1] for i in range(int(data["n_layers"]))]
    tree = len(data["tree_levels"]) if "tree_levels" in data else 0
    search = 2 * q * n + (q * n if data["neighbors"].size else 0) + tree * n
    inputs = [n, *widths][: len(widths)]
    networks = sum(a * b for a, b in zip(inputs, widths, strict=True)) + 2 * n
    n_obs = data["obs_matrix"].shape[1]
    hidden = sum(widths[:-1])
    return Cost(
        numbers=sum(size.get(name, 0) for name in TABLES),
        indices=sum(size.get(name, 0) for name in WHOLE),
        multiplications=n * n_obs + search + m * (n + 2) + (networks if widths else 0),
        activations=2 * hidden,
        locals=2 * n + 7 * m + hidden + 8,
    )
