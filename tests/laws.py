"""Every material law, with random constants and in each of its choices, for tests that run over all."""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from jaxclamp.core.records import concrete_subclasses
from jaxclamp.physics.materials import Material

SPAN = {"kPa": (0.5, 50.0), "": (0.05, 4.0), "deg": (0.2, 1.3), "mm": (0.5, 5.0)}
"""values to draw from for a constant of each unit (radians), inside its own range"""


def example(kind: type[Material], seed: int = 0, **chosen) -> Material:
    """A law with random constants, read off its fields."""
    random = np.random.default_rng(seed)
    values = {}
    for field in dataclasses.fields(kind):
        if "range" in field.metadata:
            low, high = SPAN[field.metadata["range"].unit]
            values[field.name] = jnp.asarray(random.uniform(low, min(high, field.metadata["range"].upper)))
    return kind(**(values | chosen))


def choices(kind: type[Material]) -> list[dict[str, str]]:
    """All combinations of a law's static choices."""
    fields = [f for f in dataclasses.fields(kind) if f.metadata.get("choices")]
    names = [f.name for f in fields]
    return [
        dict(zip(names, picked, strict=True))
        for picked in itertools.product(*[f.metadata["choices"] for f in fields])
    ]


VARIANTS = [(kind, picked) for kind in concrete_subclasses(Material) for picked in choices(kind)]
LAWS = [example(kind, **picked) for kind, picked in VARIANTS]
NAMES = ["-".join([kind.__name__, *picked.values()]) for kind, picked in VARIANTS]
every_law = pytest.mark.parametrize("law", LAWS, ids=NAMES)
