"""What every test needs: float64 without silent promotion, and repeatable examples."""

import jax
from hypothesis import settings

import jaxclamp  # noqa: F401  (switches JAX to float64)

jax.config.update("jax_numpy_dtype_promotion", "strict")

settings.register_profile("jaxclamp", deadline=None, derandomize=True, max_examples=40)
settings.load_profile("jaxclamp")
