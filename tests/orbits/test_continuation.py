"""Families of periodic orbits: published members, slopes, stability, turns."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from once import filter_once
from orbits.three_body_series import solve
from scipy.integrate import solve_ivp

from rigidjax import orbits
from rigidjax.frames import Point
from rigidjax.orbits import PeriodicOrbit, differential_correction

MU = 0.01215058560962404
MOON = orbits.cr3bp(MU)
# Howell 1984, doi:10.1007/BF01358403: halo orbits about L1 at μ = 0.04, six digits printed:
# x, z, v_y, half the period.
HOWELL = np.array(
    [
        [0.723268, 0.040000, 0.198019, 1.300177],
        [0.729988, 0.215589, 0.397259, 1.348532],
        [0.753700, 0.267595, 0.399909, 1.211253],
        [0.777413, 0.284268, 0.361870, 1.101099],
        [0.801125, 0.299382, 0.312474, 1.017241],
        [0.817724, 0.313788, 0.271306, 0.978635],
    ]
)


# JPL's catalogue of three-body periodic orbits, Earth and Moon, halo orbits about L2, southern,
# near-rectilinear: x, z, v_y at apolune (rows as a public program quotes them). The first has about
# the period of the Gateway's (9:2 with the synodic month).
JPL = np.array(
    [
        [1.0213448959167291, -0.18162633785360355, -0.10177771593237860],
        [1.0311112407855418, -0.18772287481683392, -0.12222545055005253],
        [1.0410413863429402, -0.19270725388017840, -0.14112595315877385],
        [1.0510246802643324, -0.19671629109317987, -0.15829051257176247],
        [1.0608510547453884, -0.19970484051930923, -0.17342665527688911],
    ]
)
JPL_PERIOD = 1.5021912429136250


def orbit_of(row):
    zero = jnp.zeros_like(row[0])
    start = Point(jnp.stack([row[0], zero, row[1]]), jnp.stack([zero, row[2], zero]))
    return PeriodicOrbit(start, 2 * row[3])


@eqx.filter_jit
def left(scene, orbits):
    """What the orbits miss at the half period, and their stability."""
    numbers = jax.vmap(differential_correction.numbers_of)(orbits)
    missed = jax.vmap(lambda n: differential_correction.half_period_residual(scene, n))(numbers)
    return jnp.max(jnp.abs(missed)), jax.vmap(scene.stability_indices)(orbits)


@pytest.mark.slow
def test_published_halo_orbits_and_their_stability():
    scene = orbits.cr3bp(0.04)
    correct = eqx.filter_jit(jax.vmap(lambda row: scene.periodic_orbit(orbit_of(row), hold="z")))
    found = correct(jnp.asarray(HOWELL))
    numbers = jax.vmap(differential_correction.numbers_of)(found)
    # Half a unit of the last digit printed, and of that of z carried along the family.
    slopes = jax.vmap(lambda orbit: scene.family_slope(orbit, hold="z"))(found)
    carried = np.stack(
        [slopes.state.x[:, 0], slopes.state.x[:, 2], slopes.state.v[:, 1], slopes.period / 2], 1
    )
    assert (np.abs(numbers - HOWELL) <= 0.51e-6 * (1 + np.abs(carried))).all()
    missed, nu = left(scene, found)
    assert float(missed) <= 1e-12
    # A narrow band is stable, roughly half way to the smaller body; the first is far from it.
    assert abs(float(nu[0, 0].real) - 1181.5) < 1
    assert np.abs(nu.imag).max() == 0
    # Against eigenvalues of the whole matrix; those beside the double one are only good to 1e-6.
    for k in (0, 2):
        whole = np.linalg.eigvals(
            np.asarray(scene.monodromy(jax.tree.map(lambda a, k=k: a[k], found)))
        )
        mean = np.sort((0.5 * (whole + 1 / whole)).real)
        wanted = np.sort(np.concatenate([nu[k].real, nu[k].real, [1.0, 1.0]]))
        np.testing.assert_allclose(mean, wanted, rtol=1e-5)


@pytest.mark.long
def test_jpls_near_rectilinear_halo_orbits():
    # x, v_y and the period at the catalogue's z. Its digits are good to 1e-12: its start leaves 9e-11
    # in v_z half a period on, at perilune, which changes of less than 1e-12 mend.
    whole = jnp.asarray([*JPL[0], JPL_PERIOD / 2])
    orbit = filter_once(lambda row: MOON.periodic_orbit(orbit_of(row), hold="z"))(whole)
    found = np.array([orbit.state.x[0], orbit.state.v[1], orbit.period])
    np.testing.assert_allclose(found, [JPL[0, 0], JPL[0, 2], JPL_PERIOD], rtol=0, atol=2e-12)
    # Stability from SciPy's variational equations, written down here, and LAPACK.
    numbers = np.concatenate([orbit.state.x, orbit.state.v, np.eye(6).ravel()])
    end = solve_ivp(
        variations, (0, float(orbit.period)), numbers, "DOP853", rtol=1e-13, atol=1e-13
    ).y[:, -1]
    np.testing.assert_allclose(end[:6], numbers[:6], atol=1e-12)
    values = np.linalg.eigvals(end[6:].reshape(6, 6))
    wanted = np.sort((0.5 * (values + 1 / values)).real)[[0, 2]]
    np.testing.assert_allclose(np.sort(MOON.stability_indices(orbit).real), wanted, atol=1e-9)
    # Nearly stable, which is why one stays there for little fuel: |ν| within 1.3.
    assert abs(wanted).max() < 1.31


@pytest.mark.slow
def test_jpls_near_rectilinear_family():
    # Along x from each orbit of the catalogue to the next, in quarters of the way.
    quarters = [np.linspace(a, b, 5)[1:] for a, b in itertools.pairwise(JPL[:, 0])]
    values = np.concatenate([JPL[:1, 0], *quarters])
    first = orbit_of(jnp.asarray([*JPL[0], JPL_PERIOD / 2]))
    found = eqx.filter_jit(lambda orbit: MOON.family(orbit, values))(first)
    numbers = np.stack([found.state.x[:, 0], found.state.x[:, 2], found.state.v[:, 1]], 1)
    np.testing.assert_allclose(numbers[::4], JPL, rtol=0, atol=2e-12)
    assert (np.diff(found.period) > 0).all()


def variations(t, y):
    """The restricted three-body problem and its variational equations."""
    x, v, matrix = y[:3], y[3:6], y[6:].reshape(6, 6)
    a = np.array([x[0] + 2 * v[1], x[1] - 2 * v[0], 0.0])
    slope = np.diag([1.0, 1.0, 0.0])
    for mass, place in ((1 - MU, -MU), (MU, 1 - MU)):
        r = x - np.array([place, 0, 0])
        d = np.linalg.norm(r)
        a -= mass * r / d**3
        slope -= mass * (np.eye(3) / d**3 - 3 * np.outer(r, r) / d**5)
    turn = np.array([[0.0, 2, 0], [-2, 0, 0], [0, 0, 0]])
    field = np.block([[np.zeros((3, 3)), np.eye(3)], [slope, turn]])
    return np.concatenate([v, a, (field @ matrix).ravel()])


@pytest.mark.slow
def test_a_lyapunov_family_and_its_slope():
    start = MOON.lyapunov_guess(1, 0.01)
    x, step = float(start.state.x[0]), 1e-4
    values = x - np.array([0.0, 0.005, 0.01 - step, 0.01, 0.01 + step, 0.02])
    found = MOON.family(start, values)
    np.testing.assert_array_equal(found.state.x[:, 0], values)
    np.testing.assert_array_equal(found.state.x[:, 1:], np.zeros((6, 2)))
    missed, nu = left(MOON, found)
    assert float(missed) <= 1e-12
    # The longer, the wider; d period/d amplitude against differences, good to their step squared.
    assert (np.diff(found.period) > 0).all()
    middle = jax.tree.map(lambda leaf: leaf[3], found)
    slope = MOON.family_slope(middle)
    for exact, member in ((slope.period, found.period), (slope.state.v[1], found.state.v[:, 1])):
        difference = (member[2] - member[4]) / (2 * step)
        assert abs(float(exact / difference) - 1) < 3e-5
    assert float(slope.state.x[0]) == 1
    per_time = MOON.family_slope(middle, hold="period")
    np.testing.assert_allclose(per_time.state.x[0] * slope.period, 1.0, rtol=1e-9)
    # Unstable in the plane all along; across it stable until the halo family branches off.
    assert (nu[:, 0].real > 500).all() and (np.diff(nu[:, 1].real) > 0).all()
    assert float(nu[0, 1].real) < 1 < float(nu[-1, 1].real)


def test_a_member_is_periodic_at_thirty_digits():
    # Its half period solved by Taylor series: what is left is float64's, not the equations'.
    found = filter_once(lambda: MOON.periodic_orbit(MOON.halo_guess(1, 0.05), hold="z"))()
    with mp.workdps(30):
        state = [float(c) for c in np.concatenate([found.state.x, found.state.v])]
        end = solve(MU, state, float(found.period) / 2)
    assert max(abs(float(end[k])) for k in (1, 3, 5)) < 1e-12


@pytest.mark.slow
def test_following_a_family_past_its_turn():
    # x of the halo family about L1 at μ = 0.04 first falls, then grows: held, it would be lost.
    scene = orbits.cr3bp(0.04)
    first = eqx.filter_jit(
        lambda: scene.periodic_orbit(orbit_of(jnp.asarray(HOWELL[0])), hold="z")
    )()
    found = scene.follow(first, 0.03, 8, rising="z")
    missed, _ = left(scene, found)
    assert float(missed) <= 1e-12
    turns = np.diff(np.append(float(first.state.x[0]), found.state.x[:, 0]))
    assert turns[0] < 0 < turns[-1] and (np.diff(found.state.x[:, 2]) > 0).all()
    numbers = np.asarray(jax.vmap(differential_correction.numbers_of)(found))
    chords = np.sqrt(np.square(np.diff(numbers, axis=0)).sum(axis=1))
    np.testing.assert_allclose(chords, 0.03, rtol=0.02)
    # The same members by another road.
    again = scene.family(first, found.state.x[:, 2], hold="z")
    np.testing.assert_allclose(again.period, found.period, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_gradients_of_a_family_both_ways():
    start = MOON.lyapunov_guess(1, 0.01)
    values = start.state.x[0] - jnp.array([0.0, 0.01, 0.02])

    def total(mu, values):
        found = orbits.cr3bp(mu).family(start, values)
        return jnp.sum(found.period * jnp.arange(1.0, 4.0)) + jnp.sum(found.state.v)

    reverse = jax.grad(total, (0, 1))(jnp.asarray(MU), values)
    forward = jax.jacfwd(total, (0, 1))(jnp.asarray(MU), values)
    for a, b in zip(reverse, forward, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11)
    member = MOON.family(start, values)
    slopes = jax.vmap(MOON.family_slope)(member)
    wanted = slopes.period * jnp.arange(1.0, 4.0) + slopes.state.v[:, 1]
    np.testing.assert_allclose(reverse[1], wanted, rtol=1e-9)
    h = 1e-6
    difference = (total(MU + h, values) - total(MU - h, values)) / (2 * h)
    np.testing.assert_allclose(reverse[0], difference, rtol=1e-6)


@pytest.mark.slow
def test_where_the_halo_family_branches_off():
    # Across the plane ν = 1 there; the halo orbits of small z end at the same planar orbit.
    start = MOON.lyapunov_guess(1, 0.01)
    x = float(start.state.x[0])
    family = MOON.family(start, np.linspace(x, x - 0.02, 41))
    nu = jax.vmap(MOON.stability_indices)(family)[:, 1].real
    branch = float(np.interp(1.0, nu, family.state.x[:, 0]))
    period = float(np.interp(1.0, nu, family.period))
    guess = MOON.halo_guess(1, 0.02)
    values = np.array([0.02, 0.01, 0.004, 0.002, 0.001])
    halo = MOON.family(guess, values, hold="z")
    # Even in z: differences fall by four, and a third of the last one leads to z = 0. The branch is
    # known to the square of the family's steps.
    for numbers, wanted in ((halo.state.x[:, 0], branch), (halo.period, period)):
        first, last = np.diff(numbers[2:])
        assert abs(first / last - 4) < 0.2
        assert abs(float(numbers[-1]) + last / 3 - wanted) < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(("mu", "stable"), [(0.04, True), (0.06, False)])
def test_a_long_walk_finds_the_stable_band(mu, stable):
    # Howell 1984: about L1 halo orbits are stable in a band that is gone at μ = 0.0573.
    scene = orbits.cr3bp(mu)
    near = eqx.filter_jit(lambda: scene.periodic_orbit(scene.halo_guess(1, 0.06), hold="z"))()
    found = scene.follow(near, 0.01, 75, rising="z")
    missed, nu = left(scene, found)
    assert float(missed) <= 1e-12
    calm = (np.abs(nu.imag) < 1e-9).all(axis=1) & (np.abs(nu.real) <= 1).all(axis=1)
    assert calm.any() == stable
    assert (np.diff(found.state.x[:, 2]) > 0).all()
    constants = jax.vmap(scene.jacobi_constant)(found.state)
    assert np.abs(np.diff(constants, 2)).max() < 0.01
    # Multipliers come in pairs λ, 1/λ: the product of all is 1, along the whole walk.
    volumes = np.linalg.det(np.asarray(jax.vmap(scene.monodromy)(found)))
    np.testing.assert_allclose(volumes, 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda o: MOON.family(o, [0.8, 0.8], hold="y"), "hold: wanted one of x, z, vy, period"),
        (lambda o: MOON.family(o, 0.8), r"values: wanted shape \(N,\)"),
        (lambda o: MOON.family(o, [0.8, np.nan]), "values: contains NaN or infinity at index"),
        (
            lambda o: MOON.family(o, [0.82, 0.6]),
            "family: lost the family at x = .*; take smaller steps",
        ),
        (lambda o: MOON.family_slope(o, hold="z"), "has a fold in z here"),
        (lambda o: MOON.follow(o, 0.0, 3), "step: wanted a number that is not 0"),
        (lambda o: MOON.follow(o, 0.1, 0), "count: wanted the number of members"),
        pytest.param(
            lambda o: MOON.follow(o, -1.0, 2),
            "follow: lost the family after 0 of 2 members; take smaller",
            marks=pytest.mark.slow,
        ),
        (lambda o: MOON.periodic_orbit(PeriodicOrbit(o.state, -1.0)), "a period that is positive"),
        (lambda o: MOON.periodic_orbit(PeriodicOrbit(o.state, np.inf)), "guess: contains NaN"),
        (lambda o: MOON.family(jax.tree.map(lambda a: a[None], o), [0.8]), "wanted one orbit"),
    ],
)
@pytest.mark.usefixtures("unhooked")
def test_mistakes_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call(MOON.lyapunov_guess(1, 0.01))
