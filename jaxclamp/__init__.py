"""jaxclamp: a differentiable mechanics engine for the design of arterial clamps.

Importing the package switches JAX to 64-bit floats: stresses near incompressibility need them.
"""

from jaxclamp.core.starting import guard_start

guard_start()

from pathlib import Path  # noqa: E402

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

from jaxclamp.core.failures import (  # noqa: E402
    BadFolder,
    EquilibriumError,
    Failure,
    SceneError,
    TooLittleMemory,
    Unfit,
    WorkerLost,
)
from jaxclamp.core.parts import by_value, own_parts  # noqa: E402
from jaxclamp.core.progress import Progress  # noqa: E402
from jaxclamp.core.records import quantity, record, static  # noqa: E402
from jaxclamp.observe.equilibria import Equilibria  # noqa: E402
from jaxclamp.observe.figures import shown_in  # noqa: E402
from jaxclamp.observe.injury import (  # noqa: E402
    MEASURES,
    damage_at_points,
    intima_contact_area,
    mean_damage,
    peak_over_threshold,
    share_above_threshold,
    smooth_peak_axial_strain_gradient,
    smooth_peak_axial_stress_ratio,
    smooth_peak_contact_pressure_excess,
    smooth_peak_damage,
)
from jaxclamp.observe.measure import Measure, N, kPa, mm, mm2, mN, uJ  # noqa: E402
from jaxclamp.observe.measures import (  # noqa: E402
    axial_stress_at_P,
    circumferential_stress_at_P,
    clamp_force,
    holding_force,
    jaw_contact_area,
    jaw_curvature,
    jaw_half_width,
    jaw_travel,
    lumen_area,
    lumen_height,
    lumen_width,
    mean_contact_pressure,
    physiological_lumen_radius,
    side_force,
    smooth_peak_axial_stress,
    smooth_peak_circumferential_stress,
    smooth_peak_contact_pressure,
    smooth_peak_principal_stress,
    stored_energy,
    volume_above,
)
from jaxclamp.observe.parts import import_parts, measures  # noqa: E402
from jaxclamp.observe.points import (  # noqa: E402
    cauchy_stress,
    contact_pressures,
    deformation_gradient,
    smooth_maximum,
    stresses,
    volumes,
)
from jaxclamp.observe.stops import ClosedStop, ForceStop, OcclusionStop, PressedStop, TravelStop  # noqa: E402
from jaxclamp.physics.jaws import Jaw  # noqa: E402
from jaxclamp.physics.materials import FibreLaw, Material  # noqa: E402
from jaxclamp.scenes.address import replace  # noqa: E402
from jaxclamp.scenes.files import dump_scene, load_scene, require_possible  # noqa: E402
from jaxclamp.scenes.scene import InjuryThreshold, Scene, Stop  # noqa: E402
from jaxclamp.sensitivity.adjoint import value_and_gradient  # noqa: E402
from jaxclamp.sensitivity.gradients import gradients  # noqa: E402
from jaxclamp.sensitivity.implicit import evaluate  # noqa: E402
from jaxclamp.solve.clamping import Result, clamp  # noqa: E402
from jaxclamp.solve.linear_solvers import cores  # noqa: E402
from jaxclamp.solve.loading import load_result  # noqa: E402
from jaxclamp.solve.memory import require_memory_for  # noqa: E402
from jaxclamp.solve.results import versions  # noqa: E402
from jaxclamp.specimens.sheet import flat_piece  # noqa: E402
from jaxclamp.specimens.tube import inflated_tube  # noqa: E402
from jaxclamp.trust.estimates import Estimate, Neighbours, neighbours, with_errors  # noqa: E402

__all__ = [
    "MEASURES",
    "BadFolder",
    "ClosedStop",
    "Equilibria",
    "EquilibriumError",
    "Estimate",
    "Failure",
    "FibreLaw",
    "ForceStop",
    "InjuryThreshold",
    "Jaw",
    "Material",
    "Measure",
    "N",
    "Neighbours",
    "OcclusionStop",
    "PressedStop",
    "Progress",
    "Result",
    "Scene",
    "SceneError",
    "Stop",
    "TooLittleMemory",
    "TravelStop",
    "Unfit",
    "WorkerLost",
    "axial_stress_at_P",
    "by_value",
    "cauchy_stress",
    "circumferential_stress_at_P",
    "clamp",
    "clamp_force",
    "contact_pressures",
    "cores",
    "damage_at_points",
    "deformation_gradient",
    "dump_scene",
    "evaluate",
    "flat_piece",
    "gradients",
    "holding_force",
    "import_parts",
    "inflated_tube",
    "intima_contact_area",
    "jaw_contact_area",
    "jaw_curvature",
    "jaw_half_width",
    "jaw_travel",
    "kPa",
    "load_result",
    "load_scene",
    "lumen_area",
    "lumen_height",
    "lumen_width",
    "mN",
    "mean_contact_pressure",
    "mean_damage",
    "measures",
    "mm",
    "mm2",
    "neighbours",
    "own_parts",
    "peak_over_threshold",
    "physiological_lumen_radius",
    "quantity",
    "record",
    "replace",
    "require_memory_for",
    "require_possible",
    "share_above_threshold",
    "shown_in",
    "side_force",
    "smooth_maximum",
    "smooth_peak_axial_strain_gradient",
    "smooth_peak_axial_stress",
    "smooth_peak_axial_stress_ratio",
    "smooth_peak_circumferential_stress",
    "smooth_peak_contact_pressure",
    "smooth_peak_contact_pressure_excess",
    "smooth_peak_damage",
    "smooth_peak_principal_stress",
    "static",
    "stored_energy",
    "stresses",
    "uJ",
    "value_and_gradient",
    "versions",
    "volume_above",
    "volumes",
    "with_errors",
]


def _write_outputs(result: Result, folder: Path) -> list[Path]:
    from jaxclamp.show.export import write_outputs

    return write_outputs(result, folder)


Result.write_outputs = _write_outputs
