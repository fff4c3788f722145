"""The inflated, stretched, layered tube of residually stressed layers, without finite elements.

Independent of the engine: NumPy and SciPy only, stresses typed from the closed forms. Two solutions:

* `Incompressible`: lambda_theta = k r / R, lambda_r = 1 / (lambda_theta lambda_z), k = 360 / (360 - alpha),
  and p = sum over the layers of int (sigma_theta - sigma_r) dr / r, by quadrature;
* `Compressible`: radial equilibrium d sigma_r / dr = (sigma_theta - sigma_r) / r with the penalty
  bulk/2 (J - 1)**2, as an initial-value problem in R shot from the lumen.

Lengths mm, stresses kPa, angles in degrees.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

SEED_PRESSURE, SEED_STRETCH = 13.33, 1.1


@dataclasses.dataclass(frozen=True)
class Sector:
    """A layer, stress-free as an open sector. `law`: "neo", "eq4" or "eq10"."""

    inner_radius: float
    thickness: float
    opening_angle: float
    c: float
    k1: float = 0.0
    k2: float = 1.0
    fibre_angle: float = 0.0
    law: str = "eq4"

    @property
    def k(self) -> float:
        """Closed angle over open angle."""
        return 360.0 / (360.0 - self.opening_angle)

    @property
    def outer_radius(self) -> float:
        return self.inner_radius + self.thickness


# Table 1 of Gasser, Schulze-Bauer & Holzapfel, J Biomech Eng 124 (2002) 355: human LAD
MEDIA = Sector(3.302, 0.493, 160.0, 27.0, 0.64, 3.54, 10.0)
ADVENTITIA = Sector(3.482, 0.247, 120.0, 2.7, 5.1, 15.4, 40.0)
SEED = (MEDIA, ADVENTITIA)
SEED_EQ10 = tuple(dataclasses.replace(layer, law="eq10") for layer in SEED)

# A closed ring of the media's material without residual stress
RING = (Sector(2.0, 0.74, 0.0, 27.0, 0.64, 3.54, 10.0),)


def fibre_slope(layer: Sector, I4):
    """d Psi / d I4 of one fibre family; works on floats and arrays."""
    E = np.maximum(I4 - 1.0, 0.0)
    if layer.law == "neo":
        return 0.0 * E
    growth = np.exp(layer.k2 * E * E) - (1.0 if layer.law == "eq10" else 0.0)
    return layer.k1 * E * growth


def extra_stress(layer: Sector, hoop, axial):
    """Stresses (theta, z, r) of the incompressible law up to a pressure, at stretches hoop and axial."""
    b = math.radians(layer.fibre_angle)
    I4 = (hoop * math.cos(b)) ** 2 + (axial * math.sin(b)) ** 2
    fibres = 4.0 * fibre_slope(layer, I4)  # two families, 2 dPsi/dI4 each
    return (
        layer.c * hoop**2 + fibres * (hoop * math.cos(b)) ** 2,
        layer.c * axial**2 + fibres * (axial * math.sin(b)) ** 2,
        layer.c / (hoop * axial) ** 2,
    )


@dataclasses.dataclass(frozen=True)
class Profile:
    """What one layer looks like at reference radii R: radius and stresses, each (n,)."""

    r: np.ndarray
    hoop: np.ndarray
    axial: np.ndarray
    radial: np.ndarray


class Incompressible:
    """The tube at lumen pressure `pressure` and axial stretch `stretch`, J = 1 everywhere."""

    def __init__(self, layers: tuple[Sector, ...], pressure: float, stretch: float) -> None:
        self.layers, self.pressure, self.stretch = layers, pressure, stretch
        scale = layers[0].inner_radius / layers[0].k
        low, high = 0.02 * scale, 0.04 * scale
        while self.carried(high) < pressure:  # the pressure carried grows with the radius
            low, high = high, 1.1 * high
            assert high < 10.0 * scale, "no equilibrium"
        self.inner_radius = brentq(lambda r: self.carried(r) - pressure, low, high, xtol=1e-14, rtol=1e-14)

    def radius(self, r_i: float, number: int, R):
        """Deformed radius of the point R of a layer: r**2 = r_i**2 + (R**2 - R_i**2) / (k lambda_z)."""
        inner = r_i**2
        for layer in self.layers[:number]:
            inner += (layer.outer_radius**2 - layer.inner_radius**2) / (layer.k * self.stretch)
        layer = self.layers[number]
        return np.sqrt(inner + (R**2 - layer.inner_radius**2) / (layer.k * self.stretch))

    def _rise(self, r_i: float, number: int, R_end: float) -> float:
        """int (sigma_theta - sigma_r) dr / r from the layer's inner surface to R_end."""
        layer = self.layers[number]
        x, w = np.polynomial.legendre.leggauss(8)
        edges = np.linspace(layer.inner_radius, R_end, 201)  # panels: the fibre switch is a kink
        half = 0.5 * (edges[1] - edges[0])
        R = (edges[:-1, None] + half * (1.0 + x)).ravel()
        r = self.radius(r_i, number, R)
        hoop, _, radial = extra_stress(layer, layer.k * r / R, self.stretch)
        dr_dR = R / (layer.k * self.stretch * r)
        return float(np.sum((hoop - radial) / r * dr_dR * np.tile(half * w, 200)))

    def carried(self, r_i: float) -> float:
        """The pressure in equilibrium with a lumen radius r_i."""
        return sum(self._rise(r_i, n, layer.outer_radius) for n, layer in enumerate(self.layers))

    def profile(self, number: int, R) -> Profile:
        """Radius and Cauchy stresses of a layer at reference radii R (n,)."""
        R, layer, r_i = np.asarray(R, float), self.layers[number], self.inner_radius
        inner_sigma_r = -self.pressure + sum(
            self._rise(r_i, n, below.outer_radius) for n, below in enumerate(self.layers[:number])
        )
        sigma_r = np.array([inner_sigma_r + self._rise(r_i, number, end) for end in R])
        r = self.radius(r_i, number, R)
        hoop, axial, radial = extra_stress(layer, layer.k * r / R, self.stretch)
        return Profile(r, hoop - radial + sigma_r, axial - radial + sigma_r, sigma_r)


class Compressible:
    """The same tube with U(J) = bulk/2 (J - 1)**2 and fibres stretched by J**(-1/3) F."""

    def __init__(
        self,
        layers: tuple[Sector, ...],
        pressure: float,
        stretch: float,
        bulk: float,
        tolerance: float = 1e-11,
    ) -> None:
        self.layers, self.pressure, self.stretch, self.bulk = layers, pressure, stretch, bulk
        self.tolerance = tolerance
        guess = Incompressible(layers, pressure, stretch).inner_radius
        width = 0.02 * guess
        while self._outer_stress(guess - width) * self._outer_stress(guess + width) > 0.0:
            width *= 2.0
        self.inner_radius = brentq(self._outer_stress, guess - width, guess + width, xtol=1e-11, rtol=1e-11)
        self._paths = self._shoot(self.inner_radius, dense=True)

    def _stress(self, layer: Sector, radial: float, hoop: float) -> tuple[float, float, float]:
        """Cauchy stresses (theta, z, r) at principal stretches: bulk (J - 1) + dev(...) / J."""
        axial = self.stretch
        J = radial * hoop * axial
        scale = J ** (-2.0 / 3.0)
        b = math.radians(layer.fibre_angle)
        t4, z4 = scale * (hoop * math.cos(b)) ** 2, scale * (axial * math.sin(b)) ** 2
        E = max(t4 + z4 - 1.0, 0.0)
        if layer.law == "neo":
            fibres = 0.0
        else:
            growth = math.exp(layer.k2 * E * E) - (1.0 if layer.law == "eq10" else 0.0)
            fibres = 4.0 * layer.k1 * E * growth
        mean = (layer.c * scale * (radial**2 + hoop**2 + axial**2) + fibres * (t4 + z4)) / 3.0
        p = self.bulk * (J - 1.0)
        return (
            p + (layer.c * scale * hoop**2 + fibres * t4 - mean) / J,
            p + (layer.c * scale * axial**2 + fibres * z4 - mean) / J,
            p + (layer.c * scale * radial**2 - mean) / J,
        )

    def _radial_stretch(self, layer: Sector, hoop: float, sigma_r: float) -> float:
        """The radial stretch at which the radial stress is sigma_r (secant)."""
        a = 1.0 / (hoop * self.stretch)
        fa = self._stress(layer, a, hoop)[2] - sigma_r
        b = a * (1.0 - fa / self.bulk)
        for _ in range(50):
            fb = self._stress(layer, b, hoop)[2] - sigma_r
            if fb == fa:
                return b
            a, fa, b = b, fb, b - fb * (b - a) / (fb - fa)
            if abs(b - a) < 1e-14 * abs(b):
                return b
        raise ArithmeticError("no radial stretch found")

    def _shoot(self, r_i: float, dense: bool = False) -> list:
        """Integrate (r, sigma_r) over R through the layers from r = r_i, sigma_r = -pressure."""
        state, paths = np.array([r_i, -self.pressure]), []
        for layer in self.layers:

            def slope(R: float, y: np.ndarray, layer: Sector = layer) -> list[float]:
                hoop = layer.k * y[0] / R
                radial = self._radial_stretch(layer, hoop, y[1])
                theta, _, r = self._stress(layer, radial, hoop)
                return [radial, radial * (theta - r) / y[0]]

            path = solve_ivp(
                slope,
                (layer.inner_radius, layer.outer_radius),
                state,
                method="DOP853",
                rtol=self.tolerance,
                atol=self.tolerance,
                dense_output=dense,
            )
            assert path.success, path.message
            state = path.y[:, -1]
            paths.append(path)
        return paths

    def _outer_stress(self, r_i: float) -> float:
        return float(self._shoot(r_i)[-1].y[1, -1])

    def profile(self, number: int, R) -> Profile:
        """Radius and Cauchy stresses of a layer at reference radii R (n,)."""
        layer = self.layers[number]
        r, sigma_r = self._paths[number].sol(np.asarray(R, float))
        stresses = []
        for radius, R_k, s in zip(r, R, sigma_r, strict=True):
            hoop = layer.k * radius / R_k
            stresses.append(self._stress(layer, self._radial_stretch(layer, hoop, s), hoop))
        theta, axial, radial = np.array(stresses).T
        return Profile(r, theta, axial, radial)


def random_sectors(seed: int) -> tuple[tuple[Sector, Sector], float, float]:
    """Two layers that fit round each other within 3 %, pressure and stretch, at random."""
    rng = np.random.default_rng(seed)

    def material() -> tuple[float, float, float, float]:
        return rng.uniform(10.0, 60.0), rng.uniform(0.5, 8.0), rng.uniform(1.0, 10.0), rng.uniform(5.0, 50.0)

    inner = Sector(rng.uniform(2.0, 4.0), rng.uniform(0.3, 0.6), rng.uniform(0.0, 160.0), *material())
    closed_outer = (inner.inner_radius + 0.5 * inner.thickness) / inner.k + 0.5 * inner.thickness
    angle, thickness = rng.uniform(0.0, 160.0), rng.uniform(0.15, 0.35)
    k = 360.0 / (360.0 - angle)
    fit = rng.uniform(0.97, 1.03)
    outer = Sector(
        fit * (closed_outer + 0.5 * thickness) * k - 0.5 * thickness, thickness, angle, *material()
    )
    return (inner, outer), rng.uniform(6.0, 16.0), rng.uniform(1.0, 1.25)
