"""Where a piece of work stands, told to whoever asked."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from typing import Any


@dataclasses.dataclass(frozen=True)
class Progress:
    """Where a piece of work stands."""

    stage: str
    """what is being done, such as clamping"""
    fraction: float
    """of the stage, 0 to 1"""
    message: str
    """what was reached, for people"""


Tell = Callable[[Progress], Any]
"""a receiver of progress"""


def teller(progress: bool | Tell | None) -> Tell:
    """The receiver that is asked for: a function, lines on standard error (True), or nobody."""
    if callable(progress):
        return progress
    if progress:
        return lambda event: sys.stderr.write(f"{event.stage:14s} {event.fraction:4.0%}  {event.message}\n")
    return lambda event: None
