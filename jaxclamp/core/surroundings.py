"""What a process must be like to compute: JAX as this package sets it, and not in a late fork."""

from __future__ import annotations

import os
from typing import Any

import jax

from jaxclamp.core.failures import Unfit

_used_before_fork = False
_forked_late = False


def require_fit() -> None:
    """Raise Unfit if this process cannot compute, or would do so wrongly."""
    config: Any = jax.config
    if _forked_late:
        raise Unfit(
            "this process was forked from one that had used JAX, and would wait for ever: start processes "
            "by spawn, such as ProcessPoolExecutor(mp_context=multiprocessing.get_context('spawn'))"
        )
    try:
        jax.devices()
    except Exception as error:  # an assertion of JAX among others
        asked = config.jax_platforms or "any platform"
        raise Unfit(
            f"JAX has no device of {asked} here: set the environment variable JAX_PLATFORMS to cpu, or to a "
            "platform that this machine has"
        ) from error
    if not config.jax_enable_x64:
        raise Unfit(
            "jax_enable_x64 is off, and jaxclamp needs 64-bit floats: leave it as `import jaxclamp` sets it, "
            "or call jax.config.update('jax_enable_x64', True)"
        )
    if config.jax_numpy_rank_promotion == "raise":
        raise Unfit(
            "jax_numpy_rank_promotion is 'raise', and jaxclamp has arrays of unlike rank act together: call "
            "it with jax.numpy_rank_promotion('allow')"
        )


def use_cpu() -> None:
    """Have JAX compute on the CPU in this process, whatever other devices there are; before its first use."""
    jax.config.update("jax_platforms", "cpu")


def _jax_was_used() -> bool:
    """True if JAX has started its threads."""
    try:
        from jax._src.xla_bridge import backends_are_initialized
    except ImportError:  # no public name tells
        return False
    return bool(backends_are_initialized())


def _before_fork() -> None:
    global _used_before_fork
    _used_before_fork = _jax_was_used()


def _in_fork() -> None:
    global _forked_late
    _forked_late = _used_before_fork


if hasattr(os, "register_at_fork"):  # not on Windows
    os.register_at_fork(before=_before_fork, after_in_child=_in_fork)
