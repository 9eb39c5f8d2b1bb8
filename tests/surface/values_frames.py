"""A second way for frames and scenes: positions differentiated, potentials, SciPy's DOP853."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
from scipy.integrate import solve_ivp
from surface import values as v
from surface.scenes import Kick, Place, Quadratic
from surface.values import between, fixed, leave_out, one_of, scale, way
from surface.values_bodies import tensor_of
from surface.values_motion import slope
from surface.values_numbers import derivative

import rigidjax as rj
from rigidjax import frames, orbits, scenes
from rigidjax.frames.frame_dynamics import InFrame
from rigidjax.rotation import quaternion as q4

# A frame about any axis, whose angle is ½ k t², at X (1 + t²).
FRAME = (one_of(v.ordinary, v.vector), between(-2, 2), one_of(v.ordinary, v.vector), between(-2, 2))
STATE = (v.ordinary, v.ordinary, v.quaternion, v.ordinary)


def moving(axis, k, place):
    return frames.MovingFrame(frames.AboutAxis(axis, Quadratic(k)), Place(place))


def pose(axis, k, place, t):
    """M and X at t."""
    return v.rotation(axis / v.norm(axis) * k * t * t / 2), place * (1 + t * t)


def rates(axis, k, place, t):
    """M, X, Ω and dΩ/dt in the axes of S', dX/dt, d²X/dt²: by differences of M and X."""
    at = lambda h: pose(axis, k, place, t + h)
    omega = lambda h: v.vee(at(h)[0].T @ derivative(lambda s: at(h + s)[0]))
    change = lambda h: derivative(lambda s: at(h + s)[1])
    return *at(0), omega(0), derivative(omega), change(0), derivative(change)


def seen(axis, k, place, t, x, u, f):
    m, origin, w, dw, speed, growth = rates(axis, k, place, t)
    terms = [-np.cross(w, np.cross(w, x)), -2 * np.cross(w, u), -np.cross(dw, x), -m.T @ growth]

    # What S sees of x' + v's + ½as²: all that is not a is what has to be made up for.
    def inertial(a):
        def place_at(s):
            p, o = pose(axis, k, place, t + s)
            return o + p @ (x + u * s + a * s * s / 2)

        return derivative(lambda h: derivative(lambda s: place_at(h + s)))

    return [
        (m, w, dw, origin, speed, growth), m, origin, w, *terms, sum(terms), *terms,
        f - m.T @ inertial(0 * f), inertial(f), m @ f, m.T @ f, m @ f, m.T @ f,
        v.dot(u, u) / 2 - v.dot(np.cross(w, x), np.cross(w, x)) / 2 + k,
        w, m,
    ]  # fmt: skip


def our_frame(axis, k, place, t, x, u, f):
    frame = moving(axis, k, place)
    now = frame.at(t)
    return [
        now, frame.matrix(t), frame.place(t), frame.angular_velocity(t), now.centrifugal(x),
        now.coriolis(u), now.euler_acceleration(x), now.translational_acceleration(), now.fictitious(x, u),
        frame.centrifugal(x, t), frame.coriolis(u, t), frame.euler_acceleration(x, t),
        frame.translational_acceleration(t), frame.acceleration(x, u, t, f),
        frame.acceleration_to_inertial(x, u, f, t), frame.force_to_inertial(f, t),
        frame.force_from_inertial(f, t), now.to_inertial_axes(f), now.from_inertial_axes(f),
        frame.jacobi_integral(rj.Point(x, u), t, k), frames.AboutAxis(axis, Quadratic(k)).rate(t),
        frames.AboutAxis(axis, Quadratic(k))(t),
    ]  # fmt: skip


way(
    " ".join(
        f"frames.{name}"
        for name in (
            "AboutAxis", "AboutAxis.rate", "Instant", "Instant.centrifugal", "Instant.coriolis",
            "Instant.euler_acceleration", "Instant.fictitious", "Instant.from_inertial_axes",
            "Instant.to_inertial_axes", "Instant.translational_acceleration", "MovingFrame", "MovingFrame.acceleration",
            "MovingFrame.acceleration_to_inertial", "MovingFrame.angular_velocity",
            "MovingFrame.at", "MovingFrame.centrifugal", "MovingFrame.coriolis",
            "MovingFrame.euler_acceleration", "MovingFrame.force_from_inertial",
            "MovingFrame.force_to_inertial", "MovingFrame.jacobi_integral", "MovingFrame.matrix",
            "MovingFrame.place", "MovingFrame.translational_acceleration",
        )
    ) + " Point",
    our_frame, (*FRAME, v.ordinary, v.ordinary, v.ordinary), seen, norm=True, cost=2,
)  # fmt: skip


def there(axis, k, place, t, x, u, q, w):
    """What S sees: place, velocity, attitude and rate by differences; and from S' of the same."""

    def at(s):
        m, origin = pose(axis, k, place, t + s)
        return origin + m @ (x + u * s), m @ v.matrix_of(v.times(q, v.quaternion_of(w * s)))

    def back(s):
        m, origin = pose(axis, k, place, t + s)
        return m.T @ (x + u * s - origin), m.T @ v.matrix_of(v.times(q, v.quaternion_of(w * s)))

    found = []
    for way_of in (at, back):
        p, r = way_of(0 * t)
        found += [p, derivative(lambda s, f=way_of: f(s)[0]), r, v.vee(
            r.T @ derivative(lambda s, f=way_of: f(s)[1]))]  # fmt: skip
    m, origin = pose(axis, k, place, t)
    return [*found, *found, m @ m, origin + m @ origin, m.T, -m.T @ origin]


def our_there(axis, k, place, t, x, u, q, w):
    frame, y = moving(axis, k, place), rj.Rigid(x, u, q, w)
    parts = lambda y: (y.x, y.v, q4.to_matrix(y.q), y.omega)
    now, twice, back = frame.at(t), frame.compose(frame), frame.inverse()
    return [
        parts(frame.to_inertial(y, t)), parts(frame.from_inertial(y, t)),
        parts(now.to_inertial(y)), parts(now.from_inertial(y)), twice.matrix(t), twice.place(t),
        back.matrix(t), back.place(t),
    ]  # fmt: skip


way(
    "frames.MovingFrame.to_inertial frames.MovingFrame.from_inertial frames.Instant.to_inertial "
    "frames.Instant.from_inertial frames.MovingFrame.compose frames.MovingFrame.inverse",
    our_there, (*FRAME, *STATE), there, norm=True,
)  # fmt: skip


def in_frame(axis, k, place, t, x, u, w):
    """A spring to |x'|⁴ inside and a weight outside, in a frame that turns steadily."""
    m, origin, omega, domega, _, growth = rates(axis, k, place, t)
    force = -4 * x**3 + m.T @ (place - (origin + m @ x)) + u
    found = force - np.cross(omega, np.cross(omega, x)) - 2 * np.cross(omega, u)
    spin = np.cross(w, x)
    steady = v.rotation(w * t)
    jacobi = v.dot(u, u) / 2 - v.dot(spin, spin) / 2 + (x**4).sum()
    return [
        found - np.cross(domega, x) - m.T @ growth, jacobi, steady, w,
        -4 * x**3 - np.cross(w, spin) - 2 * np.cross(w, u), u - x, u, u - x,
    ]  # fmt: skip


def our_in_frame(axis, k, place, t, x, u, w):
    power = lambda x: jnp.sum(x**4)
    scene = InFrame(
        moving(axis, k, place), inside=lambda t, y: y.v, outside=lambda t, y: place - y.x,
        potential=power,
    )  # fmt: skip
    steady = InFrame(frames.MovingFrame(frames.Uniform(w)), potential=power)
    force = frames.Force(lambda t, y, body: y.v - y.x)
    y = rj.Point(x, u)
    return [
        scene.acceleration(t, y), steady.conserved(t, y), frames.Uniform(w)(t),
        frames.Uniform(w).rate(t), steady.acceleration(t, y), force.acceleration(t, y),
        force.field(t, y), list(force.conserved(t, y).values()), scene.conserved(t, y),
    ]  # fmt: skip


way(
    "frames.InFrame frames.InFrame.acceleration frames.InFrame.conserved frames.Uniform "
    "frames.Uniform.rate frames.Force frames.Force.acceleration frames.Force.conserved "
    "frames.AbstractScene frames.AbstractScene.field",
    our_in_frame, (*FRAME, v.ordinary, v.ordinary, v.ordinary), in_frame, norm=True,
)  # fmt: skip


def in_body(axis, k, place, t, s, q, w):
    """The torque: I dΩ'/dt − IΩ' × Ω', with Ω' = Ω − R'ᵀΩ_frame differentiated along the motion."""
    i = tensor_of(s)
    _, _, omega, domega, _, _ = rates(axis, k, place, t)
    seen = lambda h: v.matrix_of(v.times(q, v.quaternion_of(w * h))).T @ (omega + domega * h)
    whole = w + seen(0 * t)
    change = v.solve(i, np.cross(i @ whole, whole)) - derivative(seen)
    return [i @ change - np.cross(i @ w, w)]


way(
    "frames.BodyInFrame",
    lambda axis, k, place, t, s, q, w: frames.BodyInFrame(moving(axis, k, place))(
        t, rj.Attitude(q, w), rj.Inertia.from_second_moment(s)),
    (*FRAME, lambda rng, i: v.second_moment(rng, 0), v.quaternion, v.ordinary), in_body, norm=True,
)  # fmt: skip


def jumping(ts):
    kick, frame = (
        Kick(rj.torques.Held(ts, jnp.ones((3, 3)))),
        frames.MovingFrame(frames.Uniform(ts)),
    )
    scene = InFrame(frame, inside=kick, outside=Kick(rj.torques.Held(3 + ts, jnp.ones((3, 3)))))
    laws = frames.Force(kick), frames.BodyInFrame(frame, kick), frames.BodyInFrame(frame), scene
    return [law.jump_times for law in laws]


way(
    "frames.Force.jump_times frames.BodyInFrame.jump_times frames.InFrame.jump_times",
    jumping, fixed(np.array([1.0, 2.0, 3.5])),
    lambda ts: [ts, ts, np.zeros(0), np.array([*ts, *(3 + ts)])],
)  # fmt: skip


# Libration in a circular orbit: the same with Ω along z, and the gradient of gravity along x.
def libration(n, i, q, w):
    r = v.matrix_of(q)
    up, normal = r[0], r[2]
    spin = np.array([0 * n, 0 * n, n])
    seen = lambda h: v.matrix_of(v.times(q, v.quaternion_of(w * h))).T @ spin
    whole = w + seen(0 * n)
    torque = 3 * n * n * np.cross(up, i @ up)
    change = v.solve(i, np.cross(i @ whole, whole) + torque) - derivative(seen)
    jacobi = v.dot(w, i @ w) + 3 * n * n * v.dot(up, i @ up) - n * n * v.dot(normal, i @ normal)
    return [i @ change, jacobi / 2]


# With the torque of its own rate, beside which round-off is to be seen.
way(
    "frames.scenes.libration frames.scenes.libration_integral",
    lambda n, i, q, w: (
        scenes.libration(n)(0.0, rj.Attitude(q, w), rj.Inertia(i)) + jnp.cross(i @ w, w),
        scenes.libration_integral(rj.Attitude(q, w), rj.Inertia(i), n),
    ),
    (scale(-3, 3), lambda rng, i: v.inertia(rng, i % 3), v.quaternion, v.ordinary), libration,
    norm=True,
)  # fmt: skip


# The turning Earth.
def on_earth(latitude, g, rate, length, h, t, x, u):
    w = rate * np.array([0 * rate, mp.cos(latitude), mp.sin(latitude)])
    fall = np.array([0 * g, 0 * g, -g])
    free = fall - np.cross(w, np.cross(w, x)) - 2 * np.cross(w, u)
    spin = np.cross(w, x)
    jacobi = v.dot(u, u) / 2 + g * x[2] - v.dot(spin, spin) / 2
    deflection = rate * g * mp.cos(latitude) / 3 * mp.sqrt(2 * h / g) ** 3
    # The string's pull keeps x·a + |v|² = 0.
    pulled = free - x * (v.dot(x, free) + v.dot(u, u)) / v.dot(x, x)
    # A swing as one complex number.
    up = w[2]
    f = mp.sqrt(g / length + up * up)
    s, ds = mp.mpc(x[0], x[1]), mp.mpc(u[0], u[1])
    b = (ds + 1j * up * s) / f
    at = lambda t: mp.exp(-1j * up * t) * (s * mp.cos(f * t) + b * mp.sin(f * t))
    place = at(t)
    speed = derivative(lambda h: at(t + h))
    return [
        free, w, jacobi, deflection, jacobi, pulled, -up,
        np.array([mp.re(place), mp.im(place), -length]),
        np.array([mp.re(speed), mp.im(speed), 0 * up]), jacobi, v.norm(x),
    ]  # fmt: skip


def our_earth(latitude, g, rate, length, h, t, x, u):
    place = scenes.earth(latitude, g, rate)
    swing = scenes.foucault(latitude, length, g, rate)
    y = rj.Point(x, u)
    return [
        place.acceleration(t, y), place.angular_velocity(), place.jacobi_integral(y),
        place.eastward_deflection(h), place.conserved(t, y), swing.acceleration(t, y),
        swing.precession_rate(), swing.small_swing(y, t), swing.conserved(t, y),
    ]  # fmt: skip


way(
    "frames.scenes.Earth frames.scenes.earth frames.scenes.Earth.acceleration "
    "frames.scenes.Earth.angular_velocity frames.scenes.Earth.conserved "
    "frames.scenes.Earth.eastward_deflection frames.scenes.Earth.jacobi_integral "
    "frames.scenes.Foucault frames.scenes.foucault frames.scenes.Foucault.acceleration "
    "frames.scenes.Foucault.conserved frames.scenes.Foucault.precession_rate "
    "frames.scenes.Foucault.small_swing",
    our_earth,
    (one_of(between(-1.5, 1.5), fixed(np.pi / 2, 0.0)), scale(-1, 2), scale(-5, 0), scale(-1, 2),
     scale(-1, 3), between(-30, 30), v.ordinary, v.ordinary),
    on_earth, norm=True,
)  # fmt: skip


def hung(length, e, n, a, b):
    up = -mp.sqrt(length**2 - (length * e) ** 2 - (length * n) ** 2)
    e, n = length * e, length * n
    place = np.array([e, n, up])
    return [place, np.array([a, b, -(e * a + n * b) / up]), place, 0 * place]


way(
    "frames.scenes.Foucault.state frames.scenes.Foucault.start",
    lambda length, e, n, a, b: (
        scenes.foucault(0.7, length).state(length * e, length * n, a, b),
        scenes.foucault(0.7, length).start(length * e, length * n),
    ),
    (scale(-3, 3), between(-0.6, 0.6), between(-0.6, 0.6), between(-2, 2), between(-2, 2)), hung,
)  # fmt: skip


def on_hoop(r, w, g, a, speed):
    """By the angle: θ'' = sin θ (Ω² cos θ − g/R)."""
    c, s = mp.cos(a), mp.sin(a)
    second = s * (w * w * c - g / r)
    x, u = r * np.array([s, 0 * s, -c]), r * speed * np.array([c, 0 * s, s])
    along = np.array([c, 0 * s, s])
    jacobi = r * r * (speed**2 - (w * s) ** 2) / 2 - g * r * c
    ratio = g / (w * w * r)
    return [
        r * second * along - r * speed**2 * np.array([s, 0 * s, -c]), jacobi, r,
        2 * w * u[0], x, u, mp.acos(ratio) if ratio < 1 else mp.mpf(0),
    ]  # fmt: skip


def our_hoop(r, w, g, a, speed):
    hoop = scenes.hoop(r, w, g)
    y = hoop.state(a, speed)
    return [
        hoop.acceleration(0.0, y), hoop.conserved(0.0, y), hoop.side_push(y), y,
        hoop.equilibrium_angle(),
    ]  # fmt: skip


way(
    "frames.scenes.Hoop frames.scenes.hoop frames.scenes.Hoop.acceleration "
    "frames.scenes.Hoop.conserved frames.scenes.Hoop.side_push frames.scenes.Hoop.state "
    "frames.scenes.Hoop.equilibrium_angle",
    our_hoop, (scale(-2, 2), scale(-1, 2), scale(-1, 2), between(-7, 7), between(-5, 5)), on_hoop,
)  # fmt: skip
way(
    "frames.scenes.turntable",
    lambda rate, growth, t, x, u: scenes.turntable(rate, growth).acceleration(t, rj.Point(x, u)),
    (scale(-3, 3), scale(-3, 3), between(-3, 3), v.ordinary, v.ordinary),
    lambda rate, growth, t, x, u: _table((rate + growth * t) * v.eye()[2], growth, x, u),
    norm=True,
)  # fmt: skip


def _table(w, growth, x, u):
    return -np.cross(w, np.cross(w, x)) - 2 * np.cross(w, u) - np.cross(growth * v.eye()[2], x)


# Three bodies: gradients of the potential, equilibria by their equation, traces.
def three(mu, x):
    first, second = x + mu * v.eye()[0], x - (1 - mu) * v.eye()[0]
    return (x[0] ** 2 + x[1] ** 2) / 2 + (1 - mu) / v.norm(first) + mu / v.norm(second)


def hill_potential(_, x):
    return (3 * x[0] ** 2 - x[2] ** 2) / 2 + 1 / v.norm(x)


def turned(u):
    return np.array([2 * u[1], -2 * u[0], 0 * u[0]])


def curvature(potential, x):
    size = max(abs(p) for p in x)
    return np.stack([
        derivative(lambda h, e=e: slope(potential, x + h * size * e)) / size for e in v.eye()
    ])  # fmt: skip


def traces(h):
    """Σ λ⁴, Σ λ⁶, Σ λ⁸ of small motions: those of powers of their matrix."""
    a = np.zeros((6, 6), object)
    a[:3, 3:], a[3:, :3], a[3, 4], a[4, 3] = v.eye(), h, mp.mpf(2), mp.mpf(-2)
    b = a @ a
    return [np.trace(b @ b), np.trace(b @ b @ b), np.trace(b @ b @ b @ b)]


def three_body(mu, x, u, c):
    value = three(mu, x)
    first, second = v.norm(x + mu * v.eye()[0]), v.norm(x - (1 - mu) * v.eye()[0])
    h = curvature(lambda y: three(mu, y), x)
    jacobi = 2 * value - v.dot(u, u)
    flat = np.array([x[0], x[1], 0 * mu])
    return [
        slope(lambda y: three(mu, y), x) + turned(u), value, first, second, jacobi, 2 * value - c,
        np.array([[2 * three(mu, flat)]]), jacobi, np.array([first, second]), np.array([0.1, 0.01]) + 0 * mu,
        h, *traces(h),
    ]  # fmt: skip


def our_three_body(mu, x, u, c):
    scene = orbits.cr3bp(mu, [0.1, 0.01])
    y = rj.Point(x, u)
    powers = scene.exponents(x)
    return [
        scene.acceleration(0.0, y), scene.potential(x), scene.distances(x),
        scene.jacobi_constant(y), scene.speed_squared(x, c), scene.zero_velocity(x[:1], x[1:2]),
        scene.conserved(0.0, y), scene.approach(0.0, y), scene.hessian(x),
        *(jnp.sum(powers**n).real for n in (4, 6, 8)),
    ]  # fmt: skip


MU = one_of(between(0.01, 0.5), scale(-12, -2), fixed(0.5))
way(
    " ".join(
        f"orbits.ThreeBody.{name}"
        for name in (
            "acceleration", "potential", "distances", "jacobi_constant", "speed_squared",
            "zero_velocity", "conserved", "approach", "hessian",
        )
    ) + " orbits.ThreeBody orbits.cr3bp",
    lambda *a: our_three_body(*a)[:-3],
    # Also near the second body, as near as μ lets it be.
    (MU, one_of(v.ordinary, lambda rng, i: rng.normal(size=3) * 1e-4 + [1.0, 0, 0]), v.ordinary,
     v.normal()),
    lambda *a: three_body(*a)[:-3], norm=True, cost=2,
)  # fmt: skip
# Of places in the plane, where the three pairs are; of up to their eighth powers.
way(
    "orbits.ThreeBody.exponents",
    lambda mu, x: our_three_body(mu, x, x, mu)[-3:],
    (MU, lambda rng, i: np.array([*rng.normal(size=2), 0.0])),
    lambda mu, x: three_body(mu, x, x, mu)[-3:], norm=True, ulps=32,
)  # fmt: skip


def equilibria(mu):
    """Zeros of dU/dx between and beyond the bodies, from a bracket; tips of triangles."""

    def pull(x):
        a, b = x + mu, x - 1 + mu
        return x - (1 - mu) * a / abs(a) ** 3 - mu * b / abs(b) ** 3

    hill, second = mp.cbrt(mu / 3), 1 - mu
    ends = (
        (-mu + mp.mpf(1) / 100, second - hill / 4), (second + hill / 4, second + 2 * hill + 1),
        (-mu - 2, -mu - mp.mpf(1) / 10),
    )  # fmt: skip
    rows = [
        [mp.findroot(pull, pair, solver="anderson", tol=mp.mpf(10) ** -70, maxsteps=200), 0, 0]
        for pair in ends
    ]
    tip = mp.sqrt(mp.mpf(3)) / 2
    return np.array([*rows, [mp.mpf(1) / 2 - mu, tip, 0], [mp.mpf(1) / 2 - mu, -tip, 0]])


way("orbits.ThreeBody.lagrange_points", lambda mu: orbits.cr3bp(mu).lagrange_points, MU,
    equilibria)  # fmt: skip


def hill_body(x, u):
    value = hill_potential(0, x)
    jacobi = 2 * value - v.dot(u, u)
    place = (mp.mpf(1) / 3) ** (mp.mpf(1) / 3) * v.eye()[0]
    return [
        slope(lambda y: hill_potential(0, y), x) + turned(u), jacobi, jacobi,
        np.array([v.norm(x)]), np.array([mp.mpf(0.1)]), np.stack([-place, place]),
    ]  # fmt: skip


way(
    "orbits.Hill orbits.hill orbits.Hill.acceleration "
    "orbits.Hill.jacobi_constant orbits.Hill.conserved orbits.Hill.approach "
    "orbits.Hill.lagrange_points",
    lambda x, u: (
        (hill := orbits.hill(0.1)).acceleration(0.0, rj.Point(x, u)),
        hill.jacobi_constant(rj.Point(x, u)), hill.conserved(0.0, rj.Point(x, u)),
        hill.approach(0.0, rj.Point(x, u)), hill.lagrange_points,
    ),
    (one_of(v.ordinary, v.normal(3, low=-4, high=2)), v.ordinary), hill_body, norm=True,
)  # fmt: skip

leave_out(
    "asked during a run: tests/orbits and tests/solve/answer/test_ending.py look at it",
    *(f"orbits.{name}.{what}" for name in ("Hill", "ThreeBody") for what in ("ends", "end_words")),
)

# Orbits: SciPy's DOP853 at 1e-13 with the variational equations, and shooting with it.
DOWN = 1e-13


def field_of(mu):
    """The field of cr3bp(mu), of Hill's problem for None, with its slope."""

    def field(x, u):
        if mu is None:
            r = np.sqrt(x @ x)
            a = np.array([3 * x[0], 0, -x[2]]) - x / r**3
            h = np.diag([3.0, 0, -1]) - np.eye(3) / r**3 + 3 * np.outer(x, x) / r**5
        else:
            a, h = np.array([x[0], x[1], 0.0]), np.diag([1.0, 1, 0])
            for m, at in ((1 - mu, -mu), (mu, 1 - mu)):
                d = x - [at, 0, 0]
                r = np.sqrt(d @ d)
                a, h = a - m * d / r**3, h - m * (np.eye(3) / r**3 - 3 * np.outer(d, d) / r**5)
        return a + np.array([2 * u[1], -2 * u[0], 0]), h

    return field


TURN = np.array([[0.0, 2, 0], [-2, 0, 0], [0, 0, 0]])


def flown(mu, state, times):
    """States (T, 6) and transition matrices (T, 6, 6) at times; the first is the start's."""
    field = field_of(mu)

    def slope(t, y):
        a, h = field(y[:3], y[3:6])
        phi = y[6:].reshape(6, 6)
        return np.concatenate(
            [y[3:6], a, np.concatenate([phi[3:], h @ phi[:3] + TURN @ phi[3:]]).ravel()]
        )

    y0 = np.concatenate([state, np.eye(6).ravel()])
    found = solve_ivp(slope, (times[0], times[-1]), y0, "DOP853", times, rtol=DOWN, atol=1e-14)
    return found.y[:6].T, found.y[6:].T.reshape(-1, 6, 6)


NAMES = ("x", "z", "vy", "period")


def shot(mu, start, hold):
    """The periodic orbit near four numbers x, z, v_y, T, one of them held: Newton's method."""
    numbers, free = np.array(start, float), [i for i in range(4) if i != NAMES.index(hold)]
    planar = abs(numbers[1]) < 1e-12 and hold != "z"
    if planar:
        free.remove(1)
    for _ in range(12):
        x, z, vy, period = numbers
        rows, phis = flown(mu, np.array([x, 0, z, 0, vy, 0]), [0.0, period / 2])
        end, phi = rows[-1], phis[-1]
        a = field_of(mu)(end[:3], end[3:])[0]
        speed = np.concatenate([end[3:], a]) / 2
        full = np.stack([phi[:, 0], phi[:, 2], phi[:, 4], speed], 1)
        left = [1, 3] if planar else [1, 3, 5]
        step = np.linalg.solve(full[np.ix_(left, free)], -end[left])
        numbers[free] += step
        if abs(step).max() < 1e-13:
            break
    return numbers


def numbers_of(orbit):
    return [orbit.state.x[..., 0], orbit.state.x[..., 2], orbit.state.v[..., 1], orbit.period]


MOON = 0.0121505856


def scene_of(mu):
    return orbits.hill() if mu is None else orbits.cr3bp(mu)


def guess(mu, x):
    """Four numbers near a periodic orbit: about L1, and around the small body."""
    if mu is None:
        return [x, 0 * x, 1.6 + 0 * x, 1.4 + 0 * x]
    return numbers_of(orbits.cr3bp(mu).lyapunov_guess(1, x))


def orbit_at(numbers):
    x, z, vy, period = numbers
    zero = 0 * x
    return orbits.PeriodicOrbit(
        rj.Point(jnp.stack([x, zero, z]), jnp.stack([zero, vy, zero])), period)  # fmt: skip


def row_of(orbit):
    return jnp.stack(numbers_of(orbit), -1)


def whole_turn(mu, start, t=None):
    x, z, vy, period = start
    return flown(mu, np.array([x, 0, z, 0, vy, 0]), [0.0, period if t is None else t])[1][-1]


def indices(mu, start):
    """½(λ + 1/λ) within the plane and across it: two of the six λ are 1."""
    whole = whole_turn(mu, start)
    across = (whole[2, 2] + whole[5, 5]) / 2
    return np.sort([across, np.trace(whole) / 2 - 1 - across])[::-1]


def steeper(mu, start, e=1e-4):
    """The family's slope by x: differences of order 4."""
    ends = [shot(mu, start + k * e * np.array([1.0, 0, 0, 0]), "x") for k in (1, -1, 2, -2)]
    return (8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12 * e)


def orbits_by_hand(mu, step=1e-3):
    def found(x, t):
        start = shot(mu, [float(n) for n in guess(mu, float(x))], "x")
        growth = steeper(mu, start)
        member = shot(mu, start + step * growth, "x")
        # So far along the tangent in (x, z, v_y, ½T), and square to it.
        half = np.array([1, 1, 1, 0.5])
        along = growth * half / np.linalg.norm(growth * half)
        after = start + step * along / half
        for _ in range(4):
            after = shot(mu, after, "x")
            after = after + growth * (step - (after - start) * half @ along) / (
                growth * half @ along
            )
        return [
            start, whole_turn(mu, start), whole_turn(mu, start, t), indices(mu, start), growth,
            np.stack([start, member]), after[None],
        ]  # fmt: skip

    return found


def our_orbits(mu, step=1e-3):
    @jax.jit
    def found(x, t):
        scene = scene_of(mu)
        orbit = scene.periodic_orbit(orbit_at(guess(mu, x)))
        at = orbit.state.x[0]
        return [
            row_of(orbit), scene.monodromy(orbit), scene.transition(orbit.state, t),
            scene.stability_indices(orbit).real, row_of(scene.family_slope(orbit)),
            row_of(scene.family(orbit, jnp.stack([at, at + step]))),
            row_of(scene.follow(orbit, step, 1)),
        ]  # fmt: skip

    return found


ORBITS = ("periodic_orbit", "monodromy", "transition", "stability_indices", "family_slope",
          "family", "follow")  # fmt: skip
for name, mu, where in (
    ("ThreeBody", MOON, between(0.005, 0.03)), ("Hill", None, between(0.295, 0.305))
):  # fmt: skip
    way(
        " ".join(f"orbits.{name}.{what}" for what in ORBITS) + " orbits.PeriodicOrbit",
        our_orbits(mu), (where, between(0.5, 1.5)), orbits_by_hand(mu), plain=True, batched=False,
        rtol=1e-9, cost=8,
    )  # fmt: skip


# An orbit's manifolds: the eigenvector of its monodromy, carried on and followed.
def manifold(x, distance):
    start = shot(MOON, [float(n) for n in guess(MOON, float(x))], "x")
    state = np.array([start[0], 0, start[1], 0, start[2], 0])
    values, vectors = np.linalg.eig(whole_turn(MOON, start))
    k = np.argmax(abs(values))
    vector = vectors[:, k].real * np.sign(vectors[0, k].real)
    rows, phis = flown(MOON, state, [0.0, start[3] / 2])
    found = []
    for at, phi in ((state, np.eye(6)), (rows[-1], phis[-1])):
        along = phi @ vector
        begin = at + distance * along / np.linalg.norm(along)
        found.append(flown(MOON, begin, np.array([0.0, 0.5, 1.0]))[0])
    # The stable one is the mirror image, in y and in time.
    return [
        np.array([0, 0.5, 1]), np.stack(found), np.array([0, 0.5]), values[k].real, found[1][0],
        found[0][0] * [1, -1, 1, -1, 1, -1],
    ]  # fmt: skip


@jax.jit
def our_manifold(x, distance):
    scene = orbits.cr3bp(MOON)
    orbit = scene.periodic_orbit(orbit_at(guess(MOON, x)))
    made = scene.manifold(orbit, "unstable", time=1.0, count=2, samples=3, distance=distance)
    flat = lambda p: jnp.concatenate([p.x, p.v], -1)
    return [
        made.ts, flat(made.states), made.phases, made.multiplier,
        flat(scene.manifold_start(orbit, 0.5, "unstable", distance=distance)),
        flat(scene.manifold_start(orbit, 0.0, "stable", distance=distance)),
    ]  # fmt: skip


way(
    "orbits.ThreeBody.manifold orbits.ThreeBody.manifold_start "
    "orbits.Manifold",
    our_manifold, (between(0.005, 0.03), scale(-6, -3)), manifold, plain=True, batched=False,
    rtol=1e-9, cost=8,
)  # fmt: skip
leave_out("the same code as of ThreeBody, whose row it is", "orbits.Hill.manifold",
          "orbits.Hill.manifold_start")  # fmt: skip


# A guess of third order: what is left is of the fourth, in the size of the orbit over γ.
def guessed(x):
    return list(shot(MOON, [float(n) for n in guess(MOON, float(x))], "x"))


way(
    "orbits.ThreeBody.lyapunov_guess", lambda x: guess(MOON, x), scale(-3.5, -3), guessed,
    plain=True, batched=False, rtol=1e-5, cost=4,
)  # fmt: skip


def halo(z):
    return numbers_of(orbits.cr3bp(MOON).halo_guess(1, z))


# A halo orbit is never small: of itself by the third power of about 1/5.
way(
    "orbits.ThreeBody.halo_guess", halo, between(0.01, 0.03),
    lambda z: list(shot(MOON, [float(n) for n in halo(float(z))], "z")), plain=True, batched=False,
    rtol=10 * 0.2**3, cost=4,
)  # fmt: skip


# Where halo orbits begin: the index across the plane is 1.
def branching(x, other):
    def index(at):
        start = shot(MOON, [*at], "x")
        whole = whole_turn(MOON, start)
        return start, (whole[2, 2] + whole[5, 5]) / 2 - 1

    ends = [index([float(n) for n in guess(MOON, float(a))]) for a in (x, other)]
    (a, f), (b, g) = ends
    for _ in range(6):
        c, h = index(b - (b - a) * g / (g - f))
        (a, f), (b, g) = (b, g), (c, h)
        if abs(h) < 1e-11:
            break
    return [b]


def our_branching(x, other):
    scene = orbits.cr3bp(MOON)
    ends = [scene.periodic_orbit(orbit_at(guess(MOON, a))) for a in (x, other)]
    return [row_of(scene.bifurcation(*ends))]


way(
    "orbits.ThreeBody.bifurcation", our_branching,
    (between(0.0155, 0.0158), between(0.0165, 0.017)), branching, plain=True, batched=False,
    rtol=1e-9, cost=8,
)  # fmt: skip
leave_out("the same code as of ThreeBody, whose row it is", "orbits.Hill.bifurcation")
way(
    "frames.AbstractScene.drift",
    lambda x, u: orbits.hill().drift(
        jnp.arange(2.0), rj.Point(jnp.stack([x, u]), jnp.stack([u, x]))),
    (v.ordinary, v.ordinary),
    lambda x, u: abs(
        2 * hill_potential(0, x) - v.dot(u, u) - 2 * hill_potential(0, u) + v.dot(x, x)),
    norm=True,
)  # fmt: skip
