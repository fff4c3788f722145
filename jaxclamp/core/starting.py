"""An interruption while the command line is loading ends it in one line.

`jaxclamp` loads JAX when it is imported, before the command line has the word. This module is the first thing
that is imported, and itself imports only what Python has loaded already.
"""

from __future__ import annotations

import _signal  # type: ignore[import-not-found]
import os
import sys

INTERRUPTED = 130
"""exit code, by the convention of shells: 128 and the signal's number"""


def guard_start() -> None:
    """Have an interruption end this process in one line, if it is the command line (see `signals.ending`)."""
    if is_command_line(sys.orig_argv) and _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
        _signal.signal(_signal.SIGINT, end)


def is_command_line(started_as: list[str]) -> bool:
    """True for `jaxclamp ...` and `python -m jaxclamp ...`, not for a process that these start.

    started_as: interpreter, its options, script and arguments, as `sys.orig_argv`
    """
    words = iter(started_as[1:])
    for word in words:
        if word in ("-X", "-W"):
            next(words, "")
        elif word == "-m":
            return next(words, "") == "jaxclamp"
        elif word == "-c" or not word.startswith("-"):
            return os.path.splitext(os.path.basename(word))[0] == "jaxclamp"
    return False


def end(number: int, frame: object) -> None:
    """A handler of signals: say so and leave at once."""
    os.write(2, b"jaxclamp: interrupted\n")
    os._exit(INTERRUPTED)
