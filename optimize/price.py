"""What a design costs: every injury measure against another clamp, each with its error.

The clamps that a study compares are wrong in much the same way: on one artery, one mesh, with one law of
contact. So the error of a difference is estimated on the difference, source by source (see
`jaxclamp.Estimate`), and is mostly far smaller than the errors of the two.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jaxclamp as jc
from jaxclamp import Estimate, Measure
from optimize.gains import Gain, with_error
from optimize.named_measures import in_words

BETTER, WORSE, SAME, UNKNOWN = "better", "worse", "same within error", "error not known"


def injuries(layers: tuple[str, ...]) -> tuple[Measure, ...]:
    """What may injure the wall, all the more the higher it is; layers: their names."""
    by_layer = (
        jc.smooth_peak_axial_stress,
        jc.smooth_peak_circumferential_stress,
        jc.smooth_peak_principal_stress,
        jc.mean_damage,
    )
    contact = (jc.smooth_peak_contact_pressure(), jc.mean_contact_pressure(), jc.clamp_force())
    return (*contact, jc.smooth_peak_axial_strain_gradient()) + tuple(
        factory(layer) for factory in by_layer for layer in layers
    )


@dataclasses.dataclass(frozen=True)
class Change:
    """One injury measure of the best design against another clamp's."""

    measure: Measure
    """the higher, the worse"""
    best: Estimate
    """of the best design, internal units"""
    other: Estimate
    """of the clamp compared with"""

    @property
    def difference(self) -> Estimate:
        """Best less other, with the error of the difference."""
        return self.best - self.other

    @property
    def word(self) -> str:
        """Better, worse, the same within its error; or that the error is not known."""
        value, error = self.difference.value, self.difference.error
        if error is None:
            return UNKNOWN
        if abs(value) <= error:
            return SAME
        return BETTER if value < 0.0 else WORSE

    @property
    def gain(self) -> Gain:
        """The same, lower being a gain."""
        return Gain(self.other.value, self.best.value, self.measure.unit, self.difference.error)

    def said(self, other: str) -> str:
        """In words; other: what the clamp compared with is called."""
        gain, within = self.gain, ""
        if self.word != WORSE and self.word != BETTER:
            within = f", {self.word.removeprefix('same ')}"
        share = f" ({gain.percentage})" if gain.percentage else ""
        what = f"the {in_words(self.measure)} is {gain.amount} {gain.direction} than the {other}'s"
        return f"{what}{share}{within}"

    def to_dict(self, other: str) -> dict[str, Any]:
        """A row of the table in study.json; other: what the clamp compared with is called."""
        found = self.difference
        return {
            "measure": in_words(self.measure),
            "unit": self.measure.unit,
            "best": self.best.value,
            other: self.other.value,
            "difference": found.value,
            "error": found.error,
            "word": self.word,
        }


@dataclasses.dataclass(frozen=True)
class Compared:
    """The clamps of a study on one model."""

    objective: Measure
    """what was minimised"""
    estimates: dict[str, dict[Measure, Estimate]]
    """by clamp ("reference", "start", "best"; those that have an equilibrium) and measure"""

    @property
    def other(self) -> str:
        """What the best design is compared with: the reference if there is one, else the start."""
        return "reference" if "reference" in self.estimates else "start"

    def gain(self, other: str) -> Gain | None:
        """From another clamp to the best design; None if one of them has no equilibrium."""
        if other not in self.estimates or "best" not in self.estimates:
            return None
        best, base = (self.estimates[name][self.objective] for name in ("best", other))
        return Gain(base.value, best.value, self.objective.unit, (base - best).error)

    @property
    def price(self) -> tuple[Change, ...]:
        """Every injury measure but the objective, best against `other`."""
        if not {"best", self.other} <= set(self.estimates):
            return ()
        best, other = self.estimates["best"], self.estimates[self.other]
        return tuple(Change(m, best[m], other[m]) for m in best if m != self.objective and m in other)

    @property
    def sentence(self) -> str:
        """The price in one sentence: what rises most, relative to the other clamp's, and what for certain."""
        rank = lambda change: change.difference.value / (abs(change.other.value) or 1.0)  # noqa: E731
        higher = sorted((c for c in self.price if c.difference.value > 0.0), key=rank, reverse=True)
        certain = [change for change in higher if change.word == WORSE]
        if not higher:
            return f"no other injury measure is higher than the {self.other}'s"
        said = f"the price: {higher[0].said(self.other)}"
        if not certain:
            return f"{said}; nothing is higher by more than its error"
        if certain[0] is not higher[0]:
            said += f"; beyond its error, {certain[0].said(self.other)}"
        return said

    def value(self, name: str) -> str:
        """The objective of a clamp with its error and unit."""
        found = self.estimates[name][self.objective]
        return with_error(found.value, found.error, self.objective.unit)

    def gains(self) -> dict[str, Any]:
        """The gains against reference and start, as in study.json."""
        found = {name: self.gain(name) for name in ("reference", "start")}
        return {name: gain.to_dict() for name, gain in found.items() if gain is not None}

    def to_dict(self) -> dict[str, Any]:
        """As in study.json."""
        return {"gains": self.gains(), "price": [change.to_dict(self.other) for change in self.price]}
