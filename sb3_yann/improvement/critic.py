"""The critic of a policy that was improved in a twin, so that learning goes on from there."""

from __future__ import annotations

import copy

import numpy as np
import torch as th

from sb3_yann._validation import Array
from sb3_yann.improvement.imitation import policy_of
from sb3_yann.improvement.model import Model
from sb3_yann.networks.yann import LawLayer
from sb3_yann.policy.policies import StartsAsMPC

SAMPLES, STEPS, BATCH, UPDATES, RATE = 1000, 100, 256, 200, 1e-3
SPREAD = 0.1
"""Standard deviation of the first input, in half-widths: the critic must know its slope."""


def refit_critic(policy: StartsAsMPC, twin: Model, seed: int) -> None:
    """Fit the critics to the returns of the policy in the twin, from inputs near its own."""
    problem, rng = policy.problem, np.random.default_rng([seed, 2])
    layer, half = copy.deepcopy(policy.actor.mu).cpu(), problem.u_half
    members = len(twin.dynamics.members)
    starts = twin.starts.draw_logged(SAMPLES // members * members, rng)
    seen = twin.dynamics.row.shown(starts)
    first = policy_of(layer, problem)(seen)
    first = first + SPREAD * half * rng.standard_normal(first.shape)
    first = np.clip(first, problem.deviations.u_min, problem.deviations.u_max)
    costs = _costs(policy, twin, layer, starts, first)
    options = policy.critic_options
    returns = options.offset_of_return(policy.gamma) - options.reward_scale * costs
    known = np.isfinite(returns)
    if np.count_nonzero(known) < BATCH:  # too few to say anything
        return
    scaled = (first - problem.deviations.u_min) / half - 1
    _fit(policy, seen[known], scaled[known], returns[known], rng)
    policy.critic_target.load_state_dict(policy.critic.state_dict())


def _costs(policy: StartsAsMPC, twin: Model, layer: LawLayer, at: Array, u: Array) -> Array:
    """Return the discounted costs (rows,) of inputs u, then of the policy; NaN if it leaves."""
    problem, gamma, dynamics = policy.problem, policy.gamma, twin.dynamics
    shape = len(dynamics.members), -1
    starts, u = at.reshape(*shape, at.shape[-1]), u.reshape(*shape, problem.model.n_inputs)
    shown = dynamics.row.shown
    with np.errstate(all="ignore"):
        first = dynamics.step(starts, u)
        rows, inputs = dynamics.roll_out(policy_of(layer, problem), first, STEPS)
        thetas = shown(rows)
        stage = problem.deviations.stage_cost(thetas[:-1], inputs)
        end = problem.value_terms(gamma).at(thetas[-1])
        later = np.tensordot(gamma ** np.arange(STEPS), stage, axes=1) + gamma**STEPS * end
        # What leaves the log is not known, and may be many times as dear as all the rest.
        later = np.where(twin.limits.violated(rows).any(axis=0), np.nan, later)
        return np.asarray(problem.deviations.stage_cost(shown(starts), u) + gamma * later).ravel()


def _fit(
    policy: StartsAsMPC, theta: Array, actions: Array, returns: Array, rng: np.random.Generator
) -> None:
    """Take steps of Adam on the critics' squared errors, in units of the returns' spread."""
    critic, device = policy.critic, policy.device
    points = th.cat([th.as_tensor(theta), th.as_tensor(actions)], dim=1).to(device)
    wanted = th.as_tensor(returns, dtype=th.float32)[:, None].to(device)
    unit = float(np.std(returns)) or 1.0
    if critic.scales_itself and policy.critic_updates == 0:
        critic.batch = points
        critic.scale_values(critic.stage_cost_of_batch())
    optimizer = th.optim.Adam(critic.parameters(), lr=RATE)
    for k in range(UPDATES):
        for group in optimizer.param_groups:
            group["lr"] = RATE * (1 - k / UPDATES)
        rows = th.as_tensor(rng.integers(len(returns), size=BATCH), device=device)
        optimizer.zero_grad()
        loss = sum(
            th.mean(((each - wanted[rows]) / unit) ** 2)  # each quantile where it has several
            for each in critic.values(points[rows])
        )
        loss.backward()  # type: ignore[union-attr]
        optimizer.step()
    optimizer.zero_grad()
