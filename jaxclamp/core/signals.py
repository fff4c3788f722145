"""What the command line does when it is interrupted or terminated: it ends in one line, and cleans up.

`jaxclamp` loads JAX when it is imported, before the command line has the word; an interruption in that time
ends the process at once.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

INTERRUPTED, TERMINATED = 130, 143
"""exit codes, by the convention of shells: 128 and the signal's number"""


class Terminated(BaseException):
    """The process was asked to end; what is under way tidies up first."""


def guard_start() -> None:
    """Let an interruption while the command line is loading end it in one line; nothing in other programs."""
    waits = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if waits and _in_main_thread() and is_command_line(sys.argv, sys.orig_argv):
        signal.signal(signal.SIGINT, _end)


def is_command_line(argv: list[str], started_as: list[str]) -> bool:
    """True in the process of `jaxclamp` or `python -m jaxclamp`, not in one that it started.

    argv, started_as: `sys.argv` and `sys.orig_argv`
    """
    if multiprocessing.parent_process() is not None or not argv:
        return False
    if argv[0] == "-m":  # what it is only turns out after the package is imported
        return "jaxclamp" in started_as[started_as.index("-m") + 1 :][:1]
    return Path(argv[0]).stem == "jaxclamp"


@contextmanager
def ending() -> Iterator[None]:
    """Have interruptions raise KeyboardInterrupt in the block, and requests to end Terminated."""
    if not _in_main_thread():
        yield
        return
    asked = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    default = [number for number in asked if signal.getsignal(number) is signal.SIG_DFL]
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in default:
        signal.signal(number, _raise)
    try:
        yield
    finally:
        for number in default:
            signal.signal(number, signal.SIG_DFL)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _end(number: int, frame: Any) -> None:
    os.write(2, b"jaxclamp: interrupted\n")
    os._exit(INTERRUPTED)


def _raise(number: int, frame: Any) -> None:
    raise Terminated
