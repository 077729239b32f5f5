"""The tables of a controller by the names that they have in code."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_yann.deployment.controller import FAR
from sb3_yann.deployment.describe import Arrays
from sb3_yann.deployment.output_range import scale_in

Tables = dict[str, NDArray[Any]]


def tables_of(data: Arrays, precision: str) -> tuple[Tables, Tables]:
    """Return the tables of numbers and those of whole numbers; nothing for what there is not."""
    same = "A b gains offsets obs_matrix obs_offset obs_rest obs_min obs_max action_shift"
    numbers: Tables = {name: data[name] for name in same.split()}
    numbers["action_scale"] = scale_in(data, precision)
    numbers["input_min"], numbers["input_max"] = data["bounds"]
    numbers["far"] = FAR * np.abs(data["box"]).max(0)
    starts = np.array([*data["starts"], len(data["b"])])
    whole: Tables = {"starts": starts, "watched": data["watched"].astype(np.int64)}
    if data["zero_input"]:
        numbers["resting"] = data["resting"]
    if len(data["change"]):
        numbers["change_min"], numbers["change_max"] = data["change"]
        numbers |= {"per_input": data["per_input"], "middle": data["middle"]}
    if len(data["pinned"]):
        last = int(data["n_layers"]) - 1
        numbers |= {f"layer{i}": data[f"layer{i}"] for i in range(last)}
        numbers |= {"last_layer": data[f"layer{last}"], "per_theta": data["per_theta"]}
        numbers["confine_middle"], numbers["confine_per_half"] = data["confines"]
        whole |= {"network_of": data["network_of"], "pinned": data["pinned"].astype(np.int64)}
    return numbers, whole


def search_tables(data: Arrays) -> tuple[Tables, Tables]:
    """Return those of a walk or a tree, likewise."""
    if data["neighbors"].size:
        return {"walk_slack": data["walk_slack"]}, {"neighbors": data["neighbors"]}
    if "tree_levels" not in data:
        return {}, {}
    numbers = {f"tree_{key}": data[f"tree_{key}"] for key in ("normals", "levels")}
    keys = "children", "leaf_starts", "leaf_regions"
    return numbers, {f"tree_{key}": data[f"tree_{key}"] for key in keys}


def index_bytes(whole: Mapping[str, NDArray[Any]]) -> int:
    """Return the bytes that whole numbers need: 2 or 4."""
    return 2 if max(int(np.abs(each).max()) for each in whole.values()) < 2**15 else 4
