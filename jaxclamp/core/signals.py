"""What the command line does when it is interrupted or asked to end: it tidies up."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from jaxclamp.core.starting import INTERRUPTED, end

__all__ = ["INTERRUPTED", "TERMINATED", "Terminated", "ending"]

TERMINATED = 143
"""exit code, by the convention of shells: 128 and the signal's number"""


class Terminated(BaseException):
    """The process was asked to end."""


@contextmanager
def ending() -> Iterator[None]:
    """Have interruptions raise KeyboardInterrupt in the block, and requests to end Terminated."""
    if threading.current_thread() is not threading.main_thread():  # others may not set handlers
        yield
        return
    if signal.getsignal(signal.SIGINT) is end:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    asked = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    ours = [number for number in asked if signal.getsignal(number) is signal.SIG_DFL]
    for number in ours:
        signal.signal(number, _raise)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


def _raise(number: int, frame: Any) -> None:
    raise Terminated
