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
# # A first clamping
#
# A human coronary artery between two rigid cylinders, closed until the lumen has lost 92.5 % of its
# height: the study of Gasser, Schulze-Bauer and Holzapfel (J Biomech Eng 124, 2002), from
# stress-free layers to the clamped artery in a few seconds.

# %%
import jaxclamp as jc

scene = jc.load_scene("human-lad")
print(jc.dump_scene(scene))

# %% [markdown]
# `clamp` goes the whole way: it closes the opened-up layers (which leaves residual stress), stretches
# and inflates the artery, and moves the jaws to the stop. It returns every converged state.

# %%
result = jc.clamp(scene)
summary = result.to_dict()
print(
    f"{len(result.states)} states in {summary['cost']['wall_s']:.1f} s, of which compilation "
    f"{summary['cost']['compile_s']:.1f} s"
)

# %% [markdown]
# ## Against the study
#
# Where the study gives a number, it stands beside ours. P is the inner surface of the media under
# the middle of the jaw.

# %%
final, body = result.final, summary["physiological"]
rows = [
    ("lumen radius in the body (mm)", body["lumen_radius_mm"], "2.52"),
    ("lumen height at the stop (mm)", final["lumen_height_mm"], "0.378"),
    ("lumen width at the stop (mm)", final["lumen_width_mm"], "5.983"),
    ("axial stress at P, over that in the body", final["axial_stress_ratio_at_P"], "about 4"),
    (
        "circumferential stress at P, over that in the body",
        final["circumferential_stress_ratio_at_P"],
        "falls",
    ),
    ("force on one jaw (N)", final["clamp_force_N"], "not given"),
]
print(f"{'':52s}{'here':>8s}   study")
for name, value, study in rows:
    print(f"{name:52s}{value:8.3f}   {study}")

# %% [markdown]
# ## Figures
#
# Residual stress makes the stress in the body nearly even through each layer.

# %%
result.plot_wall_stress()

# %%
result.plot_sections()

# %% [markdown]
# As the jaws close, the axial stress at P rises to several times its value in the body, while the
# circumferential stress falls: the media is pulled along the artery, a direction it is not made for.

# %%
result.plot_stress_at_P()

# %%
result.plot_axial_stress_maps()

# %%
result.plot_force_travel()

# %% [markdown]
# ## Another jaw
#
# The jaw is data: `replace` gives a scene with another radius. The first result serves as the
# starting point, so that a neighbouring design costs a fraction of the Newton iterations of a whole
# clamping.

# %%
wider = jc.replace(scene, "clamp.jaw.radius", 4.0)
again = jc.clamp(wider, guess=result)
iterations = [r.to_dict()["solver"]["newton_iterations"] for r in (result, again)]
print(f"Newton iterations: {iterations[0]} from the start, {iterations[1]} from the neighbour")
for radius, r in ((3.0, result), (4.0, again)):
    ratio, force = r.final["axial_stress_ratio_at_P"], r.final["clamp_force_N"]
    print(
        f"radius {radius} mm: axial stress at P {ratio:.2f} times that in the body, jaw force {force:.3f} N"
    )

# %% [markdown]
# A wider cylinder bends the wall less sharply: less axial stress at P, at the price of a higher force.
