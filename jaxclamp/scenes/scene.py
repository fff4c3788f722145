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
from jaxclamp.physics.placement import Placement


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
class Hinge:
    """Jaws that turn about a hinge beside the artery, as those of scissors."""

    hinge_distance: Array = quantity("mm", 0.0, 1e4, open_lower=True)
    """from the artery's axis to the hinge"""


@record
class Clamp:
    """Two jaws that close across the artery: `jaw` for both, or `upper` and `lower`.

    A pair of unlike jaws floats as a whole in the closing direction, as a clamp in the hand does: both press
    with one force. What is None is not there, and makes the model no larger.
    """

    jaw: Jaw | None = None
    """the shape of both"""
    upper: Jaw | None = None
    """the shape of the upper one"""
    lower: Jaw | None = None
    """the shape of the lower one, as it is seen in its mirror image"""
    oblique: Array | None = quantity("deg", -80.0, 80.0, default=None)
    """angle of both jaws about the closing direction"""
    reach: Array | None = quantity("mm", 0.0, 1e3, open_lower=True, default=None)
    """how far the jaws reach across, from the side of the artery without load; None: all the way"""
    closing: Hinge | None = None
    """None: the jaws stay parallel"""

    @property
    def jaws(self) -> tuple[Jaw, Jaw]:
        """The upper and the lower one."""
        upper, lower = (self.jaw, self.jaw) if self.jaw is not None else (self.upper, self.lower)
        assert upper is not None
        assert lower is not None
        return upper, lower

    @property
    def kinds(self) -> dict[str, Jaw]:
        """The jaws by the key of scene files: one, or two that are not alike."""
        if self.jaw is not None:
            return {"jaw": self.jaw}
        return dict(zip(("upper", "lower"), self.jaws, strict=True))

    def placement(self, outer_radius: Array) -> Placement:
        """How the jaws lie across an artery whose outer radius without load is given, mm."""
        tip = None if self.reach is None else self.reach - outer_radius
        hinge = None if self.closing is None else self.closing.hinge_distance
        return Placement(oblique=self.oblique, hinge_distance=hinge, tip=tip, reach=self.reach)

    def half_extent(self) -> float:
        """Distance along the artery from the middle to the side of the wider jaw, mm."""
        return max(float(jaw.half_extent()) for jaw in self.jaws)

    @property
    def planes(self) -> str:
        """The mirror planes that hold, by the letters of their normals, whatever the floats."""
        square = self.oblique is None
        on_one_side = self.reach is not None or self.closing is not None
        teeth = [part for jaw in self.jaws if (part := getattr(jaw, "teeth", None)) is not None]
        holds = {
            "x": square and not on_one_side and all("x" in part.planes for part in teeth),
            "y": self.jaw is not None,
            "z": square and all("z" in part.planes for part in teeth),
        }
        return "".join(axis for axis in "xyz" if holds[axis])


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
    radial_grading: Array = quantity("", 0.0, 6.0, default=0.0)
    """elements of all layers but the innermost grow by exp(grading) from the inside of their layer, where the
    fibres of a softer layer stiffen, to its outside; 0 is uniform. In a file that does not say:
    `fidelity.radial_grading`"""
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
