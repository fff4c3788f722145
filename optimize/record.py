"""The record of a study: every design that was evaluated, and how that is written down and read back."""

from __future__ import annotations

import dataclasses
import hashlib
from typing import Any

import numpy as np

from jaxclamp import dump_scene, own_parts, versions
from optimize.problem import DesignProblem

FEASIBLE = 1e-3
"""relative violation of a constraint that is still called feasible"""


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """What is known of one design."""

    design: np.ndarray
    """(n_variables,), internal units"""
    values: np.ndarray
    """objective, then what is constrained, (n_measures,), internal units"""
    gradients: np.ndarray
    """their derivatives, (n_measures, n_variables)"""
    newton_iterations: int
    """that the solution took; 0 for a failure"""
    start: int = 1
    """number of the start design it was reached from"""
    failure: str | None = None
    """why there is no equilibrium; values and gradients mean nothing then"""

    def violation(self, problem: DesignProblem) -> float:
        """Largest relative violation of a constraint; 0 if all hold."""
        pairs = zip(problem.constraints, self.values[1:], strict=True)
        falls = -problem.climbs(self.design)
        return max([0.0, *map(float, falls), *(c.violation(float(value)) for c, value in pairs)])


@dataclasses.dataclass
class Record:
    """The evaluations of a study, in order."""

    problem: DesignProblem
    """what is studied"""
    method: str
    """a key of `optimize.drivers.METHODS`"""
    evaluations: list[Evaluation]
    """the problem's own start first"""

    @property
    def fingerprint(self) -> str:
        """A word that changes with anything that the evaluations depend on."""
        p = self.problem
        parts = [dump_scene(p.scene), str(p.objective), self.method, repr(p.entries)]
        parts += [f"{c.measure} {c.lower} {c.upper}" for c in p.constraints]
        parts += [f"rising {p.rises.tolist()}"] if p.rises.size else []
        parts += [str(own["sha256"]) for own in self._own_parts()]
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]

    def best(self) -> Evaluation | None:
        """The feasible design of least objective; the least infeasible one if there is none."""
        solved = [e for e in self.evaluations if e.failure is None]
        rank = lambda e: (max(e.violation(self.problem), FEASIBLE), e.values[0])  # noqa: E731
        return min(solved, key=rank, default=None)

    def rows(self) -> list[dict[str, Any]]:
        """The rows of iterations.csv: file units for the design, the measures' own for the rest."""
        return [self._row(number, e) for number, e in enumerate(self.evaluations, 1)]

    def _row(self, number: int, e: Evaluation) -> dict[str, Any]:
        solved = e.failure is None
        row: dict[str, Any] = {
            "evaluation": number,
            "start": e.start,
            "objective": e.values[0] if solved else "",
        }
        for constraint, value in zip(self.problem.constraints, e.values[1:], strict=True):
            row[f"{constraint.measure}"] = value if solved else ""
        row["violation"] = e.violation(self.problem) if solved else ""
        for entry, value in zip(self.problem.entries, e.design, strict=True):
            row[entry.name] = value / entry.factor
        return row | {"newton_iterations": e.newton_iterations, "failure": e.failure or ""}

    def to_dict(
        self,
        *,
        start: dict[str, Any] | None = None,
        best: dict[str, Any] | None = None,
        best_design: np.ndarray | None = None,
        reference: dict[str, Any] | None = None,
        stopped_because: str | None = None,
        verification: dict[str, Any] | None = None,
        seconds: float | None = None,
    ) -> dict[str, Any]:
        """The content of study.json, as far as it is known.

        start, best: their final records; reference: the same with its objective; best_design: internal
        units; all None while the study runs
        """
        p, found = self.problem, self.best()
        first = self.evaluations[0] if self.evaluations else None
        if best_design is None and found is not None:
            best_design = found.design
        return {
            "title": p.scene.title,
            "objective": f"{p.objective} [{p.objective.unit}]",
            "method": self.method,
            "fingerprint": self.fingerprint,
            "design": self._design(best_design),
            "constraints": self._constraints(found),
            "start": _with_objective(start, first),
            "best": _with_objective(best, found),
            "reference": reference,
            "best_is_feasible": found is not None and found.violation(p) <= FEASIBLE,
            "evaluations": len(self.evaluations),
            "gradient_evaluations": sum(e.failure is None for e in self.evaluations),
            "iterations": self._iterations(),
            "stopped_because": stopped_because,
            "verified_on_finer_mesh": verification,
            "cost": {"wall_s": seconds},
            "own_parts": self._own_parts(),
            "versions": versions(),
        }

    def _own_parts(self) -> list[dict[str, str | None]]:
        """What the study needs that is not shipped."""
        return own_parts(self.problem.scene, self.problem.reference, self.problem.measures)

    def _design(self, best: np.ndarray | None) -> dict[str, Any]:
        """The variables with bounds, start and best, in file units."""
        entries = self.problem.entries
        factors = np.array([entry.factor for entry in entries])
        return {
            "names": [entry.name for entry in entries],
            "units": [entry.unit for entry in entries],
            "lower": [entry.lower / entry.factor for entry in entries],
            "upper": [entry.upper / entry.factor for entry in entries],
            "start": (self.problem.start / factors).tolist(),
            "best": None if best is None else (best / factors).tolist(),
        }

    def _constraints(self, best: Evaluation | None) -> list[dict[str, Any]]:
        """The constraints, with the best design's value of each."""
        return [
            {
                "measure": str(c.measure),
                "unit": c.measure.unit,
                "lower": c.lower,
                "upper": c.upper,
                "best": None if best is None else float(best.values[1 + i]),
            }
            for i, c in enumerate(self.problem.constraints)
        ]

    def _iterations(self) -> list[dict[str, Any]]:
        """The rows of iterations.csv with what `optimize.resuming` needs to take them over."""
        return [
            row
            | {
                "design": e.design.tolist(),
                "values": e.values.tolist(),
                "gradients": e.gradients.tolist(),
            }
            for row, e in zip(self.rows(), self.evaluations, strict=True)
        ]


def _with_objective(final: dict[str, Any] | None, evaluation: Evaluation | None) -> dict[str, Any] | None:
    """A final record with the objective in front; None without a record."""
    value = None if evaluation is None or evaluation.failure else float(evaluation.values[0])
    return None if final is None else {"objective": value, **final}
