"""What a clamping is: artery, clamp, stop, and the numerical choices. Plain frozen data.

Every float can be differentiated; every string, integer and tuple of them is a static choice.
Units inside are mm, kPa, mN and radians; the ranges are in the units of scene files. Build scenes with
`jaxclamp.load_scene` (validated) and change them with `jaxclamp.replace`, which also works on traced
values. A field annotated `Array` holds one number unless it says otherwise.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar, cast

from jax import Array

from jaxclamp.core.records import UNIT_FACTOR, quantity, record, static
from jaxclamp.physics.contact import Contact
from jaxclamp.physics.jaws import Jaw
from jaxclamp.physics.materials import Material


@record
class Layer:
    """One layer of the wall, stress-free as an opened-up circular sector of its own."""

    name: str = static()
    """what results call it, such as media"""
    inner_radius: Array = quantity("mm", 0.0, 1e3, open_lower=True)
    """inner radius of the open sector"""
    thickness: Array = quantity("mm", 0.0, 1e3, open_lower=True)
    """thickness of the open sector"""
    opening_angle: Array = quantity("deg", -350.0, 350.0)
    """360 deg minus the sector's angle: 0 for a closed ring, negative for an overlapping one"""
    material: Material
    """its law and constants; they may be arrays over quadrature points and cells in scenes made in Python"""


@record
class Artery:
    """A layered tube, its stretch in the body and its blood pressure."""

    length: Array = quantity("mm", 0.0, 1e4, open_lower=True)
    """load-free length; the clamp sits in the middle"""
    axial_stretch: Array = quantity("", 0.2, 5.0)
    """length in the body over load-free length"""
    pressure: Array = quantity("kPa", 0.0, 1e4)
    """blood pressure, a follower load on the lumen"""
    layers: tuple[Layer, ...]
    """from inside to outside"""


@record
class Clamp:
    """Two jaws alike, closing symmetrically across the artery."""

    jaw: Jaw
    """the shape of both"""


class Stop(abc.ABC):
    """When closing ends. A stop is one record with its target, the only quantity, and a name of its own.

    Scene files tell stops apart by the target's key, such as `travel_mm`.
    """

    CHOSEN_BY_KEY: ClassVar[bool] = True
    STEADY: ClassVar[bool] = False
    """the measure changes steadily from first contact on, so that closing can go in steps of it"""

    kind: str
    """what the stop is called in results"""

    @abc.abstractmethod
    def measure(self, equilibria: Any) -> Array:
        """What is to reach the target, in internal units: a JAX function of `Equilibria`."""

    def target(self) -> Array:
        """The value at which closing ends: the record's only quantity, in internal units."""
        value: Array = getattr(self, self._quantity().name)
        return value

    def unit(self) -> str:
        """The target's unit in scene files."""
        return str(self._quantity().metadata["range"].unit)

    def said(self, value: Array | float) -> str:
        """A value of the measure with its unit in scene files, for a reader."""
        unit = self.unit()
        return f"{float(value) / UNIT_FACTOR[unit]:.3g} {unit}".rstrip()

    def _quantity(self) -> dataclasses.Field[Any]:
        (field,) = (f for f in dataclasses.fields(cast(Any, self)) if "range" in f.metadata)
        return field

    def after(self) -> Stop | None:
        """A stop to be reached before this one; None if there is none."""
        return None

    def far_from_closure(self) -> bool:
        """True if opposite inner walls surely do not meet on the way to the stop."""
        return False


@record
class MeshSettings:
    """Hexahedra of the modelled part of the artery."""

    circumferential: int = static()
    """elements over the quarter circumference"""
    axial: int = static()
    """elements over the half length"""
    radial: tuple[int, ...] = static()
    """elements through each layer"""
    axial_grading: Array = quantity("", 0.0, 12.0, default=2.5)
    """elements grow by exp(grading) from the clamp to the end; 0 is uniform"""
    circumferential_grading: Array = quantity("", 0.0, 6.0, default=0.0)
    """elements grow by exp(grading) from the fold to the compression axis; 0 is uniform. In a file that does
    not say: `fidelity.grading`"""
    element: str = static("q1pz", choices=("q1pz", "q1p0", "q2p1"))
    """q1p0: 8 nodes, mean dilatation; q1pz: the same, stable against axial waves at a sharp fold; q2p1: 27
    nodes, linear discontinuous pressure"""
    contact_points: int = static(4)
    """contact quadrature points per facet and direction (more between inner walls where nodes need it)"""
    symmetry: str = static("auto", choices=("auto", "xyz", "xy", "xz", "yz", "x", "y", "z", "none"))
    """mirror planes of the modelled part, by their normals; auto: all that hold"""

    @property
    def words(self) -> str:
        """Elements around a quarter, along one half, and through each layer, such as 10 x 15 x (5 + 3)."""
        return f"{self.circumferential} x {self.axial} x ({' + '.join(map(str, self.radial))})"


@record
class SolverSettings:
    """How equilibrium is found: on the path of closing jaws, whichever way (docs/which-equilibrium.md)."""

    tolerance: float = static(1e-9)
    """largest residual over the norm of the support reactions"""
    continuation: str = static("lumen", choices=("lumen", "travel"))
    """close in steps of lumen height, or of jaw travel"""
    path_mesh: str = static("coarser", choices=("coarser", "own"))
    """walk the closing path on a coarser mesh, if that carries it, and solve for nothing but body and stop on
    the scene's own; or walk all of it on the scene's own, which takes several times as long"""
    linear_solver: str = static("auto", choices=("auto", "pardiso", "rslab", "splu"))
    """sparse direct back end; auto takes the first that is installed"""


@record
class InjuryThreshold:
    """A value from which on a user takes the wall to be injured: data with a source, not a verdict."""

    measure: str = static(
        choices=(
            "axial_stress",
            "circumferential_stress",
            "principal_stress",
            "contact_pressure",
            "contact_pressure_excess",
        )
    )
    """what it is of: a Cauchy stress in a layer, or pressure under the jaws (in excess of blood pressure)"""
    layer: str = static("")
    """the layer that a stress is of; none for what is under the jaws"""
    threshold: Array = quantity("kPa", 0.0, 1e6, open_lower=True)
    """above this"""
    source: str = static()
    """where the number comes from, such as author and year"""

    @property
    def of_a_layer(self) -> bool:
        """True for a stress, False for what is under the jaws."""
        return self.measure.endswith("stress")

    @property
    def unsourced(self) -> InjuryThreshold:
        """The same without its source: programs that take it are not compiled anew for that."""
        return dataclasses.replace(self, source="")


@record
class Scene:
    """One clamping: everything that `jaxclamp.clamp` needs."""

    title: str = static("")
    """what results are headed with"""
    artery: Artery
    """what is clamped"""
    clamp: Clamp
    """with what"""
    stop: Stop
    """and how far"""
    contact: Contact
    """how jaws and wall, and opposite inner walls, keep apart"""
    mesh: MeshSettings
    """how finely it is computed"""
    solver: SolverSettings
    """and how accurately solved"""
    injury: tuple[InjuryThreshold, ...] = ()
    """thresholds that results are held against; any number"""
