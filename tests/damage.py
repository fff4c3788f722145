"""Damaged files: what becomes of a sound table or text that was edited, cut, mixed up or overwritten."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase
from hypothesis import strategies as st

MOST_MB, MOST_SECONDS = 200.0, 20.0
"""what handling one damaged file may take beyond the start, on a busy machine"""

REPEATABLE: dict[str, Any] = {
    "derandomize": True,
    "database": None,
    "deadline": None,
    "phases": [Phase.explicit, Phase.generate],
    "suppress_health_check": list(HealthCheck),
}
"""settings of hypothesis: the same damage every time, and none that is searched for"""

NUMBERS = st.one_of(
    st.sampled_from(
        [0, -1, 1, 2**31, -(10**400), 10**400, 0.0, -0.0, 1e-320, 1e308, float("nan"), float("inf")]
    ),
    st.integers(-1000, 1000),
    st.floats(),
)
WORDS = st.one_of(
    st.sampled_from(
        ["", "human-lad", "a.b", "__class__", "nan", "\x00", "ünïcödé 🫀", "x" * 3000, "../../etc"]
    ),
    st.text(max_size=12),
)
JUNK = st.recursive(
    st.one_of(NUMBERS, WORDS, st.booleans()),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.dictionaries(WORDS, inner, max_size=3),
    ),
    max_leaves=6,
) | NUMBERS.map(lambda number: [number] * 250)

TOKENS = [b"[" * 5000, b"{" * 5000, b"a." * 20000, b"\n[[x]]\n", b'"', b"=", b"nan", b"9" * 5000, b"\xff"]
"""what a parser may stumble over"""

Place = tuple[Any, Any]
"""a table or a list, and a key or position in it"""


def places(node: Any) -> Iterator[Place]:
    """Every place below a table or list."""
    for key in node if isinstance(node, dict) else range(len(node)):
        yield node, key
        if isinstance(node[key], dict | list):
            yield from places(node[key])


def edit(draw: Callable[[Any], Any], table: dict[str, Any], junk: Any = JUNK) -> dict[str, Any]:
    """The table with one to three edits: something dropped, renamed, overwritten, nested, repeated."""
    table = copy.deepcopy(table)
    for _ in range(draw(st.integers(1, 3))):
        known = list(places(table))
        if not known:
            break
        owner, key = known[draw(st.integers(0, len(known) - 1))]
        value = owner[key]
        kind = draw(st.sampled_from(["drop", "rename", "junk", "number", "nest", "negate", "repeat", "add"]))
        if kind == "drop":
            del owner[key]
        elif kind == "rename" and isinstance(owner, dict):
            owner[draw(WORDS)] = owner.pop(key)
        elif kind == "number":
            owner[key] = draw(NUMBERS)
        elif kind == "nest":
            owner[key] = draw(st.sampled_from([[value], {"a": value}, [[[value]]], {str(key): value}]))
        elif kind == "negate" and isinstance(value, int | float):
            owner[key] = -value
        elif kind == "repeat" and isinstance(value, list):
            owner[key] = value * draw(st.sampled_from([0, 2, 40]))
        elif kind == "add" and isinstance(value, dict):
            value[draw(WORDS)] = draw(junk)
        else:
            owner[key] = draw(junk)
    return table


def scratch(draw: Callable[[Any], Any], content: bytes) -> bytes:
    """The bytes with one to three cuts, insertions or repetitions anywhere."""
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(content)))
        kind = draw(st.sampled_from(["cut", "end", "noise", "token", "repeat"]))
        if kind == "cut":
            content = content[:at] + content[at + draw(st.integers(1, 60)) :]
        elif kind == "end":
            content = content[:at]
        elif kind == "noise":
            content = content[:at] + draw(st.binary(max_size=40)) + content[at:]
        elif kind == "token":
            content = content[:at] + draw(st.sampled_from(TOKENS)) + content[at:]
        else:
            content = content[:at] + content[max(at - 200, 0) :]
    return content


@contextmanager
def bounded() -> Iterator[None]:
    """Fail if the block takes too long or, where the system tells, more than `MOST_MB` at its peak."""
    start, before = time.monotonic(), _peak_MB(reset=True)
    yield
    assert time.monotonic() - start < MOST_SECONDS
    after = _peak_MB()
    assert before is None or after is None or after - before < MOST_MB


def _peak_MB(reset: bool = False) -> float | None:
    """Largest memory of this process, MB, since the last `reset`."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        status = Path("/proc/self/status").read_text()
    except OSError:
        return None
    return float(status.split("VmHWM:")[1].split()[0]) / 1024.0
