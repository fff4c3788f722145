"""A second process with a JAX of its own, for work that JAX itself calls back for.

JAX must not be called from inside one of its own callbacks: it may wait for itself for ever. So a
compiled program that needs an equilibrium has it solved here. The process starts afresh; jaws and laws of a
script or a notebook travel with their scene.

It has a pipe of its own because `jax.jit` has to work in any script, and the processes of libraries do not:
a fork of a process that has used JAX hangs; one that `multiprocessing` or `concurrent.futures` spawns runs
the user's script again, which has to be guarded by `if __name__ == "__main__"` then; loky's tracker of
resources (tried, 3.7) imports from the current folder, where a file may be called like a module of Python's.
"""

from __future__ import annotations

import atexit
import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import cloudpickle

from jaxclamp.core.failures import Failure, WorkerLost
from jaxclamp.core.parts import by_value

_lock = threading.Lock()
_process: subprocess.Popen[bytes] | None = None


def call_elsewhere(function: Callable[..., Any], *arguments: Any) -> Any:
    """The value of a function of picklable arguments, or the error that it raises.

    Raises WorkerLost if the process ends meanwhile; the next call starts another.
    """
    global _process
    request = pickle.dumps(by_value(function, *arguments))
    with _lock:
        process = _process = _process or _start()
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(request)
            process.stdin.flush()
            worked, answer = pickle.load(process.stdout)
        except (OSError, EOFError, pickle.UnpicklingError):
            _end(process)
            raise WorkerLost(
                "the process that solves scenes for compiled programs has ended, perhaps for lack of memory; "
                "the next call starts another"
            ) from None
        except BaseException:  # interrupted: the answer would be taken for that of the next call
            _end(process)
            raise
    if not worked:
        raise answer
    return answer


def _start() -> subprocess.Popen[bytes]:
    """The process, which finds the modules of this one; those of the current folder hide no others."""
    here = [path for path in sys.path if path]
    path = here if len(here) == len(sys.path) else [*here, os.getcwd()]
    program = f"import sys; sys.path[:] = {path!r}; from jaxclamp.sensitivity.worker import serve; serve()"
    process = subprocess.Popen(
        [sys.executable, "-P", "-W", "ignore", "-c", program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONWARNINGS": "ignore"},
    )
    atexit.register(_end, process)
    return process


def _end(process: subprocess.Popen[bytes]) -> None:
    global _process
    _process = None
    process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout):
        with suppress(OSError):  # of what nobody will read
            stream.close()  # type: ignore[union-attr]
    atexit.unregister(_end)


def serve() -> None:
    """Answer requests on standard input until it closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal interrupts both; the caller decides
    requests: Any = sys.stdin.buffer
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever is printed must not mix with answers
    while requests.peek(1):
        try:
            content = cloudpickle.dumps((True, pickle.load(requests)()))
        except Exception as error:
            content = cloudpickle.dumps((False, _fit_to_travel(error)))
        answers.write(content)
        answers.flush()


def _fit_to_travel(error: Exception) -> Exception:
    """The error itself if it is of a kind that pickles, else one with its text."""
    if isinstance(error, Failure):
        return error
    return RuntimeError(f"{type(error).__name__}: {error}")


def _is_of_others(record: logging.LogRecord) -> bool:
    """True unless a log record is of a `Failure`, whose one sentence the exception brings."""
    return record.exc_info is None or not isinstance(record.exc_info[1], Failure)


# JAX logs whatever is raised in its callbacks, with all of its traceback
logging.getLogger("jax._src.callback").addFilter(_is_of_others)
