"""Leaving the random states of the process as they are."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch as th


@contextmanager
def preserve_rng() -> Iterator[None]:
    """Restore the states of the random generators that older envs and torch modules draw from."""
    python, legacy = random.getstate(), np.random.get_state()  # noqa: NPY002
    torch_state = th.get_rng_state()
    uses_cuda = th.cuda.is_initialized()  # type: ignore[no-untyped-call]
    cuda = th.cuda.get_rng_state_all() if uses_cuda else []
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(legacy)  # noqa: NPY002
        th.set_rng_state(torch_state)
        if cuda:
            th.cuda.set_rng_state_all(cuda)
