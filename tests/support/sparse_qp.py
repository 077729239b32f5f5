"""The program of a problem with all its states, solved at one parameter, and random problems.

The package condenses the states away. Here they are variables and the model is an equality. Nothing
but the arguments of `LinearMPC` is used, all in plant units; the steady state is that of the
optimality conditions of its own small program.
"""

import contextlib
import warnings
from typing import Any

import daqp
import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from sb3_yann import (
    DisturbanceBounds,
    ExplicitLimitError,
    ExplicitSolutionError,
    LinearCost,
    LinearModel,
    LinearMPC,
    MixedBounds,
    RateLimits,
    SoftBounds,
    Tracking,
)

Array = NDArray[np.float64]

EQUALITY = 5  # DAQP's code for a constraint that holds with equality
NO_BOUND = 1e30
FEATURES = ("blocks", "preview", "mixed", "price", "parametric")
MOST_REGIONS = 400


class SparseQP:
    """Rows are linear in ``(u_0 ... u_{N-1}, x_1 ... x_N, slacks, theta, 1)``.

    The variables are scaled by the input ranges and the box; half the cost is minimized.
    """

    def __init__(self, mpc: LinearMPC) -> None:
        self.mpc = mpc
        self.n, self.m = mpc.model.B.shape
        self.mixed = mpc.mixed.sized(self.n, self.m)
        soft = {"x": mpc.soft.x, "y": mpc.soft.y, "mixed": self.mixed.soft}
        self.soft = {kind: units for kind, units in soft.items() if np.any(units > 0)}
        self.n_moves = mpc.horizon * (self.n + self.m)
        self.n_z = self.n_moves + len(self.soft)
        self.eye = np.eye(self.n_z + mpc.n_theta + 1)
        width = mpc.u_max - mpc.u_min
        self.u_unit = np.where(np.isfinite(width), width / 2, 1.0)
        x_unit = np.maximum(np.abs(mpc.theta_min), np.abs(mpc.theta_max))[: self.n]
        moves = [np.tile(each, mpc.horizon) for each in (self.u_unit, x_unit)]
        self.unit = np.concatenate([*moves, np.ones(len(self.soft))])
        self._set_rows()
        self._set_cost()

    def constant(self, values: Array) -> Array:
        return np.outer(values, self.eye[-1])

    def entry(self, name: str) -> Array:
        """Return the row of an entry of theta."""
        return self.eye[self.n_z + self.mpc.layout.names.index(name)]

    def entries(self, kind: str, count: int) -> Array:
        rows = [self.entry(f"{kind}[{i}]") for i in range(count)]
        return np.reshape(rows, (count, len(self.eye)))

    def u(self, k: int) -> Array:
        return self.entries("u_prev", self.m) if k < 0 else self.eye[k * self.m : (k + 1) * self.m]

    def x(self, k: int) -> Array:
        first = self.mpc.horizon * self.m + (k - 1) * self.n
        return self.eye[first : first + self.n] if k else self.entries("x", self.n)

    def known(self, kind: str, count: int, preview: int, k: int) -> Array:
        """Return the reference or the disturbance that is known for a step."""
        ahead = min(k, preview)
        return self.entries(f"{kind}_{ahead}" if ahead else kind, count)

    def reference(self, k: int) -> Array:
        tracking = self.mpc.tracking
        return self.known("r", len(tracking.C), tracking.preview, k)

    def disturbance(self, k: int) -> Array:
        count = self.mpc.model.E.shape[1]
        rows = self.known("d", count, self.mpc.disturbances.preview, k)
        return rows - self.constant(self.mpc.model.d_ss)

    def _set_rows(self) -> None:
        """Rows that are zero, and rows that are at most zero."""
        mpc = self.mpc
        model = mpc.model
        steps = range(mpc.horizon)
        equal = []
        self.upper: list[Array] = []
        for k in steps:
            moved = self.x(k + 1) - model.A @ self.x(k) - model.B @ self.u(k)
            rest = model.x_ss - model.A @ model.x_ss - model.B @ model.u_ss
            equal.append(moved - self.constant(rest) - model.E @ self.disturbance(k))
            self._bound(self.u(k), "u", mpc.u_min, mpc.u_max)
            self._bound(self.x(k + 1), "x", mpc.x_min, mpc.x_max)
            self._bound(mpc.outputs.C @ self.x(k + 1), "y", mpc.outputs.y_min, mpc.outputs.y_max)
            if mpc.layout.n_previous:
                self._bound(self.u(k) - self.u(k - 1), "du", mpc.rate.du_min, mpc.rate.du_max)
        starts = np.cumsum([0, *mpc.blocks])
        equal += [self.u(k) - self.u(k - 1) for k in steps if k not in starts]
        acts = np.any(self.mixed.G, axis=1)
        for k in range(mpc.horizon + 1):
            made = self.mixed.F @ self.x(k)
            if k < mpc.horizon:
                made = made + self.mixed.G @ self.u(k)
            holds = (acts & (k < mpc.horizon)) | (~acts & (k > 0))
            self._bound(made, "mixed", self.mixed.low, self.mixed.high, holds)
        F, g = mpc.terminal.set
        last = [self.entry(name) for name in mpc.layout.names]
        last[: self.n] = self.x(mpc.horizon)
        if mpc.layout.n_previous:
            last[-self.m :] = self.u(mpc.horizon - 1)
        self.upper.append(F @ np.array(last) - self.constant(g))
        slacks = self.eye[self.n_moves : self.n_z]
        self.equal = self._scaled(np.vstack(equal))
        self.below = self._scaled(np.vstack([*self.upper, -slacks]))

    def _bound(
        self, rows: Array, kind: str, low: Array, high: Array, holds: Array | bool = True
    ) -> None:
        """Add the bounds of some rows, those in theta too, with a slack where they are soft."""
        slack = np.zeros_like(rows)
        if kind in self.soft:
            place = self.n_moves + [*self.soft].index(kind)
            slack = np.outer(self.soft[kind], self.eye[place])
        for sign, end, side in ((1, "max", high), (-1, "min", low)):
            names = [f"{kind}_{end}[{i}]" for i in range(len(rows))]
            given = np.isin(names, self.mpc.layout.names)
            limit = self.constant(np.where(np.isfinite(side) & ~given, side, 0.0))
            for i in np.flatnonzero(given):
                limit[i] = self.entry(names[i])
            kept = holds & (given | np.isfinite(side))
            self.upper.append((sign * (rows - limit) - slack)[kept])

    def _scaled(self, rows: Array) -> Array:
        """Return rows of unit length in units of the variables."""
        rows = rows.copy()
        rows[:, : self.n_z] *= self.unit
        return rows / np.maximum(np.linalg.norm(rows[:, : self.n_z], axis=1), 1e-09)[:, None]

    def _set_cost(self) -> None:
        mpc = self.mpc
        H = np.zeros_like(self.eye)
        linear = np.zeros(len(self.eye))
        price = mpc.price.sized(self.n, self.m)
        for k in range(mpc.horizon):
            discount = mpc.gamma**k
            goal = self.target(k)
            parts = [(self.x(k) - goal[self.m :], mpc.Q), (self.u(k) - goal[: self.m], mpc.R)]
            if mpc.layout.n_previous:
                parts.append((self.u(k) - self.u(k - 1), mpc.rate.R_du))
            for rows, weight in parts:
                H += discount * rows.T @ weight @ rows
            linear += discount / 2 * (price.x @ self.x(k) + price.u @ self.u(k))
        goal = self.target(mpc.horizon)
        end = np.vstack([
            self.x(mpc.horizon) - goal[self.m :], self.u(mpc.horizon - 1) - goal[: self.m],
        ])[: len(mpc.terminal.cost)]  # fmt: skip
        H += mpc.gamma**mpc.horizon * end.T @ mpc.terminal.cost @ end
        slacks = np.arange(self.n_moves, self.n_z)
        H[slacks, slacks] += mpc.soft.penalty
        linear[slacks] += mpc.soft.penalty / 2
        H = H[: self.n_z]
        H[:, -1] += linear[: self.n_z]
        moves = np.arange(self.n_moves)
        size = np.mean(H[moves, moves] * self.unit[: self.n_moves] ** 2)
        self.gradient = H[:, self.n_z :] * self.unit[:, None] / size
        H = H[:, : self.n_z] * np.outer(self.unit, self.unit) / size
        # The squares of the equalities, which change no optimum, make the Hessian positive
        # definite, as DAQP wants it, where Q is singular.
        z = self.equal[:, : self.n_z]
        self.hessian = np.ascontiguousarray(H + z.T @ z)
        self.gradient = self.gradient + z.T @ self.equal[:, self.n_z :]

    def target(self, k: int) -> Array:
        """Return rows of [u_s; x_s]: the cheapest steady state that holds a step's reference."""
        model = self.mpc.model
        C = self.mpc.tracking.C
        holds = np.hstack([model.B, model.A - np.eye(self.n)])
        shows = np.hstack([np.zeros((len(C), self.m)), C])
        M = np.vstack([holds, shows])
        kkt = np.block([
            [linalg.block_diag(self.mpc.R, self.mpc.Q), M.T], [M, np.zeros((len(M), len(M)))],
        ])  # fmt: skip
        right = np.vstack([
            np.zeros((self.n + self.m, len(self.eye))),
            -model.E @ self.disturbance(k),
            self.reference(k) - self.constant(C @ model.x_ss),
        ])  # fmt: skip
        found = np.linalg.lstsq(kkt, right, rcond=1e-13)[0][: self.n + self.m]
        return found + self.constant(np.append(model.u_ss, model.x_ss))

    def limits(self, theta: Array) -> tuple[Array, Array]:
        """Return what rows times scaled variables are equal to, and at most."""
        given = np.append(theta, 1.0)
        return -self.equal[:, self.n_z :] @ given, -self.below[:, self.n_z :] @ given

    def __call__(self, theta: Array) -> Array | None:
        """Return u_0, or None where no input keeps all constraints."""
        equal, upper = self.limits(theta)
        z, _, status, _ = daqp.solve(
            self.hessian,
            self.gradient @ np.append(theta, 1.0),
            np.ascontiguousarray(np.vstack([self.equal, self.below])[:, : self.n_z]),
            np.concatenate([equal, upper]),
            np.concatenate([equal, np.full(len(upper), -NO_BOUND)]),
            np.repeat(np.intc([EQUALITY, 0]), [len(equal), len(upper)]),
            primal_tol=1e-12,
            dual_tol=1e-12,
        )
        return np.asarray(z)[: self.m] * self.u_unit if status == 1 else None


def room(mpc: LinearMPC, theta: Array) -> float:
    """How far all constraints can be kept at theta, by HiGHS: negative where it is infeasible.

    The unit is that of the half-widths of inputs and box.
    """
    qp = SparseQP(mpc)
    equal, upper = qp.limits(theta)
    rows = np.column_stack([qp.below[:, : qp.n_z], np.ones(len(upper))])
    held = np.column_stack([qp.equal[:, : qp.n_z], np.zeros(len(equal))])
    free = [*[(None, None)] * qp.n_z, (None, 1.0)]
    cost = np.append(np.zeros(qp.n_z), -1.0)
    found = optimize.linprog(cost, rows, upper, held, equal, free, method="highs")
    assert found.status == 0, found.message
    return float(found.x[-1])


def online_answers(mpc: LinearMPC, points: Array) -> tuple[Array, Array]:
    """Return the inputs at the feasible points (k, m), and which points those are (count,)."""
    online = SparseQP(mpc)
    answers = [online(point) for point in points]
    feasible = np.array([u is not None for u in answers])
    inputs = [u for u in answers if u is not None]
    return np.reshape(inputs, (len(inputs), mpc.model.n_inputs)), feasible


def relative_error(mpc: LinearMPC, actual: Array, expected: Array) -> float:
    """Largest difference, as a share of the input range."""
    width = mpc.u_max - mpc.u_min
    return float(np.max(np.abs(actual - expected) / np.where(np.isfinite(width), width, 1.0)))


def draw(rng: np.random.Generator, features: tuple[str, ...]) -> LinearMPC:
    """Draw a problem in plant units with these features, and some of the others' neighbors."""
    n = int(rng.integers(1, 4))
    m = min(n, int(rng.integers(1, 3)))
    while True:
        A = rng.normal(size=(n, n))
        B = rng.normal(size=(n, m))
        A *= rng.uniform(0.4, 1.05) / np.max(np.abs(np.linalg.eigvals(A)))
        C = rng.normal(size=(m, n))
        square = np.block([[A - np.eye(n), B], [C, np.zeros((m, m))]])
        reach = np.hstack([np.linalg.matrix_power(A, k) @ B for k in range(n)])
        smallest = [np.linalg.svd(each, compute_uv=False)[-1] for each in (square, reach)]
        if min(smallest) > 0.15:
            break
    N = int(rng.integers(2, 6))
    tracks = "preview" in features or rng.random() < 0.5
    loaded = tracks and ("preview" in features or rng.random() < 0.5)
    x_ss = rng.normal(size=n) * 3
    u_ss = rng.normal(size=m) * 3

    def around(point: Array, low: float, high: float) -> tuple[Array, Array]:
        size = len(point)
        return point - rng.uniform(low, high, size), point + rng.uniform(low, high, size)

    given: dict[str, Any] = {"Q": np.diag(rng.uniform(0.2, 2, n)), "horizon": N}
    given |= {"R": np.diag(rng.uniform(0.05, 1, m)), "gamma": float(rng.choice([1.0, 0.95]))}
    given |= zip(("x_min", "x_max"), around(x_ss, 2, 5), strict=True)
    given |= zip(("u_min", "u_max"), around(u_ss, 0.4, 1.5), strict=True)
    preview = rng.integers(0, N + 1, 2).tolist() if "preview" in features else [0, 0]
    if tracks:
        given["tracking"] = Tracking(C, *around(C @ x_ss, 0.2, 0.8), preview=preview[0])
    load: dict[str, Any] = {}
    if loaded:
        load = {"E": rng.normal(size=(n, 1)) * 0.3, "d_ss": rng.normal(size=1)}
        given["disturbances"] = DisturbanceBounds(*around(load["d_ss"], 0.2, 0.6), preview[1])
    if rng.random() < 0.4:
        weight = np.diag(rng.uniform(0, 1, m)) * float(rng.random() < 0.5)
        given["rate"] = RateLimits(-rng.uniform(0.3, 1, m), rng.uniform(0.3, 1, m), weight)
    soft_x = rng.uniform(0.2, 1, n) * float(rng.random() < 0.5)
    soft_rows = np.zeros(0)
    if "blocks" in features:
        cuts = sorted(rng.choice(np.arange(1, N), int(rng.integers(0, N)), replace=False))
        given["control_horizon"] = np.diff([0, *cuts, N]).tolist()
    if "mixed" in features:
        k = int(rng.integers(1, 3))
        F = rng.normal(size=(k, n)) * rng.integers(0, 2, (k, 1))
        G = rng.normal(size=(k, m)) * float(rng.random() < 0.8)
        G[np.all(F == 0, axis=1)] = 1.0
        low, high = around(F @ x_ss + G @ u_ss, 0.4, 2)
        low[rng.random(k) < 0.3] = -np.inf
        soft_rows = rng.uniform(0.3, 1, k) * rng.integers(0, 2, k)
        given["mixed"] = MixedBounds(F, G, low, high, soft=soft_rows)
    if np.any(soft_x) or np.any(soft_rows):
        given["soft"] = SoftBounds(soft_x, penalty=200.0)
    if "price" in features:
        given["price"] = LinearCost(rng.normal(size=n), rng.normal(size=m))
    if "parametric" in features:
        names = [f"u_max[{m - 1}]", "u_min[0]", f"x_max[{n - 1}]"]
        names += ["du_max[0]"] if "rate" in given else []
        names += ["mixed_max[0]"] if "mixed" in features and np.isfinite(low[0]) else []
        chosen = rng.permutation(names)[: rng.integers(1, 3)]
        given["parametric_bounds"] = [str(each) for each in chosen]
    return LinearMPC(LinearModel(A, B, 1.0, x_ss=x_ss, u_ss=u_ss, **load), **given)


def worst_difference(features: tuple[str, ...], seed: int, points: int) -> tuple[float, int]:
    """Return how far laws are off in half-ranges of the inputs at most, and at how many points.

    The online law counts at each point that has an answer, the explicit one where it has at most
    400 regions.
    """
    rng = np.random.default_rng(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # steady states at the edge
        mpc = draw(rng, features)
    exact = SparseQP(mpc)
    laws = [mpc.online()]
    with contextlib.suppress(ExplicitLimitError, ExplicitSolutionError, ValueError):
        laws.append(mpc.explicit(region_limit=MOST_REGIONS))
    center = (mpc.theta_max + mpc.theta_min) / 2
    worst = 0.0
    count = 0
    for share in rng.uniform(0.1, 1, points):
        theta = center + share * mpc.theta_half * rng.uniform(-1, 1, mpc.n_theta)
        u = exact(theta)
        if u is None:
            continue
        count += 1
        for law in laws:
            off = np.abs(law.plant_input(theta) - u).max()
            inside = law.in_domain(mpc.units.to_deviations(theta))
            worst = max(worst, off / mpc.u_half.min() if inside else np.inf)
    return float(worst), count
