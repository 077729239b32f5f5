"""The YANN policy for PPO."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule

from sb3_yann.policy.actor_critic import YannCritic
from sb3_yann.policy.sb3_hooks import restore_learning_rate, single_precision
from sb3_yann.policy.spread import Explores, TruncatedNormal


class OptimizerGroup:
    """One group of an optimizer's parameters, kept and restored as an optimizer of its own."""

    def __init__(self, optimizer: th.optim.Optimizer, index: int) -> None:
        self.optimizer, self.index = optimizer, index

    @property
    def param_groups(self) -> list[dict[str, Any]]:
        """The group."""
        return [self.optimizer.param_groups[self.index]]

    @property
    def state(self) -> Any:
        """Moments, those of the other groups among them."""
        return self.optimizer.state

    def state_dict(self) -> dict[str, Any]:
        """Return the group and its moments."""
        whole = self.optimizer.state_dict()
        group = whole["param_groups"][self.index]
        state = {key: each for key, each in whole["state"].items() if key in group["params"]}
        return {"state": state, "param_groups": [group]}

    def load_state_dict(self, given: dict[str, Any]) -> None:
        """Restore the group and its moments; the others stay."""
        whole = self.optimizer.state_dict()
        (group,) = given["param_groups"]
        others = {k: each for k, each in whole["state"].items() if k not in group["params"]}
        whole["param_groups"][self.index] = group
        self.optimizer.load_state_dict({**whole, "state": {**others, **given["state"]}})


class YannPPOPolicy(Explores, ActorCriticPolicy):
    """A PPO policy whose most likely action is that of a linear MPC, exactly.

    ``PPO("YannPolicy", env)``. The value network starts as minus the law's cost to go.

    Parameters
    ----------
    initial_std : float, default 0.1
        As that of :class:`YannSACPolicy`, but larger: PPO learns from drawn actions alone what a
        better one is.
    actor_lr_mult : float, default 1
        Multiple of the algorithm's ``learning_rate`` for the actor.
    *args, **kwargs
        As those of :class:`YannSACPolicy`, without ``critic_warmup``; there is one critic, of the
        kind "afterstate".

    Examples
    --------
    >>> model = PPO("YannPolicy", "CSTR-v0", policy_kwargs={"simulator": True}, device="cpu")
    >>> model.policy.predict_values(th.zeros(1, 4)).shape
    torch.Size([1, 1])
    """

    ALGORITHMS = (PPO,)

    def __init__(
        self, *args: Any, initial_std: float = 0.1, actor_lr_mult: float = 1.0, **kwargs: Any
    ) -> None:
        super().__init__(*args, initial_std=initial_std, actor_lr_mult=actor_lr_mult, **kwargs)
        self._squash_output = True  # actions are in [-1, 1], and SB3 gives them units

    def _build(self, lr_schedule: Schedule) -> None:
        if self.critic_options.kind != "afterstate":
            raise ValueError(
                f"critic = {self.critic_options.kind!r}: PPO learns the value of states, which is "
                "that of 'afterstate'."
            )
        networks: Any = self.net_arch
        common = {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            "activation_fn": self.activation_fn,
            "normalize_images": self.normalize_images,
        }
        self.actor_kwargs = {**common, "net_arch": networks["pi"]}
        self.critic_kwargs = {**common, "net_arch": networks["qf"], "n_critics": 1}
        with single_precision():
            self.actor = self.make_actor(self.features_extractor)
            self.critic = self.make_critic(self.features_extractor)
        groups = [
            {"params": [*network.parameters()], "multiple": self.lr_mult[name]}
            for name, network in (("actor", self.actor), ("critic", self.critic))
        ]
        optimizer: Any = self.optimizer_class
        self.optimizer = optimizer(groups, lr=lr_schedule(1), **self.optimizer_kwargs)
        # What keeps and restores an actor finds its optimizer there.
        for i, network in enumerate((self.actor, self.critic)):
            vars(network)["optimizer"] = OptimizerGroup(self.optimizer, i)
        self._register_counters()
        self._attach_hooks()

    @property
    def critic_target(self) -> YannCritic:  # type: ignore[override]
        """The critic: there is no other."""
        return self.critic

    def _attach_hooks(self) -> None:
        self.optimizer.register_step_pre_hook(self._before_step)
        self.optimizer.register_step_post_hook(restore_learning_rate)

    def _before_step(self, optimizer: th.optim.Optimizer, *_: Any) -> None:
        self.critic_updates.add_(not self._refuses("actor", optimizer))
        for group in optimizer.param_groups:
            group["scheduled_lr"] = group["lr"]
            group["lr"] = group["multiple"] * group["lr"]
        optimizer.param_groups[0]["lr"] *= self.actor_step

    def get_distribution(self, obs: Any) -> TruncatedNormal:  # type: ignore[override]
        """Return the distribution of actions in [-1, 1]."""
        actor: Any = self.actor
        distribution: TruncatedNormal = actor.distribution(obs)
        return distribution

    def predict_values(self, obs: Any) -> th.Tensor:
        """Return the values of states, (batch, 1)."""
        return self.critic.state_value(obs)

    def forward(  # type: ignore[override]
        self, obs: th.Tensor, deterministic: bool = False
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Return actions in [-1, 1], values, and the logarithm of the actions' density."""
        if not deterministic:
            self.says_that_it_explores()
        distribution = self.get_distribution(obs)
        actions = distribution.mode() if deterministic else distribution.sample()
        return actions, self.predict_values(obs), distribution.log_prob(actions)

    def evaluate_actions(
        self, obs: Any, actions: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """Return values, the logarithm of the actions' density, and the entropy."""
        self.critic.know_scale(obs, actions)
        distribution, values = self.get_distribution(obs), self.predict_values(obs)
        if values.requires_grad:
            # The error of values in their own unit: one gradient of both networks is clipped, and
            # in units of rewards the critic's would leave nothing of the actor's.
            unit = self.critic.unit
            values.register_hook(lambda each: each / unit**2)  # type: ignore[no-untyped-call]
        return values, distribution.log_prob(actions), distribution.entropy()

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        distribution = self.get_distribution(observation)
        return distribution.mode() if deterministic else distribution.sample()


PPO.policy_aliases["YannPolicy"] = YannPPOPolicy
