"""Simulated tumblers: light curves of lit bodies, read on some nights with 2 % noise."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import ConvexHull

import rigidjax as rj
from rigidjax import exact, identify
from rigidjax.identify import SensorInput
from rigidjax.tumblers import Brightness
from rigidjax.tumblers.light_curve import Alias

HOUR, NOISE, COUNT = 3600.0, 0.02, 480


class Tumbler(NamedTuple):
    """The truth: moments over the largest, first state, periods in s; and the recording."""

    mode: str
    semi_axes: np.ndarray
    moments: np.ndarray
    state: rj.Attitude
    rotation: float
    precession: float
    phase: float
    amplitude: float
    recording: identify.Recording


@jax.jit
def periods(moments, omega):
    body = rj.Inertia(jnp.diag(moments))
    return exact.body_period(body, omega), exact.precession_period(body, omega)


@jax.jit
def brightness(sensor, moments, state, ts):
    body = rj.Inertia(jnp.diag(moments))
    motion = exact.FreeBody(body, state)

    def at(t):
        return sensor.predict(SensorInput(t, motion(t), body, lambda t, y, args: y))

    return jax.vmap(at)(ts)


def half_way(one: "Tumbler", sensor: Any) -> np.ndarray:
    """Directions (T, 3) half way between sun and observer, body frame, of the true motion."""
    motion = exact.FreeBody(rj.Inertia(jnp.diag(jnp.asarray(one.moments))), one.state)
    middle = sensor.sun / jnp.linalg.norm(sensor.sun) + sensor.observer
    middle = middle / jnp.linalg.norm(middle)
    turn = jax.vmap(lambda t: rj.quaternion.rotate_inverse(motion(t).q, middle))
    return np.asarray(turn(jnp.asarray(one.recording.t)))


def nights(rng):
    """Times of readings, s: 9 to 12 nights of 6 to 9 hours, some lost, some with a cloud."""
    out, last = [], int(rng.integers(9, 13))
    for night in range(last):
        if night not in (0, 1, 2, last - 2, last - 1) and rng.uniform() < 0.2:
            continue
        start = 24 * night + rng.uniform(0, 1)
        t = np.arange(start, start + rng.uniform(6, 9), 0.1)
        if rng.uniform() < 0.3:
            cloud = rng.uniform(t[0], t[-1])
            t = t[(t < cloud) | (t > cloud + 1.0)]
        out.append(t)
    t = np.concatenate(out)
    # Always as many: one program for all.
    t = np.sort(rng.choice(t, min(COUNT, t.size), replace=False))
    return (t - t[0]) * HOUR


def polyhedron(rng, semi_axes, rough):
    """Corners and faces of a convex polyhedron about an ellipsoid, in its principal axes; moments.

    The hull of 150 points: the logarithm of each one's distance is moved by a smooth random
    function of the direction, of standard deviation `rough`.
    """
    u = rng.normal(size=(150, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    waves, phases = 2.0 * rng.normal(size=(3, 50)), rng.uniform(0, 2 * np.pi, 50)
    moved = rough * np.sin(u @ waves + phases).sum(axis=1) / 5.0
    corners = u * semi_axes * np.exp(moved)[:, None]
    hull = ConvexHull(corners)
    faces = hull.simplices.copy()
    a, b, c = (corners[faces[:, k]] for k in range(3))
    inward = np.sum(np.cross(b - a, c - a) * hull.equations[:, :3], axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    moments, axes = np.linalg.eigh(np.asarray(rj.shapes.mesh(corners, faces, 1.0).inertia.tensor))
    axes[:, 0] *= np.linalg.det(axes)
    return corners @ axes, faces, moments


def magnitudes(corners, faces, sensor, moments, state, ts):
    """What `sensor` reads of a polyhedron in its principal axes, without noise."""

    motion = exact.FreeBody(rj.Inertia(jnp.diag(jnp.asarray(moments))), state)

    def at(t):
        q = motion(t).q
        sides = [rj.quaternion.rotate_inverse(q, d) for d in (sensor.sun, sensor.observer)]
        return rj.tumblers.brightness.mesh(corners, faces, *sides)

    return -2.5 * np.log10(np.asarray(jax.jit(jax.vmap(at))(jnp.asarray(ts))))


def tumbler(seed: int, mode: str, rough: float = 0.0, noise: float = NOISE) -> Tumbler:
    """One tumbler in long- or short-axis mode, of 4 to 16 hours of precession.

    Of `rough` above zero it is no ellipsoid but a `polyhedron`.
    """
    rng = np.random.default_rng(1000 + seed)
    shape = None
    while True:
        b = rng.uniform(0.5, 0.9)
        c = b * rng.uniform(0.6, 0.95)
        second = np.array([1.0, b * b, c * c])
        moments = second.sum() - second
        if rough:
            *shape, moments = polyhedron(rng, np.sqrt(second), rough)
        moments = moments / moments[2]
        # h²/2T from a spin about the axis of the mode (0) to the separatrix (1).
        part = rng.uniform(0.15, 0.85)
        pure = moments[0] if mode == "long" else moments[2]
        d = pure + part * (moments[1] - pure)
        x = (1 / d - 1 / moments[2]) / (1 / moments[0] - 1 / moments[2])
        omega = np.array([np.sqrt(x), 0.0, np.sqrt(1 - x)]) * rng.choice([-1, 1], 3) / moments
        rotation, precession = map(float, periods(moments, omega))
        wanted = np.exp(rng.uniform(np.log(4), np.log(16))) * HOUR
        rotation, omega = rotation * wanted / precession, omega * precession / wanted
        if rotation < 60 * HOUR:
            break
    q = rng.normal(size=4)
    state = rj.Attitude(q / np.linalg.norm(q), omega)
    body = rj.Inertia(jnp.diag(jnp.asarray(moments)))
    state = exact.free_body(body, state, rng.uniform(0, rotation))
    phase = rng.uniform(10, 50)
    observer = [np.cos(np.radians(phase)), np.sin(np.radians(phase)), 0.0]
    sensor = Brightness([1.0, 0.0, 0.0], observer, noise=1.0857 * noise, unit="mag")
    ts = nights(rng)
    if shape is None:
        clean = np.asarray(brightness(sensor, jnp.asarray(moments), state, jnp.asarray(ts)))
    else:
        clean = magnitudes(*shape, sensor, moments, state, ts)
    flux = 10 ** (-0.4 * clean)
    level = rng.uniform(10.0, 20.0)
    read = level - 2.5 * np.log10(flux * (1 + noise * rng.normal(size=ts.size)))
    amplitude = float(flux.std() / flux.mean())
    recording = identify.Recording(ts, (sensor, read))
    semi_axes = np.array([1.0, b, c])
    return Tumbler(mode, semi_axes, moments, state, rotation, wanted, phase, amplitude, recording)


def level(scene: Any) -> Any:
    return scene.sensors[0].level


def problem(recording: identify.Recording) -> identify.Model:
    free = [identify.Free(level, "level")]
    return identify.Model(recording, identify.PrincipalRatios(), free=free)


def off(one: Tumbler, alias: Alias) -> tuple[float, float]:
    """The largest relative errors of both periods and of both ratios of moments."""
    times = alias.rotation / one.rotation - 1, alias.precession / one.precession - 1
    ratios = alias.ratios / one.moments[:2] - 1
    return max(abs(time) for time in times), float(np.abs(ratios).max())


def of_unknown_noise(one: Tumbler) -> identify.Recording:
    """The same recording without a noise that is given."""
    reading = one.recording.readings[0]
    known: Any = reading.sensor
    sensor = Brightness(known.sun, known.observer, unit="mag")
    return identify.Recording(np.asarray(one.recording.t), (sensor, np.asarray(reading.values)))


def apart(one: Tumbler, alias: Alias) -> np.ndarray:
    """Logarithms (4,) of rotation, precession and both ratios of moments over the true ones."""
    found = np.array([alias.rotation, alias.precession, *alias.ratios])
    return np.log(found / [one.rotation, one.precession, *one.moments[:2]])
