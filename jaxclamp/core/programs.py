"""Compiled programs are mapped into memory, and a process may map only so many pieces of it."""

from __future__ import annotations

import gc
from pathlib import Path

import jax

MOST_MAPPINGS = 40_000
"""of the 65,530 that Linux allows a process by default; the programs of one mesh take some 4,000, and JAX
ends the process with a segmentation fault where there is no room for another"""


def forget_if_crowded() -> bool:
    """Drop JAX's compiled programs if this process has gathered so many that the next may not fit.

    Programs that are asked for again are compiled again (or read from the persistent cache). True if
    dropped. Nothing is done where the system does not tell (other than Linux).
    """
    try:
        with open(Path("/proc/self/maps"), "rb") as file:
            crowded = sum(1 for _ in file) > MOST_MAPPINGS
    except OSError:
        return False
    if crowded:
        jax.clear_caches()
        gc.collect()
    return crowded
