"""Material laws. What every law promises runs over all of them and their choices; then each one's own.

Deformation gradients have their batch axis last; their columns belong to the material axes
(radial, circumferential, axial).
"""

import dataclasses
import itertools
import math

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from jaxclamp.core.tensors import LARGEST_EXPONENT, det, pointwise_derivatives, total
from jaxclamp.physics.materials import GOH, HGO, HSGR, FibreLaw, Fung, Material, NeoHookean
from laws import every_law, example


@jax.jit
def psi(law, F):
    return law.psi(F)


@jax.jit
def stress(law, F):
    """First Piola-Kirchhoff stress dpsi/dF, (3, 3, n)."""
    return jax.grad(lambda F: jnp.sum(law.psi(F)))(F)


@jax.jit
def along(law, F, direction):
    """psi, its slope and its curvature along one direction (3, 3, n) in the space of F."""
    f = lambda s: law.psi(F + s * direction)
    slope = lambda s: jax.jvp(f, (s,), (jnp.ones_like(s),))[1]
    zero = jnp.zeros(F.shape[2:])
    value, first = jax.jvp(f, (zero,), (jnp.ones_like(zero),))
    return value, first, jax.jvp(slope, (zero,), (jnp.ones_like(zero),))[1]


@jax.jit
def all_derivatives(law, F):
    return pointwise_derivatives(
        lambda v: law.psi({(i, j): v[3 * i + j] for i in range(3) for j in range(3)}),
        [F[i, j] for i in range(3) for j in range(3)],
    )


def rotations(n: int, seed: int) -> np.ndarray:
    """Random rotations, (n, 3, 3)."""
    Q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(n, 3, 3)))
    return Q * np.sign(np.linalg.det(Q))[:, None, None]


def stretched(stretches: np.ndarray, seed: int) -> np.ndarray:
    """R U R' turned by Q, with principal stretches (n, 3): F (3, 3, n)."""
    R, Q = rotations(len(stretches), seed), rotations(len(stretches), seed + 1)
    F = Q @ (R * stretches[:, None, :]) @ np.swapaxes(R, 1, 2)
    return np.moveaxis(F, 0, -1)


moderate = jnp.asarray(stretched(np.random.default_rng(1).uniform(0.75, 1.3, (60, 3)), 2))
rest = jnp.asarray(np.eye(3)[:, :, None])


def basis(i: int, j: int) -> jax.Array:
    """e_i e_j', (3, 3, 1)."""
    return jnp.zeros((3, 3, 1)).at[i, j].set(1.0)


# --------------------------------------------------------------------------------- every law


@every_law
def test_constituents_add_up(law):
    parts = law.constituents(moderate)
    families = len(law.directions()) if isinstance(law, FibreLaw) else 0
    families = 1 if isinstance(law, Fung) else families  # one exponential of both strains
    assert len(parts) == 1 + families
    np.testing.assert_allclose(sum(parts), law.psi_bar(moderate), rtol=1e-14)
    assert all(np.min(part) >= 0.0 for part in parts)
    crushed = [np.isinf(part).all() for part in law.constituents(-moderate)]
    assert all(crushed)


def test_a_law_that_does_not_tell_its_constituents_apart_is_one():
    class Own(HGO):
        parts_of = FibreLaw.parts_of
        psi_of = lambda self, I1, J, I4: total(HGO.parts_of(self, I1, J, I4))

    law = Own(**{f.name: getattr(example(HGO), f.name) for f in dataclasses.fields(HGO)})
    (whole,) = law.constituents(moderate)
    np.testing.assert_allclose(whole, law.psi_bar(moderate), rtol=1e-14)


@every_law
def test_nothing_at_rest(law):
    size = float(law.bulk + law.c)
    np.testing.assert_allclose(psi(law, rest), 0.0, atol=1e-15 * size)
    np.testing.assert_allclose(stress(law, rest), 0.0, atol=1e-14 * size)


@every_law
def test_nothing_after_a_rotation(law):
    Q = jnp.asarray(np.moveaxis(rotations(30, 3), 0, -1))
    size = float(law.bulk + law.c)
    np.testing.assert_allclose(psi(law, Q), 0.0, atol=1e-12 * size)
    np.testing.assert_allclose(stress(law, Q), 0.0, atol=1e-12 * size)


@every_law
def test_frame_indifference(law):
    """psi(Q F) = psi(F) and P(Q F) = Q P(F) for rotations Q of space."""
    Q = np.moveaxis(rotations(60, 4), 0, -1)
    turned = jnp.asarray(np.einsum("ijn,jkn->ikn", Q, moderate))
    np.testing.assert_allclose(psi(law, turned), psi(law, moderate), rtol=1e-10)
    expected = np.einsum("ijn,jkn->ikn", Q, stress(law, moderate))
    np.testing.assert_allclose(stress(law, turned), expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


@every_law
def test_cauchy_stress_is_symmetric(law):
    kirchhoff = np.einsum("ijn,kjn->ikn", stress(law, moderate), moderate)
    np.testing.assert_allclose(kirchhoff, np.swapaxes(kirchhoff, 0, 1), atol=1e-11 * np.abs(kirchhoff).max())


@every_law
def test_energy_stores_something_in_every_deformation(law):
    assert np.all(np.asarray(psi(law, moderate)) > 0.0)


@every_law
def test_the_two_fibre_families_are_alike(law):
    """Reflection of the axial axis swaps the families and changes nothing."""
    mirror = jnp.asarray(np.diag([1.0, 1.0, -1.0]))
    reflected = jnp.einsum("ij,jkn,kl->iln", mirror, moderate, mirror)
    np.testing.assert_allclose(psi(law, reflected), psi(law, moderate), rtol=1e-11)


@every_law
@pytest.mark.parametrize(("i", "j"), [p for p in itertools.product(range(3), repeat=2) if p[0] != p[1]])
def test_simple_shear_is_convex(law, i, j):
    """In F = 1 + g e_i e_j' the volume stays, I1 and I4 are convex parabolas of g, and every law is a
    convex, growing function of them; it starts from zero slope."""
    g = jnp.linspace(-1.5, 1.5, 100)
    F = rest + g * basis(i, j)
    value, slope, curvature = along(law, F, jnp.broadcast_to(basis(i, j), F.shape))
    assert np.all(np.asarray(curvature) > 0.0)
    assert np.all(np.asarray(slope * g) > 0.0)
    # the matrix alone gives c g**2 / 2
    assert np.all(np.asarray(value) >= 0.5 * float(law.c) * np.asarray(g) ** 2 * (1.0 - 1e-12))


@every_law
def test_a_change_of_volume_alone_costs_the_bulk_energy(law):
    """F = J**(1/3) 1 leaves the isochoric invariants at rest: psi = bulk/2 (J - 1)**2, Eq. (3)."""
    if getattr(law, "fibre_invariant", "isochoric") == "full":
        pytest.skip("fibres of the full invariant feel a change of volume, as they should")
    J = jnp.linspace(0.4, 2.5, 30)
    found = psi(law, J ** (1.0 / 3.0) * rest)
    np.testing.assert_allclose(found, 0.5 * law.bulk * (J - 1.0) ** 2, rtol=1e-10, atol=1e-10)


# ------------------------------------------------------------------------- small-strain moduli


@every_law
@pytest.mark.parametrize(("i", "j"), [(0, 1), (0, 2)])
def test_radial_shear_modulus_is_c(law, i, j):
    """F = 1 + g e_r e_j' lengthens fibres in second order only: fibre energy of order g**4."""
    value = psi(law, rest + 1e-4 * basis(i, j))
    assert float(value[0]) == pytest.approx(0.5 * float(law.c) * 1e-8, rel=1e-5)


def stiffness_along_hoop(law, stretch):
    """Second derivative, at `stretch`, of psi in the isochoric F = diag(l**-1/2, l, l**-1/2)."""
    energy = lambda s: law.psi(
        {
            (i, j): (s if i == 1 else s**-0.5) if i == j else jnp.zeros_like(s)
            for i in range(3)
            for j in range(3)
        }
    )
    return float(jax.jit(jax.grad(jax.grad(energy)))(jnp.asarray(stretch)))


def test_small_strain_moduli_of_neo_hookean():
    """c/2 (l**2 + 2/l - 3) has the curvature 3 c at l = 1."""
    law = example(NeoHookean)
    assert stiffness_along_hoop(law, 1.0) == pytest.approx(3.0 * float(law.c), rel=1e-12)


@pytest.mark.parametrize("invariant", ["isochoric", "full"])
@pytest.mark.parametrize("angle_deg", [0.0, 10.0, 40.0, 54.0, 70.0])
def test_small_strain_moduli_of_hgo(invariant, angle_deg):
    """I4 = l**2 cos(b)**2 + sin(b)**2 / l: E = (3 cos(b)**2 - 1)(l - 1) + ...

    Eq. (4) gives k1 E**2 / 2 per family, so 2 k1 (3 cos(b)**2 - 1)**2 beside 3 c where E > 0;
    Eq. (10) starts with E**4 and adds nothing.
    """
    b = math.radians(angle_deg)
    factor = 3.0 * math.cos(b) ** 2 - 1.0
    law = example(HGO, fibre_angle=jnp.asarray(b), fibre_invariant=invariant)
    printed = dataclasses.replace(law, fibre_energy="eq10")
    tension = 1.0 + math.copysign(1e-7, factor)
    compression = 1.0 - math.copysign(1e-7, factor)
    c, k1 = float(law.c), float(law.k1)
    assert stiffness_along_hoop(law, tension) == pytest.approx(3 * c + 2 * k1 * factor**2, rel=1e-5)
    assert stiffness_along_hoop(law, compression) == pytest.approx(3 * c, rel=1e-5)
    assert stiffness_along_hoop(printed, tension) == pytest.approx(3 * c, rel=1e-5)


# --------------------------------------------------------------------------------- fibre stress


@pytest.mark.parametrize("k2", [0.0, 0.3, 3.54, 15.4])
def test_fibre_stress_of_both_printed_equations(k2):
    """One fibre direction (angle 0), stretched alone by l: I4 = l**2, E = l**2 - 1, no matrix, full
    invariant. Then dpsi/dl = 2 families * k1 E exp(k2 E**2) * 2 l by Eq. (4), and with
    (exp(k2 E**2) - 1) instead by Eq. (10)."""
    stretch, k1 = np.linspace(1.05, 1.6, 12), 5.1
    E = stretch**2 - 1.0
    F = np.zeros((3, 3, len(stretch)))
    F[0, 0] = F[2, 2] = 1.0
    F[1, 1] = stretch
    for equation, factor in (("eq4", np.exp(k2 * E**2)), ("eq10", np.expm1(k2 * E**2))):
        law = HGO(
            c=jnp.asarray(1e-12),
            k1=jnp.asarray(k1),
            k2=jnp.asarray(k2),
            fibre_angle=jnp.asarray(0.0),
            bulk=jnp.asarray(1e-12),
            fibre_energy=equation,
            fibre_invariant="full",
        )
        found = stress(law, jnp.asarray(F))[1, 1]
        np.testing.assert_allclose(found, 2.0 * k1 * E * factor * 2.0 * stretch, rtol=1e-9, atol=1e-9)


@every_law
def test_fibres_carry_no_compression(law):
    """With every fibre shortened, the law is its matrix."""
    stretch = np.random.default_rng(9).uniform(0.6, 0.95, (2, 40))
    F = np.zeros((3, 3, 40))
    F[1, 1], F[2, 2] = stretch
    F[0, 0] = 1.0 / (stretch[0] * stretch[1])
    if isinstance(law, Fung):
        pytest.skip("an exponential of strains, not of fibres")
    if isinstance(law, GOH):
        law = dataclasses.replace(law, dispersion=jnp.asarray(0.0))
    if isinstance(law, HSGR):
        law = dataclasses.replace(law, rho=jnp.asarray(1.0))
    matrix = NeoHookean(c=law.c, bulk=law.bulk)
    np.testing.assert_allclose(psi(law, jnp.asarray(F)), psi(matrix, jnp.asarray(F)), rtol=1e-12)


def test_dispersion_zero_is_hgo():
    goh = example(GOH, dispersion=jnp.asarray(0.0))
    hgo = HGO(c=goh.c, k1=goh.k1, k2=goh.k2, fibre_angle=goh.fibre_angle, bulk=goh.bulk)
    np.testing.assert_allclose(psi(goh, moderate), psi(hgo, moderate), rtol=1e-12)
    np.testing.assert_allclose(stress(goh, moderate), stress(hgo, moderate), rtol=1e-10, atol=1e-10)


def test_dispersion_one_third_forgets_the_angle():
    laws = [
        example(GOH, dispersion=jnp.asarray(1.0 / 3.0), fibre_angle=jnp.asarray(b)) for b in (0.0, 0.4, 1.5)
    ]
    for law in laws[1:]:
        np.testing.assert_allclose(psi(law, moderate), psi(laws[0], moderate), rtol=1e-12)
    # and is isotropic: psi(F R) = psi(F)
    R = np.moveaxis(rotations(60, 11), 0, -1)
    turned = jnp.asarray(np.einsum("ijn,jkn->ikn", moderate, R))
    np.testing.assert_allclose(psi(laws[0], turned), psi(laws[0], moderate), rtol=1e-10)


def test_dispersion_between_depends_on_the_angle():
    laws = [example(GOH, dispersion=jnp.asarray(0.2), fibre_angle=jnp.asarray(b)) for b in (0.2, 1.2)]
    assert np.max(np.abs(np.asarray(psi(laws[0], moderate) - psi(laws[1], moderate)))) > 1e-3


def test_rho_one_is_hgo():
    hsgr = example(HSGR, rho=jnp.asarray(1.0))
    hgo = HGO(c=hsgr.c, k1=hsgr.k1, k2=hsgr.k2, fibre_angle=hsgr.fibre_angle, bulk=hsgr.bulk)
    np.testing.assert_allclose(psi(hsgr, moderate), psi(hgo, moderate), rtol=1e-12)
    np.testing.assert_allclose(stress(hsgr, moderate), stress(hgo, moderate), rtol=1e-10, atol=1e-10)


def test_rho_zero_forgets_the_angle():
    laws = [example(HSGR, rho=jnp.asarray(0.0), fibre_angle=jnp.asarray(b)) for b in (0.0, 0.4, 1.5)]
    for law in laws[1:]:
        np.testing.assert_allclose(psi(law, moderate), psi(laws[0], moderate), rtol=1e-12)


def test_stress_is_continuous_where_fibres_of_hsgr_slacken():
    """At I4 = 1 the ground has a strain of its own, which the printed switch would drop at once."""
    law = example(HSGR, fibre_angle=jnp.asarray(0.0), rho=jnp.asarray(0.5), c=jnp.asarray(1.0))
    F = lambda hoop: (hoop * basis(1, 1) + 1.4 * basis(0, 0) + basis(2, 2) / (1.4 * hoop)).astype(float)
    below, above = stress(law, F(1.0 - 1e-9)), stress(law, F(1.0 + 1e-9))
    np.testing.assert_allclose(below, above, atol=1e-6 * float(jnp.max(jnp.abs(above))))


def test_fung_is_as_stiff_around_and_along_as_its_coefficients_say():
    """In plane strain, F = diag(1/l, l, 1): E_t = l - 1 + ..., so psi'' = 4 c + k1 b_t at l = 1."""
    law = example(Fung)
    zero, one = jnp.asarray(0.0), jnp.asarray(1.0)
    for axis, b in ((1, law.b_circumferential), (2, law.b_axial)):

        def energy(stretch, axis=axis):
            diagonal = [1.0 / stretch, one, one]
            diagonal[axis] = stretch
            return law.psi({(i, j): diagonal[i] if i == j else zero for i in range(3) for j in range(3)})

        curvature = float(jax.jit(jax.grad(jax.grad(energy)))(one))
        assert curvature == pytest.approx(4.0 * float(law.c) + float(law.k1 * b), rel=1e-12)


# ------------------------------------------------------------------------------------ extremes


def exact_psi(law: Material, F: np.ndarray) -> mpmath.mpf:
    """The energy of one F (3, 3) from the printed formulas, in 40 digits."""
    with mpmath.workdps(40):
        number = lambda name: mpmath.mpf(float(getattr(law, name)))
        F = mpmath.matrix(F.tolist())
        J, C = mpmath.det(F), F.T * F
        shrink = J ** (-mpmath.mpf(2) / 3)
        I1 = shrink * (C[0, 0] + C[1, 1] + C[2, 2])
        energy = number("bulk") / 2 * (J - 1) ** 2 + number("c") / 2 * (I1 - 3)
        if isinstance(law, NeoHookean):
            return energy
        if isinstance(law, Fung):
            E_t, E_z = (shrink * C[1, 1] - 1) / 2, (shrink * C[2, 2] - 1) / 2
            b_t, b_z = number("b_circumferential"), number("b_axial")
            Q = b_t * E_t**2 + b_z * E_z**2 + 2 * number("coupling") * mpmath.sqrt(b_t * b_z) * E_t * E_z
            return energy + number("k1") / 2 * mpmath.expm1(Q)
        for sign in (1, -1):
            a = mpmath.matrix(
                [0, mpmath.cos(number("fibre_angle")), sign * mpmath.sin(number("fibre_angle"))]
            )
            I4 = (a.T * C * a)[0]
            if getattr(law, "fibre_invariant", "isochoric") == "isochoric":
                I4 = I4 * shrink
            k1, k2 = number("k1"), number("k2")
            if isinstance(law, HSGR):
                rho = number("rho")
                S = (1 - rho) * (I1 - 3) ** 2 + rho * max(I4 - 1, 0) ** 2
                energy += k1 * (mpmath.expm1(k2 * S) / (2 * k2) if k2 else S / 2)
                continue
            d = number("dispersion") if isinstance(law, GOH) else mpmath.mpf(0)
            E = d * (I1 - 3) + (1 - 3 * d) * (I4 - 1)
            if E <= 0:
                continue
            fibre = mpmath.expm1(k2 * E**2) / (2 * k2) if k2 else E**2 / 2
            if getattr(law, "fibre_energy", "eq4") == "eq10":
                fibre -= E**2 / 2
            energy += k1 * fibre
        return energy


N_EXTREME = 400


def extreme_states(n: int, seed: int) -> np.ndarray:
    """det F from 0.05 to 5 and principal stretches from 0.2 to 3, turned at random, (3, 3, n)."""
    random = np.random.default_rng(seed)
    stretches = np.exp(random.uniform(math.log(0.2), math.log(3.0), (20 * n, 3)))
    volume = np.prod(stretches, axis=1)
    stretches = stretches[(volume > 0.05) & (volume < 5.0)][:n]
    assert len(stretches) == n
    corners = np.array(
        [[0.2, 0.5, 0.5], [0.2, 0.2, 3.0], [3.0, 3.0, 0.2], [3.0, 3.0, 5 / 9], [0.2, 3.0, 3.0]]
    )
    return stretched(np.concatenate([stretches, corners]), seed + 1)


@every_law
@pytest.mark.parametrize("k2", [0.0, 3.54, 15.4, 500.0, 1e4])
def test_crushed_and_torn(law, k2):
    """No NaN in energy, stress and moduli; the energy is right where float64 has it, else +inf."""
    if hasattr(law, "k2"):
        law = dataclasses.replace(law, k2=jnp.asarray(k2))
    F = extreme_states(N_EXTREME - 5, 12)
    value, first, second = (np.asarray(v) for v in all_derivatives(law, jnp.asarray(F)))
    for quantity in (value, first, second):
        assert not np.any(np.isnan(quantity))
    for found, one in zip(value[::8], np.moveaxis(F, -1, 0)[::8], strict=True):
        exact = exact_psi(law, one)
        if exact < mpmath.mpf(10) ** 300:
            assert found == pytest.approx(float(exact), rel=1e-10)
        elif exact > mpmath.mpf(10) ** 310:
            assert found == np.inf


@every_law
def test_stress_is_the_slope_of_the_energy_far_from_rest(law):
    F = extreme_states(100, 20)
    direction = np.random.default_rng(21).normal(size=F.shape)
    F, direction = jnp.asarray(F), jnp.asarray(direction)
    value, slope, curvature = (np.asarray(v) for v in along(law, F, direction))
    step = 1e-6
    forward, backward = (np.asarray(psi(law, F + s * step * direction)) for s in (1.0, -1.0))
    usable = value < 1e8
    assert np.sum(usable) > 20
    scale = np.abs(slope) + np.abs(curvature) * 1e-3 + np.abs(value)
    error = np.abs((forward - backward) / (2 * step) - slope) / scale
    assert np.max(error[usable]) < 1e-4


@every_law
def test_beyond_the_largest_exponent_the_slope_keeps_its_sign(law):
    """A fibre stretched without end pulls back, with a finite force."""
    if not hasattr(law, "k2"):
        pytest.skip("no fibres")
    law = dataclasses.replace(law, k2=jnp.asarray(500.0), fibre_angle=jnp.asarray(0.1))
    stretch = jnp.linspace(2.0, 3.0, 20)
    F = stretch**-0.5 * (basis(0, 0) + basis(2, 2)) + stretch * basis(1, 1)
    assert float(law.k2) * (float(stretch[0]) ** 2 - 1.0) ** 2 > LARGEST_EXPONENT
    pull = np.asarray(stress(law, F)[1, 1])
    assert np.all(np.isfinite(pull))
    assert np.all(pull > 0.0)


@every_law
def test_inverted_is_infinite_and_never_nan(law):
    F = extreme_states(N_EXTREME - 5, 30)
    F[:, 0] *= -1.0
    F[:, 0, :50] = 0.0  # flattened
    F[..., 0] = 0.0
    F = jnp.asarray(F)
    assert np.all(np.asarray(det(F)) <= 0.0)
    value, first, second = (np.asarray(v) for v in all_derivatives(law, F))
    assert np.all(value == np.inf)
    assert not np.any(np.isnan(first))
    assert not np.any(np.isnan(second))


@every_law
def test_derivative_by_every_constant(law):
    """Against central differences, in a wall that is stretched as an artery is."""
    F = jnp.asarray(np.array([[0.62, 0.05, 0.0], [0.02, 1.35, 0.1], [0.0, -0.04, 1.2]])[:, :, None])
    total = jax.jit(lambda material: jnp.sum(material.psi(F)))
    found = jax.jit(jax.grad(total))(law)
    for field in dataclasses.fields(law):
        if "range" not in field.metadata:
            continue
        constant = getattr(law, field.name)
        step = 1e-5 * constant
        ends = [total(dataclasses.replace(law, **{field.name: constant + s * step})) for s in (1.0, -1.0)]
        difference = float((ends[0] - ends[1]) / (2.0 * step))
        assert float(getattr(found, field.name)) == pytest.approx(difference, rel=1e-6, abs=1e-8)
