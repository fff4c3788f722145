"""Mirror planes: what part of the artery is modelled, and what that means for everything that is reported.

The planes go through the middle of the clamp: x = 0 holds the compression axis, y = 0 the fold axis (it
lies between the jaws), z = 0 is mid-length. This is the one place that turns them into spans of angle and
length, supports, factors from the modelled part to the whole artery, mirror images, and words.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from jaxclamp.scenes.scene import Clamp, MeshSettings

AXES = "xyz"


@dataclasses.dataclass(frozen=True)
class Symmetry:
    """The mirror planes that a model makes use of, by the letters of their normals."""

    planes: str
    """letters such as "xyz", "" for none"""

    def __contains__(self, axis: str) -> bool:
        return axis in self.planes

    @property
    def parts(self) -> int:
        """Modelled parts in the whole artery: 8 with all three planes."""
        return 2 ** len(self.planes)

    @property
    def parts_of_a_jaw(self) -> float:
        """Factor from the force that belongs to the jaws' height in the model to that on one whole jaw.

        With the plane y = 0 the model holds one jaw only. Without it, two jaws share one height, and each
        takes half of the force.
        """
        return self.parts / 2.0

    @property
    def parts_of_a_section(self) -> int:
        """Modelled parts in a whole cross-section."""
        return 2 ** sum(axis in self for axis in "xy")

    @property
    def share(self) -> str:
        """The modelled part: "1/8", "1/4", "1/2" or "1"."""
        return "1" if self.parts == 1 else f"1/{self.parts}"

    @property
    def rigid_coordinates(self) -> tuple[str, ...]:
        """Names of the rigid coordinates, see `potential.densities`."""
        names = {"jaw_height": True, "clamp_height": "y" not in self, "side_force": "x" not in self}
        return tuple(name for name, there in names.items() if there)

    def rigid_place(self, name: str) -> int | None:
        """Place of a rigid coordinate among them; None where it is not there."""
        names = self.rigid_coordinates
        return names.index(name) if name in names else None

    # --- spans ------------------------------------------------------------------------------------

    @property
    def quarters(self) -> tuple[int, int]:
        """The modelled quarters of the circumference: first and last-plus-one, from the fold (x axis) on."""
        return {"xy": (0, 1), "y": (0, 2), "x": (-1, 1), "": (0, 4)}[self.planes.replace("z", "")]

    @property
    def wraps(self) -> bool:
        """True if the model goes all the way round, so that its last grid line is its first."""
        return self.quarters == (0, 4)

    @property
    def halves(self) -> tuple[int, int]:
        """The modelled halves of the length: first and last-plus-one, from mid-length on."""
        return (0, 1) if "z" in self else (-1, 1)

    # --- words and pictures -----------------------------------------------------------------------

    @property
    def words(self) -> str:
        """The modelled part and why, for a reader."""
        if not self.planes:
            return "the whole artery; its ends are held across along their horizontal and vertical diameters"
        round_ = {"xy": "a quarter of the circumference", "y": "the upper half of the circumference"}
        round_ |= {"x": "one side of the circumference", "": "the whole circumference"}
        around = round_[self.planes.replace("z", "")]
        along = "half the length" if "z" in self else "the whole length"
        names = {8: "one eighth", 4: "one quarter", 2: "one half"}
        planes = ", ".join(f"{axis} = 0" for axis in AXES if axis in self)
        plane = "mirror planes" if len(self.planes) > 1 else "mirror plane"
        held = "" if "x" in self and "y" in self else "; the ends are held across where a plane is missing"
        return (
            f"{names[self.parts]}: {around} by {along} ({plane} {planes}, which artery and clamp have in "
            f"common{held})"
        )

    @property
    def mirrors(self) -> np.ndarray:
        """Signs (x, y, z) of every mirror image, the model itself first, (parts, 3)."""
        signs = np.ones((1, 3))
        for number, axis in enumerate(AXES):
            if axis in self:
                image = signs.copy()
                image[:, number] *= -1.0
                signs = np.concatenate([signs, image])
        return signs


def symmetry_of(settings: MeshSettings, clamp: Clamp) -> Symmetry:
    """The symmetry that a scene's mesh asks for; "auto": all planes that hold.

    They hold in a straight artery and in what the clamp's jaws share.
    """
    return Symmetry({"auto": clamp.planes, "none": ""}.get(settings.symmetry, settings.symmetry))
