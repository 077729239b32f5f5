"""Names and units of states and inputs: checked, and in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sb3_yann._validation import is_text
from sb3_yann.control.linear_system import LinearSystem, names

Units = Mapping[str, str] | Sequence[str]


def as_names(what: str, given: Sequence[str], size: int) -> tuple[str, ...]:
    """Return so many different names, or none."""
    if isinstance(given, str) or not all(isinstance(each, str) for each in given):
        raise TypeError(f"{what} = {given!r} must be a list of str, one for each of the {size}.")
    found = tuple(given)
    if found and (len(found) != size or len(set(found)) != size or not all(found)):
        raise ValueError(
            f"{what} = {list(found)} must be {size} different names, or none: leave it out."
        )
    _require_text(what, found)
    return found


def _require_text(what: str, given: Sequence[str]) -> None:
    """Raise where a name holds what files in XML, HTML and UTF-8 cannot."""
    for each in given:
        if not all(map(is_text, each)):
            raise ValueError(
                f"{what}: {each!r} holds a character that is no text. Leave out line ends, escape "
                "sequences and other control characters."
            )


def require_different(labels: Sequence[str]) -> None:
    """Raise ValueError if a name stands for a state and for an input."""
    if both := sorted({each for each in labels if labels.count(each) > 1}):
        raise ValueError(f"{both} name a state and an input: each needs a name of its own.")


def as_units(given: Units, labels: Sequence[str]) -> tuple[str, ...]:
    """Return the unit of each state and input, "" where there is none.

    Labels are the names of both, ``x[0]`` where there are no others.
    """
    if isinstance(given, Mapping):
        if unknown := [each for each in given if each not in labels]:
            raise ValueError(f"units has {unknown}, but the names are {list(labels)}.")
        given = [given.get(each, "") for each in labels]
    if isinstance(given, str) or not all(isinstance(each, str) for each in given):
        raise TypeError(f"units = {given!r} must map names to str, or list one for each.")
    found = tuple(given)
    if found and len(found) != len(labels):
        raise ValueError(f"units = {list(found)} must have one entry for each of {list(labels)}.")
    _require_text("units", found)
    return found if any(found) else ()


def as_unit(what: str, given: str) -> str:
    """Return one unit, which may be empty."""
    if not isinstance(given, str):
        raise TypeError(f"{what} = {given!r} must be a str, such as 's'.")
    _require_text(what, [given])
    return given


def labels_of(model: LinearSystem) -> tuple[list[str], list[str]]:
    """Return the names of states and of inputs, ``x[0]`` and ``u[0]`` where none is given."""
    plain = names((model.n_states, model.n_inputs))
    n = model.n_states
    return list(model.state_names) or plain[:n], list(model.input_names) or plain[n:]


def with_units(model: LinearSystem) -> tuple[list[str], list[str]]:
    """Return the names of states and inputs, each with its unit in parentheses where it has one."""
    states, inputs = labels_of(model)
    units = model.units or ("",) * (len(states) + len(inputs))
    whole = [
        f"{name} ({unit})" if unit else name
        for name, unit in zip([*states, *inputs], units, strict=True)
    ]
    return whole[: len(states)], whole[len(states) :]


def missing_observer(model: LinearSystem) -> str:
    """Return what a law or a policy of this model lacks; empty where nothing is estimated."""
    if not model.estimated:
        return ""
    which = [f"d[{i}]" for i in model.estimated]
    verb = "is" if len(which) == 1 else "are"
    return (
        f"{', '.join(which)} {verb} estimated: the DisturbanceObserver is no part of the law or "
        "the policy. Whoever calls it runs the observer, and passes its x_hat and d_hat."
    )


def past_inputs(model: LinearSystem) -> list[tuple[int, str]]:
    """Return the number of the input, and the lag as in ``(k-1)``, of each last state named so."""
    inputs, found = labels_of(model)[1], list[tuple[int, str]]()
    for label in reversed(model.state_names):
        name, lag, rest = label.partition("(k-")
        if name not in inputs or not rest.removesuffix(")").isdigit():
            break
        found.insert(0, (inputs.index(name), lag + rest))
    return found


def completed(
    model: LinearSystem,
    past: Sequence[tuple[int, str]],
    state_names: Sequence[str],
    input_names: Sequence[str],
    units: Units,
) -> tuple[Sequence[str], Units]:
    """Return names of states and units with those of inputs on their way, where they are left out.

    ``past`` are the last states of a model with dead time: numbers of inputs, and lags.
    """
    own, m = model.n_states - len(past), model.n_inputs
    named = len(input_names) == m
    if not isinstance(state_names, str) and len(state_names) == own and own:
        inputs = list(input_names) if named else labels_of(model)[1]
        state_names = [*state_names, *(inputs[j] + lag for j, lag in past)]
    if not isinstance(units, str | Mapping) and len(units) == own + m:
        of_inputs = list(units[own:])
        units = [*units[:own], *(of_inputs[j] for j, _ in past), *of_inputs]
    return state_names, units
