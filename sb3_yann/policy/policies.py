"""The YANN policy for Stable-Baselines3's TD3 and DDPG, and what it shares with other policies."""

from __future__ import annotations

import inspect
import sys
import weakref
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import ArrayLike
from stable_baselines3 import TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_yann._validation import (
    Array,
    check_array,
    check_bool,
    check_choice,
    check_discount,
    check_int,
    check_range,
    check_type,
    warn,
)
from sb3_yann.control import LinearMPC, wrapper_stack
from sb3_yann.control.online import LAWS
from sb3_yann.networks import RowAdam, SharedYannLayer
from sb3_yann.networks.zero_output import FEW
from sb3_yann.policy import checks, sb3_hooks
from sb3_yann.policy.actor_critic import (
    CriticOptions,
    YannActor,
    YannCritic,
    as_critic_options,
    layer_for,
)
from sb3_yann.policy.checks import require_own_problem, resolve_problem
from sb3_yann.policy.observations import (
    AffineFeatures,
    AffineObservation,
    to_deviations,
    with_extra_shown,
)
from sb3_yann.policy.sb3_hooks import (
    KeepsPrecision,
    finite_gradient,
    single_precision,
    warn_of_refused_step,
    watch_buffer,
)

NOT_OURS = "use_sde log_std_init use_expln clip_mean full_std squash_output ortho_init".split()
"""Of the arguments of SB3's policies that draw actions: of how they do."""
OF_THE_LAYER = (
    "max_correction", "pin_equilibrium", "law", "networks", "keep_bounds", "bounds_margin",
)  # fmt: skip
"""Keywords of an actor, and of its policy, that are of its layer around the law."""
if TYPE_CHECKING:
    _AnyPolicy = TD3Policy
else:
    _AnyPolicy = object  # the SB3 policy of each class comes after it


class StartsAsMPC(KeepsPrecision, _AnyPolicy):
    """What every policy that starts as a linear MPC is besides its SB3 policy: see `YannPolicy`."""

    ALGORITHMS: ClassVar[tuple[type[BaseAlgorithm], ...]] = ()  # which train it
    OWN: ClassVar[tuple[str, ...]] = ()  # keywords beside those of `YannPolicy`
    THEIRS: ClassVar[tuple[str, ...]] = ("n_critics",)  # not all SB3 policies have
    ACTOR: ClassVar[type[YannActor]] = YannActor
    OF_ACTOR: ClassVar[tuple[str, ...]] = OF_THE_LAYER  # keywords of the policy that it takes too
    CRITIC: ClassVar[type[YannCritic]] = YannCritic
    guarded = False  # while an `ImprovementGuard` is at work
    states_checked = False  # once what an env shows was compared with the model
    actor: YannActor
    actor_target: YannActor
    critic: YannCritic
    critic_target: YannCritic
    critic_updates: th.Tensor
    mean_stage_cost: th.Tensor

    def __init__(  # noqa: PLR0913 (a user's policy_kwargs)
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        problem: LinearMPC | str | None = None,
        gamma: float | None = None,
        net_arch: dict[str, list[int]] | list[int] | None = None,
        activation_fn: type[nn.Module] = nn.Tanh,
        actor_lr_mult: float = 0.1,
        critic_lr_mult: float = 1.0,
        critic: str | CriticOptions | Mapping[str, Any] = "afterstate",
        critic_warmup: int = 2000,
        max_correction: float | None = None,
        pin_equilibrium: bool | None = None,
        observation: AffineObservation | None = None,
        law: str = "auto",
        networks: str | None = None,
        keep_bounds: bool | None = None,
        bounds_margin: float = 0.0,
        extra: int = 0,
        **sb3_kwargs: Any,
    ) -> None:
        algorithm = sb3_hooks.algorithm_under_construction(lr_schedule)
        checks.require_algorithm(algorithm, self.ALGORITHMS)
        names = [*inspect.signature(StartsAsMPC).parameters]
        own = [*names[names.index("problem") : -1], *self.OWN]
        checks.require_sb3_kwargs(sb3_kwargs, own, self.THEIRS)
        checks.require_box("observation_space", observation_space, observation is not None)
        checks.require_box("action_space", action_space)
        self.problem = resolve_problem(problem, observation_space)
        self.saved_kwargs: dict[str, Any] = {}  # those that an algorithm saves
        if algorithm is not None:  # no longer the user's own dict
            self.saved_kwargs = algorithm.policy_kwargs = dict(algorithm.policy_kwargs)
        if observation is not None:
            wanted = "an AffineObservation, or None: an env shows plant units"
            check_type("observation", observation, AffineObservation, wanted)
        if check_int("extra", extra, 0):
            self.problem, observation = with_extra_shown(
                self.problem, observation_space, observation, extra
            )
            self.saved_kwargs["extra"] = 0
        if isinstance(problem, str) or extra:
            # Saved by value with the model: a load then neither looks it up nor solves it again.
            self.saved_kwargs["problem"] = self.problem
        self.action_units = checks.as_action_units(self.problem, action_space)
        self.observation = observation
        # Whether the user said what the env shows.
        self.observation_given = self.observation is not None
        self._meets(algorithm, observation_space)
        self.to_theta = to_deviations(self.observation, self.problem)
        if self.observation is not None:
            self.saved_kwargs["observation"] = self.observation
        self.first_obs_checked = False  # at the first observation
        self.gamma = check_discount(checks.as_gamma(gamma, algorithm))
        self.gamma_given = gamma is not None
        if algorithm is not None:
            checks.warn_of_another_gamma(algorithm, self.gamma)
        self.lr_mult = {
            "actor": check_range("actor_lr_mult", actor_lr_mult, 0, np.inf, "[)"),
            "critic": check_range("critic_lr_mult", critic_lr_mult, 0, np.inf, "[)"),
        }
        self.critic_options = as_critic_options(critic)
        self.critic_warmup = check_int("critic_warmup", critic_warmup, 0, "It counts updates.")
        self.max_correction = _as_correction(max_correction)
        if pin_equilibrium is None:
            layout = self.problem.layout
            priced = self.problem.price.counts  # it does not rest at the operating point
            pin_equilibrium = not (layout.has_constants or layout.bounds or priced)
        self.pin_equilibrium = check_bool("pin_equilibrium", pin_equilibrium)
        self.law = check_choice("law", law, LAWS)
        self.networks = networks
        shared = layer_for(self.problem.law(law), networks) is SharedYannLayer
        if keep_bounds is None:
            keep_bounds = self.problem.has_hard_bounds and self.problem.infeasible != "zero_input"
        self.keep_bounds = check_bool("keep_bounds", keep_bounds)
        self.bounds_margin = _as_margin(bounds_margin)
        self.actor_step = 1.0  # another factor of the learning rate, which an ImprovementGuard sets
        self.refused = {"actor": 0, "critic": 0}  # steps whose gradient was not finite
        self.batch_is_finite = True
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=checks.as_net_arch(net_arch, shared),
            activation_fn=checks.as_activation(activation_fn),
            **checks.with_fused_adam(sb3_kwargs),
        )
        self._builder: Any = algorithm and weakref.ref(algorithm)
        env = algorithm and algorithm.get_env()
        self._met: Any = env and weakref.ref(env)
        if algorithm is not None:
            watch_buffer(algorithm)

    @property
    def _algorithm(self) -> Any:
        """The algorithm that has built the policy; None for one that stands alone, and a copy."""
        return self._builder and self._builder()

    def _meets(self, algorithm: BaseAlgorithm | None, space: spaces.Space[Any]) -> None:
        """Raise unless the observations of an algorithm's env are what the policy takes."""
        env = None if algorithm is None else algorithm.get_env()
        if env is not None:  # first: wrappers say why a size is another one
            wrapper_stack.require_state_shown(env, self.observation_given)
            wrapper_stack.warn_of_moving_rewards(env)
        checks.require_theta(self.problem, space, self.observation)
        checks.require_inverse_normalization(self.problem, algorithm, self.observation)
        if env is not None and not self.observation_given:
            wrapper_stack.require_theta_order(env, self.problem)

    def _meets_another_env(self) -> None:
        """Do the same where `set_env` has given another env since; refuse another discount."""
        algorithm = self._algorithm
        if algorithm is None or algorithm.policy is not self:
            return
        if not self.gamma_given:
            checks.require_gamma(algorithm, self.gamma)
        env = algorithm.get_env()
        if env is not None and (self._met is None or self._met() is not env):
            self._meets(algorithm, self.observation_space)
            self._met = weakref.ref(env)

    def _build(self, lr_schedule: Schedule) -> None:
        with single_precision():
            super()._build(lr_schedule)
        chosen = {name: each for name, each in self.optimizer_kwargs.items() if name != "fused"}
        adam = self.optimizer_class is th.optim.Adam and chosen.keys() <= {"betas", "eps"}
        if adam and type(self.actor) is YannActor and (mu := self.actor.mu).n_networks > FEW:
            # A step, and its gradients, of the regions in use alone.
            self.actor.optimizer = RowAdam(self.actor.parameters(), lr=lr_schedule(1), **chosen)
            mu.row_gradients = True
        self._register_counters()

    def _register_counters(self) -> None:
        # A buffer travels with the parameters: a model that is loaded goes on where it was.
        self.register_buffer("critic_updates", th.zeros((), dtype=th.int64))
        self.register_buffer("mean_stage_cost", th.zeros((), dtype=th.float64))
        self._attach_hooks()

    def _attach_hooks(self) -> None:
        self.actor.optimizer.register_step_pre_hook(self._before_actor_step)
        self.critic.optimizer.register_step_pre_hook(self._before_critic_step)
        for network in (self.actor, self.critic):
            network.optimizer.register_step_post_hook(sb3_hooks.restore_learning_rate)

    def _refuses(self, name: str, optimizer: th.optim.Optimizer) -> bool:
        """Return whether a step must not be taken, and take its gradient away then."""
        if finite_gradient(optimizer):
            return False
        self.refused[name] += 1
        warn_of_refused_step(name, optimizer, self.refused[name], self._algorithm)
        optimizer.zero_grad()
        return True

    def _before_actor_step(self, optimizer: th.optim.Optimizer, *_: Any) -> None:
        # What the critic refuses to learn from says nothing to the actor either.
        if self.critic_updates < self.critic_warmup or not self.batch_is_finite:
            optimizer.zero_grad()  # no gradient at all: neither parameters nor moments move
        else:
            self._refuses("actor", optimizer)
        sb3_hooks.multiply_learning_rate(optimizer, self.lr_mult["actor"] * self.actor_step)

    def _before_critic_step(self, optimizer: th.optim.Optimizer, *_: Any) -> None:
        self.batch_is_finite = not self._refuses("critic", optimizer)
        if self.batch_is_finite:
            if self.critic_options.scales_itself and self.lr_mult["critic"] > 0:
                self._follow_scale(int(self.critic_updates))
            self.critic_updates.add_(1)
        sb3_hooks.multiply_learning_rate(optimizer, self.lr_mult["critic"])

    def _follow_scale(self, taken: int) -> None:
        """Let the factor of the critic's networks follow the mean stage cost, by factors of two.

        What they put out stays, to the bit: Pop-Art (van Hasselt et al., *Learning values across
        many orders of magnitude*, 2016). The mean takes in that of the batch after every tenth of
        ``taken`` updates.
        """
        scale_check = 10  # updates after which the values' scale is checked
        if taken % scale_check:
            return
        mean = self.mean_stage_cost
        # The batch's share in the mean cost.
        share = max(scale_check / (taken + scale_check), 0.1)
        mean.add_(share * (self.critic.stage_cost_of_batch() - mean))
        if taken == 0:  # the critic has taken its first batch's for the unit, the target had none
            self.critic_target.load_state_dict(self.critic.state_dict())
        scale = self.critic.scale * self.critic.rescale(float(mean), self.critic.optimizer)
        self.critic_target.rescale(float(mean))
        # Adam's default is for gradients in units of the values' scale.
        eps = self.optimizer_kwargs.get("eps", 1e-8)
        for network, power in ((self.actor, 1), (self.critic, 2)):
            for group in network.optimizer.param_groups:
                group["eps"] = eps * scale**power

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """Load parameters of a policy with the same problem; ValueError for others, before any."""
        require_own_problem(self, state_dict, strict)
        return super().load_state_dict(state_dict, strict, assign)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy or a pickle holds: it is no longer the policy of the algorithm."""
        return {**self.__dict__, "_builder": None, "_met": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy or a pickle; torch drops the hooks of optimizers on the way."""
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self._attach_hooks()

    def theta(self, observations: ArrayLike) -> th.Tensor:
        """Return what the law takes, theta in deviations (batch, n_theta), for observations."""
        obs = th.as_tensor(np.asarray(observations), device=self.device)
        with th.no_grad():
            return self.actor.extract_features(obs, self.actor.features_extractor)

    def inputs(self, actions: ArrayLike) -> Array:
        """Return the inputs in deviations, (batch, m), of actions as the env takes them."""
        return self.action_units.input(actions)

    def predict(
        self, observation: Any, *args: Any, **kwargs: Any
    ) -> tuple[Any, tuple[Any, ...] | None]:
        """Return SB3's prediction; name a deviation that is shown in place of plant units."""
        self._meets_another_env()
        predicted = super().predict(observation, *args, **kwargs)
        if not self.first_obs_checked:
            self.first_obs_checked = True
            rows = np.reshape(observation, (-1, *cast(Any, self.observation_space.shape)))
            theta = self.theta(rows).double().cpu().numpy()
            if words := self.problem.shown_as_deviation(self.problem.units.to_plant(theta)):
                warn(words)
        return predicted

    def set_training_mode(self, mode: bool) -> None:
        """Do what SB3 asks for as a rollout begins; name random actions and misread states."""
        if not mode and sys._getframe(1).f_code.co_name == "collect_rollouts":
            sb3_hooks.warn_of_random_actions(self._algorithm)
            sb3_hooks.warn_of_first_steps(self, self._algorithm)
        super().set_training_mode(mode)

    def unscale_action(self, scaled_action: Array) -> Array:
        """Return actions in [-1, 1] as the env takes them: in its action space, to the last bit."""
        space = cast(Any, self.action_space)
        # SB3's formula rounds: where bounds are asymmetric it may end one bit beyond them.
        action = super().unscale_action(scaled_action)
        # A space of float16 holds no action of float32.
        return np.clip(action, space.low, space.high).astype(space.dtype, copy=False)

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """Return the map from an observation to theta."""
        if self.to_theta is None:
            return super().make_features_extractor()
        return AffineFeatures(self.observation_space, self.to_theta)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> YannActor:
        """Return an actor that equals the law, with networks that are zero."""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        kwargs = {name: each for name, each in kwargs.items() if name not in NOT_OURS}
        kwargs |= {name: getattr(self, name) for name in self.OF_ACTOR}
        with single_precision():
            return self.ACTOR(self.problem, **kwargs).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> YannCritic:
        """Return a critic that is the law's value on the linear model, with networks of zero."""
        kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        options = self.critic_options
        pinned = self.pin_equilibrium
        with single_precision():
            critic = self.CRITIC(self.problem, self.gamma, options, pinned, **kwargs)
        return critic.to(self.device)

    def limit_correction(self, max_correction: float | None) -> None:
        """Bound what networks may add, as a fraction of the input range; a saved model keeps it."""
        self.max_correction = _as_correction(max_correction)
        self.saved_kwargs["max_correction"] = self.max_correction
        for actor in (self.actor, self.actor_target):
            actor.options["max_correction"] = self.max_correction
            actor.mu.limit(self.max_correction)

    def confine_correction(self, low: ArrayLike | None, high: ArrayLike | None) -> None:
        """Let the actor's networks count in a box of theta only; None is everywhere.

        They count in full within. Beyond they fade, and from a quarter of a half-width on the law
        acts alone. :func:`improve` sets it to what its episodes show. It is saved with the weights.
        ``low`` and ``high`` (n_theta,) are the edges, ValueError for others and low above high.
        """
        box: list[Any] = [None, None]
        if low is not None or high is not None:
            given: dict[str, Any] = {"low": low, "high": high}
            box = [check_array(name, each, (self.problem.n_theta,)) for name, each in given.items()]
            if np.any(np.greater(*box)):
                raise ValueError(f"low = {low!r} must not be above high = {high!r}.")
        for actor in (self.actor, self.actor_target):
            actor.mu.confine(*box)

    def set_bounds_margin(self, margin: float) -> None:
        """Let the actor keep further from the bounds: ``bounds_margin``. It is saved with weights.

        ValueError for a policy that does not keep them.
        """
        if not self.keep_bounds:
            raise ValueError("The policy has keep_bounds=False: there is no margin to set.")
        self.bounds_margin = self.saved_kwargs["bounds_margin"] = _as_margin(margin)
        for actor in (self.actor, self.actor_target):
            actor.options["bounds_margin"] = self.bounds_margin
            actor.mu.keep(self.bounds_margin)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        same = ("problem", "gamma", "critic_warmup", "observation", *OF_THE_LAYER)
        return {
            **super()._get_constructor_parameters(),
            **{name: getattr(self, name) for name in same},
            **{f"{name}_lr_mult": multiple for name, multiple in self.lr_mult.items()},
            "critic": self.critic_options,
        }


def _as_correction(value: float | None) -> float | None:
    hint = "It is a fraction of the input range, or None."
    return None if value is None else check_range("max_correction", value, 0, 1, hint=hint)


def _as_margin(value: float) -> float:
    hint = "It is in half-widths of the box of theta."
    return check_range("bounds_margin", value, 0, np.inf, "[)", hint)


def require_yann_policy(policy: BasePolicy, who: str) -> StartsAsMPC:
    """Return the policy of a model, else raise TypeError in the name of a callback."""
    if not isinstance(policy, StartsAsMPC):
        name = type(policy).__name__
        raise TypeError(
            f"{who} needs a YannPolicy; the policy of this model is {name}. Build it as "
            'DDPG("YannPolicy", env).'
        )
    return policy


def require_problem_of_twin(policy: StartsAsMPC, problem: LinearMPC) -> None:
    """Raise ValueError unless a twin's problem is the policy's."""
    if policy.problem != problem:
        raise ValueError(
            f"The twin is one of {problem!r}, the model's problem is {policy.problem!r}. Fit "
            "the twin with model.policy.problem."
        )


class YannPolicy(StartsAsMPC, TD3Policy):
    """A TD3 or DDPG policy that starts as a linear MPC, exactly, with the critic that goes with it.

    The actor is the law of the MPC plus networks that are zero at first. The critic is
    the state-action value of the law on the linear model, plus such a network. Transitions and
    gradients that are not finite are left out, with a :class:`NonFiniteWarning`; where an
    observation or the actor's networks are not finite, the law acts.

    Pass ``target_policy_noise=0.0`` to TD3, else the critic learns the value of a noisy controller.

    Parameters
    ----------
    observation_space : gymnasium.spaces.Box
        The parameter theta of the law, shape (n_theta,), or what ``observation`` makes theta of.
    action_space : gymnasium.spaces.Box, shape (m,)
        Its bounds are ``u_min`` and ``u_max`` of the problem, or [-1, 1].
    lr_schedule : callable
        SB3's learning rate schedule.
    problem : LinearMPC or str, optional
        The MPC, the name of a registered one, or ``"module:attribute"``. The default is the
        ``problem`` of the observation space, as our environments have it.
    gamma : float, optional
        Discount of the critic. The default is that of the algorithm that builds the policy.
    net_arch : dict or list, optional
        Widths of one or two hidden layers, for each network of the actor and for each critic:
        ``{"pi": [16, 16], "qf": [64, 64]}`` by default, with [64, 64] for a shared network.
    activation_fn : type, default torch.nn.Tanh
        An activation that is 0 at 0.
    actor_lr_mult, critic_lr_mult : float, default 0.1 and 1
        Multiples of the algorithm's ``learning_rate`` for actor and critic; 0 freezes.
    critic : str, CriticOptions or mapping, default "afterstate"
        The kind of critic, or all of its options.
    critic_warmup : int, default 2000
        Updates of the critic before the first one of the actor, which is the MPC until then.
    max_correction : float, optional
        Bound on the distance from the MPC, as a fraction of the input range, 0 to 1: exact,
        whatever is learnt. The default is none.
    pin_equilibrium : bool, optional
        Whether actor and critic keep their value at ``theta = 0`` for good: not where the model's
        steady-state input is wrong. False for problems with references, disturbances, prices or
        bounds that change at run time, else True.
    observation : AffineObservation, optional
        The map from what the env shows to theta. By default the env shows theta, in plant units
        where the problem's model has an operating point.
    law : {"auto", "explicit", "online"}, default "auto"
        The explicit law, or the one whose program is solved at each point: see
        :meth:`LinearMPC.law`.
    networks : {"per_region", "shared"}, optional
        A network for each region of an explicit law, as in the paper, or one for all theta, which
        keeps the policy as continuous as the law. The default is the first where there are regions.
    keep_bounds : bool, optional
        Whether what the networks add stops where the model's next state would leave the MPC's hard
        bounds, or the set from which inputs can keep them (:attr:`LinearMPC.kept_set`). Where the
        law alone is beyond one, the policy goes no further. The default is True where there are
        hard bounds of states or outputs, or bounds in theta, but for ``infeasible="zero_input"``:
        there the paper's law gives up beyond them, and the networks are to come back.
    extra : int, default 0
        The last so many entries of the observation are seen by the networks of actor and critic
        alone, in half-widths of their bounds in the observation space, which are finite. The policy
        is then one of :func:`with_extra` of the problem.
    bounds_margin : float, default 0
        What the plant's next state may differ from the model's, in half-widths of the box of theta:
        the policy keeps so far from the bounds, where the law does.
    **sb3_kwargs
        ``n_critics``, ``optimizer_class`` and ``optimizer_kwargs``, as in SB3's `TD3Policy`. For
        Adam, the actor of more than 32 regions has :class:`RowAdam`. Arguments for features must
        keep their defaults: theta must reach the law as it is.

    Raises
    ------
    TypeError, ValueError
        If there is no problem, spaces or algorithm do not fit it, or a keyword is not known.

    Examples
    --------
    >>> from stable_baselines3 import DDPG
    >>> model = DDPG(YannPolicy, "CSTR-v0", policy_kwargs={"max_correction": 0.1}, device="cpu")
    >>> theta = np.zeros(4, dtype=np.float32)
    >>> bool(np.allclose(model.predict(theta)[0], model.policy.problem.explicit()(theta)))
    True
    """

    ALGORITHMS = (TD3,)


# DDPG shares this table, so DDPG("YannPolicy", env) works as well.
TD3.policy_aliases["YannPolicy"] = YannPolicy
