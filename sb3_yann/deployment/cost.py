"""What a controller costs: its tables, and the operations of a step at worst."""

from __future__ import annotations

from dataclasses import dataclass

from sb3_yann.deployment.describe import Arrays
from sb3_yann.deployment.tables import index_bytes, search_tables, tables_of


@dataclass(frozen=True)
class Cost:
    """What a controller needs at worst.

    Attributes
    ----------
    numbers : int
        Entries of its tables of numbers.
    indices : int
        Entries of its tables of whole numbers.
    index_bytes : int
        Bytes of each of these.
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
    index_bytes: int
    multiplications: int
    activations: int
    locals: int

    def table_bytes(self, size: int) -> int:
        """Return the bytes of the tables, for numbers of ``size`` bytes."""
        return self.numbers * size + self.indices * self.index_bytes

    def __str__(self) -> str:
        """Say it in words."""
        return (
            f"tables: {self.numbers} numbers and {self.indices} indices "
            f"({self.table_bytes(8) / 1000:.1f} kB double, {self.table_bytes(4) / 1000:.1f} kB "
            f"float); a step at worst: {self.multiplications} multiplications with additions, "
            f"{self.activations} activations, some {self.locals} numbers on the stack"
        )


def cost_of(data: Arrays) -> Cost:
    """Return what a controller of these arrays costs."""
    tables = zip(tables_of(data, "double"), search_tables(data), strict=True)
    numbers, whole = ({**own, **of_search} for own, of_search in tables)
    (_, m, n), q = data["gains"].shape, len(data["b"])
    widths = [data[f"layer{i}"].shape[1] for i in range(int(data["n_layers"]))]
    tree = len(data["tree_levels"]) if "tree_levels" in data else 0
    search = 2 * q * n + (q * n if data["neighbors"].size else 0) + tree * n
    inputs = [n, *widths][: len(widths)]
    networks = sum(a * b for a, b in zip(inputs, widths, strict=True)) + 2 * n
    n_obs = data["obs_matrix"].shape[1]
    hidden = sum(widths[:-1])
    return Cost(
        numbers=sum(each.size for each in numbers.values()),
        indices=sum(each.size for each in whole.values()),
        index_bytes=index_bytes(whole),
        multiplications=n * n_obs + search + m * (n + 2) + (networks if widths else 0),
        activations=2 * hidden,
        locals=2 * n + 7 * m + hidden + 8,
    )
