"""Overrides such as "clamp.jaw.radius_mm=1.5": one value of a scene's table changed before it is read."""

from __future__ import annotations

import re
from itertools import pairwise
from typing import Any

from jaxclamp.core.failures import BadAddress, BadKey, SceneError
from jaxclamp.core.records import concrete_subclasses
from jaxclamp.scenes import schema
from jaxclamp.scenes.address import Step, steps
from jaxclamp.scenes.scene import Stop
from jaxclamp.scenes.toml import parsed
from jaxclamp.scenes.wording import did_you_mean, shortened


def apply_override(table: dict[str, Any], override: str, source: str) -> None:
    """Change one value of `table`, as "KEY=VALUE" says; `source` names the scene in refusals.

    Tables that are not there yet are made. Raises SceneError for what is no override or leads nowhere.
    """
    address, equals, text = override.partition("=")
    said = f"{source}: override {schema.shown(override)}"
    try:
        path = steps(address.strip())
    except BadAddress:
        path = ()
    if not equals or not path:
        raise SceneError(f"{said}: expected KEY=VALUE such as artery.layers[0].material.c_kPa=30")
    value = _value(text.strip(), said)
    place = f"{said}: {shortened(address.strip())}"
    node: Any = table
    for step, following in pairwise(path):
        if isinstance(step, str) and isinstance(node, dict) and isinstance(following, str):
            node.setdefault(step, {})
        node = _inside(node, step, place)
    last = path[-1]
    if isinstance(node, dict) and isinstance(last, str):
        if len(path) == 2:
            _push_out(node, _alternatives(path[0]), last)
        node[last] = value
    else:
        _inside(node, last, place)
        node[last] = value


def _alternatives(section: Step) -> list[set[str]]:
    """Sets of keys that go together: a key that is brought in pushes out those that are in none with it."""
    if section == "stop":
        return [set(schema.fields_by_key(stop)) for stop in concrete_subclasses(Stop)]
    return [{"jaw"}, {"upper", "lower"}] if section == "clamp" else []


def _push_out(node: dict[str, Any], alternatives: list[set[str]], key: str) -> None:
    together = set().union(*(keys for keys in alternatives if key in keys))
    if together:
        for other in set().union(*alternatives) - together:
            node.pop(other, None)


def _inside(node: Any, step: Step, place: str) -> Any:
    """The value of `node` at `step`; SceneError if it has none."""
    if isinstance(step, int) and isinstance(node, list) and step < len(node):
        return node[step]
    if isinstance(step, str) and isinstance(node, dict) and step in node:
        return node[step]
    if isinstance(node, dict):
        known = [schema.bare(key) for key in node]
        raise SceneError(f"{place} does not exist; {did_you_mean(str(step), known)}")
    if isinstance(node, list):
        raise SceneError(f"{place} does not exist: expected a position from [0] to [{len(node) - 1}]")
    where = shortened(f"[{step}]" if isinstance(step, int) else repr(step))
    raise SceneError(f"{place} does not exist: {where} is asked of {schema.shown(node)}")


def _value(text: str, said: str) -> Any:
    """A TOML value; a bare word is a string."""
    try:
        table = parsed(f"value = {text}")
        if table.keys() == {"value"}:
            return table["value"]
    except BadKey:
        if re.fullmatch(r"\w[\w.+-]*", text):
            return text
    raise SceneError(f'{said}: expected a number, a word, a "text", a [list] or a {{ table }} after the =')
