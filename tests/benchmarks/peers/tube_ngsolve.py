"""The tube with NGSolve: mixed Q1 x DG0 energy, pressures condensed by element, PARDISO, two threads.

The energy is quadratic in the pressure of an element, so that the solution is that of mean dilatation.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Any

import ngsolve as ng
import numpy as np
import tube_work as work
from netgen import meshing

PLANES = ("lumen", "outside", "x0", "y0", "z0", "z1")


@dataclasses.dataclass
class Tube:
    """Spaces and forms."""

    mesh: work.TubeMesh
    space: Any
    gf: Any
    p: Any
    form: Any
    load: Any
    slopes: dict[str, Any]


def surface_facets(mesh: work.TubeMesh) -> list[np.ndarray]:
    """Facets of each of PLANES, (n, 4), normals outwards."""
    n = mesh.grid()

    def facets(s: np.ndarray) -> np.ndarray:
        return np.stack([v.ravel() for v in (s[:-1, :-1], s[1:, :-1], s[1:, 1:], s[:-1, 1:])], axis=1)

    lumen, outside, x0, y0, z0, z1 = (
        facets(s) for s in (n[:, :, 0], n[:, :, -1], n[:, -1], n[:, 0], n[0], n[-1])
    )
    turned = lambda f: f[:, ::-1]
    return [lumen, turned(outside), x0, turned(y0), z0, turned(z1)]


def ng_mesh(mesh: work.TubeMesh) -> Any:
    """The same mesh for NGSolve; its vertices keep their numbers."""
    made = meshing.Mesh(dim=3)
    numbers = [made.Add(meshing.MeshPoint(meshing.Pnt(*map(float, X)))) for X in mesh.points]
    inside = made.AddRegion("wall", 3)
    for cell in mesh.cells:
        made.Add(meshing.Element3D(inside, [numbers[n] for n in cell]))
    for name, facets in zip(PLANES, surface_facets(mesh), strict=True):
        region = made.AddRegion(name, 2)
        for facet in facets:
            made.Add(meshing.Element2D(region, [numbers[n] for n in facet]))
    return ng.Mesh(made)


def build(mesh: work.TubeMesh) -> Tube:
    """Spaces, energies, and their forms."""
    ng.SetNumThreads(os.cpu_count() or 1)
    domain = ng_mesh(mesh)
    V = ng.VectorH1(domain, order=1, dirichletx="x0", dirichlety="y0", dirichletz="z0|z1")
    space = V * ng.L2(domain, order=0)
    (u, q), p = space.TrialFunction(), ng.Parameter(0.0)
    names = {"c": ng.Parameter(work.C), "k1": ng.Parameter(work.K1), "k2": ng.Parameter(work.K2)}
    c, k1, k2 = names.values()
    F = ng.Id(3) + ng.Grad(u)
    J = ng.Det(F)
    scale, R = J ** (-2.0 / 3.0), ng.sqrt(ng.x**2 + ng.y**2)
    cosine, sine = np.cos(work.FIBRE_ANGLE), np.sin(work.FIBRE_ANGLE)
    psi = c / 2 * (scale * ng.InnerProduct(F, F) - 3.0)
    for side in (1.0, -1.0):
        Fa = F * ng.CF((-ng.y / R * cosine, ng.x / R * cosine, side * sine))
        stretch = scale * ng.InnerProduct(Fa, Fa) - 1.0
        E = ng.IfPos(stretch, stretch, 0.0)
        psi += k1 / (2 * k2) * (ng.exp(k2 * E**2) - 1.0)
    mixed = psi + q * (J - 1.0) - q**2 / (2 * work.BULK)
    dx = ng.dx(intrules={ng.ET.HEX: ng.IntegrationRule(ng.ET.HEX, 3)})
    ds = ng.ds("lumen", intrules={ng.ET.QUAD: ng.IntegrationRule(ng.ET.QUAD, 3)})
    moved = ng.Id(3) + ng.Grad(u).Trace()
    n = ng.Cof(moved) * ng.specialcf.normal(3)
    outward = 0.5 * ((ng.x + u.Trace()[0]) * n[0] + (ng.y + u.Trace()[1]) * n[1])
    form = ng.BilinearForm(space, symmetric=True, condense=True)
    form += ng.Variation(mixed.Compile() * dx)
    form += ng.Variation((p * outward).Compile() * ds)
    load = ng.BilinearForm(space, symmetric=True)
    load += ng.Variation(outward.Compile() * ds)
    slopes = {}
    for name, parameter in names.items():
        slopes[name] = ng.BilinearForm(space, symmetric=True)
        slopes[name] += ng.Variation(psi.Diff(parameter).Compile() * dx)
    return Tube(mesh, space, ng.GridFunction(space), p, form, load, slopes)


def applied(form: Any, gf: Any) -> Any:
    """The vector of a form at the present state."""
    vector = gf.vec.CreateVector()
    form.Apply(gf.vec, vector)
    return vector


def linear_solve(tube: Tube, b: Any) -> Any:
    """Assemble the tangent at the present state and solve once, pressures condensed by element."""
    form = tube.form
    form.AssembleLinearization(tube.gf.vec)
    inverse = form.mat.Inverse(tube.space.FreeDofs(True), inverse="pardiso")
    b.data += form.harmonic_extension_trans * b
    x = b.CreateVector()
    x.data = inverse * b
    x.data += form.harmonic_extension * x
    x.data += form.inner_solve * b
    return x


def solve(tube: Tube, u: np.ndarray, pressures: Sequence[float]) -> work.Answer:
    """Newton's method; the loop is ours because of the common stop."""
    tube.gf.vec[:] = 0.0
    for i in range(3):
        tube.gf.components[0].components[i].vec.FV().NumPy()[:] = u[:, i]
    free = np.array(list(tube.space.FreeDofs()), dtype=bool)

    def linearise(_: None, p: float) -> work.Linearised:
        tube.p.Set(p)
        residual = applied(tube.form, tube.gf)
        load = p * float(np.linalg.norm(applied(tube.load, tube.gf).FV().NumPy()))
        return residual.FV().NumPy()[free], residual, load

    def correct(_: None, residual: Any, __: np.ndarray) -> None:
        tube.gf.vec.data -= linear_solve(tube, residual)

    with ng.TaskManager():
        _, iterations, seconds = work.newton(linearise, correct, None, pressures)
    found = np.stack([tube.gf.components[0].components[i].vec.FV().NumPy() for i in range(3)], axis=1)
    return work.Answer(tube.mesh.radius(found), iterations, seconds)


def gradient(tube: Tube, answer: work.Answer) -> dict[str, float]:
    """Derivatives of the radius by an adjoint solve with the symmetric tangent, at the state just solved."""
    with ng.TaskManager():
        weights = ng.GridFunction(tube.space)
        for i, column in enumerate(tube.mesh.radius_weights().T):
            weights.components[0].components[i].vec.FV().NumPy()[:] = column
        adjoint = linear_solve(tube, weights.vec)
        slope = lambda form: -float(ng.InnerProduct(adjoint, applied(form, tube.gf)))
        return {name: slope(form) for name, form in tube.slopes.items()} | {"p": slope(tube.load)}


BY = "adjoint and linear solve written by the user; force slopes by its symbolic differentiation"

if __name__ == "__main__":
    work.main("NGSolve", "ngsolve", build, solve, gradient, BY)
