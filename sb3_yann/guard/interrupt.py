"""Ctrl-C during `learn`, of which SB3 tells no callback: a handler restores the accepted policy."""

from __future__ import annotations

import signal
import threading
import weakref
from collections.abc import Callable
from types import FrameType
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm


class Handler:
    """Calls the handler that was there; where that raises, it restores the accepted policy.

    Once another exception has ended `learn`, it only passes on.
    """

    def __init__(self, model: BaseAlgorithm, restore: Callable[[], None], before: Any) -> None:
        self.before, self.run, self.model = before, model.start_time, weakref.ref(model)
        self.restore = weakref.WeakMethod(restore, lambda _: self.remove())

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Handle the signal."""
        try:
            self.before(number, frame)
        except BaseException:
            restore = self.restore()
            if restore is not None and self.is_needed(frame):
                restore()
            self.remove()
            raise

    def is_needed(self, frame: FrameType | None) -> bool:
        """Return whether what is running is the same `learn` as at the beginning."""
        model = self.model()
        if self.restore() is None or model is None or model.start_time != self.run:
            return False
        while frame is not None:
            if frame.f_code.co_name == "learn" and frame.f_locals.get("self") is model:
                return True
            frame = frame.f_back
        return False

    def remove(self) -> None:
        """Restore the handler that was there, unless somebody else's handler has come since."""
        present: object = signal.getsignal(signal.SIGINT)
        if threading.current_thread() is threading.main_thread() and present is self:
            signal.signal(signal.SIGINT, self.before)


def install(model: BaseAlgorithm, restore: Callable[[], None], frame: FrameType) -> Handler | None:
    """Return the handler for a `learn` that begins; None where there can be or need be none.

    ``restore`` is a bound method, held weakly; ``frame`` is the caller's. Handlers of runs that are
    over are passed by.
    """
    before: Any = signal.getsignal(signal.SIGINT)
    while isinstance(before, Handler) and not before.is_needed(frame):
        before = before.before
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        return None
    handler = Handler(model, restore, before)
    signal.signal(signal.SIGINT, handler)
    return handler
