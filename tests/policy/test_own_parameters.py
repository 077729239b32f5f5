"""Parameters of another problem are refused before anything is changed; own ones load."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG, TD3

from policy_samples import build, scalar_mpc
from sb3_yann import AffineObservation
from sb3_yann.policy.checkpoint import ActorCheckpoint

KINDS: dict[str, dict[str, Any]] = {
    "a network for each region": {},
    "a shared network": {"networks": "shared"},
    "an online law": {"law": "online"},
    "the paper's critic": {"critic": "state_action"},
    "a map of observations": {"observation": AffineObservation(2 * np.eye(1), np.ones(1))},
}
OTHERS = {
    "same count": {"R": [[2]]},
    "other count": {"horizon": 3, "R": [[2]]},
    "other range": {"u_max": 2},
}


def model_of(kind: str, algorithm=DDPG, **changes) -> Any:
    """A model whose networks, and whose target's, have learnt something: noise."""
    model = build(algorithm, scalar_mpc(**changes), KINDS[kind])
    generator = th.Generator().manual_seed(len(changes))
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.01 * th.randn(parameter.shape, generator=generator))
    return model


def state_of(model) -> dict[str, th.Tensor]:
    return {name: each.clone() for name, each in model.policy.state_dict().items()}


def same(one: dict[str, th.Tensor], other: dict[str, th.Tensor]) -> bool:
    return one.keys() == other.keys() and all(th.equal(one[name], other[name]) for name in one)


def require_refused(model, load: Callable[[], Any], what: str = "") -> None:
    before = state_of(model)
    message = rf"with another problem, observation or networks: .*{what}.*DDPG\.load\(path\)"
    with pytest.raises(ValueError, match=message):
        load()
    assert same(state_of(model), before)


@pytest.mark.parametrize("exact_match", [True, False])
@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("kind", KINDS)
def test_parameters_of_another_problem_change_nothing(kind, other, exact_match) -> None:
    model, foreign = model_of(kind), model_of(kind, **OTHERS[other]).get_parameters()
    require_refused(model, lambda: model.set_parameters(foreign, exact_match), r"actor\.mu\.")


def test_a_guards_checkpoint_of_another_problem_changes_nothing() -> None:
    model, foreign = build(), ActorCheckpoint.of(build(mpc=scalar_mpc(R=[[2]])).policy)
    require_refused(model, lambda: foreign.restore(model.policy))


def test_a_critic_of_other_weights_is_told_where_the_law_is_the_same() -> None:
    model, foreign = build(), build(mpc=scalar_mpc(Q=[[2]], R=[[2]]))
    require_refused(
        model, lambda: model.set_parameters(foreign.get_parameters()), r"critic\.qf0\.W"
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("algorithm", [DDPG, TD3])
def test_parameters_of_the_same_problem_are_loaded_exactly(kind, algorithm) -> None:
    learnt, model = model_of(kind, algorithm), build(algorithm, scalar_mpc(), KINDS[kind])
    model.set_parameters(learnt.get_parameters())
    assert same(state_of(model), state_of(learnt))


@pytest.mark.parametrize("kind", KINDS)
def test_what_another_machine_has_solved_is_loaded(kind) -> None:
    model, state = model_of(kind), state_of(model_of(kind))
    generator = th.Generator().manual_seed(0)
    for name, each in state.items():
        if each.dtype == th.float64 and ".network." not in name:
            noise = th.randn(each.shape, generator=generator, dtype=th.float64)
            each.mul_(1 + 1e-12 * noise).add_(1e-13 * noise.nan_to_num() * each.isfinite())
    model.policy.load_state_dict(state)
    for name, each in state_of(model).items():  # a law of one's own stays to the bit
        assert th.allclose(each, state[name], rtol=1e-9, atol=1e-9, equal_nan=True), name


def test_a_load_with_another_problem_names_it(tmp_path) -> None:
    """Stable-Baselines3 takes a plain ValueError for that of an old DQN, which is a KeyError."""
    model = build()
    model.save(tmp_path / "model")
    changed = {"policy_kwargs": {"problem": scalar_mpc(R=[[2]])}}
    with pytest.raises(ValueError, match="with another problem"):
        DDPG.load(tmp_path / "model", custom_objects=changed)


@pytest.mark.parametrize("changes", [{"x_max": 4.9}, {"u_min": -0.99}, {"R": [[1.001]]}])
def test_online_laws_of_problems_alike_are_told_apart(changes) -> None:
    model, other = model_of("an online law"), model_of("an online law", **changes)
    require_refused(model, lambda: model.set_parameters(other.get_parameters()))
