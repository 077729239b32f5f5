"""Random problems in plant units, and their programs written down with all states, for cvxopt.

Nothing here asks the package for a matrix: predictions, targets, terminal cost and bounds are built
from the numbers that the constructor of the problem gets.
"""

import contextlib
import warnings
from dataclasses import dataclass, field
from typing import Any

import cvxopt
import numpy as np
from numpy.typing import NDArray
from scipy import linalg

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
FEATURES = ("blocks", "preview", "mixed", "price", "parametric")
PENALTY = 200.0
MOST_REGIONS = 400


@dataclass
class Spec:
    """What a problem consists of; arrays in plant units."""

    A: Array
    B: Array
    E: Array
    x_ss: Array
    u_ss: Array
    d_ss: Array
    Q: Array
    R: Array
    N: int
    gamma: float
    x: tuple[Array, Array]
    u: tuple[Array, Array]
    C: Array
    r: tuple[Array, Array]
    d: tuple[Array, Array]
    R_du: Array
    du: tuple[Array, Array]
    blocks: list[int]
    ahead: tuple[int, int] = (0, 0)
    F: Array = field(default_factory=lambda: np.zeros((0, 0)))
    G: Array = field(default_factory=lambda: np.zeros((0, 0)))
    mixed: tuple[Array, Array] = field(default_factory=lambda: (np.zeros(0), np.zeros(0)))
    soft: Array = field(default_factory=lambda: np.zeros(0))
    soft_x: Array = field(default_factory=lambda: np.zeros(0))
    price: tuple[Array, Array] | None = None
    parametric: list[str] = field(default_factory=list)
    tracks: bool = True
    loaded: bool = True
    rated: bool = False
    y_max: float | None = None


def draw(rng: np.random.Generator, features: tuple[str, ...]) -> Spec:
    """Draw a problem with these features, and some of the others' neighbors."""
    n = int(rng.integers(1, 4))
    m = int(rng.integers(1, 3))
    m = min(n, m)
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
    tracks = bool("preview" in features or rng.random() < 0.5)
    loaded = tracks and bool("preview" in features or rng.random() < 0.5)
    rated = bool(rng.random() < 0.4)
    x_ss = rng.normal(size=n) * 3
    u_ss = rng.normal(size=m) * 3

    def around(point: Array, low: float, high: float) -> tuple[Array, Array]:
        size = len(point)
        return point - rng.uniform(low, high, size), point + rng.uniform(low, high, size)

    spec = Spec(
        A, B, rng.normal(size=(n, 1)) * 0.3 if loaded else np.zeros((n, 0)), x_ss, u_ss,
        rng.normal(size=1) if loaded else np.zeros(0),
        Q=np.diag(rng.uniform(0.2, 2, n)), R=np.diag(rng.uniform(0.05, 1, m)), N=N,
        gamma=float(rng.choice([1.0, 0.95])),
        x=around(x_ss, 2, 5), u=around(u_ss, 0.4, 1.5), C=C,
        r=around(C @ x_ss, 0.2, 0.8), d=(np.zeros(0), np.zeros(0)),
        R_du=np.diag(rng.uniform(0, 1, m)) * float(rng.random() < 0.5),
        du=(-rng.uniform(0.3, 1, m), rng.uniform(0.3, 1, m)), blocks=[1] * N,
        tracks=tracks, loaded=loaded, rated=rated,
    )  # fmt: skip
    spec.d = around(spec.d_ss, 0.2, 0.6)
    spec.soft_x = rng.uniform(0.2, 1, n) * float(rng.random() < 0.5)
    if "blocks" in features:
        cuts = sorted(rng.choice(np.arange(1, N), int(rng.integers(0, N)), replace=False))
        spec.blocks = np.diff([0, *cuts, N]).tolist()
    if "preview" in features:
        spec.ahead = (int(rng.integers(0, N + 1)), int(rng.integers(0, N + 1)))
    if "mixed" in features:
        k = int(rng.integers(1, 3))
        spec.F = rng.normal(size=(k, n)) * rng.integers(0, 2, (k, 1))
        spec.G = rng.normal(size=(k, m)) * float(rng.random() < 0.8)
        spec.G[np.all(spec.F == 0, axis=1)] = 1.0
        spec.mixed = around(spec.F @ x_ss + spec.G @ u_ss, 0.4, 2)
        spec.mixed[0][rng.random(k) < 0.3] = -np.inf
        spec.soft = rng.uniform(0.3, 1, k) * rng.integers(0, 2, k)
    if "price" in features:
        spec.price = rng.normal(size=n), rng.normal(size=m)
    if "parametric" in features:
        names = [f"u_max[{m - 1}]", "u_min[0]", f"x_max[{n - 1}]"]
        spec.parametric = [str(each) for each in rng.permutation(names)[: rng.integers(1, 3)]]
    return spec


def problem(spec: Spec, **changes: Any) -> LinearMPC:
    """Return the package's problem."""
    s = spec
    model = LinearModel(s.A, s.B, 1.0, E=s.E, x_ss=s.x_ss, u_ss=s.u_ss, d_ss=s.d_ss)
    values: dict[str, Any] = {"Q": s.Q, "R": s.R, "horizon": s.N, "gamma": s.gamma}
    values |= {"x_min": s.x[0], "x_max": s.x[1], "u_min": s.u[0], "u_max": s.u[1]}
    values |= {"control_horizon": s.blocks, "parametric_bounds": s.parametric}
    if s.tracks:
        values["tracking"] = Tracking(s.C, *s.r, preview=s.ahead[0])
    if s.loaded:
        values["disturbances"] = DisturbanceBounds(*s.d, preview=s.ahead[1])
    if s.rated:
        values["rate"] = RateLimits(*s.du, s.R_du)
    if len(s.F):
        values["mixed"] = MixedBounds(s.F, s.G, *s.mixed, soft=s.soft)
    if np.any(s.soft_x) or np.any(s.soft):
        values["soft"] = SoftBounds(s.soft_x, penalty=PENALTY)
    if s.price is not None:
        values["price"] = LinearCost(*s.price)
    return LinearMPC(model, **{**values, **changes})


class SparseQP:
    """The program of a problem in x_0 ... x_N, u_0 ... u_{N-1} and slacks."""

    def __init__(self, spec: Spec) -> None:
        self.s = spec
        self.n, self.m = spec.B.shape
        self.n_slacks = 2
        self.size = (spec.N + 1) * self.n + spec.N * self.m + self.n_slacks
        self.weighs_rate = spec.rated and bool(np.any(spec.R_du))
        self.P = self._terminal()

    def _terminal(self) -> Array:
        s = self.s
        n = self.n
        m = self.m
        root = np.sqrt(s.gamma)
        if not self.weighs_rate:
            return linalg.solve_discrete_are(root * s.A, root * s.B, s.Q, s.R)
        A = linalg.block_diag(s.A, np.zeros((m, m)))
        B = np.vstack([s.B, np.eye(m)])
        Q = linalg.block_diag(s.Q, s.R_du)
        cross = np.vstack([np.zeros((n, m)), -s.R_du])
        return linalg.solve_discrete_are(root * A, root * B, Q, s.R + s.R_du, s=cross)

    def x(self, k: int) -> Array:
        return np.eye(self.size)[k * self.n : (k + 1) * self.n]

    def u(self, k: int) -> Array:
        first = (self.s.N + 1) * self.n + k * self.m
        return np.eye(self.size)[first : first + self.m]

    def _parts(self, theta: Array) -> dict[str, Any]:
        """Take theta in plant units apart: r and d by sample."""
        s = self.s
        found: dict[str, Any] = {}
        rest = theta
        found["x"] = rest[: self.n]
        rest = rest[self.n :]
        p = len(s.C) if s.tracks else 0
        d = s.E.shape[1]
        for name, size, ahead in (("r", p, s.ahead[0]), ("d", d, s.ahead[1])):
            count = size * (ahead + 1)
            found[name] = rest[:count].reshape(ahead + 1, size)
            rest = rest[count:]
        found["bounds"] = dict(zip(s.parametric, rest, strict=False))
        found["u_prev"] = rest[len(s.parametric) :]
        return found

    def _target(self, r: Array, d: Array) -> tuple[Array, Array]:
        s = self.s
        n = self.n
        m = self.m
        if not s.tracks:
            return s.x_ss, s.u_ss
        square = np.block([[s.A - np.eye(n), s.B], [s.C, np.zeros((m, m))]])
        right = np.concatenate([-s.E @ (d - s.d_ss), r - s.C @ s.x_ss])
        found = np.linalg.solve(square, right)
        return s.x_ss + found[:n], s.u_ss + found[n:]

    def __call__(self, theta: Array) -> Array | None:  # noqa: C901 (one page to read)
        """Return u_0 in plant units, None where there is none or it is not certain."""
        s = self.s
        given = self._parts(theta)
        H = np.zeros((self.size, self.size))
        c = np.zeros(self.size)
        equal: list[tuple[Array, Array]] = [(self.x(0), given["x"])]
        upper: list[tuple[Array, Array]] = []

        def weigh(rows: Array, target: Array, weight: Array) -> None:
            nonlocal H, c
            H = H + 2 * rows.T @ weight @ rows
            c = c - 2 * rows.T @ weight @ target

        def between(rows: Array, sides: tuple[Array, Array], slack: Array) -> None:
            for sign, side in ((1, sides[1]), (-1, sides[0])):
                upper.append((sign * rows - slack, sign * side))

        def known(values: Array, k: int) -> Array:
            return values[min(k, len(values) - 1)] if len(values) else np.zeros(0)

        x_lim, u_lim = ([side.copy() for side in each] for each in (s.x, s.u))
        for name, value in given["bounds"].items():
            (x_lim if name[0] == "x" else u_lim)["max" in name][int(name[6])] = value
        no_slack = np.zeros((1, self.size))
        slack_x, slack_m = np.eye(self.size)[-2:]
        hard_x = not np.any(s.soft_x)
        for k in range(s.N):
            r = known(given["r"], k)
            d = known(given["d"], k)
            x_s, u_s = self._target(r, d)
            g = s.gamma**k
            weigh(self.x(k), x_s, g * s.Q)
            weigh(self.u(k), u_s, g * s.R)
            if s.price is not None:
                c = c + g * (self.x(k).T @ s.price[0] + self.u(k).T @ s.price[1])
            moved = self.x(k + 1) - s.A @ self.x(k) - s.B @ self.u(k)
            equal.append((moved, s.x_ss - s.A @ s.x_ss - s.B @ s.u_ss + s.E @ (d - s.d_ss)))
            between(self.u(k), (u_lim[0], u_lim[1]), no_slack)
            soft = np.outer(s.soft_x, slack_x) if not hard_x else np.zeros((self.n, self.size))
            between(self.x(k + 1), (x_lim[0], x_lim[1]), soft)
            if s.rated:
                before = self.u(k - 1) if k else np.zeros((self.m, self.size))
                held = np.zeros(self.m) if k else given["u_prev"]
                between(self.u(k) - before, (s.du[0] + held, s.du[1] + held), no_slack)
                weigh(self.u(k) - before, held, g * s.R_du)
        starts = set(np.cumsum([0, *s.blocks[:-1]]).tolist())
        for k in range(s.N):
            if k not in starts:
                equal.append((self.u(k) - self.u(k - 1), np.zeros(self.m)))
        for k in range(s.N + 1):
            for i in range(len(s.F)):
                acts = np.any(s.G[i] != 0)
                if (acts and k < s.N) or (not acts and k > 0):
                    row = s.F[i] @ self.x(k) + (s.G[i] @ self.u(k) if k < s.N else 0)
                    sides = s.mixed[0][i : i + 1], s.mixed[1][i : i + 1]
                    between(row[None], sides, (s.soft[i] * slack_m)[None])
        x_s, u_s = self._target(known(given["r"], s.N), known(given["d"], s.N))
        end = self.x(s.N)
        goal = x_s
        if self.weighs_rate:
            end = np.vstack([end, self.u(s.N - 1)])
            goal = np.concatenate([x_s, u_s])
        weigh(end, goal, s.gamma**s.N * self.P)
        for slack in (slack_x, slack_m):
            H = H + 2 * PENALTY * np.outer(slack, slack)
            c = c + PENALTY * slack
            upper.append((-slack[None], np.zeros(1)))
        G, h = (np.concatenate(each) for each in zip(*upper, strict=True))
        bounded = np.isfinite(h)
        rows, right = (np.concatenate(each) for each in zip(*equal, strict=True))
        values = _solve(H, c, G[bounded], h[bounded], rows, right)
        return None if values is None else self.u(0) @ values


def _solve(H: Array, c: Array, G: Array, h: Array, A: Array, b: Array) -> Array | None:
    """Return the solution from cvxopt, put right on its active set and proved by its conditions."""
    options = {"show_progress": False, "abstol": 1e-11, "reltol": 1e-11, "feastol": 1e-11}
    try:
        found = cvxopt.solvers.qp(
            *(cvxopt.matrix(each) for each in (H, c, G, h, A, b)), options=options
        )
    except (ValueError, ArithmeticError):
        return None
    s, z = (np.ravel(found[name]) for name in ("s", "z"))
    active = np.flatnonzero(z > s)
    for _ in range(20):
        tight = np.vstack([A, G[active]])
        K = np.block([[H, tight.T], [tight, np.zeros((len(tight), len(tight)))]])
        right = np.concatenate([-c, b, h[active]])
        both = np.linalg.lstsq(K, right, rcond=1e-13)[0]
        values = both[: len(c)]
        multipliers = both[len(c) + len(b) :]
        off = G @ values - h
        if np.abs(K @ both - right).max() > 1e-7:
            return None
        if off.max() <= 1e-9 and multipliers.min(initial=0.0) >= -1e-7:
            return values
        keep = active[multipliers >= -1e-7]
        active = np.union1d(keep, np.flatnonzero(off > 1e-9))
    return None


def worst_difference(features: tuple[str, ...], seed: int, points: int = 8) -> tuple[float, int]:
    """Return how far laws are off in half-ranges of the inputs at most, and at how many points.

    The online law counts at each point that has an answer, the explicit one where it has at most
    400 regions.
    """
    rng = np.random.default_rng(seed)
    spec = draw(rng, features)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # steady states at the edge
        mpc = problem(spec)
    exact = SparseQP(spec)
    laws = [mpc.online()]
    with contextlib.suppress(ExplicitLimitError, ExplicitSolutionError, ValueError):
        laws.append(mpc.explicit(region_limit=MOST_REGIONS))
    center = (mpc.theta_max + mpc.theta_min) / 2
    half = mpc.theta_half
    worst = 0.0
    count = 0
    for share in rng.uniform(0.1, 1, points):
        theta = center + share * half * rng.uniform(-1, 1, mpc.n_theta)
        u = exact(theta)
        if u is None:
            continue
        count += 1
        for law in laws:
            off = (
                np.abs(law.plant_input(theta) - u).max()
                if law.in_domain(mpc.units.to_deviations(theta))
                else np.inf
            )
            worst = max(worst, float(np.max(off / mpc.u_half.min())))
    return worst, count
