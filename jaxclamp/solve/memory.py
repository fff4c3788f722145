"""What a scene needs of memory, held against what this process may have, before any of it is used."""

from __future__ import annotations

import numpy as np

from jaxclamp.core.failures import TooLittleMemory
from jaxclamp.core.memory import ADDRESSES, free_MB, resident_MB
from jaxclamp.fem.tube import build_tube, supports
from jaxclamp.scenes.scene import MeshSettings

START, PER_UNKNOWN = 850.0, 0.03
"""MB: Python with its compiled programs and the error estimates, and what each unknown adds (human-lad on
meshes of 500 to 31,000 unknowns, q1p0 and q2p1: 833 to 1758 MB, within 12 %)"""
ADDRESSES_PER_MB, ADDRESSES_PER_UNKNOWN, ADDRESSES_EXPONENT = 1.2, 5e-4, 1.5
"""addresses taken, MB: for each MB of memory, and factor times unknowns to the exponent (the same runs:
694 MB on the smallest mesh, 757 on 9,600 unknowns, 4048 on the largest; never less than they took)"""


def unknowns_of(mesh: MeshSettings) -> int:
    """Degrees of freedom that move."""
    return int(np.sum(~supports(build_tube(mesh), mesh)))


def predicted_MB(unknowns: int) -> float:
    """Largest memory of a process that solves one scene, with the errors of its figures."""
    return START + PER_UNKNOWN * unknowns


def require_memory(unknowns: int) -> None:
    """Raise TooLittleMemory if a scene with so many unknowns will not fit, as far as that is known."""
    taken, free = resident_MB(), free_MB()
    if taken is None or free is None:
        return
    left, by = free
    more = max(predicted_MB(unknowns) - taken, 0.0)
    if by == ADDRESSES and more > 0.0:
        more = ADDRESSES_PER_MB * more + ADDRESSES_PER_UNKNOWN * unknowns**ADDRESSES_EXPONENT
    if more > left:
        raise TooLittleMemory(
            f"the scene has {unknowns} unknowns and needs about {more:.0f} MB more, and {by} leaves "
            f"{max(left, 0.0):.0f} MB: take fewer mesh elements (--fidelity draft), or allow more memory"
        )
