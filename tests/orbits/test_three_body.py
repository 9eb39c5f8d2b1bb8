"""The restricted three-body problem and Hill's: published values, roots at 50 digits, orbits."""

import functools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from once import filter_once, once

import rigidjax as rj
from rigidjax import orbits
from rigidjax.frames import Point
from rigidjax.frames.frame_dynamics import InFrame
from rigidjax.orbits import PeriodicOrbit

# Hairer, Nørsett, Wanner, Solving Ordinary Differential Equations I, II.0.
ARENSTORF = PeriodicOrbit(
    Point([0.994, 0.0, 0.0], [0.0, -2.0015851063790824, 0.0]), 17.065216560157964
)
ARENSTORF_MU = 0.012277471
# pykep's documentation, propagation in the restricted three-body problem.
PYKEP_MU = 0.01215058560962404
PYKEP = Point(
    [1.01238082345234, -0.0423523523454, 0.22634376321],
    [-0.1232623614, 0.123462698209365, 0.123667064622],
)
PYKEP_TIME = 5.7856656782589235
PYKEP_END = np.array(
    [
        *(0.43038358727124, -1.64650668902846, 0.10271923139472),
        *(-0.9315629872575, -0.42680151362818, 0.22257221767767),
    ]
)
MOON = orbits.cr3bp(PYKEP_MU)


def end_of(scene, state, late, **kw):
    ys = rj.simulate(None, state, [0.0, float(late)], scene, **kw)
    return jnp.concatenate([ys.ys.x[-1], ys.ys.v[-1]]), ys.stats


def test_published_spatial_state():
    end, _ = end_of(MOON, PYKEP, PYKEP_TIME, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(end, PYKEP_END, rtol=0, atol=1e-10)
    assert abs(float(MOON.jacobi_constant(PYKEP)) - 2.967373061875731) < 1e-14


def quintic(mu, which):
    c = {
        1: [1, mu - 3, 3 - 2 * mu, -mu, 2 * mu, -mu],
        2: [1, 3 - mu, 3 - 2 * mu, -mu, -2 * mu, -mu],
        3: [1, 2 + mu, 1 + 2 * mu, mu - 1, 2 * mu - 2, mu - 1],
    }[which]
    start = mp.mpf("0.9") if which == 3 else mp.cbrt(mu / 3)
    return mp.findroot(lambda g: functools.reduce(lambda total, a: total * g + a, c), start)


@pytest.mark.parametrize("mu", [1e-12, 3.0035e-6, 9.5e-4, PYKEP_MU, 0.2, 0.5])
def test_lagrange_points_and_their_derivatives(mu):
    found, slope = jax.jvp(lambda m: orbits.cr3bp(m).lagrange_points, (mu,), (1.0,))
    with mp.workdps(50):

        def place(m, which):
            gap = quintic(m, which)
            return {1: 1 - m - gap, 2: 1 - m + gap, 3: -m - gap}[which]

        for which in (1, 2, 3):
            exact = mp.mpf(mu)
            wanted = float(place(exact, which))
            assert abs(float(found[which - 1, 0]) - wanted) <= 1e-14
            wanted = float(
                mp.diff(lambda m, w=which: place(m, w), exact, h=exact * mp.mpf("1e-15"))
            )
            assert abs(float(slope[which - 1, 0]) - wanted) <= 1e-11 * abs(wanted)
    for point in found:
        rest = orbits.cr3bp(mu).acceleration(0.0, Point(point, np.zeros(3)))
        np.testing.assert_allclose(rest, np.zeros(3), atol=1e-13 / mu**0.34)
    np.testing.assert_allclose(found[3:, 1], [0.75**0.5, -(0.75**0.5)], rtol=1e-15)


def test_stability_of_the_points():
    routh = 0.5 * (1 - (23 / 27) ** 0.5)
    for mu, stable in ((0.99 * routh, True), (1.01 * routh, False)):
        scene = orbits.cr3bp(mu)
        growth = [float(scene.exponents(p).real.max()) for p in scene.lagrange_points]
        assert min(growth[:3]) > 0.1 and (growth[3] < 1e-10) is stable
    # Against the eigenvalues of the derivative of the field itself.
    point = MOON.lagrange_points[0]

    def rate(y):
        return jnp.concatenate([y[3:], MOON.acceleration(0.0, Point(y[:3], y[3:]))])

    matrix = jax.jacfwd(rate)(jnp.concatenate([point, jnp.zeros(3)]))
    key = lambda z: (np.round(z.real, 8), np.round(z.imag, 8))
    wanted = sorted(np.linalg.eigvals(np.asarray(matrix)), key=key)
    found = sorted(np.asarray(MOON.exponents(point)), key=key)
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_rotating_field_is_the_inertial_one_seen_from_the_frame():
    # Both primaries move on circles in S; a frame turning at 1 must give the scene's own field.
    frame = rj.frames.MovingFrame(rj.frames.Uniform([0.0, 0.0, 1.0]))
    mu, t = PYKEP_MU, 0.8

    def pull(t, state):
        at = lambda r: r * jnp.stack([jnp.cos(t), jnp.sin(t), 0 * t])
        total = jnp.zeros(3)
        for mass, r in ((1 - mu, -mu), (mu, 1 - mu)):
            gap = state.x - at(r)
            total = total - mass * gap / jnp.sqrt(jnp.sum(gap**2)) ** 3
        return total

    inside = InFrame(frame, outside=pull).acceleration(jnp.asarray(t), PYKEP)
    np.testing.assert_allclose(inside, MOON.acceleration(t, PYKEP), atol=1e-12)


def test_zero_velocity():
    at = MOON.lagrange_points[0]
    jacobi = MOON.jacobi_constant(Point(at, np.zeros(3)))
    assert abs(float(MOON.speed_squared(at, jacobi))) < 1e-15
    assert float(MOON.speed_squared(MOON.lagrange_points[3], jacobi)) < 0
    np.testing.assert_allclose(jax.grad(MOON.potential)(at), np.zeros(3), atol=1e-13)


def test_zero_velocity_curves_pass_through_the_points():
    points = np.asarray(MOON.lagrange_points)
    grid = np.asarray(MOON.zero_velocity(points[:, 0], points[:, 1]))
    constants = np.diag(grid)
    # Closed form at L4 and L5; the others at 40 digits from Euler's quintics.
    np.testing.assert_allclose(constants[3:], 3 - PYKEP_MU * (1 - PYKEP_MU), rtol=1e-15)
    with mp.workdps(40):
        mu = mp.mpf(PYKEP_MU)
        for which in (1, 2, 3):
            gap = quintic(mu, which)
            x = {1: 1 - mu - gap, 2: 1 - mu + gap, 3: -mu - gap}[which]
            wanted = x**2 + 2 * (1 - mu) / abs(x + mu) + 2 * mu / abs(x - 1 + mu)
            assert abs(float(wanted) - constants[which - 1]) < 2e-15
    # The neck at L1 opens where C falls below its constant: on the line between the bodies the
    # least of the grid is that of L1.
    line = np.asarray(MOON.zero_velocity(np.linspace(0.1, 0.95, 2001), [0.0]))[0]
    assert constants[0] <= line.min() < constants[0] + 1e-5


def test_transition_matrix():
    late = 1.5
    found = np.asarray(MOON.transition(PYKEP, late))
    one = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.eye(3), np.zeros((3, 3))]])
    # In momenta p = v + (−y, x, 0) the motion is Hamiltonian, its derivative symplectic.
    turn = np.eye(6)
    turn[3, 1], turn[4, 0] = -1, 1
    canonical = turn @ found @ np.linalg.inv(turn)
    np.testing.assert_allclose(canonical.T @ one @ canonical, one, atol=1e-11)
    assert abs(np.linalg.det(found) - 1) < 1e-11
    step = 1e-5
    for k in range(6):
        bump = step * np.eye(6)[k]
        ends = [
            end_of(MOON, Point(PYKEP.x + s * bump[:3], PYKEP.v + s * bump[3:]), late, rtol=1e-13)[0]
            for s in (1, -1)
        ]
        np.testing.assert_allclose(found[:, k], (ends[0] - ends[1]) / (2 * step), atol=1e-6)


def closes(scene, orbit, bar):
    end, _ = end_of(scene, orbit.state, orbit.period, rtol=3e-14, atol=1e-15)
    start = jnp.concatenate([orbit.state.x, orbit.state.v])
    np.testing.assert_allclose(end, start, rtol=0, atol=bar)


@pytest.mark.parametrize("point", [1, *(pytest.param(p, marks=pytest.mark.slow) for p in (2, 3))])
def test_lyapunov_family(point):
    @filter_once
    def orbit(mu, amplitude):
        moon = orbits.cr3bp(mu)
        return moon.periodic_orbit(moon.lyapunov_guess(point, amplitude))

    mu = jnp.asarray(PYKEP_MU)
    periods = []
    for amplitude in (1e-5, 0.01, 0.02):
        found = orbit(mu, jnp.asarray(amplitude))
        closes(MOON, found, 1e-9)
        periods.append(float(found.period))
    # Small orbits have the period of the linear motion, 2π/|imaginary exponent in the plane|.
    u = np.asarray(MOON.hessian(MOON.lagrange_points[point - 1]))
    b = 4 - u[0, 0] - u[1, 1]
    rate = np.sqrt(0.5 * (b + np.sqrt(b * b - 4 * (u[0, 0] * u[1, 1] - u[0, 1] ** 2))))
    assert abs(periods[0] - 2 * np.pi / rate) < 1e-7
    assert periods[0] < periods[1] < periods[2]


def test_the_guess_of_a_lyapunov_orbit_is_of_third_order():
    """The velocity is off by the fourth power of the amplitude, of itself by the third."""

    @filter_once
    def off(amplitude):
        guess = MOON.lyapunov_guess(1, amplitude)
        found = MOON.periodic_orbit(guess)
        return guess.state.v[1] / found.state.v[1] - 1

    left = [float(off(jnp.asarray(a))) for a in (1e-3, 5e-4)]
    assert 7.5 < left[0] / left[1] < 8.5


@pytest.mark.oldest
def test_the_derivative_of_an_orbit_both_ways():
    def period(p):
        moon = orbits.cr3bp(p[0])
        return moon.periodic_orbit(moon.lyapunov_guess(1, p[1])).period

    @filter_once
    def all_of(p):
        return period(p), jax.jacfwd(period)(p), jax.grad(period)(p)

    p = jnp.array([PYKEP_MU, 0.01])
    _, forward, reverse = all_of(p)
    np.testing.assert_allclose(forward, reverse, rtol=1e-11)
    for k, step in ((0, 1e-6), (1, 1e-4)):
        up, down = (float(all_of(p.at[k].add(sign * step))[0]) for sign in (1, -1))
        np.testing.assert_allclose(forward[k], (up - down) / (2 * step), rtol=1e-5)


@pytest.mark.slow
def test_halo_family_with_gradients():
    @eqx.filter_jit
    def numbers(mu, height):
        moon = orbits.cr3bp(mu)
        guess = moon.halo_guess(1, 0.05)
        guess = eqx.tree_at(lambda g: g.state.x, guess, guess.state.x.at[2].set(height))
        orbit = moon.periodic_orbit(guess, hold="z")
        return jnp.stack([orbit.state.x[0], orbit.state.v[1], orbit.period]), orbit

    mu, height = jnp.asarray(PYKEP_MU), jnp.asarray(0.05)
    _, orbit = numbers(mu, height)
    assert float(orbit.state.x[2]) == 0.05
    closes(MOON, orbit, 1e-9)
    f = eqx.filter_jit(lambda m, h: numbers(m, h)[0])
    forward = eqx.filter_jit(jax.jacfwd(f, (0, 1)))(mu, height)
    reverse = eqx.filter_jit(jax.jacrev(f, (0, 1)))(mu, height)
    for k, step in ((0, 1e-6), (1, 1e-5)):
        np.testing.assert_allclose(forward[k], reverse[k], rtol=1e-12)
        up, down = ([mu, height], [mu, height])
        up[k], down[k] = up[k] + step, down[k] - step
        differences = (f(*up) - f(*down)) / (2 * step)
        np.testing.assert_allclose(forward[k], differences, rtol=1e-5, atol=1e-6)
    # Howell's family: multipliers come as λ, 1/λ, and two are 1.
    values = np.linalg.eigvals(np.asarray(MOON.monodromy(orbit)))
    order = np.sort(np.abs(values))
    assert abs(order[0] * order[-1] - 1) < 1e-6
    assert np.sort(np.abs(values - 1))[1] < 1e-3


def test_arenstorf_and_hill_are_corrected_too():
    guess = PeriodicOrbit(Point([0.994, 0, 0], [0.0, -2.00159, 0]), 17.0652)
    scene = orbits.cr3bp(ARENSTORF_MU)
    found = filter_once(scene.periodic_orbit)(guess)
    assert abs(float(found.state.v[1]) + 2.0015851063790824) < 1e-10
    assert abs(float(found.period) - 17.065216560157964) < 1e-9
    hill = orbits.hill()
    guess = PeriodicOrbit(Point([0.3, 0, 0], [0.0, 1.6, 0]), 1.2)
    found = filter_once(hill.periodic_orbit)(guess)
    closes(hill, found, 1e-10)


def test_hill_is_the_limit_of_small_mass():
    state = Point([0.4, 0.2, 0.1], [0.3, -0.2, 0.5])
    hill = orbits.hill()
    gaps = []
    for mu in (1e-6, 1e-9):
        scale = mu ** (1 / 3)
        near = Point(jnp.array([1 - mu, 0, 0]) + scale * state.x, scale * state.v)
        close = orbits.cr3bp(mu).acceleration(0.0, near) / scale
        gaps.append(float(jnp.abs(close - hill.acceleration(0.0, state)).max()))
    assert gaps[0] < 0.02 and gaps[1] < 0.12 * gaps[0]
    for point in hill.lagrange_points:
        rest = hill.acceleration(0.0, Point(point, np.zeros(3)))
        np.testing.assert_allclose(rest, np.zeros(3), atol=1e-14)
    solution = rj.simulate(None, state, [0.0, 2.0], hill, rtol=1e-12, atol=1e-12)
    assert float(solution.stats["drift"]["jacobi"]) < 1e-9


# At rest in the inertial frame, far from the light body: falls straight into the heavy one.
HEAD_ON = (orbits.cr3bp(1e-14), Point([0.5, 0.0, 0.0], [0.0, -0.5, 0.0]))


def test_a_collision_is_named():
    scene, start = HEAD_ON
    ts = np.linspace(0.0, 1.0, 101)
    # Kepler's fall from r = ½ takes π/2 √(r³/2) = 0.3927.
    with pytest.raises(
        ValueError, match=r"collision with body 1 .* t = 0\.392699.*ts before it is 0.39;"
    ):
        rj.simulate(None, start, ts, scene)
    kept = rj.simulate(None, start, ts, scene, throw=False)
    assert kept.result == dfx.RESULTS.event_occurred
    assert abs(float(kept.stats["end_time"]) - np.pi / 8) < 1e-7
    distances, _ = scene.approach(kept.stats["end_time"], kept.stats["end_state"])
    assert float(distances[0]) < 1e-6
    assert int(kept.stats["num_steps"]) < 2000
    early = np.asarray(kept.ys.x)[ts < 0.39]
    assert np.isfinite(early).all() and np.isnan(np.asarray(kept.ys.x)[-1]).all()
    wide = orbits.cr3bp(1e-14, radii=[0.1, 0.0])
    with pytest.raises(ValueError, match=r"body 1 of the scene at t = 0\.3"):
        rj.simulate(None, start, ts, wide)
    with pytest.raises(Exception, match="the particle collided"):
        eqx.filter_jit(lambda s: rj.simulate(None, s, ts, wide).ys.x)(start).block_until_ready()
    with pytest.raises(ValueError, match=r"collision with body 1 .* t = 0, .*; the start$"):
        rj.simulate(None, Point([0.05, 0, 0], [0.0, 0, 0]), ts, wide)


def test_particles_side_by_side_collide_alone():
    wide, ts = orbits.cr3bp(1e-14, radii=[0.1, 0.0]), jnp.array([0.0, 0.1, 0.6])
    # Falls, starts inside, and a circle of radius 1/2 about the heavy body: v = √2 less the turning.
    speeds = jnp.array([[0.0, -0.5, 0.0], [0.0, 0.0, 0.0], [0.0, np.sqrt(2.0) - 0.5, 0.0]])
    places = jnp.array([[0.5, 0.0, 0.0], [0.05, 0.0, 0.0], [0.5, 0.0, 0.0]])

    def end(x, v, radius):
        scene = eqx.tree_at(lambda s: s.radii, wide, jnp.stack([radius, jnp.zeros(())]))
        out = rj.simulate(None, Point(x, v), ts, scene, throw=False)
        return out.ys.x, out.stats["ended"], out.stats["end_time"]

    radius = jnp.array(0.1)
    x, hit, when = once(jax.vmap(end, (0, 0, None)))(places, speeds, radius)
    np.testing.assert_array_equal(hit, [True, True, False])
    assert when[1] == 0 and np.pi / 16 < when[0] < np.pi / 8
    reached = np.isfinite(np.asarray(x)).all(-1)
    np.testing.assert_array_equal(reached, [[1, 1, 0], [1, 0, 0], [1, 1, 1]])
    angle = (np.sqrt(8.0) - 1.0) * np.asarray(ts)
    circle = 0.5 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    np.testing.assert_allclose(x[2], circle, atol=1e-8)

    # Where it is neither stopped nor changed by it, the radius has no derivative; the start has.
    def last(v, radius):
        return end(places[2], v, radius)[0][-1]

    by_speed, by_radius = once(jax.jacrev(last, (0, 1)))(speeds[2], radius)
    np.testing.assert_array_equal(by_radius, np.zeros(3))
    forward = once(jax.jacfwd(last))(speeds[2], radius)
    np.testing.assert_allclose(by_speed, forward, rtol=1e-10, atol=1e-12)
    h = 1e-5 * np.eye(3)
    far = once(jax.vmap(lambda h: last(speeds[2] + h, radius) - last(speeds[2] - h, radius)))
    np.testing.assert_allclose(by_speed, np.asarray(far(jnp.asarray(h))).T / 2e-5, atol=1e-7)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: orbits.cr3bp(0.7), "mu: wanted 0 < mu ≤ ½"),
        (lambda: orbits.cr3bp(0.0), "mu: wanted 0 < mu ≤ ½"),
        (lambda: orbits.cr3bp(float("nan")), "mu: wanted 0 < mu ≤ ½"),
        (lambda: orbits.cr3bp(0.1, [-1.0, 0]), "radii: wanted two numbers ≥ 0"),
        (lambda: MOON.lyapunov_guess(4, 0.01), "point: wanted 1, 2 or 3"),
        (lambda: MOON.periodic_orbit(ARENSTORF, hold="y"), "hold: wanted one of x, z, vy, period"),
        (lambda: MOON.periodic_orbit(PeriodicOrbit(PYKEP, 1.0)), "at a right angle"),
        (
            lambda: MOON.periodic_orbit(PeriodicOrbit(Point([0.5, 0, 0], [0.0, 30.0, 0]), 1.0)),
            "went from the guess",
        ),
        (
            lambda: MOON.periodic_orbit(ARENSTORF, tolerance=1e-30),
            "no orbit near the guess .* at half period",
        ),
    ],
)
@pytest.mark.usefixtures("unhooked")
def test_mistakes_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
