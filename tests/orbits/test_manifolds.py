"""Manifolds, a connection between two orbits, and where families branch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import filter_once
from scipy.integrate import solve_ivp

import rigidjax as rj
from rigidjax import orbits
from rigidjax.orbits import manifolds

MU = 0.0121505856
MOON = orbits.cr3bp(MU)


@filter_once
def orbit_about(scene, point, amplitude):
    return scene.periodic_orbit(scene.lyapunov_guess(point, amplitude))


@pytest.mark.long
def test_the_direction_is_the_eigenvector_with_its_derivative():
    # LAPACK's, of a matrix with pairs λ, 1/λ; its derivative against differences.
    rng = np.random.default_rng(3)
    frame = rng.normal(size=(6, 6))
    pairs = np.diag([90.0, 1 / 90.0, 1.0, 1.0, np.cos(1.0), np.cos(1.0)])
    pairs[4, 5], pairs[5, 4] = np.sin(1.0), -np.sin(1.0)
    matrix = jnp.asarray(frame @ pairs @ np.linalg.inv(frame))
    value, vector = manifolds.unstable_direction(matrix)
    values, vectors = np.linalg.eig(np.asarray(matrix))
    k = np.argmax(np.abs(values))
    wanted = vectors[:, k].real * np.sign(vectors[0, k].real)
    np.testing.assert_allclose(value, 90.0, rtol=1e-10)
    np.testing.assert_allclose(vector, wanted, atol=1e-10)
    # A change that keeps the pairs: the frame's.
    change = jnp.asarray(rng.normal(size=(6, 6)))

    def turned(s):
        g = jnp.asarray(frame) + s * change
        return manifolds.unstable_direction(g @ jnp.asarray(pairs) @ jnp.linalg.inv(g))[1]

    found = jax.jacfwd(turned)(0.0)
    wanted = (turned(1e-5) - turned(-1e-5)) / 2e-5
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    np.testing.assert_allclose(jax.jacrev(turned)(0.0), found, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("side", [1, -1])
def test_motions_leave_and_arrive(side):
    orbit = orbit_about(MOON, 1, jnp.asarray(0.02))
    jacobi = float(MOON.jacobi_constant(orbit.state))
    distance = 1e-6
    out = {}
    for which in ("unstable", "stable"):
        found = MOON.manifold(
            orbit, which, side=side, count=6, samples=41, time=2.5, distance=distance
        )
        out[which] = found
        energies = jax.vmap(jax.vmap(MOON.jacobi_constant))(found.states)
        # Off by the square of the distance.
        np.testing.assert_allclose(energies, jacobi, atol=1e-8)
        assert (np.diff(found.ts) * (1 if which == "unstable" else -1) > 0).all()
    np.testing.assert_allclose(out["unstable"].multiplier * out["stable"].multiplier, 1.0)
    # A period later a motion is λ times as far from the orbit, to first order.
    start = MOON.manifold_start(orbit, 0.25, "unstable", side=side, distance=1e-8)
    value = float(out["unstable"].multiplier)
    times = [0.0, float(orbit.period)]
    how = dict(rtol=1e-13, atol=1e-15)
    there = rj.simulate(None, start, times, MOON, **how).ys
    begin = rj.simulate(None, orbit.state, [0.0, 0.25 * float(orbit.period)], MOON, **how).ys
    gap = np.concatenate([there.x - begin.x[-1:], there.v - begin.v[-1:]], axis=1)
    np.testing.assert_allclose(gap[1], value * gap[0], rtol=2e-3, atol=2e-3 * np.abs(gap[1]).max())
    # The stable one comes nearer as time goes on: backwards it leaves at 1/λ.
    start = MOON.manifold_start(orbit, 0.25, "stable", side=side, distance=1e-8)
    there = rj.simulate(None, start, [0.0, -times[1]], MOON, **how).ys
    gap = np.concatenate([there.x - begin.x[-1:], there.v - begin.v[-1:]], axis=1)
    np.testing.assert_allclose(gap[1], value * gap[0], rtol=2e-3, atol=2e-3 * np.abs(gap[1]).max())


def section(t, state, body):
    """The line through the smaller body, across the axis."""
    return state.x[0] - (1 - MU_SUN)


# Sun and Jupiter, and their most famous connection (Koon, Lo, Marsden and Ross 2000,
# doi:10.1063/1.166509): C = 3.037, in the plane x = 1 − μ.
MU_SUN = 9.537e-4


@pytest.mark.slow
def test_a_connection_between_two_orbits():
    sun = orbits.cr3bp(MU_SUN)
    jacobi = 3.037

    def orbit_with(point):
        # The amplitude at which the orbit has this constant, by the secant method.
        def miss(amplitude):
            orbit = orbit_about(sun, point, jnp.asarray(amplitude))
            return float(sun.jacobi_constant(orbit.state)) - jacobi, orbit

        a, b = 0.008, 0.012
        low = miss(a)[0]
        for _ in range(12):
            at, orbit = miss(b)
            if abs(at) < 1e-12:
                break
            a, b, low = b, b - at * (b - a) / (at - low), at
        return orbit

    first, second = orbit_with(1), orbit_with(2)

    def cut(orbit, phase, which, side, end):
        # Where it passes through the plane for the third time: y, v, and when.
        start = sun.manifold_start(orbit, phase, which, side=side, distance=1e-6)
        found = rj.crossings(
            None, start, 0.0, end, section, sun, max_crossings=3, rtol=1e-12, atol=1e-13
        )
        state = jax.tree.map(lambda leaf: leaf[2], found.states)
        return jnp.stack([state.x[1], state.v[1], state.v[0], found.times[2]])

    def leaving(phase):
        return cut(first, phase, "unstable", 1, 12.0)

    def arriving(phase):
        return cut(second, phase, "stable", -1, -12.0)

    def both_ends(phases):
        return leaving(phases[0]), arriving(phases[1])

    newton = filter_once(lambda phases: (both_ends(phases), jax.jacfwd(both_ends)(phases)))
    # The nearest of 400 phases of each are 2e-4 apart.
    phases = jnp.array([0.0401, 0.0351])
    for _ in range(8):
        (one, other), (by_one, by_other) = newton(phases)
        gap = (one - other)[:2]
        if float(jnp.abs(gap).max()) < 1e-10:
            break
        phases = phases - jnp.linalg.solve((by_one - by_other)[:2], gap)
    assert float(jnp.abs(gap).max()) < 1e-9
    # The same energy but for what starts so near an orbit are off, and so the same motion.
    np.testing.assert_allclose(one[2], other[2], atol=1e-8)
    # SciPy goes from near the first orbit to there, and back there from near the second.
    for phase, orbit, which, side, end in (
        (phases[0], first, "unstable", 1, one),
        (phases[1], second, "stable", -1, other),
    ):
        start = sun.manifold_start(orbit, phase, which, side=side, distance=1e-6)
        out = solve_ivp(
            slope, (0, float(end[3])), [*start.x[:2], *start.v[:2]], "DOP853", rtol=1e-13,
            atol=1e-14,
        ).y[:, -1]  # fmt: skip
        wanted = [1 - MU_SUN, end[0], end[2], end[1]]
        np.testing.assert_allclose(out, wanted, atol=1e-7)


def slope(t, y):
    """The planar problem, written down here."""
    x, y, vx, vy = y
    first, second = x + MU_SUN, x - 1 + MU_SUN
    a = (1 - MU_SUN) / np.hypot(first, y) ** 3
    b = MU_SUN / np.hypot(second, y) ** 3
    return [vx, vy, 2 * vy + x - a * first - b * second, -2 * vx + y - (a + b) * y]


@pytest.mark.slow
def test_where_the_halo_orbits_begin():
    near, far = MOON.lyapunov_guess(1, 0.005), MOON.lyapunov_guess(1, 0.03)
    found = MOON.bifurcation(near, far)
    np.testing.assert_allclose(MOON.stability_indices(found)[1], 1.0, atol=1e-9)
    # Halo orbits, which know nothing of stability, shrink to it: as z², by Richardson's series.
    numbers = []
    for height in (0.001, 0.002):
        guess = jax.tree.map(lambda leaf: leaf, found)
        x = guess.state.x.at[2].set(height)
        halo = MOON.periodic_orbit(
            orbits.PeriodicOrbit(rj.Point(x, guess.state.v), guess.period), hold="z"
        )
        numbers.append(
            np.array(
                [halo.state.x[0], halo.state.v[1], halo.period, MOON.jacobi_constant(halo.state)]
            )
        )
    # x, v_y, T and C at z = 0.
    limit = numbers[0] + (numbers[0] - numbers[1]) / 3
    wanted = [found.state.x[0], found.state.v[1], found.period, MOON.jacobi_constant(found.state)]
    np.testing.assert_allclose(limit, wanted, atol=2e-7)


@pytest.mark.long
def test_words(unhooked):
    orbit = MOON.lyapunov_guess(1, 0.01)
    with pytest.raises(ValueError, match="branch: wanted one of stable, unstable, got 'up'"):
        MOON.manifold_start(orbit, 0.0, "up")
    with pytest.raises(ValueError, match=r"side: wanted 1 \(to larger x"):
        MOON.manifold_start(orbit, 0.0, "stable", side=2)
    with pytest.raises(TypeError, match=r"wanted a PeriodicOrbit"):
        MOON.manifold_start(orbit.state, 0.0, "stable")
    with pytest.raises(ValueError, match="count: wanted a whole number of at least 1"):
        MOON.manifold(orbit, "stable", count=0)
    with pytest.raises(ValueError, match="distance: wanted a positive number"):
        MOON.manifold(orbit, "stable", distance=-1.0)
    with pytest.raises(ValueError, match="index: wanted 0 or 1"):
        MOON.bifurcation(orbit, orbit, index=2)
    with pytest.raises(ValueError, match="hold: wanted one of"):
        MOON.bifurcation(orbit, orbit, hold="q")
    with pytest.raises(ValueError, match="value: wanted a finite number, got nan"):
        MOON.bifurcation(orbit, orbit, value=np.nan)
    with pytest.raises(ValueError, match="phase: contains NaN"):
        MOON.manifold_start(orbit, np.nan, "stable")
    # Long after the end of Hill's family g is a stable orbit: the retrograde ones.
    hill = orbits.hill()
    stable = orbits.PeriodicOrbit(rj.Point([0.3, 0, 0], [0.0, -2.2, 0]), 0.8)
    with pytest.raises(ValueError, match="no multiplier that is real and of size above 1"):
        hill.manifold(hill.periodic_orbit(stable), "unstable", count=2, samples=2)
