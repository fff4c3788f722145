"""Numbers that others wrote: in a study file, in the study.json of an earlier run."""

from __future__ import annotations

import math
from typing import Any

from jaxclamp import SceneError
from jaxclamp.scenes.schema import shown

MOST = 1e12
"""size up to which bounds and stresses of a study file are taken"""


def finite(value: Any) -> float | None:
    """The value as a float; None if it is no number, not finite, or an integer that no float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        found = float(value)
    except OverflowError:
        return None
    return found if math.isfinite(found) else None


def number(value: Any, path: str, least: float, most: float, what: str = "a number") -> float:
    """A number of a study file from `least` to `most`; path: its key. Raises SceneError."""
    found = finite(value)
    if found is None or not least <= found <= most:
        raise SceneError(f"{path} = {shown(value)}: expected {what} from {least:g} to {most:g}")
    return found
