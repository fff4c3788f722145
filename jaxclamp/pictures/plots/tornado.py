"""Which uncertain number matters most: bars of what one standard deviation of each moves a figure by."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from jaxclamp.pictures.plots.style import AXIAL, CIRCUMFERENTIAL, SMALL, Picture, dress

MOST = 12
"""numbers that are drawn"""


def plot_tornado(parts: Mapping[str, Mapping[str, float]]) -> Picture:
    """Bars by number, the widest on top, a panel for each figure.

    parts: by figure and number, what a standard deviation more of that number adds to the figure
    """
    rows = min(MOST, max(len(each) for each in parts.values()))
    picture = Picture(8.2, len(parts) * (0.34 * rows + 1.0))
    grid = picture.subplots(len(parts), 1, squeeze=False)
    for axes, (figure, each) in zip(grid[:, 0], parts.items(), strict=True):
        ranked = sorted(each, key=lambda key: abs(each[key]), reverse=True)[:MOST]
        places = np.arange(len(ranked))
        sizes = np.array([abs(each[key]) for key in ranked])
        for sign in (1.0, -1.0):
            more = [AXIAL if sign * each[key] > 0.0 else CIRCUMFERENTIAL for key in ranked]
            axes.barh(places, sign * sizes, 0.6, color=more)
        axes.set_yticks(places, ranked, fontsize=SMALL)
        axes.invert_yaxis()
        dress(axes, f"{figure}: change by one standard deviation more (orange) or less (blue)")
    return picture
