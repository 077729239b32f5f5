"""The smallest cost that any controller can have: the optimum of both plants, start by start.

It knows the state and the plant. All starts at once go through control-limited differential dynamic
programming (Y. Tassa, N. Mansard and E. Todorov, ICRA 2014; Gauss-Newton curvature). Its feedback
also tames the upright pendulum: over an episode that amplifies a change of the first torque 1e16
times, so the plain sequence of torques has no usable gradient. A plan's cost is what the
environment itself charges for its inputs: it can be reached, so it is an upper bound on the
optimum, close to it where the `residual` is small and the best valley was among those searched.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import gymnasium
import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates
from torch import Tensor

from sb3_yann._validation import Array
from sb3_yann.control import LinearMPC
from sb3_yann_envs import clipped_pendulum as pendulum
from sb3_yann_envs import cstr as reactor
from sb3_yann_envs import problems

Policy = Callable[[int, Tensor], Tensor]  # step and states (k, n) -> inputs (k,)

STEP_SIZES = 0.5 ** torch.arange(12, dtype=torch.float64)[:, None, None]
BARRIERS = (1e-2, 1e-4, 0.0)
"""Weights of the logarithmic barrier at the temperature limit, solved one after the other."""
TORQUES = np.linspace(-pendulum.MAX_TORQUE, pendulum.MAX_TORQUE, 11)
"""Torques of the pendulum's dynamic programming in N m."""
FORCED = [(torque, n) for torque in (-math.inf, 0.0, math.inf) for n in (3, 8)]
"""First torques in N m, clipped, and for how many steps: searches that may swing another way."""


@dataclass(frozen=True)
class Plan:
    """Costs (k,), inf where the limit could not be kept, of open-loop inputs (k, steps).

    Played in the environment the inputs give the costs to the last bit. The residual (k,) is the
    largest projected gradient with respect to one input, with feedback in the steps after it. The
    pendulum's is not zero where it swings round: there its speed limit makes the cost kink.
    """

    costs: Array
    inputs: Array
    residual: Array


@dataclass(frozen=True)
class _Plant:
    """A differentiable simulator of states (..., n) and inputs (...,), with its cost."""

    env_id: str
    step: Callable[[Tensor, Tensor], Tensor]
    error: Callable[[Tensor], Tensor]  # the deviation that the cost squares, (..., n)
    Q: Tensor  # diagonal, (n,)
    R: float
    max_input: float
    limit: float  # of the last state

    def cost(self, x: Tensor, u: Tensor, barrier: float) -> Tensor:
        """Return the sums (...,) over trajectories (..., steps + 1, n) with their inputs."""
        total = (self.Q * self.error(x[..., :-1, :]) ** 2).sum((-1, -2)) + self.R * (u**2).sum(-1)
        slack = self.limit - x[..., 1:, -1]
        if barrier:
            total = total - barrier * (slack / self.limit).log().sum(-1)
        return torch.where((slack >= 0).all(-1), total, math.inf)

    def clip(self, u: Tensor) -> Tensor:
        """Return the inputs within their bounds."""
        return u.clamp(-self.max_input, self.max_input)

    def rollout(self, starts: Tensor, policy: Policy, steps: int) -> tuple[Tensor, Tensor]:
        """Return trajectories (..., steps + 1, n) and inputs (..., steps) from starts (..., n)."""
        states = [starts]
        inputs = []
        for t in range(steps):
            inputs.append(self.clip(policy(t, states[-1])))
            states.append(self.step(states[-1], inputs[-1]))
        return torch.stack(states, -2), torch.stack(inputs, -1)


def _pendulum_step(x: Tensor, u: Tensor) -> Tensor:
    """Return the state 0.05 s later, semi-implicit Euler as in `ClippedPendulumEnv.step`."""
    gravity = 1.5 * pendulum.GRAVITY / pendulum.LENGTH
    gain = 3 / pendulum.LENGTH**2 / pendulum.MASS
    speed = x[..., 1] + (gravity * x[..., 0].sin() + gain * u) * pendulum.DT
    speed = speed.clamp(-pendulum.MAX_SPEED, pendulum.MAX_SPEED)
    return torch.stack([x[..., 0] + speed * pendulum.DT, speed], -1)


def _wrapped(x: Tensor) -> Tensor:
    """Return the pendulum's state with the angle in [-pi, pi)."""
    return torch.stack([(x[..., 0] + math.pi) % (2 * math.pi) - math.pi, x[..., 1]], -1)


def _reactor_rates(x: Tensor, transfer: Tensor) -> Tensor:
    """Return `sb3_yann_envs.cstr.dynamics`: absolute states, derivatives per hour."""
    a, b, s, temperature = x.unbind(-1)
    thermal = reactor.GAS_CONSTANT * temperature
    r1 = (reactor.LOG_FREQUENCY_1 - reactor.ACTIVATION_1 / thermal).exp() * a * b
    r2 = (reactor.LOG_FREQUENCY_2 - reactor.ACTIVATION_2 / thermal).exp() * s
    feed = (reactor.FEED_A, reactor.FEED_B, reactor.FEED_S, reactor.FEED_TEMPERATURE)
    cooling = 1e3 * reactor.AREA / reactor.VOLUME * transfer
    heating = reactor.REACTION_HEAT_1 * r1 + reactor.REACTION_HEAT_2 * r2
    heating = heating - cooling * (temperature - reactor.COOLANT_TEMPERATURE)
    flow = reactor.DILUTION * (torch.tensor(feed, dtype=x.dtype) - x)
    return flow + torch.stack([-r1, -r1, -r2, heating / reactor.HEAT_CAPACITY], -1)


def _reactor_step(deviation: Tensor, u: Tensor) -> Tensor:
    """Return the deviation 1/60 h later, classical Runge-Kutta as in `CSTREnv.step`."""
    steady = torch.tensor(reactor.X_SS)
    x = deviation + steady
    transfer = u + float(reactor.U_SS[0])
    h = reactor.DT / reactor.SUBSTEPS
    for _ in range(reactor.SUBSTEPS):
        p = _reactor_rates(x, transfer)
        q = _reactor_rates(x + h / 2 * p, transfer)
        r = _reactor_rates(x + h / 2 * q, transfer)
        x = x + h / 6 * (p + 2 * (q + r) + _reactor_rates(x + h * r, transfer))
    return x - steady


PENDULUM = _Plant(
    "ClippedPendulum-v0",
    _pendulum_step,
    _wrapped,
    torch.tensor(pendulum.Q.diagonal().copy()),
    float(pendulum.R[0, 0]),
    pendulum.MAX_TORQUE,
    math.inf,
)
REACTOR = _Plant(
    "CSTR-v0",
    _reactor_step,
    lambda x: x,
    torch.tensor(reactor.Q.diagonal().copy()),
    float(reactor.R[0, 0]),
    reactor.MAX_INPUT,
    reactor.TEMPERATURE_LIMIT - float(reactor.X_SS[3]) - 1e-9,  # more than rounding
)


def _backward(plant: _Plant, x: Tensor, u: Tensor, barrier: float) -> tuple[Tensor, ...]:
    """Return corrections (k, steps), gains (k, steps, n), gradients (k, steps): Tassa et al."""
    jacobians = torch.func.vmap(torch.func.vmap(torch.func.jacrev(plant.step, (0, 1))))
    A, B = jacobians(x[:, :-1], u)
    lx = 2 * plant.Q * plant.error(x)
    lxx = torch.diag(2 * plant.Q).repeat(*x.shape[:2], 1, 1)
    lx[:, -1] = lxx[:, -1] = 0  # an episode is charged for the states before its steps
    if barrier:
        slack = plant.limit - x[:, 1:, -1]
        lx[:, 1:, -1] += barrier / slack
        lxx[:, 1:, -1, -1] += barrier / slack**2
    v = lx[:, -1]
    V = lxx[:, -1]
    corrections = torch.zeros_like(u)
    gains = torch.zeros_like(B)
    gradients = torch.zeros_like(u)
    for t in reversed(range(u.shape[1])):
        a = A[:, t]
        b = B[:, t]
        Va = V @ a
        Vb = (V @ b[..., None])[..., 0]
        qx = lx[:, t] + (v[:, None] @ a)[:, 0]
        qu = 2 * plant.R * u[:, t] + (b * v).sum(-1)
        qux = (b[:, None] @ Va)[:, 0]
        quu = 2 * plant.R + (b * Vb).sum(-1)
        wanted = u[:, t] - qu / quu
        move = plant.clip(wanted) - u[:, t]
        free = wanted.abs() < plant.max_input
        gain = torch.where(free[:, None], -qux / quu[:, None], 0.0)
        cross = gain[..., None] * (qux + quu[:, None] * gain / 2)[:, None]
        v = qx + gain * (qu + quu * move)[:, None] + qux * move[:, None]
        V = lxx[:, t] + a.mT @ Va + cross + cross.mT
        corrections[:, t] = move
        gains[:, t] = gain
        gradients[:, t] = qu
    return corrections, gains, gradients


def _improved(plant: _Plant, x: Tensor, u: Tensor, barrier: float) -> tuple[Tensor, Tensor]:
    """Return trajectories (k, steps + 1, n) and inputs (k, steps) that no correction improves."""
    x = x.clone()
    u = u.clone()
    steps = u.shape[1]
    costs = plant.cost(x, u, barrier)
    active = torch.arange(len(u))
    for _ in range(200):
        old_x = x[active]
        old_u = u[active]
        old_costs = costs[active]
        corrections, gains, _ = _backward(plant, old_x, old_u, barrier)
        tried = old_u + STEP_SIZES * corrections
        begin = old_x[:, 0].expand(len(STEP_SIZES), -1, -1)
        new_x, new_u = plant.rollout(begin, partial(_following, old_x, tried, gains), steps)
        new_costs, best = plant.cost(new_x, new_u, barrier).min(0)
        better = new_costs < old_costs
        rows = torch.arange(len(active))
        changed = active[better]
        x[changed] = new_x[best, rows][better]
        u[changed] = new_u[best, rows][better]
        costs[changed] = new_costs[better]
        active = active[old_costs - new_costs > 1e-12 + 1e-9 * old_costs.abs()]
        if len(active) == 0:
            break
    return x, u


def _following(path: Tensor, u: Tensor, gains: Tensor, t: int, x: Tensor) -> Tensor:
    """Return the inputs (..., k) with feedback to a path (k, steps + 1, n)."""
    return u[..., t] + (gains[:, t] * (x - path[:, t])).sum(-1)


def _played(plant: _Plant, path: Tensor, u: Tensor, gains: Tensor) -> tuple[Array, Array]:
    """Return the environment's costs (k,) and the inputs (k, steps) that hold it on the path.

    The feedback only undoes the differences of rounding between torch and the environment.
    """
    env = gymnasium.make(plant.env_id).unwrapped
    costs = np.zeros(len(u))
    inputs = u.numpy().copy()
    for i, u_i in enumerate(inputs):
        _, info = env.reset(options={"state": path[i, 0].numpy()})
        for t in range(len(u_i)):
            drift = plant.error(torch.tensor(info["state"]) - path[i, t])
            u_i[t] = plant.clip(u[i, t] + gains[i, t] @ drift)
            *_, info = env.step(u_i[t : t + 1])
            costs[i] += info["cost"]
            if info["violation"]:
                costs[i] = np.inf
                break
    return costs, inputs


def _planned(plant: _Plant, searches: list[tuple[Tensor, Tensor]]) -> Plan:
    """Return the best plan per start that the trajectories with their inputs lead to."""
    k = len(searches[0][0])
    x, u = (torch.cat(parts) for parts in zip(*searches, strict=True))
    for barrier in BARRIERS if math.isfinite(plant.limit) else (0.0,):
        x, u = _improved(plant, x, u, barrier)
    best = plant.cost(x, u, 0.0).reshape(-1, k).argmin(0) * k + torch.arange(k)
    x = x[best]
    u = u[best]
    _, gains, gradients = _backward(plant, x, u, 0.0)
    residual = (plant.clip(u - gradients) - u).abs().amax(1).numpy()
    return Plan(*_played(plant, x, u, gains), residual)


def _checked(plant: _Plant, starts: ArrayLike, steps: int) -> Tensor:
    """Return the starts as float64 (k, n), or raise a ValueError."""
    values = np.array(starts, dtype=np.float64)
    n = len(plant.Q)
    if values.ndim != 2 or values.shape[1] != n or len(values) == 0:
        raise ValueError(f"starts must have shape (k, {n}) with k > 0, got shape {values.shape}.")
    if steps < 1:
        raise ValueError(f"steps must be at least 1, got {steps}.")
    return torch.from_numpy(values)


def _law(plant: _Plant, mpc: LinearMPC) -> Policy:
    """Return the explicit linear MPC as a policy."""
    law = mpc.explicit()
    return lambda t, x: torch.from_numpy(law(plant.error(x).numpy())[:, 0])


def cstr_plan(starts: ArrayLike, steps: int = 400) -> Plan:
    """Return the best inputs of CSTR-v0; the searches start from the linear MPC and full cooling.

    Parameters
    ----------
    starts : array_like, shape (k, 4)
        Deviations from the steady state: C_A, C_B, C_S in mol/L, T in K.
    steps : int
        Samples of 1/60 h.

    Returns
    -------
    Plan
        Inputs are deviations of the heat transfer coefficient in kJ/(h m2 K).
    """
    begin = _checked(REACTOR, starts, steps)
    policies = [_law(REACTOR, problems.cstr()), lambda t, x: torch.full_like(x[:, 0], math.inf)]
    return _planned(REACTOR, [REACTOR.rollout(begin, policy, steps) for policy in policies])


def cstr_optimum(starts: ArrayLike, steps: int = 400) -> Array:
    """Return the smallest costs (k,) of CSTR-v0; see `cstr_plan`."""
    return cstr_plan(starts, steps).costs


def _lookahead(values: Array, x: Array) -> Array:
    """Return the costs (k, torques) of one torque in states (k, 2), then `pendulum_values`."""
    angles, speeds = values.shape
    pairs = torch.from_numpy(x)[:, None].expand(-1, len(TORQUES), -1)
    theta, speed = _wrapped(_pendulum_step(pairs, torch.from_numpy(TORQUES))).numpy().T
    i = (theta / math.pi + 1) / 2 * (angles - 1)
    j = (speed / pendulum.MAX_SPEED + 1) / 2 * (speeds - 1)
    ahead: Array = map_coordinates(values, [i.T, j.T], order=1, mode="nearest")
    now = _wrapped(torch.from_numpy(x)).numpy() ** 2 @ pendulum.Q.diagonal()
    ahead += now[:, None] + PENDULUM.R * TORQUES**2
    return ahead


def pendulum_values(steps: int, angles: int = 161, speeds: int = 97) -> list[Array]:
    """Return the costs of 0, 1, ... steps on grids (angles, speeds) from end to end of the states.

    Dynamic programming with the torques `TORQUES` and bilinear interpolation.
    """
    theta = np.linspace(-math.pi, math.pi, angles)
    speed = np.linspace(-pendulum.MAX_SPEED, pendulum.MAX_SPEED, speeds)
    grid = np.stack(np.meshgrid(theta, speed, indexing="ij"), -1).reshape(-1, 2)
    values: list[Array] = [np.zeros((angles, speeds))]
    for _ in range(steps):
        values.append(_lookahead(values[-1], grid).min(1).reshape(angles, speeds))
    return values


def clipped_pendulum_plan(starts: ArrayLike, steps: int = 200) -> Plan:
    """Return the best torques of ClippedPendulum-v0 that eight searches find.

    They start from the linear MPC, and from dynamic programming on a grid, whose first torques are
    free or one of `FORCED`.

    Parameters
    ----------
    starts : array_like, shape (k, 2)
        Angle from upright in rad, angular speed in rad/s.
    steps : int
        Samples of 0.05 s.

    Returns
    -------
    Plan
        Inputs are torques in N m.
    """
    begin = _checked(PENDULUM, starts, steps)
    values = pendulum_values(steps)

    def greedy(t: int, x: Tensor) -> Tensor:
        return torch.from_numpy(TORQUES[_lookahead(values[steps - 1 - t], x.numpy()).argmin(1)])

    def forced(torque: float, n: int) -> Policy:
        return lambda t, x: torch.full_like(x[:, 0], torque) if t < n else greedy(t, x)

    policies = [_law(PENDULUM, problems.clipped_pendulum()), greedy]
    policies += [forced(torque, n) for torque, n in FORCED]
    return _planned(PENDULUM, [PENDULUM.rollout(begin, policy, steps) for policy in policies])


def clipped_pendulum_optimum(starts: ArrayLike, steps: int = 200) -> Array:
    """Return the smallest costs (k,) of ClippedPendulum-v0; see `clipped_pendulum_plan`."""
    return clipped_pendulum_plan(starts, steps).costs
