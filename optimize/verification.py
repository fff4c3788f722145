"""Does a gain survive a finer mesh and stiffer, sharper contact? Nobody should build a mesh artefact."""

from __future__ import annotations

import dataclasses
from typing import Any

from jaxclamp import Estimate, Failure, Measure, Result, Scene, clamp, neighbours, replace
from optimize.gains import Gain, with_error
from optimize.named_measures import in_words
from optimize.price import Compared
from optimize.problem import Constraint, DesignProblem
from optimize.record import FEASIBLE

STIFFER = 2.0
"""contact stiffness times, and smoothing divided by, this"""


def finer(scene: Scene) -> Scene:
    """Half as many elements again along the artery, where the jaw's shape acts, and harder contact."""
    axial = -(-3 * scene.mesh.axial // 2)
    scene = dataclasses.replace(scene, mesh=dataclasses.replace(scene.mesh, axial=axial))
    scene = replace(scene, "contact.stiffness", STIFFER * scene.contact.stiffness)
    return replace(scene, "contact.smoothing", scene.contact.smoothing / STIFFER)


@dataclasses.dataclass(frozen=True)
class Verification:
    """Start, best and perhaps a reference on the finer model; None where it has no equilibrium."""

    coarse: dict[str, float]
    """objective on the study's own model, internal units"""
    fine: dict[str, float | None]
    """objective on the finer model"""
    final: dict[str, dict[str, Any] | None]
    """final record on the finer model"""
    failure: str | None
    """why start or best has no equilibrium there"""
    elements: int
    """of the finer mesh"""
    unit: str = ""
    """of the objective"""
    before: Compared | None = None
    """the same clamps with their errors on the study's own model; None: no errors are known"""
    after: Compared | None = None
    """on the finer model"""
    missed: tuple[str, ...] = ()
    """what of the constraints the best design does not keep there, a sentence each"""

    @property
    def gain_before(self) -> Gain:
        """From start to best on the study's own model."""
        found = None if self.before is None else self.before.gain("start")
        return found or Gain(self.coarse["start"], self.coarse["best"], self.unit)

    @property
    def gain(self) -> Gain | None:
        """The same on the finer model; None if that is not known."""
        found = None if self.after is None else self.after.gain("start")
        if found is not None:
            return found
        start, best = self.fine["start"], self.fine["best"]
        return None if start is None or best is None else Gain(start, best, self.unit)

    @property
    def survives(self) -> bool:
        """True if at least half of the gain is there on the finer model, or there was none to lose."""
        if self.gain is None:
            return False
        before = self.gain_before.difference
        return before <= 0.0 or self.gain.difference >= 0.5 * before

    @property
    def sentence(self) -> str:
        """What came of it, for a reader."""
        if self.gain is None:
            return f"the finer model was not solved: {self.failure}"
        verdict = "the gain survives" if self.survives else "THE GAIN DOES NOT SURVIVE"
        if self.gain_before.difference <= 0.0:
            verdict = "there was no gain to lose"
        model = f"{self.elements} elements with harder contact"
        said = f"{verdict} on {model}: best against start is {self.gain}; before, it was {self.gain_before}"
        said = "; ".join((said, *self.missed))
        now, before = (c and c.gain("reference") for c in (self.after, self.before))
        return said if now is None else f"{said}. Best against reference is {now}; before, it was {before}"

    def to_dict(self) -> dict[str, Any]:
        """As in study.json."""
        blocks = {
            name: None if final is None else {"objective": self.fine[name], **final}
            for name, final in self.final.items()
        }
        gain = self.gain
        said = {
            "gain": None if gain is None else gain.share,
            "gain_difference": None if gain is None else gain.difference,
            "gain_error": None if gain is None else gain.error,
            **({} if self.after is None else self.after.to_dict()),
            "survives": self.survives,
            "missed": list(self.missed),
            "elements": self.elements,
        }
        return {**blocks, **said, "failure": self.failure}


def verify(
    problem: DesignProblem,
    results: dict[str, Result],
    measures: tuple[Measure, ...] = (),
    before: Compared | None = None,
) -> Verification:
    """Solve the results "start" and "best" (and others) on the finer model, carried over from their own.

    measures: whose errors are estimated there; before: the same on the study's own model
    """
    fine: dict[str, float | None] = dict.fromkeys(results)
    final: dict[str, dict[str, Any] | None] = dict.fromkeys(results)
    estimates, limited = {}, {}
    constrained = tuple(c.measure for c in problem.constraints)
    failure, elements = None, 0
    for name, result in results.items():
        try:
            found = clamp(finer(result.scene), guess=result)
        except Failure as error:
            failure = f"{name}: {error}" if name in ("start", "best") else failure
            continue
        fine[name], final[name] = found.measure(problem.objective), found.final
        elements = found.model.mesh.n_cells
        if measures:
            near = neighbours(found)
            estimates[name] = near.estimates(measures)
            limited[name] = near.estimates(constrained) if name in ("best", "reference") else {}
    coarse = {name: result.measure(problem.objective) for name, result in results.items()}
    after = Compared(problem.objective, estimates) if measures else None
    unit = problem.objective.unit
    missed = tuple(
        said
        for c in problem.constraints
        if "best" in limited and (said := miss(c, limited["best"], limited.get("reference")))
    )
    return Verification(coarse, fine, final, failure, elements, unit, before, after, missed)


def miss(
    c: Constraint, best: dict[Measure, Estimate], reference: dict[Measure, Estimate] | None
) -> str | None:
    """In a sentence, that the best design is beyond a bound by more than its error; None if it is not.

    A bound that is relative to the reference is so on the same model; it is not known if that was not solved.
    """
    value = best[c.measure]
    for side, sign in c.sides:
        bound = Estimate(side, dict.fromkeys(value.sources, 0.0))
        if c.reference:
            if not reference:
                return (
                    f"there the bound of the {in_words(c.measure)} is not known: the reference was not solved"
                )
            bound = _times(reference[c.measure], side / c.reference)
        left = value - bound
        if -sign * left.value > FEASIBLE * c.scale + (left.error or 0.0):
            amount = with_error(abs(left.value), left.error, c.measure.unit)
            return f"there the {in_words(c.measure)} is beyond its bound of {bound.value:.4g} by {amount}"
    return None


def _times(found: Estimate, factor: float) -> Estimate:
    parts = {name: None if part is None else factor * part for name, part in found.sources.items()}
    return Estimate(factor * found.value, parts)
