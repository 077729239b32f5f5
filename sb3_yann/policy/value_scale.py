"""The unit of a critic's networks, which follows the plant's costs: no setting carries it."""

from __future__ import annotations

import torch as th

from sb3_yann.policy.actor_critic import YannActor, YannCritic

EPS = 1e-8
"""Of Adam, for gradients in units of the values' scale."""
FOLLOWS, RECENT = 10, 0.1
"""Updates after which the values' scale is looked at; share of that batch in the mean cost."""


def follow_scale(
    actor: YannActor,
    critic: YannCritic,
    target: YannCritic,
    mean: th.Tensor,
    taken: int,
    eps: float,
) -> None:
    """Let the factor of the critic's networks follow the mean stage cost, by factors of two.

    What they put out stays, to the bit: Pop-Art (van Hasselt et al., *Learning values across
    many orders of magnitude*, 2016).

    Parameters
    ----------
    actor, critic, target
        The target is the critic's.
    mean : Tensor, shape ()
        The mean stage cost until now, which takes in that of the critic's batch.
    taken : int
        Updates of the critic so far: it is looked at after every tenth.
    eps : float
        Of both optimizers, in units of their gradients.
    """
    if taken % FOLLOWS:
        return
    cost, share = critic.stage_cost_of_batch(), max(FOLLOWS / (taken + FOLLOWS), RECENT)
    mean.add_(share * (cost - mean))
    if taken == 0:  # the critic has taken its first batch's for the unit, the target had none
        target.load_state_dict(critic.state_dict())
    scale = critic.rescale(float(mean), critic.optimizer)
    target.rescale(float(mean))
    for optimizer, power in ((actor.optimizer, 1), (critic.optimizer, 2)):
        for group in optimizer.param_groups:
            group["eps"] = eps * (critic.scale * scale) ** power
