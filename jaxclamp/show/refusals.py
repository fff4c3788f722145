"""Errors that are no mistake of this program, as a sentence and an exit code."""

from __future__ import annotations

from jaxclamp.core.failures import Failure

WRONG_INPUT, MACHINE_REFUSED = 2, 4
"""exit codes; failures bring their own"""


def refusal(error: Exception) -> tuple[str, int] | None:
    """Sentence and exit code of an error; None for a mistake of this program."""
    if isinstance(error, Failure):
        return str(error), error.exit_code
    if (usage := getattr(error, "format_message", None)) is not None:  # of the command itself
        return usage(), WRONG_INPUT
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return (
            "not enough memory: take a coarser mesh (--fidelity draft, or fewer mesh elements)",
            MACHINE_REFUSED,
        )
    if isinstance(error, OSError):
        where = f" {error.filename}" if error.filename else ""
        return f"the machine refused{where}: {error.strerror or error}", MACHINE_REFUSED
    return None
