"""What figures need of a result, and the states they pick from it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from jaxclamp.pictures.fields import spread
from jaxclamp.pictures.plots.style import letters
from jaxclamp.potential.energy import State
from jaxclamp.potential.model import Model
from jaxclamp.scenes.scene import Scene

SHOWN = 6
"""states A to F"""


class KeptState(Protocol):
    """One converged state."""

    @property
    def state(self) -> State: ...
    @property
    def values(self) -> dict[str, Any]: ...
    @property
    def model(self) -> Model: ...


class Clamped(Protocol):
    """A clamping's result, as far as figures are concerned."""

    @property
    def model(self) -> Model: ...
    @property
    def scene(self) -> Scene: ...
    @property
    def load_free(self) -> KeptState | None: ...
    @property
    def physiological(self) -> KeptState | None: ...
    @property
    def closing(self) -> Sequence[KeptState]: ...
    @property
    def history(self) -> list[dict[str, Any]]: ...
    @property
    def converged(self) -> bool: ...
    @property
    def coarser(self) -> Clamped | None: ...
    def in_body_like(self, kept: Any, /) -> KeptState | None: ...


def shown_states(result: Clamped) -> dict[str, int]:
    """Letter -> place in `closing`, from the body (A) to the last state, evenly spread over the travel."""
    if not result.history:
        raise ValueError("the artery in the body did not converge: there is no closing to draw")
    places = spread([record["jaw_travel_mm"] for record in result.history], SHOWN)
    return dict(zip(letters(len(places)), places, strict=True))


def path_of(result: Clamped) -> Clamped:
    """The result, or that on the coarser mesh on which its closing path was walked: all of one mesh."""
    return result if result.coarser is None else path_of(result.coarser)


def meshes_of(result: Clamped, marked: dict[str, int]) -> tuple[str, str] | None:
    """Letters and elements of the states on the result's own mesh, and elements of the closing path.

    None if they are the same. marked: from `shown_states`
    """
    path = path_of(result)
    if path is result:
        return None
    own = [letter for letter, place in marked.items() if result.closing[place].model is result.model]
    own_words, path_words = (f"{r.scene.mesh.words} elements" for r in (result, path))
    return f"{', '.join(own)}: {own_words}", path_words


def final_state(result: Clamped) -> KeptState:
    """The last converged state from the physiological one on."""
    if not result.closing:
        raise ValueError("the artery in the body did not converge: there is no clamped state to draw")
    return result.closing[-1]
