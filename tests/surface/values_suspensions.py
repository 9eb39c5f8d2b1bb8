"""A second way for suspensions: geometry and quadrature at 40 digits."""

import jax.numpy as jnp
import mpmath as mp
import numpy as np
from surface import values as v
from surface.values import between, leave_out, scale, way

import rigidjax as rj
from rigidjax import identify, suspensions as hung


def matter(m, c, s):
    return rj.MassProperties(m, c, s)


def inertia(s):
    return np.trace(s) * v.eye() - s


def turned(axis, angle, x):
    unit = axis / v.norm(axis)
    side, along = np.cross(unit, x), v.dot(unit, x)
    return x * mp.cos(angle) + side * mp.sin(angle) + unit * along * (1 - mp.cos(angle))


def on_axle(m, c, s, axis, point, g, angle, rate):
    """Moment, potential, place, unit vector, and energy and pose of the turn."""
    unit, arm = axis / v.norm(axis), c - point
    moment = v.dot(unit, inertia(s) @ unit) + m * v.dot(np.cross(unit, arm), np.cross(unit, arm))
    place = point + turned(axis, angle, arm)
    potential = -m * v.dot(g, place - point)
    q = np.array([mp.cos(angle / 2), *(mp.sin(angle / 2) * unit)])
    speed = np.cross(rate * unit, place - point)
    energy = moment * rate**2 / 2 + potential
    return moment, potential, place, unit, energy, [place, speed, q, rate * unit]


ANGLE = between(-3.0, 3.0)
way(
    "Turn suspensions.Axle suspensions.Axle.moment suspensions.Axle.potential suspensions.Axle.place "
    "motion.AbstractSuspension.unit motion.AbstractSuspension.energy motion.AbstractSuspension.state",
    lambda m, c, s, axis, point, g, angle, rate: (
        (axle := hung.Axle(axis, point, g)).moment(matter(m, c, s), angle),
        axle.potential(matter(m, c, s), angle), axle.place(matter(m, c, s), angle), axle.unit,
        axle.energy(matter(m, c, s), rj.Turn(angle, rate)),
        axle.state(matter(m, c, s), rj.Turn(angle, rate)),
    ),
    (scale(-2, 2), v.ordinary, v.second_moment, v.ordinary, v.ordinary, v.ordinary, ANGLE, ANGLE),
    on_axle, norm=True, ulps=16,
)  # fmt: skip


def height(a, b, length, angle):
    return mp.sqrt(length**2 - a**2 - b**2 + 2 * a * b * mp.cos(angle))


def on_strings(m, s, a, b, spare, angle):
    length = a + b + spare
    h = height(a, b, length, angle)
    unit = np.array([mp.mpf(0), mp.mpf(0), mp.mpf(1)])
    lift = -a * b * mp.sin(angle) / h
    # At rest in the hand: γ'' = m g h'/M, and the tension carries g − h' γ''.
    moment = inertia(s)[2, 2] + m * lift**2
    pull = m * 9 * (1 - m * lift**2 / moment) * length / (3 * h)
    return h, moment, -m * 9 * h, -h * unit, pull


def strings(a, b, spare):
    return hung.Strings(3, a, b, a + b + spare, gravity=9.0)


SIZE = between(0.1, 0.5)
way(
    "suspensions.Strings suspensions.Strings.height suspensions.Strings.moment "
    "suspensions.Strings.potential suspensions.Strings.place suspensions.Strings.tension",
    lambda m, s, a, b, spare, angle: (
        (three := strings(a, b, spare)).height(angle), three.moment(body := matter(m, jnp.zeros(3), s), angle),
        three.potential(body, angle), three.place(body, angle),
        three.tension(body, rj.Turn(angle, 0.0)),
    ),
    (scale(-2, 2), v.second_moment, SIZE, SIZE, SIZE, ANGLE), on_strings, norm=True, ulps=32,
)  # fmt: skip

way(
    "suspensions.Friction",
    lambda c, rate: hung.Friction(*c)(rate),
    (between(0.1, 2.0, 4), ANGLE),
    lambda c, rate: -(c[0] + c[1] * abs(rate)) * rate - c[2] * mp.tanh(rate / c[3]),
)


def on_bar(i, axis, stiffness, angle, rate, t):
    unit = axis / v.norm(axis)
    moment = v.dot(unit, i @ unit)
    nu = mp.sqrt(stiffness / moment)
    c, s = mp.cos(nu * t), mp.sin(nu * t)
    turn = [angle * c + rate * s / nu, rate * c - angle * nu * s]
    return moment, stiffness * angle**2 / 2, turn, 2 * mp.pi / nu, nu, 0 * axis


way(
    "suspensions.TorsionBar suspensions.TorsionBar.moment suspensions.TorsionBar.potential "
    "suspensions.TorsionBar.swing suspensions.Twist suspensions.Twist.pace "
    "suspensions.TorsionBar.period suspensions.TorsionBar.place suspensions.period",
    lambda i, axis, stiffness, angle, rate, t: (
        (bar := hung.TorsionBar(axis, stiffness)).moment(body := rj.Inertia(i), angle),
        bar.potential(body, angle), (twist := bar.swing(body, rj.Turn(angle, rate)))(t),
        hung.period(body, bar, angle), twist.pace,
        bar.place(matter(1.0, jnp.zeros(3), jnp.eye(3)), angle),
    ),
    (v.inertia, v.ordinary, scale(-1, 1), ANGLE, ANGLE, between(0.0, 3.0)), on_bar, norm=True,
    ulps=16,
)  # fmt: skip


def moment_chart(m, c, s, axis, point, x):
    unit = axis / v.norm(axis)
    arm = np.cross(unit, c - point)
    own, far = v.dot(unit, inertia(s) @ unit), m * v.dot(arm, arm)
    log = mp.log(2 * own + far)
    factor = (mp.exp(x[0]) * (own + far) - far) / own
    return factor * s, np.array([log]), np.array([log - mp.log(own + far)])


way(
    "identify.Moment identify.Moment.body identify.Moment.logs identify.Moment.vector",
    lambda m, c, s, axis, point, x: (
        (chart := identify.Moment(matter(m, c, s), hung.Axle(axis, point))).body(x).second_moment,
        chart.logs(other := matter(m, c, 2 * s)), chart.vector(other),
    ),
    (
        scale(-1, 1), v.ordinary, lambda rng, i: v.second_moment(rng, 0), v.ordinary, v.ordinary,
        between(-1, 1, 1),
    ), moment_chart, norm=True, ulps=32,
)  # fmt: skip

leave_out(
    "tests/suspensions hold them by Jacobi's functions and quadratures at 50 digits",
    "suspensions.Axle.swing", "suspensions.Swing", "suspensions.Swing.pace",
    "suspensions.Axle.period", "suspensions.Strings.period",
)  # fmt: skip
leave_out(
    "a truth value, words, or an error: tests/suspensions",
    "motion.AbstractSuspension.closed_form", "motion.AbstractSuspension.require_body",
    "suspensions.Strings.swing", "suspensions.Strings.ends", "suspensions.Strings.end_words",
)  # fmt: skip
leave_out("abstract", "motion.AbstractSuspension")
