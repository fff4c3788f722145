"""Figures of a study: profiles, stress on one scale, convergence, force against travel."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

import jaxclamp as jc
from jaxclamp import Jaw, Measure, Result
from jaxclamp.pictures.fields import LayerFields, contact_along, layer_fields
from jaxclamp.pictures.plots import Plate
from jaxclamp.pictures.plots.maps import (
    frame_of_map,
    half_length_shown,
    highest_through,
    load_free_angles,
    stress_range,
    unrolled,
)
from jaxclamp.pictures.plots.states import path_of
from jaxclamp.pictures.plots.style import (
    AXIAL,
    CIRCUMFERENTIAL,
    FAINT,
    THIRD,
    Picture,
    colour_bar,
    colours,
    dress,
    legend,
    plain,
    stress_colours,
)
from optimize.named_measures import in_words
from optimize.problem import Constraint
from optimize.record import FEASIBLE
from optimize.study import Study

COLOURS = {"reference": FAINT, "start": CIRCUMFERENTIAL, "best": AXIAL}


def shown(study: Study) -> dict[str, Result]:
    """The clamps that a study compares, by name."""
    reference = {} if study.reference is None else {"reference": study.reference}
    return {**reference, "start": study.start, "best": study.best}


def labelled(measure: Measure) -> str:
    """A measure in words with its unit, as the label of an axis or a title."""
    words = in_words(measure)
    return f"{words[:1].upper()}{words[1:]}{f', {measure.unit}' if measure.unit else ''}"


CLIMBS = 1000
"""steps to a face from below: on a slope of 20 each leaves 0.95 of the way"""


def profile(result: Result) -> tuple[np.ndarray, np.ndarray]:
    """The jaw's face along the artery, side to side: z and height above its lowest point, mm.

    A height that no part of the face has is not a number. z is closer together towards the sides, where
    faces rise steeply.
    """
    jaw = result.scene.clamp.jaws[0]
    reach = float(jaw.half_extent())
    z = reach * np.sin(np.linspace(-0.5 * np.pi, 0.5 * np.pi, 401))
    y, gap = map(np.asarray, _climbed(jaw, jnp.asarray(z), jnp.full(z.shape, -reach)))
    return z, np.where(np.abs(gap) < 1e-4 * reach, y, np.nan)


@jax.jit
def _climbed(jaw: Jaw, z: Array, y: Array) -> tuple[Array, Array]:
    """Heights from y (n,) on, raised again and again by the gap that is left at z; and what is left then."""
    gap = lambda up: jaw.gap((jnp.zeros_like(z), up, z))  # noqa: E731
    up = jax.lax.fori_loop(0, CLIMBS, lambda _, up: up + gap(up), y)
    return up, gap(up)


def plot_profiles(study: Study) -> Picture:
    """The faces of the jaws along the artery, to scale, each from side to side and to its top."""
    figure = Picture(7.2, 3.0)
    axes = figure.add_subplot()
    for name, result in shown(study).items():
        axes.plot(*profile(result), color=COLOURS[name], linewidth=2.2 if name == "best" else 1.4, label=name)
    dress(axes, "position along the artery (mm)", "height (mm)", "Face of the upper jaw, to scale")
    axes.set_aspect("equal")
    legend(axes, loc="upper center", ncols=3)
    return figure


def plot_contact(study: Study) -> Picture:
    """Contact pressure along the artery, the highest around it."""
    figure = Picture(6.4, 3.4)
    axes = figure.add_subplot()
    for name, result in shown(study).items():
        z, pressure = contact_along(result.model, result.states[-1].state)
        axes.plot(z, pressure, color=COLOURS[name], linewidth=2.2 if name == "best" else 1.4, label=name)
    reach = max(result.scene.clamp.half_extent() for result in shown(study).values())
    axes.set_xlim(-1.1 * reach, 1.1 * reach)
    dress(axes, "position along the artery (mm)", "highest contact pressure (kPa)")
    axes.set_ylim(bottom=0.0)
    legend(axes)
    return figure


ANGLES, PLACES = 91, 201
"""grid on which stress maps are compared, around and along the artery"""


def _on_a_grid(layer: LayerFields, angles: np.ndarray, reach: float) -> np.ndarray:
    """Highest axial stress through a layer over (place along the artery, angle), (PLACES, ANGLES), kPa."""
    z, value = highest_through(layer)
    places = np.linspace(-reach, reach, PLACES)
    lines = np.stack([np.interp(places, *line) for line in zip(z.T, value.T, strict=True)], axis=1)
    around = np.linspace(0.0, 180.0, ANGLES)
    return np.stack([np.interp(around, angles, line) for line in lines])


def plot_difference(study: Study) -> Picture:
    """Axial stress of the best design less that of the clamp it is compared with, by layer."""
    results = shown(study)
    other = results[study.compared.other]
    pair = [(r, layer_fields(r.model, r.states[-1].state)) for r in (study.best, other)]
    reach = min(half_length_shown(r, layers) for r, layers in pair)
    rows = len(study.best.scene.artery.layers)
    maps = [
        np.subtract(*[_on_a_grid(layers[row], load_free_angles(r, row), reach) for r, layers in pair])
        for row in range(rows)
    ]
    flat = [found.ravel() for found in maps]
    shades = colours(flat, [np.ones_like(found) for found in flat], 5.0)
    size = max(map(abs, shades.limits))
    shades = dataclasses.replace(shades, limits=(-size, size))
    figure = Picture(5.6, 2.7 * rows + 0.3)
    grid = figure.subplots(rows, 1, squeeze=False, sharex=True)
    for row, found in enumerate(maps):
        axes: Axes = grid[row, 0]
        drawn = axes.pcolormesh(
            np.linspace(-reach, reach, PLACES),
            np.linspace(0.0, 180.0, ANGLES),
            found.T,
            cmap="RdBu_r",
            norm=Normalize(*shades.limits),
            shading="gouraud",
            rasterized=True,
        )
        frame_of_map(axes, reach)
        last = row == rows - 1
        name = plain(study.best.scene.artery.layers[row].name)
        dress(
            axes,
            "position along the artery (mm)" if last else "",
            "angle from the fold (deg)",
            f"{name}: best less {study.compared.other}",
            grid=False,
        )
    label = f"difference of axial Cauchy stress (kPa){shades.said('area')}"
    colour_bar(figure, drawn, label, shades.beyond)
    return figure


def plot_stress(study: Study) -> Picture:
    """Axial stress of every layer at the stop, start and best side by side on one scale."""
    results = shown(study)
    layers = {name: layer_fields(r.model, r.states[-1].state) for name, r in results.items()}
    reach = min(half_length_shown(r, layers[name]) for name, r in results.items())
    shades = stress_range([layer for parts in layers.values() for layer in parts], reach)
    scale = ScalarMappable(Normalize(*shades.limits), stress_colours())
    rows = len(next(iter(layers.values())))
    figure = Picture(3.4 * len(results) + 0.8, 2.7 * rows + 0.3)
    grid = figure.subplots(rows, len(results), squeeze=False, sharex=True, sharey=True)
    for column, (name, result) in enumerate(results.items()):
        for row, layer in enumerate(layers[name]):
            axes: Axes = grid[row, column]
            P = row == result.model.marks.P_layer
            unrolled(axes, layer, load_free_angles(result, row), reach, scale, P)
            dress(
                axes,
                "position along the artery (mm)" if row == rows - 1 else "",
                "angle from the fold (deg)" if column == 0 else "",
                f"{name}: {plain(layer.name)}",
                grid=False,
            )
    colour_bar(figure, scale, f"axial Cauchy stress (kPa){shades.said('volume')}", shades.beyond)
    return figure


def plot_convergence(study: Study) -> Picture:
    """Objective of every evaluation, and of the best feasible one so far."""
    figure = Picture(6.4, 3.4)
    axes = figure.add_subplot()
    solved = [(n + 1, e) for n, e in enumerate(study.evaluations) if e.failure is None]
    good = [(n, float(e.values[0])) for n, e in solved if e.violation(study.problem) <= FEASIBLE]
    bad = [(n, float(e.values[0])) for n, e in solved if e.violation(study.problem) > FEASIBLE]
    failed = [n + 1 for n, e in enumerate(study.evaluations) if e.failure is not None]
    if good:
        axes.plot(*np.transpose(good), "o", color=CIRCUMFERENTIAL, markersize=5, label="feasible")
        best = np.minimum.accumulate([value for _, value in good])
        axes.step([n for n, _ in good], best, where="post", color=AXIAL, linewidth=1.8, label="best so far")
    if bad:
        axes.plot(
            *np.transpose(bad), "o", color=CIRCUMFERENTIAL, fillstyle="none", label="violates a constraint"
        )
    values = [value for _, value in good or bad]
    low, high = min(values), max(values[0], float(np.median(values)))
    axes.set_ylim(low - 0.1 * (high - low or 1.0), high + 0.6 * (high - low or 1.0))
    if failed:
        level = np.full(len(failed), axes.get_ylim()[1])
        axes.plot(failed, level, "x", color=THIRD, clip_on=False, label="no equilibrium")
    dress(axes, "evaluation", labelled(study.problem.objective), "What was minimised")
    legend(axes)
    return figure


MOST_LIMITS = 3
"""constraints that are drawn"""


def limits(study: Study) -> list[tuple[int, Constraint]]:
    """The constraints that are of the artery, not of the jaw's shape alone, with their places."""
    shape = jc.jaw_curvature().name, jc.jaw_half_width().name
    every = [(i, c) for i, c in enumerate(study.problem.constraints) if c.measure.name not in shape]
    return every[:MOST_LIMITS]


def plot_limits(study: Study) -> Picture:
    """The objective of every design over what is constrained, the bounds as lines."""
    drawn = limits(study)
    figure = Picture(3.4 * max(len(drawn), 1) + 1.0, 3.5)
    grid = figure.subplots(1, max(len(drawn), 1), squeeze=False, sharey=True)
    solved = [e for e in study.evaluations if e.failure is None]
    for column, (place, c) in enumerate(drawn):
        axes: Axes = grid[0, column]
        for good, fill, label in ((True, "full", "feasible"), (False, "none", "violates a constraint")):
            points = [
                e.values[[1 + place, 0]] for e in solved if good is (e.violation(study.problem) <= FEASIBLE)
            ]
            if points:
                axes.plot(
                    *np.transpose(points),
                    "o",
                    color=CIRCUMFERENTIAL,
                    fillstyle=fill,
                    markersize=4,
                    label=label,
                )
        for number, (bound, _) in enumerate(c.sides):
            axes.axvline(bound, color=THIRD, linewidth=1.2, label="_" if number else "bound")
        for name, result in shown(study).items():
            pair = result.measure(c.measure), result.measure(study.problem.objective)
            axes.plot(*pair, "D", color=COLOURS[name], markersize=7, label=name)
        dress(axes, labelled(c.measure), "" if column else labelled(study.problem.objective))
    if drawn:
        legend(grid[0, 0])
    return figure


def plot_force_travel(study: Study) -> Picture:
    """Force on one jaw against its travel."""
    figure = Picture(5.6, 3.5)
    axes = figure.add_subplot()
    travel, force = "jaw_travel_mm", "clamp_force_N"
    for name, result in shown(study).items():
        path = path_of(result)
        axes.plot(
            [record[travel] for record in path.history],
            [record[force] for record in path.history],
            color=COLOURS[name],
            marker="o",
            markersize=3.5,
            linewidth=1.8,
            label=name if path is result else f"{name}, closing on {path.scene.mesh.words} elements",
        )
        if path is not result:
            axes.plot(result.final[travel], result.final[force], "D", color=COLOURS[name], markersize=6)
    if any(result.coarser is not None for result in shown(study).values()):
        stop = f"at the stop, {study.best.scene.mesh.words} elements"
        axes.plot([], [], "D", color=FAINT, markersize=6, label=stop)
    dress(axes, "travel of each jaw (mm)", "force on one jaw (N)")
    axes.set_ylim(bottom=0.0)
    legend(axes)
    return figure


PLATES = (
    (
        "profiles",
        "The jaws",
        "Faces of the jaws along the artery, symmetric about the middle.",
        plot_profiles,
    ),
    (
        "stress",
        "Axial stress at the stop",
        "Each layer unrolled, with the highest axial Cauchy stress through its thickness, on one colour "
        "scale; crosses mark the highest of all. Arrows on the bar: a small part of a layer has stresses "
        "beyond the colours.",
        plot_stress,
    ),
    (
        "contact_pressure",
        "Contact pressure",
        "The highest pressure of a jaw on the wall around the artery, for each ring of elements along it, "
        "at the points where contact is integrated.",
        plot_contact,
    ),
    (
        "stress_difference",
        "What changes in the wall",
        "Highest axial Cauchy stress through each layer, unrolled: the best design less the clamp it is "
        "compared with. Blue: less stress.",
        plot_difference,
    ),
    (
        "convergence",
        "Convergence",
        "The objective of every design that was solved. Far outliers of the line search are cut off.",
        plot_convergence,
    ),
    (
        "limits",
        "Objective against what is constrained",
        "Every design that was solved: what was minimised over what has a bound, which is the line.",
        plot_limits,
    ),
    (
        "force_travel",
        "Force",
        "Force on one jaw against the travel of each jaw. Where jaws close on a coarser mesh, the curve "
        "is that mesh's alone, and the mark beside its end is of the study's.",
        plot_force_travel,
    ),
)


def figures(study: Study) -> Iterator[Plate]:
    """All figures of a study."""
    for name, title, caption, draw in PLATES:
        if draw is plot_limits and not limits(study):
            continue
        yield Plate(name, title, caption, draw(study))
