"""Does a gain survive a finer mesh and stiffer, sharper contact? Nobody should build a mesh artefact."""

from __future__ import annotations

import dataclasses
from typing import Any

from jaxclamp import EquilibriumError, Result, Scene, clamp, replace
from optimize.problem import DesignProblem

STIFFER = 4.0
"""contact stiffness times, and smoothing divided by, this"""


def finer(scene: Scene) -> Scene:
    """Twice the elements along the artery, where the jaw's shape acts, and harder contact."""
    scene = dataclasses.replace(scene, mesh=dataclasses.replace(scene.mesh, axial=2 * scene.mesh.axial))
    scene = replace(scene, "contact.stiffness", STIFFER * scene.contact.stiffness)
    return replace(scene, "contact.smoothing", scene.contact.smoothing / STIFFER)


@dataclasses.dataclass(frozen=True)
class Verification:
    """Objective and final record of start and best on the finer model; None where it did not converge."""

    objective: dict[str, float | None]
    """of start and best, internal units"""
    coarse: dict[str, float]
    final: dict[str, dict[str, Any] | None]
    failure: str | None
    elements: int

    @property
    def gain(self) -> float | None:
        """Share by which the objective falls on the finer model; None if that is not known."""
        start, best = self.objective["start"], self.objective["best"]
        return None if start is None or best is None else 1.0 - best / start

    @property
    def survives(self) -> bool:
        """True if at least half of the gain is there on the finer model, or there was none to lose."""
        coarse = 1.0 - self.coarse["best"] / self.coarse["start"]
        return self.gain is not None and self.gain >= 0.5 * coarse

    @property
    def sentence(self) -> str:
        """What came of it, for a reader."""
        if self.gain is None:
            return f"the finer model has no equilibrium: {self.failure}"
        verdict = "the gain survives" if self.survives else "THE GAIN DOES NOT SURVIVE"
        coarse = 1.0 - self.coarse["best"] / self.coarse["start"]
        model = f"{self.elements} elements with harder contact"
        return f"{verdict} on {model}: {self.gain:.1%} ({coarse:.1%} before)"

    def to_dict(self) -> dict[str, Any]:
        """As in study.json."""
        blocks = {
            name: None if final is None else {"objective": self.objective[name], **final}
            for name, final in self.final.items()
        }
        return {
            **blocks,
            "gain": self.gain,
            "survives": self.survives,
            "elements": self.elements,
            "failure": self.failure,
        }


def verify(problem: DesignProblem, start: Result, best: Result) -> Verification:
    """Solve start and best from scratch on the finer model."""
    objective: dict[str, float | None] = {"start": None, "best": None}
    final: dict[str, dict[str, Any] | None] = {"start": None, "best": None}
    failure, elements = None, 0
    for name, result in (("start", start), ("best", best)):
        try:
            fine = clamp(finer(result.scene))
        except EquilibriumError as error:
            failure = f"{name}: {error}"
            continue
        objective[name], final[name] = fine.measure(problem.objective), fine.final
        elements = fine.model.mesh.n_cells
    coarse = {"start": start.measure(problem.objective), "best": best.measure(problem.objective)}
    return Verification(objective, coarse, final, failure, elements)
