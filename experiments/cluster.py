"""The same runs on the workers of a dask cluster, on other machines as well."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cloudpickle
from distributed import Client, as_completed

import experiments
from experiments.runner import Outcome, Run, play, save


def on_cluster(
    runs: Sequence[Run],
    execute: Callable[[Run], Outcome],
    folder: Path,
    fingerprint: str,
    address: str,
) -> Iterator[tuple[Run, str | None]]:
    """Yield each run when it is done, with its traceback if it failed; saved on this machine.

    The workers need this version of Python and ``sb3-yann[paper]``, but not this folder: the
    package ``paper`` travels by value. SB3 seeds the generators of a whole process, therefore a
    worker must have one thread, ``dask worker --nthreads 1``.
    """
    if not runs:
        return
    with Client(address) as client:
        threads: Mapping[str, int] = client.nthreads()
        if any(count != 1 for count in threads.values()):
            raise ValueError(f"Start the dask workers with --nthreads 1; they have {threads}.")
        futures = {
            client.submit(
                lambda call: __import__("pickle").loads(call)(),
                by_value(functools.partial(_outcome_as_arrays, execute, run)),
                key=f"{run} {fingerprint} {number}",
                pure=False,
                priority=-number,
            ): run
            for number, run in enumerate(runs)
        }
        for future in as_completed(list(futures)):
            run = futures.pop(future)
            yield run, _saved(future, run, folder, fingerprint)
            future.release()


def by_value(value: object) -> bytes:
    """Return a pickle that carries the code of this package along."""
    registered = experiments.__name__ in cloudpickle.list_registry_pickle_by_value()
    file = io.BytesIO()
    cloudpickle.register_pickle_by_value(experiments)
    try:
        _Pickler(file).dump(value)
    finally:
        if not registered:
            cloudpickle.unregister_pickle_by_value(experiments)
    return file.getvalue()


def _saved(future: Any, run: Run, folder: Path, fingerprint: str) -> str | None:
    try:
        result = future.result()
    except Exception as error:  # a lost worker, for instance
        return f"{type(error).__name__}: {error}"
    if isinstance(result, str):
        return result
    save(Outcome(**result), run, folder, fingerprint)
    return None


def _outcome_as_arrays(execute: Callable[[Run], Outcome], run: Run) -> dict[str, Any] | str:
    import sb3_yann  # noqa: F401  (registers the environments, also where nothing else imports it)

    outcome = play(execute, run)
    return outcome if isinstance(outcome, str) else dict(vars(outcome))


class _Pickler(cloudpickle.Pickler):
    """Cloudpickle, which alone would send a cached function by its name only."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, functools._lru_cache_wrapper) and _is_ours(obj):
            return _cached, (obj.__wrapped__, obj.cache_parameters())
        return super().reducer_override(obj)


def _is_ours(obj: Any) -> bool:
    return f"{obj.__module__}.".startswith(f"{experiments.__name__}.")


def _cached(function: Callable[..., Any], parameters: dict[str, Any]) -> Callable[..., Any]:
    return functools.lru_cache(**parameters)(function)
