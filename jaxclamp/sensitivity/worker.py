"""A second process with a JAX of its own, for work that JAX itself calls back for.

JAX must not be called from inside one of its own callbacks: it may wait for itself for ever. So a
compiled program that needs an equilibrium has it solved here.
"""

from __future__ import annotations

import atexit
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import IO, Any

_lock = threading.Lock()
_process: subprocess.Popen[bytes] | None = None


def call_elsewhere(function: Callable[..., Any], *arguments: Any) -> Any:
    """The value of an importable function of picklable arguments. Raises RuntimeError with its error."""
    global _process
    with _lock:
        if _process is None or _process.poll() is not None:
            _process = subprocess.Popen(
                [sys.executable, "-m", "jaxclamp.sensitivity.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
            )
            atexit.register(_process.kill)
        assert _process.stdin is not None
        assert _process.stdout is not None
        try:
            _send(_process.stdin, (function, arguments))
            worked, answer = _receive(_process.stdout)
        except (OSError, EOFError) as error:
            raise RuntimeError("the process that solves scenes for compiled programs has ended") from error
    if not worked:
        raise RuntimeError(answer)
    return answer


def _send(stream: IO[bytes], content: Any) -> None:
    data = pickle.dumps(content)
    stream.write(len(data).to_bytes(8, "little") + data)
    stream.flush()


def _receive(stream: IO[bytes]) -> Any:
    size = stream.read(8)
    if len(size) < 8:
        raise EOFError
    return pickle.loads(stream.read(int.from_bytes(size, "little")))


def serve() -> None:
    """Answer requests on standard input until it closes."""
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # whatever is printed must not mix with answers
    while True:
        try:
            function, arguments = _receive(requests)
        except EOFError:
            return
        try:
            answer = True, function(*arguments)
        except Exception as error:
            answer = False, str(error)
        _send(answers, answer)


if __name__ == "__main__":
    serve()
