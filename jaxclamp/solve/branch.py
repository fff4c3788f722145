"""Which equilibrium: the one on the way of a jaw that closes steadily, or another one.

A clamped wall may have several stable equilibria at the same stop (its middle pressed flat, or bulged off the
jaw), and Newton's method may jump from one to another. On a continuous path of equilibria the energy of
wall, blood and contact rises by the work of the jaws and by nothing else. A snap loses energy, as real ones
do; a jump to where no closing jaw leads gains it. So each step is held to its balance of energy and work.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from jaxclamp.core.failures import NotConverged
from jaxclamp.solve.newton import Equilibrium, Step
from jaxclamp.solve.stops import Held

KINK = 0.1
"""energy beyond the jaws' work that a step may show, over stiffness times travel squared: one kink of the
force, wherever in the step, makes the rule of `work` miss at most 1/12; jumps made 0.9 and 1.7 where they
were seen"""
ROUNDING = 1e-9
"""share of the energy that is not told from none"""
BACK = 1e-6
"""a jaw that is higher by this part of its travel than it was has gone back"""

CLOSING_PATH = "closing path"
AFTER_A_SNAP = "closing path, after a snap"
FOLLOWED = "followed from a neighbour's equilibrium, not closed anew"
ANOTHER = "another equilibrium"
"""how `solver.branch` in results begins where the answer is not on the way of a closing jaw"""


def work(a: Equilibrium, b: Equilibrium) -> float:
    """Work of the jaws from one equilibrium to the next, mN mm.

    The force is integrated over the travel with its slopes at both ends (Hermite, fourth order):
    W = h/2 (F0 + F1) + h**2/12 (F0' - F1').
    """
    down = float(a.state.jaw_height) - float(b.state.jaw_height)
    forces = float(a.lin.jaw_force) + float(b.lin.jaw_force)
    return down / 2.0 * forces + down**2 / 12.0 * (b.force_slope - a.force_slope)


def gain(a: Equilibrium, b: Equilibrium) -> float:
    """Energy that a step gains beyond the jaws' work, over stiffness times travel squared; see `KINK`."""
    change = float(b.lin.energy) - float(a.lin.energy)
    down = float(a.state.jaw_height) - float(b.state.jaw_height)
    scale = down**2 * max(abs(a.force_slope), abs(b.force_slope))
    rounding = ROUNDING * max(abs(float(e.lin.energy)) for e in (a, b))
    return (change - work(a, b)) / (scale + rounding / KINK + 1e-300)


def require_same_path(step: Step, before: Equilibrium, found: Equilibrium) -> None:
    """Refuse an equilibrium that a closing jaw does not come to from the one before. Raises NotConverged."""
    if abs(gain(before, found)) > KINK:
        raise NotConverged("the way of the closing jaw ends, or was lost")
    if isinstance(step.closing, Held) and found.negative_pivots:
        raise NotConverged("lost stability")


def branch_of(closing: Sequence[Equilibrium]) -> str:
    """What the last of the equilibria from first contact on is, in one sentence."""
    jumps = [gain(a, b) for a, b in pairwise(closing)]
    unstable = any(e.negative_pivots for e in closing)
    snapped = any(jump < -KINK for jump in jumps)
    heights = [float(e.state.jaw_height) for e in closing]
    went_back = heights[-1] - min(heights) > BACK * (heights[0] - min(heights))
    if closing[-1].negative_pivots:
        return f"{ANOTHER}: unstable, the wall would snap away from it under jaws that are held"
    if any(jump > KINK for jump in jumps):
        return f"{ANOTHER}: on the way here the wall gained energy that no jaw brought"
    if went_back and (snapped or unstable):
        return f"{ANOTHER}: closing jaws snap past it, and it was found on the way back"
    if unstable and not snapped:
        return f"{ANOTHER}: closing jaws lose stability before they come here"
    return AFTER_A_SNAP if snapped else CLOSING_PATH
