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
# # Your own jaw, law and measure
#
# A jaw, a material law and a measure that jaxclamp does not have, written outside of the package. Each is a
# record with its numbers and its one function; stresses, forces and derivatives follow by automatic
# differentiation. The mesh here is coarse, to be quick.

# %%
import jax
import jax.numpy as jnp

import jaxclamp as jc

# %% [markdown]
# ## A jaw
#
# A blunt wedge. `gap(point)` is the signed distance of a point $(x, y, z)$ from the face, in mm: zero on the
# face with a gradient of length one there, positive outside, negative inside the jaw, which lies above
# $y = h(z)$.
# `half_extent` and `curvatures` help with meshes and warnings.
#
# A `quantity` has a unit, a range and a derivative; the `static` text is the name in scene files.


# %%
@jc.record
class Wedge(jc.Jaw):
    """y = h(z): a hyperbola of a given radius at its tip, whose sides rise to a given slope."""

    shape: str = jc.static("wedge")
    tip_radius: jax.Array = jc.quantity("mm", 0.0, 1e3, open_lower=True)
    slope: jax.Array = jc.quantity("", 0.0, 20.0, open_lower=True)
    half_width: jax.Array = jc.quantity("mm", 0.0, 1e3, open_lower=True)

    def gap(self, point):
        tip = self.slope * self.tip_radius
        root = jnp.sqrt(point[2] ** 2 + tip**2)
        height, rise = self.slope * (root - tip), self.slope * point[2] / root
        return (height - point[1]) / jnp.sqrt(1.0 + rise**2)

    def half_extent(self):
        return jnp.asarray(self.half_width)

    def curvatures(self):
        return jnp.reshape(1.0 / self.tip_radius, 1)


# %% [markdown]
# ## A law
#
# Demiray's isotropic exponential law (J Biomech 5, 1972): $\bar\psi = \frac{c}{2 b}
# \left(e^{b (\bar I_1 - 3)} - 1\right)$. A law of invariants is a `FibreLaw`, here without fibres; any other
# one is a `Material` with `psi_bar(F)`.


# %%
@jc.record
class Demiray(jc.FibreLaw):
    """An exponential of the first invariant."""

    law: str = jc.static("demiray")
    c: jax.Array = jc.quantity("kPa", 1e-6, 1e9)
    b: jax.Array = jc.quantity("", 1e-6, 1e4)
    bulk: jax.Array = jc.quantity("kPa", 1e-3, 1e12)

    def directions(self):
        return ()

    def psi_of(self, I1, J, I4):
        return self.c / (2.0 * self.b) * jnp.expm1(self.b * (J ** (-2.0 / 3.0) * I1 - 3.0))


# %% [markdown]
# ## A measure
#
# Media of older femoral arteries begin to be damaged at an axial stretch of about 1.27 (Anttila et al., Acta
# Biomater 90, 2019). So: the greatest axial stretch of a layer at the stop, as a smooth maximum that can be
# differentiated.


# %%
def stretch_of(equilibria, layer):
    F = jc.deformation_gradient(equilibria, layer)
    return jc.smooth_maximum(jnp.sqrt(jnp.sum(F[:, 2] ** 2, axis=0)), jc.volumes(equilibria, layer))


def peak_axial_stretch(layer: str) -> jc.Measure:
    """Smooth maximum of the axial stretch in a layer at the stop."""
    return jc.Measure("peak_axial_stretch", "", stretch_of, (layer,))


# %% [markdown]
# ## A clamping with all three
#
# Scene files can name them from now on, in this notebook, and overrides too.

# %%
coarse = ["mesh.circumferential=4", "mesh.axial=8", "mesh.radial=[1, 1]", "stop.occlusion=0.6"]
wedge = 'clamp.jaw={shape="wedge", tip_radius_mm=2.0, slope=2.0, half_width_mm=2.5}'
law = 'artery.layers[1].material={law="demiray", c_kPa=10.0, b=2.0, bulk_kPa=1e4}'
scene = jc.load_scene("human-lad", [*coarse, wedge, law])
result = jc.clamp(scene)
stretch = peak_axial_stretch("media")
print(f"axial stretch in the body {scene.artery.axial_stretch}, at the stop {result.measure(stretch):.4f}")
print(f"force on a jaw {result.final['clamp_force_N']:.4f} N")

# %% [markdown]
# ## Its derivatives
#
# By the wedge's radius and the law's constants, with one linear solve; a finite difference agrees.

# %%
paths = ("clamp.jaw.tip_radius", "clamp.jaw.slope", "artery.layers[1].material.b")
(value,), (slopes,) = jc.gradients(result, (stretch,), paths=paths)
for path, slope in zip(paths, slopes, strict=True):
    print(f"d stretch / d {path}: {float(slope):.6f}")

h = 1e-3
ahead, behind = (
    jc.clamp(jc.replace(scene, paths[0], 2.0 + step), guess=result).measure(stretch) for step in (h, -h)
)
print(f"by differences, the first: {(ahead - behind) / (2 * h):.6f}")

# %% [markdown]
# The same under `jit`: another process solves it, and what this notebook has defined travels there.

# %%
force = jax.jit(lambda r: jc.evaluate(jc.replace(scene, "clamp.jaw.tip_radius", r), jc.clamp_force()))
print(f"force of a wedge of 2.5 mm: {float(force(2.5)) / 1e3:.4f} N")

# %% [markdown]
# ## A study of it
#
# The wedge that stretches the media least, searched from two starts, the second one in a process of its own.

# %%
from optimize import DesignProblem, Variable, minimise

problem = DesignProblem(
    scene,
    objective=stretch,
    variables=(
        Variable("clamp.jaw.tip_radius", lower=1.5, upper=3.0),
        Variable("clamp.jaw.slope", lower=1.0, upper=4.0),
    ),
)
study = minimise(problem, max_evaluations=4, starts=2, check_finer_mesh=False)
print(study.stopped_because)
for name, value in zip(paths, study.best_design, strict=False):
    print(f"{name}: {value:.3f}")
start, best = (found.measure(stretch) for found in (study.start, study.best))
print(f"axial stretch: {start:.4f} at the start, {best:.4f} at best")

# %% [markdown]
# ## In a file of your own
#
# Put such definitions into a Python file, and the command line knows them too:
# `jaxclamp run scene.toml --import my_parts.py`, and the same for `show`, `optimise` and `accuracy`. A study
# file names a measure by its function, which says that it makes one (`-> jc.Measure`), and its unit, such as
# `mean_axial_stress_kPa`. Python imports the file with `jc.import_parts`.

# %%
from pathlib import Path

Path("my_parts.py").write_text('''
import jax.numpy as jnp

import jaxclamp as jc


@jc.record
class Bar(jc.Jaw):
    """A round bar."""

    shape: str = jc.static("bar")
    radius: float = jc.quantity("mm", 0.0, 1e3, open_lower=True)

    def gap(self, point):
        return jnp.hypot(point[1] - self.radius, point[2]) - self.radius

    def half_extent(self):
        return jnp.asarray(self.radius)

    def curvatures(self):
        return jnp.reshape(1.0 / self.radius, 1)


def mean_axial_stress(layer: str) -> jc.Measure:
    return jc.Measure("mean_axial_stress", "kPa", mean_of, (layer,))


def mean_of(equilibria, layer):
    volumes = jc.volumes(equilibria, layer)
    return jnp.sum(jc.stresses(equilibria, layer).axial * volumes) / jnp.sum(volumes)
''')

parts = jc.import_parts("my_parts.py")
bar = jc.load_scene("human-lad", [*coarse, 'clamp.jaw={shape="bar", radius_mm=3.0}'])
mean = jc.clamp(bar).measure(parts.mean_axial_stress("media"))
print(f"mean axial stress of the media: {mean:.3f} kPa")

# %% [markdown]
# What such a scene leaves on disk says which file it needs.

# %%
print(jc.dump_scene(bar).splitlines()[0])
