"""A second way for laws and equations of motion: gradients of potentials at 40 digits, and words."""

import jax.numpy as jnp
import mpmath as mp
import numpy as np
from scipy.interpolate import CubicSpline
from surface import values as v
from surface.scenes import SYMMETRIC, Quadratic, Spring
from surface.values import between, fixed, leave_out, one_of, scale, way
from surface.values_bodies import props, tensor_of
from surface.values_numbers import derivative, euler_matrix, euler_rates

import rigidjax as rj
from rigidjax import lagrangian, torques as laws
from rigidjax.lagrangian.hamiltonian import MomentumAndDirection
from rigidjax.motion.coupled import Coupled
from rigidjax.motion.equations import (
    AttitudeEquations,
    EulerEquations,
    NewtonEuler,
    project_to_group,
)
from rigidjax.motion.torques.states import freeze_own_states
from rigidjax.rotation import quaternion as q4

STATE = (v.vector, v.vector, v.quaternion, v.vector)


def rigid(x, u, q, w):
    return rj.Rigid(x, u, q, w)


def gradient(potential, q):
    """The torque of U(q), body axes: minus the slope along turns about them."""
    turned = lambda h, e: v.times(q, v.quaternion_of(h * e))
    return np.array([-derivative(lambda h, e=e: potential(turned(h, e))) for e in v.eye()])


def slope(f, x):
    size = max(abs(p) for p in x) or 1
    return np.array([derivative(lambda h, e=e: f(x + h * size * e)) / size for e in v.eye()])


way(
    "motion.torques.ConstantTorque motion.torques.Damping motion.torques.QuadraticDamping "
    "motion.torques.InSpace motion.torques.Flywheel motion.torques.Flywheel.energy "
    "motion.torques.Flywheel.internal_momentum motion.torques.Sum",
    lambda c, q, w: [
        law(0.3, rj.Attitude(q, w), rj.Inertia(jnp.eye(3)))
        for law in (
            laws.ConstantTorque(c), laws.Damping(c), laws.QuadraticDamping(c), laws.InSpace(c),
            laws.Flywheel(c), laws.Sum(laws.Damping(c), laws.InSpace(c), lambda t, y, b: t * y.omega),
        )
    ] + [laws.Flywheel(c).energy(0.3, rj.Spin(w), None), laws.Flywheel(c).internal_momentum(0.3)],
    (v.vector, v.quaternion, v.vector),
    lambda c, q, w: (
        c, -c * w, -c * v.norm(w) * w, v.matrix_of(q).T @ c, np.cross(c, w),
        -c * w + v.matrix_of(q).T @ c + mp.mpf(0.3) * w, 0 * c[0], c,
    ),
    norm=True,
)  # fmt: skip
# Momenta that are functions of time: the torque takes their derivative.
way(
    "motion.torques.Flywheel (spun up) motion.torques.Flywheel",
    lambda a, w, t: laws.Flywheel(lambda s: a * jnp.sin(3.0 * s))(t, rj.Spin(w), None),
    (v.ordinary, v.ordinary, between(-3, 3)),
    lambda a, w, t: np.cross(a * mp.sin(3 * t), w) - 3 * a * mp.cos(3 * t), norm=True,
)  # fmt: skip


def top_energy(m, c, g, q):
    return -m * v.dot(g, v.matrix_of(q) @ c)


way(
    "motion.torques.HeavyTop motion.torques.HeavyTop.energy motion.torques.MagneticDipole "
    "motion.torques.MagneticDipole.energy motion.torques.FromPotential "
    "motion.torques.FromPotential.energy motion.torques.HeavyTop.axis "
    "motion.torques.MagneticDipole.axis",
    lambda m, c, g, q: [
        part
        for law in (
            laws.HeavyTop(m, c, g), laws.MagneticDipole(c, g), laws.FromPotential(Spring(m))
        )
        for part in (law(0.0, rj.Attitude(q, c), None), law.energy(0.0, rj.Attitude(q, c), None))
    ] + [laws.HeavyTop(m, c, g).axis, laws.MagneticDipole(c, g).axis],
    (scale(), v.vector, v.vector, v.quaternion),
    lambda m, c, g, q: [
        part
        for u in (
            lambda q: top_energy(m, c, g, q), lambda q: top_energy(1, c, g, q),
            lambda q: 2 * m * (q[1] ** 2 + q[2] ** 2 + 2 * q[3] ** 2),
        )
        for part in (gradient(u, q), u(q))
    ] + [g, g],
    norm=True,
)  # fmt: skip


def gradient_energy(mu, r, i, q):
    u = v.matrix_of(q).T @ r / v.norm(r)
    return mu / (2 * v.norm(r) ** 3) * (3 * v.dot(u, i @ u) - np.trace(i))


way(
    "motion.torques.GravityGradient motion.torques.GravityGradient.energy",
    lambda mu, r, i, q: (
        laws.GravityGradient(mu, r)(0.0, rj.Attitude(q, r), rj.Inertia(i)),
        laws.GravityGradient(mu, r).energy(0.0, rj.Attitude(q, r), rj.Inertia(i)),
    ),
    (scale(), v.vector, v.inertia, v.quaternion),
    lambda mu, r, i, q: (
        gradient(lambda q: gradient_energy(mu, r, i, q), q), gradient_energy(mu, r, i, q)),
    norm=True,
)  # fmt: skip


def central_energy(mu, m, s, x, q):
    return -mu * m / v.norm(x) + gradient_energy(mu, x, tensor_of(s), q)


# A body not larger than its distance: 𝔖/m is that of a body of about 1 m.
FAR = lambda rng, i: v.direction(rng, i) * 10.0 ** rng.uniform(0.5, 8)


def small(rng, i):
    return v.second_moment(rng, i % 5)


way(
    "motion.torques.CentralGravity motion.torques.CentralGravity.energy",
    lambda mu, m, c, s, x, u, q, w: (
        laws.CentralGravity(mu)(0.0, rigid(x, u, q, w), props(m, c, s)),
        laws.CentralGravity(mu).energy(0.0, rigid(x, u, q, w), props(m, c, s)),
    ),
    (scale(), scale(-2, 2), v.ordinary, small, FAR, *STATE[1:]),
    lambda mu, m, c, s, x, u, q, w: (
        -slope(lambda x: central_energy(mu, m, s, x, q), x),
        gradient(lambda q: central_energy(mu, m, s, x, q), q), central_energy(mu, m, s, x, q),
    ),
    norm=True,
)  # fmt: skip


def drags(k, a, b, c, wind, m, x, u, q, w):
    r = v.matrix_of(q)
    air = u - wind
    force = -k * v.norm(air) * air
    seen = r.T @ air
    other = -r @ (a * seen + b * abs(seen) * seen)
    return [
        force, np.cross(c, r.T @ force), other, np.cross(c, r.T @ other), m * a, 0 * a,
        -m * v.dot(a, x), 0 * a, a, b,
    ]  # fmt: skip


def our_drags(k, a, b, c, wind, m, x, u, q, w):
    y, body = rigid(x, u, q, w), props(m, c, jnp.eye(3))
    fall = laws.UniformGravity(a)
    wrench = laws.Wrench(a, b)
    return [
        laws.Drag(k, c, wind)(0.0, y, body), laws.BodyDrag(a, b, c, wind)(0.0, y, body),
        fall(0.0, y, body), jnp.zeros(3) if fall(0.0, y, body).torque is None else None,
        fall.energy(0.0, y, body), fall.internal_momentum(0.0), wrench,
    ]  # fmt: skip


way(
    "motion.torques.Drag motion.torques.BodyDrag motion.torques.UniformGravity "
    "motion.torques.UniformGravity.energy motion.torques.UniformGravity.internal_momentum "
    "motion.torques.Wrench",
    our_drags, (scale(-3, 3), v.ordinary, v.ordinary, v.vector, v.ordinary, scale(-3, 3), *STATE),
    drags, norm=True,
)  # fmt: skip


def pushes(n, d, k, c, r):
    force = sum(k[i] * n[i] ** 2 * d[i] for i in range(3))
    turn = sum(
        np.cross(r[i], k[i] * n[i] ** 2 * d[i])
        - s * c[i] * n[i] ** 2 * d[i]
        + s * c[i] * n[i] * np.cross(d[i], n)
        for i, s in enumerate((1, -1, 1))
    )
    return force, turn


# Directions are unit to round-off.
UNITS = lambda rng, i: np.stack([v.direction(rng, 1) for _ in range(3)])
way(
    "motion.torques.Rotors",
    lambda n, d, k, c, r, q: (
        laws.Rotors(r, d, jnp.asarray([1.0, -1.0, 1.0]), k, c, n, c)(0.0, rigid(
            r[0], r[1], q, n), props(1.0, r[0], jnp.eye(3)))),
    (v.normal(3, low=-3, high=4), UNITS, v.ordinary, v.ordinary, v.normal(3, 3), v.quaternion),
    lambda n, d, k, c, r, q: (v.matrix_of(q) @ pushes(n, d, k, c, r)[0], pushes(n, d, k, c, r)[1]),
    norm=True,
)  # fmt: skip

# Functions of time: at knots, between, before and after.
TIMES = np.array([-1.0, 0.0, 0.5, 2.0, 3.5])
AT = one_of(between(-1, 3.5), fixed(*TIMES), between(-9, -1), between(3.5, 99))


def row_at(t):
    return int(np.searchsorted(TIMES, float(t), side="right")) - 1


def held(rows, t):
    return rows[min(max(row_at(t), 0), 4)]


def line(rows, t):
    i = min(max(row_at(t), 0), 3)
    s = (t - TIMES[i]) / (TIMES[i + 1] - TIMES[i])
    s = min(max(s, mp.mpf(0)), mp.mpf(1))
    return rows[i] * (1 - s) + rows[i + 1] * s


def tables(rows, t):
    inside = TIMES[0] <= t < TIMES[-1]
    return [
        held(rows, t), line(rows, t), line(rows, t) if inside else 0 * rows[0],
        rows[row_at(t)] if inside else 0 * rows[0],
        sum((b - a) * r for a, b, r in zip(TIMES, TIMES[1:], rows, strict=False)),
        held(rows, t - mp.mpf(0.75)), [v.number(TIMES)] * 2, v.number(TIMES + 0.75),
        line(rows, t) + (line(rows, t - mp.mpf(0.75))),
    ]  # fmt: skip


def our_tables(rows, t):
    ts = jnp.asarray(TIMES)
    pulses = laws.Pulses(ts, rows[:-1])
    step, ramp = laws.Held(ts, rows), laws.Linear(ts, rows)
    spin = rj.Spin(jnp.zeros(3))
    return [
        step(t), ramp(t), laws.Tabulated(ts, rows)(t, spin, None), pulses(t, spin, None),
        pulses.impulse, laws.Delayed(step, 0.75)(t), ramp.jump_times, step.jump_times,
        laws.Delayed(step, 0.75).jump_times,
        laws.Sum(laws.InSpace(laws.bind(laws.Input("u"), {"u": ramp})),
                 laws.InSpace(laws.Delayed(ramp, 0.75)))(
            t, rj.Attitude(jnp.array([1.0, 0, 0, 0]), jnp.zeros(3)), rj.Inertia(jnp.eye(3))),
    ]  # fmt: skip


way(
    "motion.torques.Held motion.torques.Linear motion.torques.Tabulated motion.torques.Pulses "
    "motion.torques.Pulses.impulse motion.torques.Delayed "
    "motion.torques.Held.jump_times motion.torques.Linear.jump_times "
    "motion.torques.Delayed.jump_times motion.torques.Input motion.torques.bind",
    our_tables, (v.normal(5, 3, low=-20, high=20), AT), tables, norm=True,
)  # fmt: skip


def spline(rows, t):
    ts = 0.5 * np.arange(7) - 1.0
    return CubicSpline(ts, rows, bc_type="not-a-knot")(np.clip(t, ts[0], ts[-1]))


way(
    "motion.torques.Series",
    lambda rows, t: laws.Series(0.5 * np.arange(7.0) - 1.0, rows)(t),
    (v.normal(7, 3, low=-20, high=20), one_of(between(-1, 2), fixed(-1.0, 0.5, 2.0), between(3, 9))),
    spline, plain=True, norm=True,
)  # fmt: skip


leave_out(
    "beside a path in closed form: tests/motion/test_carried.py",
    "motion.torques.LoggedMotion", "motion.torques.LoggedMotion.from_poses",
    "motion.torques.Carried", "motion.torques.Carried.motion", "motion.torques.Kinematics",
)  # fmt: skip


def tilted(tilt, axis):
    """The axis, and so much of the two next ones."""
    found = np.array([mp.mpf(1), *tilt])
    return np.roll(found / v.norm(found), axis)


# What a log shows at t + ¼ s is what was at t.
way(
    "motion.torques.Wheel motion.torques.Wheel.direction",
    lambda j, tilt, k, t: (
        laws.Wheel(j, [0.0, 0.0, 1.0], Quadratic(k), delay=0.25, tilt=tilt)(t),
        laws.Wheel(j, [0.0, 1.0, 0.0], Quadratic(k), tilt=tilt).direction,
    ),
    (scale(), between(-0.3, 0.3, 2), scale(-3, 3), between(-3, 3)),
    lambda j, tilt, k, t: (
        j * k * (t + mp.mpf(0.25)) ** 2 / 2 * tilted(tilt, 2), tilted(tilt, 1)),
)  # fmt: skip


def lag(u, big, y, t):
    source = u * t * t / 2
    return (source - y) / big, source, y


way(
    "motion.torques.Lagged motion.torques.Lagged.rate motion.torques.Lagged.state0",
    lambda u, big, y, t: (
        laws.Lagged(Quadratic(u), big).rate(t, y, None, None),
        laws.Lagged(Quadratic(u), big).state0(t, None, None),
        freeze_own_states(laws.Lagged(Quadratic(u), big), (y,))(t),
    ),
    (scale(-5, 5), scale(-5, 5), scale(-5, 5), between(-3, 3)), lag,
)  # fmt: skip
way(
    "motion.torques.RandomTorque motion.torques.CorrelatedTorque "
    "motion.torques.CorrelatedTorque.deviation",
    lambda d, t: (
        laws.RandomTorque(d)(0.0, rj.Spin(d), None), laws.CorrelatedTorque(d, t)(
            0.0, rj.Spin(d), None), laws.CorrelatedTorque(d, t).deviation),
    (lambda rng, i: 10.0 ** rng.uniform(-20, 20, 3), scale()),
    lambda d, t: (0 * d, 0 * d, v.sqrt(d / (2 * t))),
)  # fmt: skip


def unscaled(rng, i):
    return v.inertia(rng, i % 5)


def third_energy(mu, r, i, q, c):
    x, y, z = u = v.matrix_of(q).T @ r / v.norm(r)
    s = u * u
    h = (
        c[0] * z * (2 * s[2] - 3 * (s[0] + s[1])) / 2
        + (c[1] * x + c[2] * y) * (4 * s[2] - s[0] - s[1]) * 3 / 2
        + 15 * z * (c[3] * (s[0] - s[1]) + 2 * c[4] * x * y)
        + 15 * (c[5] * x * (s[0] - 3 * s[1]) + c[6] * y * (3 * s[0] - s[1]))
    )  # fmt: skip
    return gradient_energy(mu, r, i, q) - mu / v.norm(r) ** 4 * h


way(
    "motion.torques.GravityGradient motion.torques.GravityGradient.energy (third degree)",
    lambda mu, r, i, q, c: (
        laws.GravityGradient(mu, r, (c,))(0.0, rj.Attitude(q, r), rj.Inertia(i)),
        laws.GravityGradient(mu, r, (c,)).energy(0.0, rj.Attitude(q, r), rj.Inertia(i)),
    ),
    (between(1, 9), v.ordinary, unscaled, v.quaternion, between(-1, 1, 7)),
    lambda mu, r, i, q, c: (
        gradient(lambda q: third_energy(mu, r, i, q, c), q), third_energy(mu, r, i, q, c)),
    norm=True,
)  # fmt: skip
way(
    "motion.torques.Chebyshev",
    lambda start, step, rows, part: laws.Chebyshev(start, step, rows)(start + step * part),
    (between(-2, 2), between(1, 2), between(-1, 1, 3, 2, 5), between(0.01, 2.99)),
    lambda start, step, rows, part: sum(
        rows[int(part), :, n] * mp.chebyt(n, 2 * (part - int(part)) - 1) for n in range(5)
    ),
)


def bulge(k, delay, mu, r, n, i, q, w):
    before = v.times(q, v.quaternion_of(-delay * w))
    u = v.matrix_of(before).T @ r / v.norm(r)
    pull = mu / v.norm(r) ** 3 * (np.outer(u, u) - v.eye() / 3)
    spin = np.outer(w, w) - v.dot(w, w) * v.eye() / 3
    spin = spin - n * n * (np.outer(v.eye()[2], v.eye()[2]) - v.eye() / 3)
    return i + k * (spin / 3 - pull)


way(
    "motion.torques.Tide",
    lambda k, delay, mu, r, n, i, q, w: laws.Tide(k, delay, mu, r, n)(
        0.3, rj.Attitude(q, w), rj.Inertia(i)),
    (between(0, 1), between(0.1, 1), between(1, 9), v.ordinary, between(0, 2), unscaled, v.quaternion, v.ordinary),
    bulge,
    norm=True,
)  # fmt: skip
# The body that is given sets nothing but, by its inverse, how many digits are left.
way(
    "motion.torques.ChangingInertia motion.torques.ChangingInertia.tensor",
    lambda i, j, c, t, w: (
        EulerEquations(rj.Inertia(SYMMETRIC), laws.ChangingInertia(
            lambda s: i + s * j, laws.Damping(c)))(t, rj.Spin(w)),
        laws.ChangingInertia(lambda s: i + s * j).tensor(t),
    ),
    (unscaled, unscaled, v.ordinary, between(0, 3), v.ordinary),
    lambda i, j, c, t, w: (
        v.solve(i + t * j, np.cross((i + t * j) @ w, w) - j @ w - c * w), i + t * j),
    norm=True,
)  # fmt: skip


def wheel_rows(j, s, motor, limit, top, c, d, i, q, w, own):
    a = np.array([[1, 0, 0], [0, mp.mpf(0.6), mp.mpf(0.8)]])
    speeds = own / j - a @ w
    wish = np.array([min(max(x, -limit), limit) for x in motor])
    fade = []
    for x, y in zip(wish, speeds, strict=True):
        room = min(max((top - y if x > 0 else top + y) / (top / 20), mp.mpf(0)), mp.mpf(1))
        fade.append(6 * room**5 - 15 * room**4 + 10 * room**3)
    put = wish * np.array(fade) - c * speeds - d * v.tanh(speeds / mp.mpf(0.5))
    h = a.T @ own
    return [
        np.cross(h, w) - a.T @ put, sum(own**2 / (2 * j)), h, put, speeds, put,
        j * (s + a @ w), i - sum(k * np.outer(x, x) for k, x in zip(j, a, strict=True)),
        w, (j * (s + a @ w),),
    ]  # fmt: skip


def our_wheels(j, s, motor, limit, top, c, d, i, q, w, own):
    law = laws.ReactionWheels(
        jnp.asarray([[1.0, 0, 0], [0, 0.6, 0.8]]), j, s, motor, max_torque=limit, max_speed=top,
        viscous=c, coulomb=d, turn_over=0.5,
    )  # fmt: skip
    y, body = rj.Spin(w), rj.Inertia(i)
    return [
        law(0.1, y, body, own), law.energy(0.1, y, body, own), law.internal_momentum(0.1, own),
        law.rate(0.1, own, y, body), law.speeds_of(own, y), law.torques_of(0.1, own, y),
        law.state0(0.1, y, body), law.without_wheels(body), Coupled.start(body, y, law, 0.1),
    ]  # fmt: skip


way(
    "motion.torques.ReactionWheels motion.torques.ReactionWheels.energy "
    "motion.torques.ReactionWheels.internal_momentum motion.torques.ReactionWheels.rate "
    "motion.torques.ReactionWheels.speeds_of motion.torques.ReactionWheels.torques_of "
    "motion.torques.ReactionWheels.state0 motion.torques.ReactionWheels.without_wheels "
    "motion.Coupled motion.Coupled.start",
    our_wheels,
    (between(0.1, 2.0, 2), v.normal(2), v.normal(2), between(0.3, 1.0), between(5.0, 6.0),
     between(0, 1), between(0, 1), v.inertia, v.quaternion, v.ordinary, v.normal(2)),
    wheel_rows, norm=True,
)  # fmt: skip


# Equations of motion, of tensors that can be turned: not the almost massless axis of a rod alone.
def euler(i, w, torque):
    return v.solve(i, np.cross(i @ w, w) + torque)


way(
    "equations_of_motion Spin Attitude",
    lambda i, c, q, w: (
        EulerEquations(rj.Inertia(i), laws.ConstantTorque(c))(0.0, rj.Spin(w)),
        EulerEquations(rj.Inertia(i), laws.ConstantTorque(c)).angular_acceleration(0.0, rj.Spin(w)),
        EulerEquations(rj.Inertia(i)).acceleration_under(c, rj.Spin(w)),
        AttitudeEquations(rj.Inertia(i), laws.InSpace(c))(0.0, rj.Attitude(q, w)),
        rj.equations_of_motion(rj.Inertia(i), rj.Attitude(q, w), laws.InSpace(c))(
            0.0, rj.Attitude(q, w), None),
    ),
    (v.inertia, v.vector, v.quaternion, v.vector),
    lambda i, c, q, w: (
        (euler(i, w, c),) * 3,
        ((v.times(q, [0, *w]) / 2, euler(i, w, v.matrix_of(q).T @ c)),) * 2,
    ),
    norm=True,
)  # fmt: skip
way(
    "Rigid",
    lambda m, c, s, g, k, x, u, q, w: NewtonEuler(
        props(m, c, s), laws.Sum(laws.UniformGravity(g), laws.Drag(k, c)))(
            0.0, rigid(x, u, q, w)),
    (scale(-3, 3), v.ordinary, v.second_moment, v.vector, scale(-3, 3), v.vector, v.vector,
     v.quaternion, v.vector),
    lambda m, c, s, g, k, x, u, q, w: (
        u, g - k * v.norm(u) * u / m, v.times(q, [0, *w]) / 2,
        euler(tensor_of(s), w, np.cross(c, v.matrix_of(q).T @ (-k * v.norm(u) * u))),
    ),
    norm=True,
)  # fmt: skip
way("Attitude (on the group)", lambda q, w: project_to_group(rj.Attitude(q, w)),
    (lambda rng, i: v.quaternion(rng, i) * 10.0 ** rng.uniform(-20, 20), v.vector),
    lambda q, w: (q / v.norm(q), w))  # fmt: skip


def kept(m, c, g, i, q, w):
    """Of a heavy top, and of the free body: energy, momentum, its square."""
    r = v.matrix_of(q)
    spin = r @ i @ w
    half = v.dot(w, i @ w) / 2
    full = half + top_energy(m, c, g, q)
    return [full, full, v.dot(spin, g) / v.norm(g), half, spin, v.dot(spin, spin)]


way(
    "energy conserved",
    lambda m, c, g, i, q, w: (
        rj.energy(rj.Inertia(i), rj.Attitude(q, w), laws.HeavyTop(m, c, g)),
        rj.conserved(rj.Inertia(i), rj.Attitude(q, w), laws.HeavyTop(m, c, g)),
        rj.conserved(rj.Inertia(i), rj.Attitude(q, w)),
    ),
    (scale(-3, 3), v.vector, v.vector, v.inertia, v.quaternion, v.vector), kept, norm=True,
)  # fmt: skip


def moved_apart(i, w, p):
    """Three rates that are no motion: the largest distances from the first, and one."""
    rows = [w, w + p, w - p]
    kinetic = [v.dot(x, i @ x) / 2 for x in rows]
    squares = [v.dot(i @ x, i @ x) for x in rows]
    return [1 + max(abs(x - row[0]) for x in row) / max(row) for row in (kinetic, squares)]


# Known to round-off of the quantity itself, of which it is a share.
way(
    "drift",
    lambda i, w, p: [1.0 + x for _, x in sorted(rj.drift(
        jnp.arange(3.0), rj.Spin(jnp.stack([w, w + p, w - p])), rj.Inertia(i)).items())],
    (v.inertia, v.vector, v.ordinary), moved_apart, norm=True,
)  # fmt: skip

# Lagrange's and Lie and Poisson's equations: those of Euler, in Euler's angles.
ANGLES = lambda rng, i: np.array([rng.uniform(-3, 3), rng.uniform(0.3, 2.8), rng.uniform(-3, 3)])


def euler_top(m, c, g, i, q, rate):
    """Ω, L, the acceleration of the angles, energy."""
    turned = euler_matrix(q, "ZXZ")
    w = euler_rates(q, rate, "ZXZ")[0]
    u = -m * v.dot(g, turned @ c)
    kinetic = v.dot(w, i @ w) / 2
    change = euler(i, w, np.cross(c, m * turned.T @ g))
    second = derivative(lambda h: euler_rates(q + h * rate, w + h * change, "ZXZ")[2])
    return kinetic - u, rate, second, kinetic + u


def our_top(m, c, g, i, q, rate):
    made = lagrangian.EulerAngleTop(rj.Inertia(i), laws.HeavyTop(m, c, g))
    field = lagrangian.equations_of_motion(made)
    y = lagrangian.Coordinates(q, rate)
    return made(q, rate), field(0.0, y), field.energy(y)


way(
    "lagrangian.EulerAngleTop lagrangian.equations_of_motion "
    "lagrangian.LagrangeEquations lagrangian.LagrangeEquations.energy "
    "lagrangian.Coordinates",
    our_top, (scale(-1, 1), v.ordinary, v.ordinary, lambda rng, i: v.inertia(rng, i % 5), ANGLES, v.ordinary), euler_top,
    norm=True, cost=2,
)  # fmt: skip
way(
    "lagrangian.to_attitude lagrangian.from_attitude",
    lambda q, rate, w: (
        q4.to_matrix((y := lagrangian.to_attitude(lagrangian.Coordinates(q, rate))).q), y.omega,
        lagrangian.from_attitude(rj.Attitude(y.q, w)),
    ),
    (ANGLES, v.ordinary, v.ordinary),
    lambda q, rate, w: (
        euler_matrix(q, "ZXZ"), euler_rates(q, rate, "ZXZ")[0], q, euler_rates(q, w, "ZXZ")[2]),
    norm=True,
)  # fmt: skip


def poisson(m, c, g, i, q, w, p, gamma):
    """Π' and γ' by Euler's equations with dγ/dt = γ × Ω; the energy; start."""
    start = i @ w, v.matrix_of(q).T @ g
    w = v.solve(i, p)
    turned = np.cross(p, w)
    energy = v.dot(p, w) / 2
    return [
        energy, turned, energy - m * v.dot(c, gamma), *start, turned + np.cross(c, m * gamma),
        np.cross(gamma, w),
    ]  # fmt: skip


def our_poisson(m, c, g, i, q, w, p, gamma):
    body = rj.Inertia(i)
    spin = lagrangian.RotationalHamiltonian(body)
    top = lagrangian.HeavyTopHamiltonian(body, laws.HeavyTop(m, c, g))
    return (
        spin(p), lagrangian.lie_poisson(spin)(0.0, lagrangian.Momentum(p)), top(p, gamma),
        top.start(rj.Attitude(q, w)),
        lagrangian.lie_poisson_with_direction(top)(0.0, MomentumAndDirection(p, gamma)),
    )  # fmt: skip


way(
    "lagrangian.RotationalHamiltonian lagrangian.HeavyTopHamiltonian "
    "lagrangian.HeavyTopHamiltonian.start lagrangian.lie_poisson "
    "lagrangian.lie_poisson_with_direction lagrangian.Momentum "
    "lagrangian.MomentumAndDirection",
    our_poisson,
    (scale(-3, 3), v.vector, v.vector, v.inertia, v.quaternion, v.ordinary, v.vector, v.vector),
    poisson,
    norm=True,
)  # fmt: skip
leave_out("abstract", "motion.torques.AbstractTorque")
leave_out("the fields of rows above", "lagrangian.LiePoisson", "lagrangian.LiePoissonWithDirection")


# What a law hands on of the functions of time in it.
def jumping(j):
    ts = jnp.asarray(TIMES)
    ramp, step = laws.Linear(ts, jnp.ones((5, 3))), laws.Held(ts, jnp.ones((5, 3)))
    spin = laws.Linear(ts, jnp.ones((5, 3, 3)))
    wheels = laws.ReactionWheels(jnp.eye(3), j, 0.0 * j, step)
    rotors = laws.Rotors(jnp.eye(3), jnp.eye(3), jnp.ones(3), 1.0, 1.0, step)
    both = laws.Sum(laws.InSpace(ramp), laws.Pulses(ts + 0.25, jnp.ones((4, 3))))
    found = (
        laws.Pulses(ts, jnp.ones((4, 3))), laws.Tabulated(ts, jnp.ones((5, 3))),
        laws.InSpace(ramp), laws.Flywheel(ramp), laws.GravityGradient(1.0, ramp),
        laws.MagneticDipole(j, ramp), laws.Lagged(step, 0.1), rotors, wheels,
        laws.ChangingInertia(spin), laws.InSpace(laws.Delayed(step, 0.25)), both,
    )  # fmt: skip
    return [jnp.sort(law.jump_times) for law in found]


way(
    " ".join(f"motion.torques.{name}.jump_times" for name in (
        "Pulses", "Tabulated", "InSpace", "Flywheel", "GravityGradient", "MagneticDipole", "Lagged",
        "Rotors", "ReactionWheels", "ChangingInertia", "Sum",
    )),
    jumping, between(1.0, 2.0, 3),
    lambda j: [TIMES] * 10 + [TIMES + 0.25, np.sort([*TIMES, *(TIMES + 0.25)])], cost=4,
)  # fmt: skip
way(
    "motion.torques.GravityGradient.axis",
    lambda r: laws.GravityGradient(1.0, r).axis / jnp.linalg.norm(laws.GravityGradient(1.0, r).axis),
    v.ordinary, lambda r: r / v.norm(r),
)  # fmt: skip
leave_out(
    "a truth value, a kind or a name: no number",
    *(f"motion.torques.{name}.steady" for name in (
        "Flywheel", "GravityGradient", "InSpace", "MagneticDipole", "ReactionWheels")),
    "motion.torques.ChangingInertia.feels", "motion.torques.Sum.feels",
    "motion.torques.Sum.rate_free",
)  # fmt: skip
