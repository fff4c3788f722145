"""What a design gains over another one, in numbers and in words; objectives may be negative or zero."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

MOST_PERCENT = 10.0
"""shares above this are said as multiples"""


def with_error(value: float, error: float | None, unit: str) -> str:
    """Such as "3 ± 0.4 kPa"; no error where it is not known."""
    return f"{value:.4g}{'' if error is None else f' ± {error:.2g}'} {unit}".rstrip()


@dataclasses.dataclass(frozen=True)
class Gain:
    """How far the objective falls from one design to another, in the objective's unit."""

    start: float
    """objective of the design compared with"""
    best: float
    """objective of the design that is to be better, so lower"""
    unit: str = ""
    """of both"""
    error: float | None = None
    """how far the difference may be off numerically, see `jaxclamp.Estimate`; None if it is not known"""

    @property
    def difference(self) -> float:
        """Start less best: positive if the objective falls."""
        return self.start - self.best

    @property
    def share(self) -> float | None:
        """The difference relative to the size of the start; None if that is 0."""
        if self.start == 0.0:
            return None
        found = self.difference / abs(self.start)
        return found if math.isfinite(found) else None

    @property
    def amount(self) -> str:
        """The size of the difference with its error and unit, such as "3 ± 0.4 kPa"."""
        return with_error(abs(self.difference), self.error, self.unit)

    @property
    def percentage(self) -> str:
        """The size of the share, such as "21.6%"; "" if there is none."""
        if self.share is None:
            return ""
        size = abs(self.share)
        return f"{size:.1%}" if size <= MOST_PERCENT else f"{size:.3g} times its size"

    @property
    def direction(self) -> str:
        """Where the objective goes from start to best."""
        if self.difference == 0.0:
            return "the same"
        return "lower" if self.difference > 0.0 else "higher"

    @property
    def is_within_error(self) -> bool:
        """True if the difference is no more than its error."""
        return self.error is not None and abs(self.difference) <= self.error

    def __str__(self) -> str:
        """Such as "3 kPa lower (60.0%)"."""
        if self.difference == 0.0:
            return self.direction
        share = f" ({self.percentage})" if self.percentage else ""
        return f"{self.amount} {self.direction}{share}{', within its error' if self.is_within_error else ''}"

    def to_dict(self) -> dict[str, Any]:
        """As in study.json."""
        return {"difference": self.difference, "error": self.error, "share": self.share}

    def card(self, other: str) -> tuple[str, str]:
        """A number to print large and the words below it; other: what the start is called."""
        if self.difference == 0.0:
            return "unchanged", f"against {other}"
        below = f"{self.direction} than {other}"
        return self.amount, f"{below} ({self.percentage})" if self.percentage else below
