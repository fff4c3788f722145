"""A process that solves on ever new meshes does not run out of memory mappings."""

import sys

import jax
import jax.numpy as jnp
import pytest

from jaxclamp.core import programs

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="the system does not tell")


@LINUX
def test_programs_are_dropped_where_there_are_too_many(monkeypatch):
    compiled = jax.jit(lambda x: 2.0 * x)
    compiled(jnp.ones(3))
    assert compiled._cache_size() == 1
    assert not programs.forget_if_crowded()
    assert compiled._cache_size() == 1
    monkeypatch.setattr(programs, "MOST_MAPPINGS", 10)
    assert programs.forget_if_crowded()
    assert compiled._cache_size() == 0
    assert compiled(jnp.ones(3)).tolist() == [2.0] * 3
