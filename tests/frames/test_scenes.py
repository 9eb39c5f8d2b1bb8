"""The Earth, Foucault's pendulum, hoop, turntable and libration, against closed forms."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import filter_once
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.special import ellipj

import rigidjax as rj
from rigidjax import orbits
from rigidjax.frames import Point, scenes
from rigidjax.frames.earth import RATE

TIGHT = dict(rtol=1e-13, atol=1e-14)
LATITUDE = 0.8527  # Paris
SIDEREAL_DAY = 86164.0905  # s, from equinox to equinox; WGS84 turns against the stars, 1e-7 less


def test_a_dropped_body_lands_east():
    place, height = scenes.earth(LATITUDE), 158.5
    fall = np.sqrt(2 * height / 9.80665)
    ts = [0.0, float(fall)]
    end = rj.simulate(None, Point([0.0, 0, height], [0.0, 0, 0]), ts, place, **TIGHT)
    wanted = RATE * 9.80665 * np.cos(LATITUDE) * fall**3 / 3
    east, north, _ = end.ys.x[-1]
    assert abs(float(place.eastward_deflection(height)) - wanted) < 1e-15
    # First order in Ω to the east; second order, Ω² t² of the height, in the rest.
    assert abs(float(east) - wanted) < 2 * (RATE * fall) ** 2 * wanted
    assert abs(float(north)) < (RATE * fall) ** 2 * height
    assert float(end.stats["drift"]["jacobi"]) < 1e-10


def test_throws_are_the_linear_motion():
    # Uniform gravity in a uniform frame is linear: the exponential of its matrix is exact.
    place, late = scenes.earth(0.5, rate=0.3), 4.0
    n, u = 0.3 * np.cos(0.5), 0.3 * np.sin(0.5)
    hat = np.array([[0, -u, n], [u, 0, 0], [-n, 0, 0]])
    matrix = np.zeros((7, 7))
    matrix[:3, 3:6] = np.eye(3)
    matrix[3:6, :3], matrix[3:6, 3:6], matrix[5, 6] = -hat @ hat, -2 * hat, -9.80665
    start = np.array([1.0, 2, 3, 4, -5, 6])
    ys = rj.simulate(None, Point(start[:3], start[3:]), [0.0, late], place, **TIGHT).ys
    wanted = (expm(late * matrix) @ np.append(start, 1.0))[:6]
    np.testing.assert_allclose(np.concatenate([ys.x[-1], ys.v[-1]]), wanted, rtol=0, atol=1e-10)


def swing_plane(ys):
    """How far the long axis of the ellipse has turned, from the mean of s² (s = east + i north)."""
    s = np.asarray(ys.x[:, 0]) + 1j * np.asarray(ys.x[:, 1])
    return 0.5 * np.angle(np.mean(s**2))


@pytest.mark.parametrize("ratio", [0.02, 0.04])
def test_foucault_precession(ratio):
    # The measured rate departs from −2π sin λ/day by the square of the amplitude: ⅜ (a/L)² of it,
    # because the bob, let go at rest, runs round a slim ellipse of half axes a and aΩ_z/ω.
    length, swings = 10.0, 100
    pendulum = scenes.foucault(LATITUDE, length)
    period = 2 * np.pi * np.sqrt(length / 9.80665) * (1 + ratio**2 / 16)
    late = swings * period
    fine = np.linspace(0, 2, 200, endpoint=False) * period
    ts = np.concatenate([fine, late + fine])
    ys = rj.simulate(None, pendulum.start(ratio * length, 0.0), ts, pendulum, **TIGHT).ys
    first, last = (
        swing_plane(jax.tree.map(lambda leaf, part=part: leaf[part], ys))
        for part in (slice(0, 200), slice(200, 400))
    )
    wanted = -2 * np.pi * np.sin(LATITUDE) / SIDEREAL_DAY
    assert abs(float(pendulum.precession_rate()) / wanted - 1) < 2e-7
    excess = (last - first) / late / wanted - 1
    assert abs(excess) < ratio**2
    assert abs(abs(excess) / ratio**2 - 0.375) < 0.05


def test_foucault_small_swings_in_closed_form():
    # In a place that turns four times as fast, where the plane has gone by 4e-3 at the end.
    pendulum = scenes.foucault(0.7, 2.0, rate=3e-4)
    ts = jnp.linspace(0.0, 20.0, 6)
    gaps = []
    for size in (0.02, 0.005):
        start = pendulum.state(size, 0.5 * size, 0.3 * size, -0.6 * size)
        ys = rj.simulate(None, start, ts, pendulum, **TIGHT).ys
        closed = filter_once(jax.vmap(lambda t, start=start: pendulum.small_swing(start, t)))(ts)
        gap = jnp.abs(ys.x - closed.x)[:, :2].max() + jnp.abs(ys.v - closed.v)[:, :2].max()
        gaps.append(float(gap) / size)
    # Relative, quadratic in the amplitude (down to Ω²L/g, where the plumb line itself moves).
    assert gaps[0] < 0.02 and gaps[1] < gaps[0] / 12


def test_foucault_keeps_its_string_and_energy():
    pendulum = scenes.foucault(-0.4, 3.0, rate=0.2)
    start = pendulum.state(1.5, -1.0, 0.7, 2.0)
    drift = rj.simulate(None, start, [0.0, 10.0, 20.0], pendulum, rtol=1e-12, atol=1e-12).stats[
        "drift"
    ]
    assert float(drift["length"]) < 1e-9 and float(drift["jacobi"]) < 1e-8


def test_bead_on_a_hoop():
    radius, rate, gravity = 1.3, 4.0, 9.8
    hoop = scenes.hoop(radius, rate, gravity)
    ts = np.linspace(0.0, 6.0, 7)
    ys = rj.simulate(None, hoop.state(0.4, 0.3), ts, hoop, **TIGHT).ys
    oracle = solve_ivp(
        lambda t, y: [y[1], np.sin(y[0]) * (rate**2 * np.cos(y[0]) - gravity / radius)],
        (0, 6), [0.4, 0.3], "DOP853", ts, rtol=1e-13, atol=1e-13,
    )  # fmt: skip
    angle = np.arctan2(ys.x[:, 0], -ys.x[:, 2])
    np.testing.assert_allclose(angle[-1], oracle.y[0, -1], atol=1e-10)
    np.testing.assert_allclose(angle, oracle.y[0], atol=1e-8)
    rest = hoop.state(hoop.equilibrium_angle())
    np.testing.assert_allclose(hoop.acceleration(0.0, rest), np.zeros(3), atol=1e-14)
    assert float(hoop.equilibrium_angle()) > 1
    slow = jax.grad(lambda w: scenes.hoop(1.0, w).equilibrium_angle())(1.0)
    assert float(slow) == 0.0


@pytest.mark.slow
def test_turntable_goes_straight_outside():
    table = scenes.turntable(0.7, 0.2)
    start, ts = Point([0.3, -0.2, 0], [0.4, 0.1, 0]), jnp.array([0.0, 1.5, 4.0])
    ys = rj.simulate(None, start, ts, table, **TIGHT).ys
    outside = jax.jit(jax.vmap(table.frame.to_inertial))(ys, ts)
    v = start.v + 0.7 * np.array([0.2, 0.3, 0])
    np.testing.assert_allclose(outside.x, start.x[None] + ts[:, None] * v[None], atol=1e-10)
    np.testing.assert_allclose(outside.x[-1], start.x + 4.0 * v, atol=1e-11)


def test_libration_in_the_plane_is_a_pendulum():
    # θ'' = −(3n²/2)((b − a)/c) sin 2θ: sin θ is a Jacobi elliptic sine.
    a, b, c, n, size = 1.0, 2.2, 2.5, 0.4, 0.9
    body, ts = rj.Inertia.from_principal(a, b, c), np.linspace(0.0, 30.0, 7)
    # u is body axis 1 at rest; a body with the small moment along the vertical is stable.
    start = rj.Attitude(rj.quaternion.exp(jnp.array([0.0, 0, size])), np.zeros(3))
    ys = rj.simulate(body, start, ts, scenes.libration(n), **TIGHT).ys
    m = np.sin(size) ** 2
    _, cn, dn, _ = ellipj(n * np.sqrt(3 * (b - a) / c) * ts, m)
    angle = 2 * np.arctan2(ys.q[:, 3], ys.q[:, 0])
    np.testing.assert_allclose(np.sin(angle), np.sin(size) * cn / dn, atol=1e-9)


def test_libration_in_space_keeps_its_integral():
    body, n = rj.Inertia.from_principal(1.0, 2.2, 2.5), 0.4
    start = rj.Attitude(rj.quaternion.exp(jnp.array([0.2, -0.3, 0.4])), np.array([0.1, 0.2, -0.1]))
    ys = rj.simulate(body, start, np.linspace(0.0, 20.0, 5), scenes.libration(n), **TIGHT).ys
    values = jax.vmap(lambda q, w: scenes.libration_integral(rj.Attitude(q, w), body, n))(
        ys.q, ys.omega
    )
    np.testing.assert_allclose(values, values[0], atol=1e-9)


def test_single_precision_stays():
    single = lambda *n: np.float32(n)
    state = Point(single(0, 0, -1), single(0.5, 0, 0))
    for scene in (
        scenes.earth(0.5),
        scenes.foucault(0.5, 1.0),
        scenes.hoop(1.0, 2.0),
        orbits.hill(),
    ):
        assert scene.acceleration(np.float32(0), state).dtype == jnp.float32
        assert all(q.dtype == jnp.float32 for q in scene.conserved(np.float32(0), state).values())
    ys = rj.simulate(None, state, single(0, 1), scenes.foucault(0.5, 1.0)).ys
    assert ys.x.dtype == jnp.float32


def covered(model, truth, scale, noise, draws):
    """z-scores of a fit to `draws` records with noise: estimate less truth, in its own sigmas."""
    value, jacobian = filter_once(model)(truth), jax.jacfwd(model)
    records = value[None] + noise * jax.random.normal(jax.random.key(0), (draws, *value.shape))

    def fit(record):
        def gauss_newton(p, _):
            slope = jacobian(truth + scale * p) * scale[None] / noise
            step = jnp.linalg.lstsq(slope, (record - model(truth + scale * p)) / noise)[0]
            return p + step, jnp.abs(step)

        found, steps = jax.lax.scan(gauss_newton, start, None, length=5)
        slope = jacobian(truth + scale * found) * scale[None] / noise
        sigma = jnp.sqrt(jnp.diag(jnp.linalg.inv(slope.T @ slope)))
        return found / sigma, jnp.max(steps[-1] / sigma)

    start = jnp.array([3.0, -3.0])[: truth.shape[0]]
    z, last = filter_once(lambda r: jax.lax.map(fit, r))(records)
    assert float(last.max()) < 0.05
    return np.asarray(z)


def foucault_record(p):
    """The bob of a Foucault pendulum at a latitude and a rate of turning, p."""
    # The plane's turning gives Ω sin λ. Ω cos λ shows only where the bob goes up and down in wide
    # swings north and south: on swings east and west the string takes its force.
    pendulum = scenes.foucault(p[0], 10.0, rate=p[1])
    start, ts = pendulum.start(0.0, 4.0), jnp.linspace(0.0, 200.0, 301)
    ys = rj.simulate(None, start, ts, pendulum, rtol=1e-10, atol=1e-12, adjoint=dfx.ForwardMode())
    return ys.ys.x[:, :2].reshape(-1)


def arc(p):
    """An arc of a particle under two bodies of mass ratio p."""
    start, ts = Point([1.02, -0.05, 0.2], [-0.1, 0.1, 0.1]), jnp.linspace(0.0, 2.0, 41)
    scene = orbits.cr3bp(p[0])
    return rj.simulate(None, start, ts, scene, adjoint=dfx.ForwardMode()).ys.x.reshape(-1)


# Record, truth, scale of the unknowns, noise.
FITS = {
    "latitude and rate": (foucault_record, [LATITUDE, RATE], [1e-2, 1e-7], 1e-6),
    "mass ratio": (arc, [0.01215058560962404], [1e-5], 1e-5),
}


@pytest.mark.parametrize("name", FITS)
def test_parameters_from_a_record(name):
    model, truth, scale, noise = FITS[name]
    z = covered(model, jnp.array(truth), jnp.array(scale), noise, 25)
    inside = (np.abs(z) < 1.96).sum(axis=0)
    assert (inside >= 21).all() and np.abs(z).max() < 4.5


@pytest.mark.slow
@pytest.mark.parametrize("name", FITS)
def test_intervals_cover_as_often_as_they_say(name):
    # Of 1000 true 95 % intervals 950 ± 6.9 cover: 93 to 97 % leaves 2.9 of these each way, and
    # an interval a tenth too narrow (92.2 %) is told; the spread of z, good to 2 %, says more.
    model, truth, scale, noise = FITS[name]
    z = covered(model, jnp.array(truth), jnp.array(scale), noise, 1000)
    inside = (np.abs(z) < 1.96).mean(axis=0)
    assert (inside >= 0.93).all() and (inside <= 0.97).all()
    assert (np.abs(z.mean(axis=0)) < 0.1).all() and (np.abs(z.std(axis=0) - 1) < 0.07).all()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: scenes.earth(48.85), "latitude: wanted radians .* were these degrees"),
        (lambda: scenes.earth(0.5, -9.8), "gravity: wanted a positive number"),
        (lambda: scenes.foucault(0.5, 0.0), "length: wanted a positive number"),
        (lambda: scenes.foucault(0.5, 1.0).start(2.0, 0.0), "beyond the length of the string"),
        (lambda: scenes.hoop(-1.0, 1.0), "radius: wanted a positive number"),
        (lambda: orbits.hill(-1.0), "radius: wanted a number ≥ 0"),
    ],
)
@pytest.mark.usefixtures("unhooked")
def test_mistakes_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
