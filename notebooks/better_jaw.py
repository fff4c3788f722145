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
# # A better jaw
#
# One jaw, its gradient, and a jaw that injures less. To be quick the mesh here is coarse; the shipped
# study, `jaxclamp optimise human-lad-jaw-unbounded`, does the same on a mesh that resolves the jaw, and
# verifies the result on a finer one.

# %%
import numpy as np

import jaxclamp as jc
from optimize import Constraint, DesignProblem, Variable, minimise

COARSE = ["mesh.circumferential=6", "mesh.axial=16", "mesh.radial=[2, 1]", "stop.occlusion=0.9"]
JAW = 'clamp.jaw={shape="spline", half_width_mm=2.0, slopes=[0.3, 0.6, 0.9], edge_radius_mm=1.0}'
scene = jc.load_scene("human-lad", [*COARSE, JAW])
result = jc.clamp(scene)

# %% [markdown]
# A *measure* is one number of the equilibria: here the smooth peak of the axial stress in the media.
# The true peak lies above it; the smooth one follows it without jumping from place to place.

# %%
peak = jc.smooth_peak_axial_stress("media")
true_peak = result.final["peak_axial_stress_kPa"]["media"]
print(f"smooth peak {result.measure(peak):.2f} kPa, true peak {true_peak:.2f} kPa")

# %% [markdown]
# ## The gradient
#
# With respect to the jaw's slopes, through the equilibrium and the occlusion that the jaw has to reach:
# one linear solve, whatever the number of variables. Finite differences agree.

# %%
problem = DesignProblem(
    scene,
    objective=peak,
    variables=(Variable("clamp.jaw.slopes", lower=(0.0, -0.3, -0.3), upper=2.0),),
    constraints=(Constraint(jc.jaw_curvature(), upper=1.0),),
)

# %%
from optimize.evaluator import gradients

_, slopes = gradients(problem, result)
h = 1e-4
for i in range(3):
    step = h * np.eye(3)[i]
    ahead, behind = (
        jc.clamp(problem.scene_at(problem.start + sign * step), guess=result).measure(peak)
        for sign in (1, -1)
    )
    print(
        f"d peak / d slope {i}: {slopes[0, i]:9.5f} kPa, by differences {(ahead - behind) / (2 * h):9.5f} kPa"
    )

# %% [markdown]
# ## The optimum
#
# `minimise` drives the jaw's slopes with SciPy's SLSQP. Each design starts from its neighbour's
# solution; the best one is solved again from scratch. No part of the face is more sharply curved
# than 1 mm, so that it can be machined.

# %%
study = minimise(problem, max_evaluations=10, check_finer_mesh=False)
print(study.stopped_because)
for line in study.lines():
    print(line)

# %%
from optimize.figures import plot_convergence, plot_profiles, plot_stress

plot_profiles(study)

# %%
plot_stress(study)

# %%
plot_convergence(study)
