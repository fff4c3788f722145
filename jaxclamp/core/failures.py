"""Every way to fail, as values of one family: one sentence each, with cause and advice where there are any.

Failures travel between processes: they pickle with their sentence. `exit_code` is what the command line
answers with.
"""

from __future__ import annotations

import math
from typing import Any


class Failure(Exception):
    """What went wrong, in one sentence."""

    exit_code = 1
    """what the command line answers with"""


class SceneError(Failure):
    """A scene, study or saved result that is not valid: one sentence with file, key, value and what was
    expected."""

    exit_code = 2


class BadFolder(Failure):
    """A folder that results were to be written into, and cannot or should not be."""

    exit_code = 2


class BadKey(Failure):
    """One sentence on what is wrong with one key; the reader of the file adds its name (`SceneError`)."""

    exit_code = 2


class BadAddress(SceneError, KeyError):
    """One sentence on an address that leads nowhere in a scene; a KeyError too, as for any missing name."""

    def __str__(self) -> str:  # KeyError's would put the sentence in quotes
        return str(self.args[0])


class NotConverged(Failure):
    """One attempt at an equilibrium failed; the caller cuts its step or changes its method."""

    exit_code = 3

    def __init__(self, reason: str, residual: float = math.nan, J_min: float = math.nan) -> None:
        """reason: in words; residual: norm of the forces left, mN; J_min: smallest volume ratio."""
        super().__init__(reason, residual, J_min)
        self.reason, self.residual, self.J_min = reason, residual, J_min

    def __str__(self) -> str:
        return self.reason


class Exhausted(NotConverged):
    """Patience is out: nothing further is to be tried."""


class EquilibriumError(Failure):
    """No converged equilibrium. One sentence; `result` keeps the states that did converge.

    `result` stays in the process it was made in. What travels to others is small: the sentence, its parts and
    `history`, what was read off the states that did converge.
    """

    exit_code = 3

    def __init__(self, stage: str, load: str, failure: NotConverged, advice: str) -> None:
        """stage and load: where it failed; failure: how; advice: what to try."""
        super().__init__(stage, load, failure, advice)
        self.stage, self.load, self.failure, self.advice = stage, load, failure, advice
        self.residual, self.J_min = failure.residual, failure.J_min
        self.result: Any = None
        self._history: list[dict[str, Any]] = []

    @property
    def history(self) -> list[dict[str, Any]]:
        """One record per converged state from the physiological one on, as in result.json."""
        return self._history if self.result is None else list(self.result.history)

    def __str__(self) -> str:
        numbers = ""
        if math.isfinite(self.residual):
            numbers = f" (residual {self.residual:.2g} mN, smallest J {self.J_min:.3g})"
        return f"no equilibrium in stage '{self.stage}', {self.load}: {self.failure}{numbers}; {self.advice}"

    @property
    def parts(self) -> tuple[Any, ...]:
        """Stage, load, reason, residual (mN), smallest J, advice: what a file keeps of it."""
        return self.stage, self.load, self.failure.reason, self.residual, self.J_min, self.advice

    def __reduce__(self) -> tuple[Any, ...]:
        return (
            EquilibriumError,
            (self.stage, self.load, self.failure, self.advice),
            {"_history": self.history},
        )


class TermMissing(Failure):
    """A term of the potential that was left out is needed after all: the caller starts again with it."""

    exit_code = 3


class Singular(Failure):
    """The matrix could not be factored, or its solutions are inaccurate."""

    exit_code = 3


class Unfit(Failure):
    """This process cannot compute, or would do so wrongly: JAX has no device, or other settings."""

    exit_code = 4


class TooLittleMemory(Failure):
    """A scene needs more memory than this process may have."""

    exit_code = 4


class WorkerLost(Failure):
    """The process that solves scenes for compiled programs has ended."""

    exit_code = 4


class NoReference(Failure):
    """The finer meshes have no solution to compare with."""

    exit_code = 3
