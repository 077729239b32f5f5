"""Processes that a trial starts and ends. It forks, so it needs Linux or macOS."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable

import psutil


def fork(work: Callable[[], None]) -> int:
    """Return the process that does some work; it exits with 0, or with 1 after an error."""
    # A signal waits until the child can meet it: before, it would be lost or end the parent's work.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    child = os.fork()
    if child:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        return child
    code = 1
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever forks may ignore it
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        work()
        code = 0
    except BaseException:
        code = 1
    finally:
        os._exit(code)


def end(child: int, sign: int | None = None, patience: float = 30) -> str:
    """Send a signal to a process, wait for its end, and say how that was."""
    if sign is not None:
        os.kill(child, sign)
    until = time.monotonic() + patience
    while time.monotonic() < until:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            return {0: "done", 1: "an error"}.get(code, f"signal {-code}")
        time.sleep(0.005)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "hangs"


def let_work(child: int, seconds: float) -> None:
    """Wait until a process has worked for so many seconds of a core, or has ended."""
    process = psutil.Process(child)
    while process.status() != psutil.STATUS_ZOMBIE:
        used = process.cpu_times()
        if used.user + used.system >= seconds:
            return
        time.sleep(0.005)
