"""A controller without memory as an ONNX graph: ``action`` and ``outside`` of ``obs``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_yann.deployment.code import ControllerArrays, action_scale, search_tolerances
from sb3_yann.deployment.controller import ACTIVATIONS, KEPT_ROUNDING
from sb3_yann.networks.yann import padded_rows


def onnx_model(data: ControllerArrays, precision: str, digest: str) -> bytes:
    """Return the file of a graph that is `Controller.evaluate`.

    ``obs`` (batch, n_obs) to ``action`` (batch, m) and ``outside`` (batch,): where the MPC has no
    solution. All regions are asked at once: a batch of B takes B times the largest number of
    half-spaces of a region times the regions.
    """
    try:
        import onnx
    except ImportError:
        raise ImportError("An ONNX file needs onnx: pip install onnx.") from None
    graph = _Graph(precision)
    action, outside = _policy(graph, data, precision)
    value = onnx.helper.make_tensor_value_info
    n_obs = data["obs_matrix"].shape[1]
    m = len(data["action_scale"])
    graph.op("Identity", action, name="action")
    graph.op("Identity", outside, name="outside")
    whole = onnx.helper.make_graph(
        graph.nodes,
        str(data["name"]),
        [value("obs", graph.kind, ["batch", n_obs])],
        [
            value("action", graph.kind, ["batch", m]),
            value("outside", onnx.TensorProto.BOOL, ["batch"]),
        ],
        graph.constants,
    )
    opset = [onnx.helper.make_opsetid("", 17)]
    model = onnx.helper.make_model(whole, producer_name="sb3-yann", opset_imports=opset)
    model.ir_version = 8  # what runtimes of that opset read
    names = {key: ", ".join(map(str, data[key])) for key in ("obs_names", "action_names")}
    note = {"note": str(data["note"])} if data["note"] else {}
    onnx.helper.set_model_props(model, {"digest": digest, **names, **note})
    model.doc_string = str(data["note"])
    onnx.checker.check_model(model)
    found: bytes = model.SerializeToString()
    return found


class _Graph:
    """Nodes and constants, each with a name of its own."""

    def __init__(self, precision: str) -> None:
        import onnx

        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        wide = precision == "double"
        self.helper = onnx.helper
        self.real = np.float64 if wide else np.float32
        self.kind = onnx.TensorProto.DOUBLE if wide else onnx.TensorProto.FLOAT
        self.from_array = onnx.numpy_helper.from_array

    def op(self, operator: str, *inputs: str, name: str = "", **attributes: Any) -> str:
        """Add a node; return the name of its output."""
        name = name or f"v{len(self.nodes)}"
        self.nodes.append(self.helper.make_node(operator, list(inputs), [name], **attributes))
        return name

    def constant(self, values: Any) -> str:
        """Add a constant: whole numbers and bools as they are, others in the precision."""
        array: NDArray[Any] = np.asarray(values)
        if array.dtype.kind == "f":
            array = array.astype(self.real)
        name = f"c{len(self.constants)}"
        self.constants.append(self.from_array(np.ascontiguousarray(array), name))
        return name

    def number(self, given: str) -> str:
        """Return a bool as a number, 0 or 1."""
        return self.op("Cast", given, to=self.kind)

    def not_finite(self, given: str) -> str:
        """Return where a number is NaN or infinite."""
        # x - x is 0 for numbers alone; runtimes know IsInf for some types only.
        return self.op("Not", self.op("Equal", self.op("Sub", given, given), self.constant(0.0)))

    def any(self, given: str) -> str:
        """Return where a row (batch, k) of bools holds one that is true, (batch, 1)."""
        most = self.op("ReduceMax", self.number(given), axes=[1], keepdims=1)
        return self.op("Greater", most, self.constant(0.0))

    def between(self, value: str, low: str, high: str) -> str:
        """Return a value clipped to bounds that broadcast."""
        return self.op("Min", self.op("Max", value, low), high)

    def column(self, row: str) -> str:
        """Return a column (batch, 1) of a row (batch,)."""
        return self.op("Unsqueeze", row, self.constant(np.array([1])))

    def distance(self, theta: str, middle: Any, per_half: Any) -> str:
        """Return how far a row of theta is from a middle, in half-widths, (batch, 1)."""
        off = self.op("Abs", self.op("Sub", theta, self.constant(middle[None])))
        off = self.op("Mul", off, self.constant(per_half[None]))
        return self.op("ReduceMax", off, axes=[1], keepdims=1)

    def times(self, matrices: str, vectors: str) -> str:
        """Return matrices (batch, a, b) times vectors (batch, b): (batch, a)."""
        last = self.constant(np.array([2]))
        column = self.op("Unsqueeze", vectors, last)
        return self.op("Squeeze", self.op("MatMul", matrices, column), last)


def _policy(graph: _Graph, data: ControllerArrays, precision: str) -> tuple[str, str]:
    """Return the names of action and outside."""
    op = graph.op
    constant = graph.constant
    zero = constant(0.0)
    lost = graph.not_finite("obs")
    seen = op("Where", lost, zero, "obs")
    theta = op("MatMul", seen, constant(data["obs_matrix"].T))
    theta = op("Add", theta, constant(data["obs_offset"][None]))
    shown = constant((data["obs_matrix"] != 0).astype(float).T)
    depends = op("Greater", op("MatMul", graph.number(lost), shown), zero)
    theta = op("Where", op("Or", depends, graph.not_finite(theta)), zero, theta)
    theta = graph.between(theta, *(constant(each[None]) for each in data["ends"]))
    region, inside = _locate(graph, data, theta, search_tolerances(data, precision))
    law = graph.times(op("Gather", constant(data["gains"]), region), theta)
    law = op("Add", law, op("Gather", constant(data["offsets"]), region))
    law = op("Where", graph.not_finite(law), zero, law)
    if data["zero_input"]:
        law = op("Where", inside, law, constant(data["resting"][None]))
    low, high = (constant(each[None]) for each in data["bounds"])
    law = graph.between(law, low, high)
    fixed = low, high

    def input_in(entries: NDArray[np.int64]) -> str:
        shown = op("Gather", theta, constant(entries), axis=1)
        shown = op("Mul", shown, constant(data["per_input"][None]))
        return op("Sub", shown, constant(data["middle"][None]))

    if len(data["moving"]):  # bounds in theta, the lower one first
        low, high = (
            op("Where", constant(at[None] >= 0), graph.between(input_in(abs(at)), *fixed), side)
            for at, side in zip(data["moving"], fixed, strict=True)
        )
        high = op("Max", low, high)
    if len(data["change"]):  # these are reached as fast as the rate allows
        n = len(data["per_theta"])
        last = input_in(np.arange(n - len(data["action_scale"]), n))
        ways = [op("Add", last, constant(each[None])) for each in data["change"]]
        slowest = [graph.between(each, *fixed) for each in ways]
        low, high = (graph.between(each, *slowest) for each in (low, high))
    law = graph.between(law, low, high)
    if int(data["n_layers"]):
        added = _correction(graph, data, theta, region)
        added = op("Where", graph.any(lost), zero, added)
        total = op("Add", law, added)
        action = graph.between(total, low, high)
        if len(data["kept"]):
            adds = graph.any(op("Not", op("Equal", total, law)))
            action = op("Where", adds, _kept(graph, data, theta, law, action, low, high), action)
        law = action
    action = op("Mul", law, constant(action_scale(data, precision)[None]))
    action = op("Add", action, constant(data["action_shift"][None]))
    return action, op("Squeeze", op("Not", inside), constant(np.array([1])))


def _locate(
    graph: _Graph, data: ControllerArrays, theta: str, tolerances: dict[str, float]
) -> tuple[str, str]:
    """Return the region (batch,) that theta violates least, and whether it holds it (batch, 1)."""
    op = graph.op
    constant = graph.constant
    A, b = padded_rows(data["starts"], data["A"], data["b"])
    slack = op("MatMul", theta, constant(A.reshape(-1, A.shape[2]).T))
    slack = op("Sub", constant(b.reshape(1, -1)), slack)
    slack = op("Reshape", slack, constant(np.array([-1, *b.shape])))
    slack = op("ReduceMin", slack, axes=[2], keepdims=0)
    largest = op("ReduceMax", slack, axes=[1], keepdims=1)
    room = op("Add", op("Abs", largest), constant(1.0))
    nearly = op("Sub", largest, op("Mul", room, constant(tolerances["tie"])))
    ties = graph.number(op("Not", op("Less", slack, nearly)))
    region = op("ArgMax", ties, axis=1, keepdims=0)
    off = graph.distance(theta, data["box_middle"], data["box_per_half"])
    least = op("Min", largest, op("Sub", constant(1.0), off))
    return region, op("Not", op("Less", least, constant(-tolerances["tolerance"])))


def _correction(graph: _Graph, data: ControllerArrays, theta: str, region: str) -> str:
    """Return what the networks add, (batch, m)."""
    op = graph.op
    constant = graph.constant
    number = data["network_of"]
    kind = str(data["activation"])
    act = ACTIVATIONS[kind]
    used = op("Gather", constant(np.maximum(number, 0)), region)
    shared = bool(np.all(number == 0))

    def activated(x: str) -> str:
        if kind == "tanh":
            return op("Tanh", x)
        zero = constant(0.0)
        if kind == "relu":
            return op("Max", x, zero)
        below = op("Sub", op("Exp", op("Min", x, zero)), constant(1.0))
        return op("Where", op("Greater", x, zero), x, below)

    def of_row(table: NDArray[Any]) -> str:
        return constant(table) if shared else op("Gather", constant(table), used)

    x = op("Mul", theta, constant(data["per_theta"][None]))
    moved = graph.any(op("Not", op("Equal", x, constant(0.0))))
    pinned = data["pinned"]
    last = int(data["n_layers"]) - 1
    for i in range(last + 1):
        layer = data[f"layer{i}"]
        W = layer[:, :, :-1]
        bias = layer[:, :, -1]
        if i == last:
            bias = np.where(pinned[:, None], 0.0, bias)
        # A shared network is one matrix for all rows, not a copy of it for each.
        x = op("MatMul", x, constant(W[0].T)) if shared else graph.times(of_row(W), x)
        x = op("Add", x, of_row(bias))
        if i < last:
            at_zero = np.where(pinned[:, None], act(bias), 0.0)
            x = op("Sub", activated(x), of_row(at_zero))
    sound = op("Not", graph.any(graph.not_finite(x)))
    counts = graph.column(op("Gather", constant(number >= 0), region))
    still = op("And", graph.column(op("Gather", constant(pinned), used)), op("Not", moved))
    counts = op("And", op("And", counts, sound), op("Not", still))
    x = op("Where", counts, x, constant(0.0))
    if np.isfinite(data["reach"]):
        x = graph.between(x, constant(-data["reach"]), constant(data["reach"]))
    full, none = data["fades"]
    beyond = graph.distance(theta, *data["confines"])
    part = op("Div", op("Sub", constant(none), beyond), constant(none - full))
    return op("Mul", x, graph.between(part, constant(0.0), constant(1.0)))


def _kept(
    graph: _Graph, data: ControllerArrays, theta: str, law: str, action: str, low: str, high: str
) -> str:
    """Return actions that break no row further than the law, as `Controller` does."""
    op = graph.op
    constant = graph.constant
    n = data["A"].shape[1]
    kept = data["kept"]
    rows = kept[:, n:-2]
    b = constant(rows.T)
    zero = constant(0.0)
    slack = op("Sub", constant(kept[None, :, -2]), op("MatMul", theta, constant(kept[:, :n].T)))
    slack = op("Sub", slack, op("MatMul", law, b))
    room = op("Max", op("Sub", slack, constant(kept[None, :, -1])), zero)
    push = op("MatMul", op("Sub", action, law), b)
    beyond = op("Sub", push, op("Min", slack, room))
    most = op("ReduceMax", beyond, axes=[1], keepdims=1)
    along = op("Gather", constant(rows), op("ArgMax", beyond, axis=1, keepdims=0))
    moved = op("Sub", action, op("Mul", most, along))
    if np.isfinite(data["reach"]):
        reach = constant(data["reach"])
        moved = graph.between(moved, op("Sub", law, reach), op("Add", law, reach))
    moved = graph.between(moved, low, high)
    way = op("Sub", moved, law)
    push = op("MatMul", way, b)
    rounding = constant(KEPT_ROUNDING)
    share = op("Div", op("Add", room, rounding), op("Max", push, rounding))
    share = op("Min", op("ReduceMin", share, axes=[1], keepdims=1), constant(1.0))
    moved = graph.between(op("Add", law, op("Mul", share, way)), low, high)
    return op("Where", op("Greater", most, zero), moved, action)
