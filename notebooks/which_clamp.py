# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Which clamp?
#
# The study of 2002 ended with three questions: which of the clamps at hand spares an artery most, how
# narrow a jaw may be, and how the force to close differs from clamp to clamp. Here they are asked of the
# artery of that study, on coarse meshes to be quick. `jaxclamp compare` and `jaxclamp optimise human-lad-
# narrowest` ask them on meshes that resolve the jaws, with errors that say what to believe.
#
# The clamps below are in the *style* of those that surgeons hold; no source has their dimensions, so that
# the numbers are illustrative. Measure yours (`shape = "measured"`), or give a file of its profile.

# %%
from optimize.comparison import asked_clamps, compare, lines, ranking

COARSE = ["mesh.circumferential=8", "mesh.axial=12", "mesh.radial=[3, 2]"]
CLAMPS = "cylinder-3mm,flat-2mm,bulldog-like,cooley-like"

asked = asked_clamps("human-lad", CLAMPS, COARSE, "draft")
rank_by, measure = ranking("smooth_peak_axial_stress_kPa", ("media", "adventitia"))
found = compare(asked, rank_by, measure, processes=1)

# %% [markdown]
# ## 1. Which one spares the wall?
#
# By the peak of the axial stress in the media, at 92.5 % occlusion. A rank that is shared (=) means that
# the numbers do not say which of the clamps is better: their difference is within its error.

# %%
print("\n".join(lines(found)))

# %%
from jaxclamp.pictures.plots.maps import plot_axial_stress_side_by_side, plot_damage_side_by_side

reached = {each.asked.name: each.at_stop for each in found.clamps if each.at_stop is not None}
plot_axial_stress_side_by_side(reached)

# %% [markdown]
# Another measure may rank them otherwise: here the damage that a law of the wall's strain energy would
# make of it.

# %%
plot_damage_side_by_side(reached)

# %% [markdown]
# ## 2. How narrow may a jaw be?
#
# A flat jaw as narrow as can be whose peak is no higher than the cylinder's. Width and edges may change.

# %%
import jaxclamp as jc
from optimize import Constraint, DesignProblem, Variable, minimise

cylinder = jc.load_scene("human-lad", [*COARSE, "clamp.jaw=cylinder-3mm"], "draft")
FLAT = 'clamp.jaw={shape="flat", half_width_mm=1.0, edge_radius_mm=1.5}'
problem = DesignProblem(
    jc.load_scene("human-lad", [*COARSE, FLAT], "draft"),
    objective=jc.jaw_half_width(),
    variables=(
        Variable("clamp.jaw.half_width", lower=0.05, upper=3.0),
        Variable("clamp.jaw.edge_radius", lower=0.5, upper=3.0),
    ),
    constraints=(Constraint(measure, upper=1.0, relative=True),),
    reference=cylinder,
)
study = minimise(problem, max_evaluations=12)
for line in study.lines():
    print(line)

# %% [markdown]
# Width against peak, for every jaw that was tried:

# %%
from optimize.figures import plot_limits, plot_profiles

plot_limits(study)

# %%
plot_profiles(study)

# %% [markdown]
# ## 3. What does the hand feel?
#
# Force against travel of each jaw, to the closed lumen (mark) and on to one force for all. A clamp whose
# curve rises steeply past the mark can be felt to close.

# %%
from optimize.comparison_report import plot_forces

plot_forces(found)
