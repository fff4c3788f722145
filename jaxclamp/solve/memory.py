"""What a scene needs of memory, held against what this process may have, before any of it is used."""

from __future__ import annotations

import numpy as np

from jaxclamp.core.failures import TooLittleMemory
from jaxclamp.core.memory import ADDRESSES, limits_MB, resident_MB
from jaxclamp.fem.tube import build_tube, supports
from jaxclamp.scenes.scene import Scene
from jaxclamp.solve.nested import to_walk_on

START, PER_UNKNOWN = 850.0, 0.025
"""MB: Python with its compiled programs and the error estimates, and what each unknown adds, those of the
coarser meshes of the closing path counted (human-lad on meshes of 31,000, 103,000, 241,000 unknowns: 1.8 to
2.0, 3.8 and 10.2 GB, predicted 1.8, 4.3 and 10.4)"""
ADDRESSES_PER_MB, ADDRESSES_PER_UNKNOWN, ADDRESSES_EXPONENT = 1.2, 5e-4, 1.5
"""addresses taken, MB: for each MB of memory, and factor times unknowns to the exponent (in a version before:
694 MB on 500 unknowns, 757 on 9,600, 4048 on 31,000; never less than they took)"""


def unknowns_of(scene: Scene) -> int:
    """Degrees of freedom that move."""
    return int(np.sum(~supports(build_tube(scene.mesh, scene.clamp), scene.mesh)))


def coarser_unknowns(scene: Scene) -> int:
    """Those of all coarser meshes on which the closing path is walked."""
    coarse = to_walk_on(scene)
    return 0 if coarse is None else unknowns_of(coarse) + coarser_unknowns(coarse)


def predicted_MB(unknowns: int, of_coarser: int = 0) -> float:
    """Largest memory of a process that solves one scene, with the errors of its figures.

    of_coarser: unknowns of its coarser meshes
    """
    return START + PER_UNKNOWN * (unknowns + of_coarser)


def require_memory(unknowns: int, of_coarser: int = 0, processes: int = 1) -> None:
    """Raise TooLittleMemory if a scene with so many unknowns will not fit, as far as that is known.

    of_coarser: unknowns of its coarser meshes; processes: this one and others, a study's starts, that solve
        such scenes at the same time; a limit on addresses is one for each
    """
    taken = resident_MB()
    if taken is None:
        return
    whole = predicted_MB(unknowns, of_coarser)
    alone = max(whole - taken, 0.0)
    together = alone + (processes - 1) * whole
    addresses = ADDRESSES_PER_MB * alone + ADDRESSES_PER_UNKNOWN * unknowns**ADDRESSES_EXPONENT
    for left, by in limits_MB():
        more = (addresses if alone else 0.0) if by == ADDRESSES else together
        if more <= left:
            continue
        what, less = f"the scene has {unknowns} unknowns and needs", "fewer mesh elements (--fidelity draft)"
        if processes > 1 and by != ADDRESSES:
            what = f"{processes} starts at once, each of {unknowns} unknowns, need"
            less = f"fewer starts or {less}"
        raise TooLittleMemory(
            f"{what} about {more:.0f} MB more, and {by} leaves {max(left, 0.0):.0f} MB: "
            f"take {less}, or allow more memory"
        )


def require_memory_for(scene: Scene, processes: int) -> None:
    """Raise TooLittleMemory if so many processes that solve a scene at the same time will not fit."""
    require_memory(unknowns_of(scene), coarser_unknowns(scene), processes)
