"""A second way for fits and filters: charts and sensors in words, Gaussians by conditioning."""

import math
import tempfile
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
from surface import values as v
from surface.values import between, fixed, leave_out, one_of, scale, way
from surface.values_bodies import (
    divergence,
    of_lune,
    pack,
    pack_moments,
    pack_second,
    props,
    tensor_of,
    unpack,
    unpack_moments,
    unpack_second,
    unpack_shape,
)  # fmt: skip
from surface.values_motion import euler
from surface.values_numbers import nearest
from surface.values_solve import TOP, TS as TIMES_OF_RUN, law_of, textbook, top_force

import rigidjax as rj
from rigidjax import identify, tumblers
from rigidjax.identify.data.recording import Reading
from rigidjax.identify.uncertainty.quantities import Quantity
from rigidjax.motion.equations import EulerEquations, NewtonEuler
from rigidjax.rotation import quaternion as q4, so3

# Charts: numbers to a body, what is reported of it, and back.
TYPICAL = 3.0


def shape_chart(x):
    i = tensor_of(unpack_shape(x))
    m = v.eigen(i)[0]
    return i, v.log(m[:2] / m[2]), np.zeros(0)


def ratios_chart(x):
    j = unpack_moments(np.array([mp.mpf(0), *x])) / 3
    return np.diag(j) + 0 * v.eye(), v.log(j[:2] / j[2]), np.zeros(0)


def tensor_chart(x):
    i = tensor_of(unpack_second(x) * TYPICAL / 2)
    at = [(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)]
    return i, v.log(v.eigen(i)[0]), np.array([i[p] for p in at])


def moments_chart(x):
    j = unpack_moments(x) * TYPICAL / 2
    return np.diag(j) + 0 * v.eye(), v.log(j), np.zeros(0)


BACK = {
    "Ratios": (lambda s: pack_second(s)[1:], 5, identify.Ratios(), shape_chart),
    "PrincipalRatios": (lambda s: pack_moments(sum(d := np.diag(s)) - d)[1:], 2, identify.PrincipalRatios(),
                        ratios_chart),
    "Tensor": (lambda s: pack_second(s * 2 / TYPICAL), 6, identify.Tensor(TYPICAL), tensor_chart),
    "Principal": (lambda s: pack_moments((sum(d := np.diag(s)) - d) * 2 / TYPICAL), 3, identify.Principal(TYPICAL),
                  moments_chart),
}  # fmt: skip
for name, (back, size, chart, forth) in BACK.items():
    way(
        " ".join(f"identify.{name}{what}" for what in ("", ".body", ".logs", ".vector")
                 + ((".plain",) if name == "Tensor" else ())),
        lambda x, s, c=chart: (
            (b := c.body(x)), c.logs(b), c.plain(b), c.vector(rj.Inertia.from_second_moment(s))),
        (one_of(between(-1, 1, size), fixed(np.zeros(size))),
         lambda rng, i: v.second_moment(rng, 0) * 10.0 ** rng.uniform(-3, 3)),
        lambda x, s, f=forth, b=back: (*f(x), b(s)), norm=True, ulps=32,
    )  # fmt: skip


GUESS = 2.0, np.array([0.1, -0.2, 0.3]), np.diag([1.0, 2.0, 1.5])


def guess():
    return props(*(jnp.asarray(x) for x in GUESS))


def mass_chart(x, m, c, s):
    """The logarithms of the guess moved, lengths by its own."""
    start = [v.number(part) for part in GUESS]
    size = mp.sqrt(np.trace(start[2]) / start[0])
    logs = np.array([mp.log(m), *v.log(v.eigen(tensor_of(s))[0])])
    return [
        *unpack(pack(*start) + x * np.array([*([1] * 7), *([size] * 3)])), np.zeros(10), logs, c,
        start[0] * mp.exp(2 * x[0]), start[1],
    ]  # fmt: skip


def our_mass_chart(x, m, c, s):
    chart, body = identify.Mass(guess()), props(m, c, s)
    lighter = identify.Mass(guess(), ["mass"]).body(x[:1])
    return [
        chart.body(x), chart.vector(body.inertia), chart.logs(body), chart.plain(body), lighter.mass,
        lighter.com,
    ]  # fmt: skip


way(
    "identify.Mass identify.Mass.body identify.Mass.vector identify.Mass.logs identify.Mass.plain",
    our_mass_chart,
    (between(-1, 1, 10), scale(-2, 2), v.ordinary, lambda rng, i: v.second_moment(rng, 0)),
    mass_chart, norm=True,
)  # fmt: skip
way(
    "identify.Known identify.Known.body identify.Known.logs identify.Known.vector",
    lambda i: (
        (k := identify.Known(rj.Inertia(i))).body(jnp.zeros(0)), k.logs(rj.Inertia(i)),
        k.plain(rj.Inertia(i)), k.vector(rj.Inertia(i))),
    v.inertia, lambda i: (i, np.zeros(0), np.zeros(0), np.zeros(0)),
)  # fmt: skip
# A sum of squares that is 2 w D, known to round-off of the trace.
way(
    "identify.Entropic identify.Entropic.residuals",
    lambda m, c, s: jnp.sum(identify.Entropic(guess(), 0.75).residuals(props(m, c, s)) ** 2) + 6.0,
    (scale(-1, 1), v.ordinary, lambda rng, i: v.second_moment(rng, 0)),
    lambda m, c, s: 1.5 * (divergence(m, c, s, *map(v.number, GUESS)) + 4), norm=True,
)  # fmt: skip

way(
    "identify.Measured identify.Measured.residual",
    lambda m: identify.Measured(lambda point: point, -2.0, 0.25, "number").residual(m),
    (scale(-1, 1),),
    lambda m: -4 * (2 + m),
)

# Losses.


def huber(e):
    s = v.dot(e, e)
    c = mp.mpf(3)
    if s <= c * c:
        return e, mp.mpf(1)
    return e * mp.sqrt((2 * c * mp.sqrt(s) - c * c) / s), c / mp.sqrt(s)


def soft(e):
    s, c = v.dot(e, e), mp.mpf(3)
    root = mp.sqrt(1 + s / c**2)
    return (e * mp.sqrt(2 * c * c * (root - 1) / s) if s else e), 1 / root


ERRORS = one_of(v.normal(3, low=-8, high=8), v.ordinary, fixed([0.0, 0, 0]))
for made, loss in ((identify.Huber(), huber), (identify.SoftL1(), soft)):
    name = type(made).__name__
    way(
        f"identify.{name} identify.{name}.shrink identify.{name}.weight",
        lambda e, c=made: (c.shrink(e), c.weight(e)), ERRORS, loss,
    )  # fmt: skip

# Sensors.


def scene_of(x, u, q, w, m, c, s):
    body = props(m, c, s)
    law = rj.torques.Sum(rj.torques.UniformGravity([0.0, 0.0, -9.8]), rj.torques.Drag(0.2, c))
    field = NewtonEuler(body, law)
    return identify.SensorInput(jnp.asarray(0.0), rj.Rigid(x, u, q, w), body, field)


def our_sensors(x, u, q, w, m, c, s, b, r, read, other):
    now = scene_of(x, u, q, w, m, c, s)
    kw = dict(bias=b, scale=1.0 + 0.1 * r, mounting=0.3 * b, skew=0.1 * b)
    star = identify.AttitudeSensor(0.1, mounting=0.3 * b)
    return [
        identify.Gyro(0.1, **kw).error(now, read),
        identify.Accelerometer(0.1, place=r, gravity=[0.0, 0, -9.8], **kw).error(now, read),
        identify.Magnetometer(0.1, field=r, **kw).error(now, read),
        star.error(now, other), q4.to_matrix(star.reading_of(now, 0.5 * b)),
        identify.Marker(r, 0.1).error(now, read),
        identify.Position(0.1, bias=b).error(now, read),
        identify.Velocity(0.1, place=r, mounting=0.3 * b, bias=b).error(now, read),
        identify.Velocity(0.1, place=r).error(now, read),
        identify.Range(read, 0.1, place=r, bias=0.3).error(now, jnp.asarray(1.5)),
        now.lever(r),
        identify.ForceTorque(
            0.1, gravity=[0.0, 0, -9.8], place=r, mounting=0.3 * b, bias=jnp.concatenate([b, r]),
            scale=jnp.concatenate([1.0 + 0.1 * r, 1.0 + 0.1 * b]),
        ).error(now, jnp.concatenate([read, b])),
    ]  # fmt: skip


def sensors(x, u, q, w, m, c, s, b, r, read, other):
    turned, i, down = v.matrix_of(q), tensor_of(s), np.array([0, 0, mp.mpf(-9.8)])
    seen = v.rotation(mp.mpf(0.3) * b).T
    a, d, e = mp.mpf(0.1) * b
    skew = np.array([[1, a, d], [0, 1, e], [0, 0, 1]])
    shown = lambda y: (1 + mp.mpf(0.1) * r) * (skew @ seen @ y) + b
    lever = r - c
    push = down - mp.mpf(0.2) * v.norm(u) * u / m
    torque = np.cross(c, turned.T @ (-mp.mpf(0.2) * v.norm(u) * u))
    felt = turned.T @ (push - down) + np.cross(euler(i, w, torque), lever) + np.cross(
        w, np.cross(w, lever))  # fmt: skip
    mount = v.quaternion_of(mp.mpf(0.3) * b)
    expected = v.times(q, mount)
    held = m * turned.T @ (push - down)
    miss = v.times([expected[0], *(-expected[1:])], other)
    point = x + turned @ lever
    speed = u + turned @ np.cross(w, lever)
    return [
        read - shown(w), read - shown(felt), read - shown(turned.T @ r), v.turn_of(miss),
        v.matrix_of(v.times(expected, v.quaternion_of(b / 2))), read - point, read - x - b,
        read - seen @ turned.T @ speed - b, read - speed,
        np.array([mp.mpf(1.5) - v.norm(point - read) - mp.mpf(0.3)]), lever,
        np.concatenate([
            read - (1 + mp.mpf(0.1) * r) * (seen @ held) - b,
            b - (1 + mp.mpf(0.1) * b) * (seen @ (torque - np.cross(lever, held))) - r,
        ]),
    ]  # fmt: skip


way(
    " ".join(f"identify.{name}" for name in (
        "Gyro", "Gyro.error", "Accelerometer", "Accelerometer.error", "Magnetometer",
        "Magnetometer.error", "AttitudeSensor", "AttitudeSensor.error",
        "AttitudeSensor.reading_of", "Marker", "Marker.error", "Position", "Position.error",
        "Velocity", "Velocity.error", "Range", "Range.error", "ForceTorque", "ForceTorque.error",
        "SensorInput",
        "SensorInput.lever",
    )),
    our_sensors,
    (v.ordinary, v.ordinary, lambda rng, i: v.quaternion(rng, i), v.ordinary, scale(-1, 1),
     v.ordinary, lambda rng, i: v.second_moment(rng, 0), v.ordinary, v.ordinary, v.ordinary,
     lambda rng, i: v.quaternion(rng, 0)),
    sensors, norm=True, cost=2,
)  # fmt: skip


way(
    "identify.Direction identify.Direction.error identify.Direction.reading_of",
    lambda q, world, x, e: (
        jnp.linalg.norm(identify.Direction(world, 0.1).error(_still(q), so3.exp(x) @ q4.rotate_inverse(
            q, world / jnp.linalg.norm(world)))),
        jnp.linalg.norm(identify.Direction(world, 0.1).error(
            _still(q), identify.Direction(world, 0.1).reading_of(_still(q), e))),
    ),
    (v.quaternion, v.ordinary, v.rotated_by(between(0, 2)), between(-0.3, 0.3, 2)),
    lambda q, world, x, e: (direction_error(q, world, x), v.norm(e)), norm=True, ulps=32,
)  # fmt: skip


def _still(q):
    state = rj.Attitude(q, jnp.zeros(3))
    return identify.SensorInput(jnp.asarray(0.0), state, rj.Inertia(jnp.eye(3)), None)


def direction_error(q, world, x):
    """As long as the chord: 2 sin of half the angle."""
    expected = v.matrix_of(q).T @ (world / v.norm(world))
    return v.norm(v.rotation(x) @ expected - expected)


def light(sun, observer, q, axes, level):
    r = v.matrix_of(q).T
    b = of_lune(axes, r @ sun, r @ observer)[1] / (mp.pi * axes.prod() ** (mp.mpf(2) / 3))
    return level * b, level - mp.mpf(2.5) * mp.log10(b), np.array([1 - level * b])


def our_light(sun, observer, q, axes, level):
    now = _still(q)
    flux = tumblers.Brightness(sun, observer, noise=0.1, level=level, semi_axes=axes)
    mag = tumblers.Brightness(sun, observer, noise=0.1, level=level, semi_axes=axes, unit="mag")
    return flux.predict(now), mag.predict(now), flux.error(now, jnp.asarray(1.0))


way(
    "tumblers.Brightness tumblers.Brightness.predict tumblers.Brightness.error",
    our_light, (v.ordinary, v.ordinary, v.quaternion, between(0.5, 2.0, 3), between(1, 3)), light,
    norm=True, ulps=32, cost=2,
)  # fmt: skip
leave_out(
    "a truth value for each row and words: tests/identify give good and bad rows",
    *(f"identify.{name}.refusal" for name in ("AttitudeSensor", "Direction", "Range")),
    "tumblers.Brightness.refusal",
)
leave_out(
    "what happens in a log, not a number: tests/identify/test_phases.py has logs of known truth",
    "identify.find_phases", "identify.Phase",
)  # fmt: skip
leave_out(
    "half a frequency of a grid: tests/tumblers/test_light_curve.py looks at it",
    "tumblers.Brightness.typical_rate",
)  # fmt: skip


# Readings of attitudes: conversions.
def our_readings(ms):
    return [
        np.asarray(jax.vmap(q4.to_matrix)(jnp.asarray(found)))
        for found in (
            identify.Recording([0.0, 1.0], (identify.AttitudeSensor(), ms)).readings[0].values,
        )
    ]  # fmt: skip


way(
    "identify.Recording identify.AttitudeSensor.readings", our_readings,
    lambda rng, i: np.stack([v.matrix(rng, i), v.matrix(rng, 0)]),
    lambda ms: [np.stack([v.matrix_of(nearest(m)) for m in ms])], batched=False, norm=True,
)  # fmt: skip


# Files: what is written with 17 digits is read again.
def our_table(t, w):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        rows = [",".join(repr(float(x)) for x in (a, *b)) for a, b in zip(t, w, strict=True)]
        path.write_text("\n".join(["t,wx,wy,wz", *rows]))
        ts, *rates = identify.read_table(path, ["t", "wx", "wy", "wz"]).values()
        read = identify.Recording(ts, (identify.Gyro(), np.stack(rates, 1)))
        columns = identify.read_table(path, ["wy", "t"])
        frame = identify.read_table(path, ["t", "wx", "wy", "wz"])
        read = identify.Recording.from_frame(frame, t="t", gyro=["wx", "wy", "wz"])
        part = read.between(t[1], t[2])
        return [read.t, read.readings[0].values, columns["wy"], columns["t"], part.t]


way(
    "identify.read_table identify.Recording identify.Recording.from_frame "
    "identify.Recording.between", our_table,
    (lambda rng, i: np.cumsum(rng.uniform(0.1, 1.0, 4)), v.normal(4, 3, low=-20, high=20)),
    lambda t, w: [t, w, w[:, 1], t, t[1:3]], batched=False,
)  # fmt: skip


# A ball with a gyro under white torque: its rate is a random walk, read with noise.
TS = np.arange(4) * 0.5


def walked(j, d, noise, y, w):
    g = mp.sqrt(d / 2) / j * v.eye()
    return filtered(v.eye(), g, v.eye(), noise * np.ones(3), y, w, mp.mpf(0.4) * v.eye())


def ball(j, d, noise, y, w):
    """What the filter of any motion gives, as rows of `filtered`."""
    found = walked(j, d, noise, y, w)
    first = np.array([w, np.full(3, mp.mpf(0.4))])
    return [*found[:6], found[6], found[2], first[0], first[1], found[0][0]]


# Readings are put in its place without the checks of known numbers: a recording is of the host.
EMPTY = identify.Recording(TS, (identify.Gyro(1.0), np.zeros((4, 3))))


def our_ball(j, d, noise, y, w):
    body = identify.Known(rj.Inertia(j * jnp.eye(3)))
    model = identify.Model(EMPTY, body, process=rj.torques.RandomTorque(d))
    reading = Reading(identify.Gyro(noise), y, jnp.ones(4, bool))
    rows = jax.tree.map(lambda leaf: leaf[None], reading)
    model = eqx.tree_at(lambda m: m.records.readings[0], model, rows)
    first = identify.first_belief(model, state=rj.Spin(w), rate=0.4)
    forth = identify.filter(model, first, throw=False, substeps=1)
    back = identify.smooth(model, first, throw=False, substeps=1)
    one = identify.step(model, first, 0.0, y[0])
    return [
        forth.states.omega, forth.belief.covariance, forth.log_likelihood,
        back.states.omega, back.belief.covariance, back.log_likelihood, forth.belief.deviation,
        identify.log_likelihood(model, first, substeps=1), first.state.omega,
        first.deviation, one.state.omega,
    ]  # fmt: skip


way(
    "identify.first_belief identify.filter identify.smooth identify.step "
    "identify.log_likelihood identify.Belief identify.Belief.covariance identify.Belief.deviation "
    "identify.Belief.state identify.Filtered identify.Filtered.states identify.Smoothed "
    "identify.Smoothed.states",
    our_ball, (scale(-1, 1), scale(-2, 0), between(0.1, 0.5), v.normal(4, 3), v.ordinary), ball,
    norm=True, ulps=64, cost=2,
)  # fmt: skip


def back_and_forth(rng, i):
    """Readings whose errors are not autocorrelated by chance: then intervals are wider."""
    sign = np.where(np.arange(12) % 2, 1.0, -1.0)[:, None]
    return rng.normal(size=3) + 0.01 * sign * rng.uniform(0.5, 1.5, (12, 3))


# A fit that is linear: a ball that turns as it did, read by a gyro. The mean, by hand.
def fitted(y, noise):
    count = len(y)
    mean = sum(y) / count
    deviation = noise / mp.sqrt(count)
    chi2 = sum(v.dot(row, row) for row in y - mean) / noise**2
    reach = mp.mpf(1.959963984540054)
    return [
        mean, np.full(3, deviation), chi2, mp.mpf(3 * count - 3), mp.mpf(1) * y - mean,
        mean - reach * deviation, mean + reach * deviation, mean - reach * deviation,
        mean + reach * deviation, np.full(3, deviation), np.stack([mean] * count), mean,
    ]  # fmt: skip


def our_fit(y, noise):
    recording = identify.Recording(np.arange(float(len(y))), (identify.Gyro(float(noise)), y))
    model = identify.Model(recording, identify.Known(rj.Inertia(jnp.eye(3))))
    fit = identify.fit(model, starts=1)
    low, high = zip(*fit.interval().values(), strict=True)
    ends = fit.interval_of(lambda point: point.state0.omega)
    planned = identify.expected_quantities(model, fit.x)
    return [
        fit.state0.omega, np.array([q.deviation for q in fit.quantities[-3:]]), fit.chi2, fit.dof,
        fit.residuals[0], np.array(low[-3:]), np.array(high[-3:]), *ends,
        np.array([q.deviation for q in planned[-3:]]), model.motion(fit.x).omega,
        model.unpack(fit.x).state0.omega,
    ]  # fmt: skip


way(
    "identify.fit identify.Fit identify.Fit.interval identify.Fit.interval_of identify.Fit.body "
    "identify.Fit.state0 identify.Fit.residuals identify.Model identify.Model.motion "
    "identify.Model.unpack identify.expected_quantities identify.Quantity",
    our_fit,
    (back_and_forth, fixed(0.01)), fitted,
    batched=False, rtol=1e-6, cost=2,
)  # fmt: skip


# A model: a ball whose gyro has a bias that a `Free` moves.
def information(count):
    """Of rate and bias, per σ²: each reading shows their sum."""
    one = np.eye(3) * count
    return np.block([[one, one], [one, one]])


def our_plan(w, b, y):
    recording = identify.Recording(
        np.arange(float(len(y))), (identify.Gyro(1.0, bias=jnp.zeros(3)), np.zeros(np.shape(y)))
    )
    model = identify.Model(
        recording, identify.Known(rj.Inertia(jnp.eye(3))),
        free=[identify.Free(lambda s: s.sensors[0].bias, "bias")],
    )  # fmt: skip
    plan = model.start(rj.Inertia(jnp.eye(3)), w).at[model.slots[0].shared[0]].set(b)
    unit = jnp.concatenate([jnp.ones(3), jnp.full(3, model.typical_rate)])
    return [
        model.unpack(plan).state0.omega, model.errors(plan)[0] + y, model.values(plan)["bias"],
        identify.fisher(model, plan) / unit[:, None] / unit, model.motion(plan).omega[0],
    ]  # fmt: skip


way(
    "identify.Model.start identify.Model.errors identify.Model.values identify.fisher "
    "identify.Free identify.Model.typical_rate",
    our_plan, (v.ordinary, v.ordinary, v.normal(4, 3)),
    lambda w, b, y: [
        w, y - w - b, b,
        # The free numbers in order: what is shared, then the rate, which is in typical rates.
        information(4) + 0 * w[0], w],
    norm=True, batched=False, cost=4,
)  # fmt: skip


# The motion that a fit follows, and the readings that a sensor would have.
def our_states(i, q, w, c, d):
    body, start, law = rj.Inertia(i), rj.Attitude(q, w), law_of(c, d)
    ts = jnp.asarray(TIMES_OF_RUN)
    found = [
        way_of.states(body, start, ts, law)
        for way_of in (identify.Adaptive(1e-9, 1e-12).refine(),
                       identify.FixedSteps(20, rj.solvers.DormandPrince8()).refine())
    ]  # fmt: skip
    read = identify.simulate_readings(
        identify.Gyro(0.1, bias=c, scale=1.0 + d), body, start, ts, law
    )
    return [*found, jnp.concatenate([found[0].omega[:1] * (1.0 + d) + c, read[1:]])]


def states(i, q, w, c, d):
    _, _, at, rates = textbook(top_force(c, d), i, np.zeros(3), np.zeros(3), q, w)
    return [at, rates, at, rates, rates * (1 + d) + c]


way(
    "identify.Adaptive identify.Adaptive.states identify.Adaptive.refine identify.FixedSteps "
    "identify.FixedSteps.states identify.FixedSteps.refine "
    "identify.simulate_readings",
    our_states, TOP, states, plain=True, rtol=1e-8, batched=False, cost=4,
)  # fmt: skip


# Windows of a record of rates: cut by hand; a constant torque on a ball is a slope.
def cut(w, u, j):
    h, length = 0.5, 3
    at = [0, 2, 4]
    wanted = np.stack([w[k + 1 : k + 1 + length] for k in at])
    starts = w[at]
    missed = wanted - starts[:, None]
    mean = abs(missed).sum(axis=(0, 2)) / 9
    squares = (missed**2).sum(axis=2)
    norm = [sum(mp.sqrt(x) for x in column) / 3 for column in squares.T]
    rms = [mp.sqrt(x) for x in squares.sum(axis=0) / 3]
    t = h * np.arange(1, length + 1)
    slope = (missed * t[None, :, None]).sum(axis=(0, 1)) / (3 * (t * t).sum())
    held = np.stack([u[k : k + length] for k in at])
    left = missed - slope * t[None, :, None]
    return [
        starts, wanted, held, np.array([3.0]), np.array([3.0]), mean, np.array(norm),
        np.array(rms),
        np.concatenate([starts, starts]), j * slope,
        np.array([mp.sqrt(x) for x in (left**2).sum(axis=(0, 2)) / 3]),
    ]  # fmt: skip


def our_cut(w, u, j):
    made = identify.windows(0.5 * np.arange(8), rj.Spin(w), {"u": u}, length=3, stride=2)
    held = made.held_horizons()
    return [
        made.starts.omega, made.wanted.omega, made.inputs["u"], np.array([made.count]) * 1.0,
        np.array([made.length]) * 1.0, held.mean_absolute["omega"], held.mean_norm["omega"],
        held.rms["omega"],
        identify.Windows.join(made, made).starts.omega,
    ]  # fmt: skip


def our_window_fit(w, j):
    plain = identify.windows(
        0.5 * np.arange(8), rj.Spin(w), length=3, stride=2, noise={"omega": 1.0}
    )
    model = identify.Model(
        plain, identify.Known(rj.Inertia(j * jnp.eye(3))),
        torque=rj.torques.ConstantTorque(jnp.zeros(3)),
        free=[identify.Free(lambda s: s.torque.torque, "torque")],
    )  # fmt: skip
    fit = identify.fit(model, tolerance=1e-9)
    return fit.values["torque"], identify.predict_windows(fit, plain).rms["omega"]


way(
    "identify.windows identify.Windows identify.Windows.count identify.Windows.length "
    "identify.Windows.held_horizons identify.Windows.join identify.Horizons",
    our_cut, (v.normal(8, 3), v.normal(8, 2), between(0.5, 2.0)), lambda *a: cut(*a)[:-2],
    batched=False, norm=True, cost=2,
)  # fmt: skip
way(
    "identify.predict_windows", our_window_fit,
    (v.normal(8, 3), between(0.5, 2.0)), lambda w, j: cut(w, w, j)[-2:], batched=False, rtol=1e-8,
    norm=True, cost=4,
)  # fmt: skip


# Two frequencies: the series of those that are found is the signal, to the noise that it is said
# to have.
def our_pair(f, g):
    t = np.sort(np.random.default_rng(0).uniform(0, 200.0, 300))
    angle = 2 * np.pi * t
    light = (
        3.0 + np.cos(angle * 2 * f) + 0.6 * np.sin(angle * g) + 0.3 * np.cos(angle * (2 * f - g))
    )
    found = tumblers.two_frequencies(t, light, noise=0.01, shortest=2.0, count=4)
    return [1.0 + found.scatter]


way(
    "tumblers.two_frequencies tumblers.TwoFrequencies", our_pair,
    (between(0.03, 0.06), between(0.1, 0.13)), lambda f, g: [1.0 + 0 * f], plain=True,
    batched=False, rtol=0.01, cost=4,
)  # fmt: skip


# Without noise a sample is the motion: a ball that turns steadily.
def our_sample(j, q, w):
    made = identify.sample(
        jax.random.key(0),
        rj.Inertia(j * jnp.eye(3)),
        rj.Attitude(q, w),
        jnp.asarray([0.0, 1.0]),
        process=rj.torques.RandomTorque(0.0),
        substeps=200,
    )
    now = identify.SensorInput(
        jnp.asarray(0.0), rj.Spin(w), rj.Inertia(j * jnp.eye(3)),
        EulerEquations(rj.Inertia(j * jnp.eye(3)), rj.torques.ConstantTorque(q[:3])),
    )  # fmt: skip
    return q4.to_matrix(made.states.q[-1]), made.states.omega[-1], now.rate


way(
    "identify.sample identify.Sampled identify.SensorInput.rate", our_sample,
    (between(0.5, 2.0), v.quaternion, v.ordinary),
    lambda j, q, w: (v.matrix_of(q) @ v.rotation(w), w, q[:3] / j), norm=True, rtol=1e-8, cost=2,
)  # fmt: skip
way(
    "identify.Quantity.interval",
    lambda x, d, r: [
        *Quantity("x", x, x * d, "m", True).interval(math.erf(r / 2**0.5)),
        *Quantity("x", x, d, "m", False).interval(math.erf(r / 2**0.5)),
    ],
    (scale(), between(0, 1), between(0.1, 3)),
    lambda x, d, r: [x * mp.exp(-d * r), x * mp.exp(d * r), x - d * r, x + d * r], batched=False,
)  # fmt: skip
leave_out(
    "a truth value, a count, a kind, a name or words",
    "identify.Filtered.words", "identify.Smoothed.words",
    "identify.LogDensity.size", "identify.Accelerometer.feels", "identify.Marker.feels",
    "identify.Combination.in_words", "identify.Fit.ok", "tumblers.LightCurve.ok",
    "identify.Fit.status", "tumblers.LightCurve.status", "identify.Fit.advice", "identify.Fit.causes",
    "identify.Answer", "identify.Cause",
    "identify.Model.count", "identify.Model.size", "identify.Recording.size",
    "identify.Descent", "identify.descend", "identify.Combination",
)  # fmt: skip
leave_out(
    "holds what it was given, or numbers of a row above",
    "identify.Belief.torques", "identify.Belief.walks", "identify.Filtered.t",
    "identify.Smoothed.t", "identify.Walk", "identify.Push", "identify.ExtendedState", "identify.Start",
    "identify.Model.recording", "identify.Model.recordings", "identify.Scene",
    "identify.Model.bodies", "identify.Model.scenes", "identify.Tolerance",
    "identify.Windows.records", "identify.Windows.scales",
    "identify.Recording.sensors", "identify.Fit.values", "identify.BestPoint",
    "identify.BestPoint.derivative_point", "identify.Uncertainty", "identify.Assessment",
    "identify.HeldOut", "identify.Pair",
    *(f"identify.Fit.{name}" for name in (
        "model", "x", "noises", "covariance", "determined_covariance", "covariance_kind",
        "null_directions", "search", "explanation", "chi2", "dof", "correlation")),
    "identify.Fit.spreads", "identify.Fit.noise", "identify.Fit.rms", "tumblers.Alias",
    "tumblers.LightCurve", "tumblers.LightCurve.rivals", "identify.Comparison",
)  # fmt: skip
leave_out(
    "what a chart's curvature rows add to the normal equations, and where derivatives of a flat body are "
    "taken: tests/identify/test_flat_limit.py",
    *(f"identify.{name}.curvature_rows" for name in (
        "AbstractBodyChart", "Mass", "Principal", "PrincipalRatios", "Ratios", "Tensor")),
    "body.parameters.curvature_rows_near_flat_body", "identify.Limit", "identify.Limit.flatness_upper_bound",
    "identify.Limit.flatness_deviation", "identify.Limit.is_flat_within",
)  # fmt: skip
leave_out(
    "errors that are considered, against refits of readings that are off: "
    "tests/identify/uncertainty/test_considered.py",
    "identify.Consideration",
)
leave_out(
    "the errors and derivatives of a fit, from which its covariance follows: "
    "tests/identify/test_uncertainty.py",
    "identify.Linearisation",
    *(f"identify.Linearisation.{name}" for name in (
        "squared_residual_change", "covariance_by_recording", "first_times", "free_count",
        "weighted_jacobian", "weighted_jacobians_by_sensor", "weighted_residuals",
        "misfit_gradients_by_recording",
        "misfit_gradient")),
)  # fmt: skip
leave_out(
    "compared with the intervals of Student: tests/identify/test_freedom.py",
    "identify.Uncertainty.degrees_of_freedom", "identify.Freedom", "identify.Freedom.of_variance",
)  # fmt: skip
leave_out(
    "abstract: made by subclassing",
    "identify.AbstractBodyChart", "identify.AbstractBodyChart.plain", "identify.AbstractLoss",
    "identify.AbstractSensor",
)  # fmt: skip
leave_out(
    "text for a reader, of numbers that other rows hold: tests/identify/test_report.py",
    *(f"identify.report.{name}" for name in (
        "as_dict", "as_html", "numbers", "rows", "table", "verdict", "write_html", "write_json")),
)  # fmt: skip
leave_out(
    "draws, and statistics of draws: tests/identify hold them against densities that are known",
    "identify.posterior", "identify.Posterior", "identify.Posterior.ess", "identify.Posterior.map",
    "identify.Posterior.points", "identify.Posterior.rhat", "identify.Posterior.to_arviz",
    "identify.Nuts", "identify.refit", "identify.Refit", "identify.Refit.effective_count",
    "identify.Refit.interval_of", "identify.Refit.point", "identify.LogDensity",
    "identify.LogDensity.unpack", "identify.Unpacked",
    "identify.Filtered.nis", "identify.ReadNumbers",
)  # fmt: skip
leave_out(
    "searches of many fits, tens of seconds each: tests/identify hold them against motions known",
    "identify.Candidates", "identify.Selection", "identify.Step", "identify.compare",
    "identify.select", "identify.usual_terms",
    "tumblers.fit_light_curve", "identify.Fit.identifiability",
    "identify.Fit.undetermined_combinations",
)  # fmt: skip
