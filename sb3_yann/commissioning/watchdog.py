"""Stub until merged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Alarm:
    kind: str
    message: str


class Watchdog:
    @classmethod
    def of(cls, twin: Any) -> Watchdog:
        return cls()

    def start(self, theta: Any, act: Any) -> None: ...

    def watch(self, theta: Any, u: Any, after: Any, violation: bool = False) -> Alarm | None:
        return None
