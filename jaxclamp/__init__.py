"""jaxclamp: a differentiable mechanics engine for the design of arterial clamps.

Importing the package switches JAX to 64-bit floats: stresses near incompressibility need them.
"""

import jax

jax.config.update("jax_enable_x64", True)

from jaxclamp.clamping import Progress, Result, clamp  # noqa: E402
from jaxclamp.equilibrium import EquilibriumError  # noqa: E402
from jaxclamp.scene import Scene, replace  # noqa: E402
from jaxclamp.scene_file import SceneError, dump_scene, load_scene  # noqa: E402

__all__ = [
    "EquilibriumError",
    "Progress",
    "Result",
    "Scene",
    "SceneError",
    "clamp",
    "dump_scene",
    "load_scene",
    "replace",
]
