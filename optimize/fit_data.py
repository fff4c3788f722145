"""Test data from CSV files: columns in internal units, and one sentence for whatever is wrong with a file."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxclamp import SceneError
from jaxclamp.scenes.wording import shortened
from optimize.fit_header import LAYER, Header, meant, understood

LARGEST_FILE = 20_000_000
"""bytes"""
MOST_ROWS = 20_000
"""of a file: means of a cycle or every tenth reading say as much"""
POSITIVE = ("inner_radius", "outer_radius", "wall_thickness", "axial_stretch", "circumferential_stretch")
"""quantities that are above 0"""


@dataclasses.dataclass(frozen=True)
class Column:
    """One measured quantity."""

    name: str
    """as the file heads it"""
    quantity: str
    """such as outer_radius"""
    unit: str
    """in which the file has it"""
    factor: float
    """internal units of the quantity in one of the file's"""
    values: np.ndarray
    """(n,), internal units (mm, kPa, mN); not a number where the cell is empty"""
    deviation: np.ndarray | None = None
    """standard deviations (n,), internal units"""


@dataclasses.dataclass(frozen=True)
class Data:
    """What one file holds."""

    source: str
    """name of the file"""
    rows: int
    """number of rows"""
    columns: Mapping[str, Column]
    """by quantity"""
    layers: tuple[str, ...]
    """names from the column `layer`, one for each row; none without that column"""
    ignored: tuple[str, ...]
    """headers that say nothing here"""
    heads: tuple[str, ...] = ()
    """all headers, as written"""

    def lacks(self, *quantities: str) -> bool:
        """True if none of the quantities is there."""
        return not any(quantity in self.columns for quantity in quantities)


def load_data(path: str | Path, renamed: Mapping[str, str] | None = None) -> Data:
    """Read a CSV file; `renamed` gives columns of the file another header. Raises SceneError."""
    return loads_data(_text(Path(path)), str(path), renamed)


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise SceneError(f"{path}: expected a CSV file of at most {LARGEST_FILE // 1_000_000} MB")
        return path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise SceneError(f"{path}: there is no such file") from None
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: expected UTF-8 text, found another byte at {error.start}") from None
    except (OSError, ValueError) as error:
        raise SceneError(f"{path}: the file cannot be read: {getattr(error, 'strerror', error)}") from None


def loads_data(text: str, source: str = "data", renamed: Mapping[str, str] | None = None) -> Data:
    """The data in a CSV text; `source` names it in errors. Raises SceneError."""
    lines = _lines(text, source)
    if len(lines) < 2:
        raise SceneError(f"{source}: expected a line of headers and lines of numbers below it")
    at, heads = lines[0]
    headers, layer, ignored = _headers(heads, f"{source}, line {at}", renamed or {})
    _check_lengths(lines, len(heads), source)
    found = {place: _numbers(lines[1:], place, heads[place], source) for place in headers}
    columns = _columns(headers, heads, found, source)
    names = () if layer is None else tuple(line[layer].strip() for _, line in lines[1:])
    data = Data(source, len(lines) - 1, columns, names, tuple(ignored), tuple(h.strip() for h in heads))
    _check_signs(data, [number for number, _ in lines[1:]])
    return data


def _lines(text: str, source: str) -> list[tuple[int, list[str]]]:
    """Cells of every line with its number, without blank lines and those that begin with #."""
    first = next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
    separator = next((mark for mark in (",", ";", "\t") if mark in first), ",")
    reader = csv.reader(io.StringIO(text), delimiter=separator)
    found = []
    try:
        for cells in reader:
            if any(cell.strip() for cell in cells) and not cells[0].startswith("#"):
                found.append((reader.line_num, cells))
            if len(found) > MOST_ROWS + 1:
                raise SceneError(f"{source}, line {reader.line_num}: expected at most {MOST_ROWS} rows")
    except csv.Error as error:
        raise SceneError(f"{source}, line {reader.line_num}: not valid CSV: {error}") from None
    return found


def _headers(
    heads: list[str], where: str, renamed: Mapping[str, str]
) -> tuple[dict[int, Header], int | None, list[str]]:
    """What each column is, by position; the position of `layer`; the headers that are left out."""
    headers: dict[int, Header] = {}
    layer, ignored = None, []
    for place, head in enumerate(heads):
        word = renamed.get(head.strip(), head)
        if word.strip().lower() == LAYER:
            layer = place
            continue
        found = understood(word)
        if isinstance(found, str):
            raise SceneError(f"{where}, column {shortened(head.strip())!r}: {found}")
        if found is None:
            ignored.append(head.strip() + meant(word.strip()))
            continue
        twin = next((heads[p] for p, other in headers.items() if _same(other, found)), None)
        if twin is not None:
            said = f"{found.meaning.quantity.replace('_', ' ')} once, it is in {twin.strip()!r} as well"
            raise SceneError(f"{where}, column {shortened(head.strip())!r}: expected {said}")
        headers[place] = found
    if not headers:
        raise SceneError(
            f"{where}: no column is known; expected headers such as pressure_mmHg, outer_radius_mm"
        )
    return headers, layer, ignored


def _same(a: Header, b: Header) -> bool:
    return (a.meaning.quantity, a.deviation) == (b.meaning.quantity, b.deviation)


def _check_lengths(lines: Sequence[tuple[int, list[str]]], count: int, source: str) -> None:
    for number, cells in lines:
        if len(cells) != count:
            raise SceneError(
                f"{source}, line {number}: expected {count} cells as in the headers, found {len(cells)}"
            )


def _numbers(lines: Sequence[tuple[int, list[str]]], place: int, head: str, source: str) -> np.ndarray:
    values = np.full(len(lines), np.nan)
    for row, (number, cells) in enumerate(lines):
        cell = cells[place].strip()
        if not cell:
            continue
        try:
            values[row] = float(cell)
        except ValueError:
            values[row] = np.nan
        if not np.isfinite(values[row]):
            where = f"{source}, line {number}, column {shortened(head.strip())!r}"
            raise SceneError(f"{where}: expected a number, found {shortened(cell)!r}")
    return values


def _columns(
    headers: Mapping[int, Header], heads: list[str], found: Mapping[int, np.ndarray], source: str
) -> dict[str, Column]:
    """Measured columns with their deviations, by quantity."""
    deviations = {h.meaning.quantity: p for p, h in headers.items() if h.deviation}
    columns = {}
    for place, header in headers.items():
        quantity = header.meaning.quantity
        if header.deviation:
            continue
        beside = deviations.pop(quantity, None)
        deviation = None if beside is None else found[beside] * headers[beside].factor
        columns[quantity] = Column(
            heads[place].strip(),
            quantity,
            header.unit,
            header.factor,
            found[place] * header.factor,
            deviation,
        )
    if deviations:
        head = heads[next(iter(deviations.values()))].strip()
        raise SceneError(f"{source}: column {head!r} has deviations of what no other column has")
    return columns


def _check_signs(data: Data, numbers: Sequence[int]) -> None:
    """Lengths and stretches are above 0, and so are deviations wherever there is a value."""
    for column in data.columns.values():
        where = f"column {column.name!r}"
        if column.quantity in POSITIVE and np.any(bad := column.values <= 0.0):
            line = numbers[int(np.argmax(bad))]
            raise SceneError(f"{data.source}, line {line}, {where}: expected a number above 0")
        if column.deviation is None:
            continue
        bad = ~np.isnan(column.values) & ~(column.deviation > 0.0)
        if np.any(bad):
            line = numbers[int(np.argmax(bad))]
            raise SceneError(
                f"{data.source}, line {line}, {where}: expected a standard deviation above 0 beside it"
            )
