"""`improve` while a model learns: the plant's episodes so far become a twin, again and again."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_yann._validation import as_whole
from sb3_yann.commissioning.improve import improve
from sb3_yann.guard.rng import preserve_rng
from sb3_yann.policy._finite import watch_buffer
from sb3_yann.policy.policies import require_problem_of_twin, require_yann_policy
from sb3_yann.twin.plant_twin import PlantTwin


@dataclass(frozen=True)
class Attempt:
    """What :class:`ImproveInTwin` did after an episode.

    Attributes
    ----------
    timestep, episode : int
        Steps and episodes of training until then.
    trusted, accepted : bool
        Whether the twin was trusted, and whether a policy was accepted in it.
    cost_error : float
        Error of the twin's predicted costs, relative to the mean; nan without a twin.
    change : float
        The policy's mean cost in the twin against the MPC's: -0.02 is 2 % less.
    reason : str
        Why nothing was accepted; empty where something was.
    """

    timestep: int
    episode: int
    trusted: bool
    accepted: bool
    cost_error: float
    change: float
    reason: str


@dataclass
class TwinState:
    """All that a stopped run needs to go on; it travels in the model's zip.

    Attributes
    ----------
    attempts : list of Attempt, all so far
    episodes : int, training episodes so far
    is_due : bool, whether an improvement waits
    given : str, digest of the log of a twin that was given, empty where there was none
    run : float, when the present `learn` began: two callbacks in it do not share a state
    """

    attempts: list[Attempt] = field(default_factory=list)
    episodes: int = 0
    is_due: bool = False
    given: str = ""
    run: float = 0


class ImproveInTwin(BaseCallback):
    """Improves the policy in a twin of the plant after every so many training episodes.

    The twin is fitted to the replay buffer. Where it is not trusted, or :func:`improve` accepts
    nothing, the model goes on as it is, and ``callback.attempts`` says why. To an
    :class:`ImprovementGuard` in the same list an improvement is a candidate like any other; while
    a guard on a plant alone lets the actor rest, it waits. The algorithm's own gradient steps go
    on in between, ``gradient_steps=0`` leaves them out. No random numbers of the training are
    drawn. The count of episodes and the attempts travel with the model, as ``model.twin_state``:
    a run that is loaded goes on there.

    Tensorboard shows ``twin/trusted``, ``twin/cost_error``, ``twin/accepted`` and ``twin/change``.

    Parameters
    ----------
    twin : PlantTwin, optional
        Improve in this one, also before the first step. By default one is fitted each time.
    every : int, default 5
        Training episodes from one improvement to the next, of all envs together.
    iterations : int, default 120
        Of :func:`improve`.
    seed : int, default 0
        Of the first twin and improvement; the others follow.
    verbose : int, default 0
        1 prints each attempt.

    Raises
    ------
    UntrustedTwinError
        If the given twin is not to be trusted.
    TypeError, ValueError
        If an argument is out of range. When training starts: if the policy is no YannPolicy, or of
        another problem than the twin, or the replay buffer cannot be read.

    Examples
    --------
    >>> from stable_baselines3 import DDPG
    >>> from sb3_yann import ImproveInTwin, NoActionNoise
    >>> model = DDPG("YannPolicy", "CSTR-v0", gradient_steps=0, seed=0, device="cpu")
    >>> callback = ImproveInTwin(every=5, iterations=20)
    >>> _ = model.learn(5 * 400, callback=[NoActionNoise(), callback])
    >>> callback.attempts[0].trusted
    True
    """

    model: OffPolicyAlgorithm

    def __init__(
        self,
        twin: PlantTwin | None = None,
        *,
        every: int = 5,
        iterations: int = 120,
        seed: int = 0,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        if twin is not None and not isinstance(twin, PlantTwin):
            raise TypeError(f"twin = {twin!r} must be a PlantTwin, or None to fit one.")
        if twin is not None:
            twin.require_trust()
        self.twin, self.refits = twin, twin is None
        self.every, self.iterations = as_whole("every", every), as_whole("iterations", iterations)
        self.seed, self.state = as_whole("seed", seed, 0), TwinState()
        self._learner: OffPolicyAlgorithm | None = None  # whose the state is

    @property
    def attempts(self) -> list[Attempt]:
        """All attempts so far, those before a resumed run included."""
        return self.state.attempts

    def _init_callback(self) -> None:
        self.policy = require_yann_policy(self.model.policy, "ImproveInTwin")
        buffer = self.model.replay_buffer
        if self.twin is not None:
            require_problem_of_twin(self.policy, self.twin.problem)
        elif buffer is not None and buffer.optimize_memory_usage:
            raise ValueError(
                "ImproveInTwin reads the replay buffer, and optimize_memory_usage=True keeps no "
                "last states of episodes. Build the model without it, or pass a PlantTwin."
            )
        watch_buffer(self.model)
        self._go_on(self.model.start_time)
        self.given = "" if self.twin is None or self.refits else _digest_of(self.twin)
        self.is_new = self.given not in ("", self.state.given)
        self.state.is_due |= self.is_new

    def _go_on(self, run: float) -> None:
        """Take the model's state, or begin one."""
        model: Any = self.model
        known = getattr(model, "twin_state", None)
        if known is None:
            model.twin_state = self.state = TwinState()
        elif self._learner is not model:  # else it is its own, also beside another callback
            self.state = TwinState() if known.run == run else known
        self.state.run, self._learner = run, model

    def _on_rollout_start(self) -> None:
        if self.is_new:  # a twin that was given, before the first step
            self._improve()

    def _on_step(self) -> bool:
        state, ended = self.state, int(np.sum(self.locals["dones"]))
        state.is_due |= (state.episodes + ended) // self.every > state.episodes // self.every
        state.episodes += ended
        if ended and state.is_due:
            self._improve()
        return True

    def _improve(self) -> None:
        if self.policy.actor_step == 0:  # a guard tests the actor as it is
            return
        self.state.is_due, self.is_new, self.state.given = False, False, self.given
        seed = self.seed + len(self.attempts)
        with preserve_rng():
            found = self._attempt(seed)
        self.attempts.append(found)
        for name in ("trusted", "accepted", "cost_error", "change"):
            if math.isfinite(value := float(getattr(found, name))):
                self.logger.record(f"twin/{name}", value)
        self.logger.dump(self.num_timesteps)  # or the next would replace it
        if self.verbose:
            said = found.reason or f"{100 * found.change:+.2f} % in the twin"
            print(f"Episode {self.state.episodes}: {said}")

    def _attempt(self, seed: int) -> Attempt:
        now = self.model.num_timesteps, self.state.episodes
        if self.refits:
            self.twin = None
            try:
                self.twin = PlantTwin.from_buffer(self.model, seed=seed)
            except ValueError as said:  # no episode that is long enough
                return Attempt(*now, False, False, np.nan, np.nan, str(said))
        assert self.twin is not None
        error, problems = self.twin.trust.cost_error, " ".join(self.twin.trust.problems)
        if not self.twin.trusted:
            return Attempt(*now, False, False, error, np.nan, problems)
        found = improve(self.model, self.twin, self.iterations, seed=seed)
        return Attempt(*now, True, found.accepted, error, found.change, found.reason)


def _digest_of(twin: PlantTwin) -> str:
    """Return the digest of the log that a twin was fitted to."""
    rows = (each.thetas.tobytes() + each.actions.tobytes() for each in twin.episodes)
    return hashlib.sha256(b"".join(rows)).hexdigest()
