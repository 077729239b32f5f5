"""Policies for algorithms that explore by drawing actions around the law: SAC and PPO."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

from sb3_yann._validation import check_bool, check_range, warn
from sb3_yann.control import LinearMPC
from sb3_yann.policy.actor_critic import YannActor, YannCritic
from sb3_yann.policy.policies import NOT_OURS, OF_THE_LAYER, StartsAsMPC
from sb3_yann.policy.sb3_hooks import restore_learning_rate, single_precision

MIN_LOG_STD = math.log(1e-4)
MAX_LOG_STD = math.log(2.0)
"""Bounds of the logarithm of a standard deviation, of actions in [-1, 1]."""
HALF_LOG_TAU = 0.5 * math.log(2 * math.pi)


class TruncatedNormal:
    """Independent normal distributions, truncated to actions in [-1, 1].

    The most likely action is the center itself, at the bounds too, and the density is finite
    everywhere in between; a tanh would have neither. Formulas: Burkardt, *The Truncated Normal
    Distribution*, 2014, and the inverse of the cumulative distribution to draw with a gradient.
    ``center`` is (batch, m); ``log_std`` (m,) is of the normal distributions before the cut.
    """

    def __init__(self, center: th.Tensor, log_std: th.Tensor) -> None:
        self.center = center
        # Float64: the tails of float32 end at five standard deviations.
        self.m = center.double()
        self.std = log_std.double().clamp(MIN_LOG_STD, MAX_LOG_STD).exp()
        self.low = (-1 - self.m) / self.std
        self.high = (1 - self.m) / self.std
        self.below = th.special.ndtr(self.low)
        self.mass = th.special.ndtr(self.high) - self.below

    def mode(self) -> th.Tensor:
        """Return the center, (batch, m)."""
        return self.center

    def sample(self) -> th.Tensor:
        """Return actions (batch, m), with a gradient by center and spread."""
        edge = 1e-12  # at quantiles 0 and 1 the normal distribution's inverse is not finite
        quantile = self.below + th.rand_like(self.m) * self.mass
        away = th.special.ndtri(quantile.clamp(edge, 1 - edge))
        actions: th.Tensor = (self.m + self.std * away).clamp(-1, 1).to(self.center.dtype)
        return actions

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """Return the logarithm of the density, (batch,), of actions (batch, m)."""
        away = (actions.double() - self.m) / self.std
        each = -0.5 * away**2 - HALF_LOG_TAU - self.std.log() - self.mass.log()
        total: th.Tensor = each.sum(1).to(self.center.dtype)
        return total

    def entropy(self) -> th.Tensor:
        """Return the differential entropy, (batch,)."""
        density = [(-0.5 * each**2 - HALF_LOG_TAU).exp() for each in (self.low, self.high)]
        edges = (self.low * density[0] - self.high * density[1]) / (2 * self.mass)
        each = HALF_LOG_TAU + 0.5 + self.std.log() + self.mass.log() + edges
        total: th.Tensor = each.sum(1).to(self.center.dtype)
        return total


class SpreadActor(YannActor):
    """The YANN actor, whose actions are drawn around what the law and its networks say."""

    def __init__(self, problem: LinearMPC, *, initial_std: float, **kwargs: Any) -> None:
        super().__init__(problem, **kwargs)
        self.options["initial_std"] = initial_std
        m = problem.model.n_inputs
        self.log_std = nn.Parameter(th.full((m,), math.log(2 * initial_std), dtype=th.float32))

    def parameters(self, recurse: bool = True) -> Iterator[nn.Parameter]:
        """Yield the weights, and the spread."""
        yield from super().parameters(recurse)
        if recurse:
            yield self.log_std

    def distribution(self, obs: th.Tensor) -> TruncatedNormal:
        """Return that of the actions for observations (batch, n_obs)."""
        return TruncatedNormal(super().forward(obs), self.log_std)

    def forward(self, obs: th.Tensor, deterministic: bool = True) -> th.Tensor:
        """Return the actions in [-1, 1], (batch, m), drawn unless ``deterministic``."""
        return super().forward(obs) if deterministic else self.distribution(obs).sample()

    def action_log_prob(self, obs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return drawn actions (batch, m) and the logarithm of their density, (batch,)."""
        distribution = self.distribution(obs)
        actions = distribution.sample()
        return actions, distribution.log_prob(actions)


class Explores(StartsAsMPC):
    """What policies share whose algorithms explore by drawing actions."""

    OWN = "initial_std", "simulator"
    ACTOR = SpreadActor
    OF_ACTOR = (*OF_THE_LAYER, "initial_std")

    def __init__(
        self,
        *args: Any,
        initial_std: float = 0.02,
        simulator: bool = False,
        use_sde: bool = False,
        **kwargs: Any,
    ) -> None:
        if use_sde:
            raise ValueError(
                "use_sde = True: the spread is one number for each input, initial_std at first."
            )
        self.initial_std = check_range("initial_std", initial_std, 0, 0.5, "(]")
        self.simulator = check_bool("simulator", simulator)
        self.explored = False
        super().__init__(*args, **kwargs)

    @property
    def actor_target(self) -> SpreadActor:  # type: ignore[override]
        """The actor: there is no other."""
        return self.actor  # type: ignore[return-value]

    def says_that_it_explores(self) -> None:
        """Warn once where nothing says that the plant is a simulator, and no guard is at work."""
        algorithm = self._algorithm
        said = self.explored or self.simulator or self.guarded
        if said or algorithm is None or algorithm.policy is not self:
            return
        self.explored = True
        warn(
            f"{type(algorithm).__name__} explores: it draws its actions, "
            f"{100 * self.initial_std:.3g} % of the input range around the policy's at first, "
            "limits or not, and nothing confirms what it learns. That belongs into a simulator, "
            "with an ImprovementGuard among the callbacks. If this env is one: "
            "policy_kwargs={'simulator': True}."
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        given = super()._get_constructor_parameters().items()
        own = {"initial_std": self.initial_std, "simulator": self.simulator}
        return {name: each for name, each in given if name not in NOT_OURS} | own


class MaximumEntropy(Explores):
    """What SAC and TQC need besides: an entropy that their defaults keep as small as it begins.

    The coefficient starts where the linear model's price of the spread balances its entropy, and
    the target is the entropy at the start; a number that the user gives stays. The first actions
    are drawn as all others are, where SB3 draws ``learning_starts`` of them from the whole range.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        algorithm = self._algorithm
        if algorithm is None:
            return
        algorithm.learning_starts = 0
        if algorithm.ent_coef == "auto":
            algorithm.ent_coef = f"auto_{self.balanced_entropy_coefficient():.6e}"
        if algorithm.target_entropy == "auto":
            center = th.zeros(1, self.problem.model.n_inputs, dtype=th.float64)
            drawn = TruncatedNormal(center, th.full_like(center[0], math.log(2 * self.initial_std)))
            algorithm.target_entropy = float(drawn.entropy())

    def balanced_entropy_coefficient(self) -> float:
        """Return the coefficient for which the initial spread is best on the linear model.

        There it costs ``u' M u`` by the critic's quadratic form, and entropy grows by its
        logarithm: Haarnoja et al., *Soft Actor-Critic Algorithms and Applications*, 2018.
        """
        m = self.problem.model.n_inputs
        curvature = np.diag(self.problem.state_action_terms(self.gamma).P)[-m:]
        each = curvature * (2 * self.initial_std * self.problem.u_half) ** 2
        return float(2 * self.critic_options.reward_scale * max(each.mean(), 1e-12))

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        if not deterministic:
            self.says_that_it_explores()
        actions: th.Tensor = self.actor(observation, deterministic)
        return actions


class YannSACPolicy(MaximumEntropy, SACPolicy):  # type: ignore[misc]
    """A SAC policy whose most likely action is that of a linear MPC, exactly.

    ``SAC("YannPolicy", env)``. The critic starts as the law's value without the entropy term, which
    shifts it by a number that is the same for all actions. ``learning_starts`` becomes 0:
    ``critic_warmup`` says how long the actor waits.

    Parameters
    ----------
    initial_std : float, default 0.02
        Standard deviation of the drawn actions, as a share of the input range; it is learnt.
    simulator : bool, default False
        Whether the env is one: then nothing is said of learning without an ImprovementGuard.
    *args, **kwargs
        As those of :class:`YannPolicy`.

    Examples
    --------
    >>> model = SAC("YannPolicy", "CSTR-v0", policy_kwargs={"simulator": True}, device="cpu")
    >>> theta = np.zeros(4, dtype=np.float32)
    >>> law = model.policy.problem.explicit()
    >>> bool(np.allclose(model.predict(theta, deterministic=True)[0], law(theta)))
    True
    """

    ALGORITHMS = (SAC,)


SAC.policy_aliases["YannPolicy"] = YannSACPolicy


class OptimizerGroup:
    """One group of an optimizer's parameters, kept and restored as an optimizer of its own."""

    def __init__(self, optimizer: th.optim.Optimizer, index: int) -> None:
        self.optimizer = optimizer
        self.index = index

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
    THEIRS = ()

    def __init__(
        self, *args: Any, initial_std: float = 0.1, actor_lr_mult: float = 1.0, **kwargs: Any
    ) -> None:
        if given := kwargs.get("critic_warmup"):
            warn(
                f"critic_warmup = {given} does nothing here: PPO moves actor and critic at once. "
                "Leave it out; actor_lr_mult makes the actor slower."
            )
        kwargs |= {"critic_warmup": 0, "initial_std": initial_std, "actor_lr_mult": actor_lr_mult}
        super().__init__(*args, **kwargs)
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
        return self.actor_target.distribution(obs)

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
        critic: Any = self.critic
        theta = critic.extract_features(obs, critic.features_extractor)
        critic.know_scale(th.cat([theta, actions], 1))
        distribution = self.get_distribution(obs)
        values = self.predict_values(obs)
        if values.requires_grad:
            # The error of values in their own unit: one gradient of both networks is clipped, and
            # in units of rewards the critic's would leave nothing of the actor's.
            unit = critic.scale * critic.q_networks[0].scale
            values.register_hook(lambda each: each / unit**2)  # type: ignore[no-untyped-call]
        return values, distribution.log_prob(actions), distribution.entropy()

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        actions: th.Tensor = self.actor(observation, deterministic)
        return actions


PPO.policy_aliases["YannPolicy"] = YannPPOPolicy
