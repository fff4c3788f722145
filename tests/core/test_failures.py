"""Failures travel between processes: by cloudpickle, and out of a pool of processes."""

from __future__ import annotations

import multiprocessing
import pickle
from types import SimpleNamespace

import cloudpickle
import pytest

from jaxclamp.core import failures
from jaxclamp.core.failures import EquilibriumError, Failure, NotConverged

HISTORY = [{"stage": "physiological", "J_min": 0.9, "peak_axial_stress_kPa": {"media": 1.0}}]


def not_converged(with_states: bool) -> EquilibriumError:
    error = EquilibriumError("clamping", "at 2 mm", NotConverged("cut", 1.0, 0.5), "refine the mesh")
    if with_states:  # a result has arrays, and no process is sent them
        error.result = SimpleNamespace(history=HISTORY, factors=(each for each in ()))
    return error


def every_failure() -> list[Failure]:
    """One of each kind."""
    kinds = [kind for kind in vars(failures).values() if isinstance(kind, type) and issubclass(kind, Failure)]
    plain = [kind("one sentence") for kind in kinds if kind is not EquilibriumError]
    assert len(plain) > 10
    return [*plain, not_converged(False), not_converged(True)]


def parts(error: Failure) -> tuple:
    """What has to arrive."""
    numbers = [repr(getattr(error, name, None)) for name in ("residual", "J_min", "stage", "advice")]
    return type(error), str(error), error.exit_code, numbers, getattr(error, "history", None)


def fail(error: Failure) -> None:
    raise error


@pytest.mark.parametrize("pickles", [pickle, cloudpickle])
def test_they_pickle(pickles):
    for error in every_failure():
        again = pickles.loads(pickles.dumps(error))
        assert parts(again) == parts(error)
        assert parts(pickles.loads(pickles.dumps(again))) == parts(error)  # and further


def test_they_come_out_of_a_pool():
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        for error in every_failure():
            with pytest.raises(Failure) as caught:
                pool.apply(fail, (error,))
            assert parts(caught.value) == parts(error)
    assert caught.value.history == HISTORY
    assert caught.value.result is None
