"""TOML text to a table, at a cost that is in proportion to the text."""

from __future__ import annotations

import re
import tomllib
from typing import Any

from jaxclamp.core.failures import BadKey

MOST_PARTS = 32
"""parts of a dotted key: the parser's time and memory grow with the square of their number"""

_PART = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_PART}(?:\.[ \t]*+{_PART}){{{MOST_PARTS}}}")


def parsed(text: str) -> dict[str, Any]:
    """The table that a TOML text describes. Raises BadKey for what is none."""
    long = _LONG_KEY.search(text)
    if long is not None:
        line = text.count("\n", 0, long.start()) + 1
        raise BadKey(f"line {line} has a key of more than {MOST_PARTS} parts")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadKey(f"not valid TOML: {' '.join(str(error).split())}") from None
