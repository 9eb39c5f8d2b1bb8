"""Simulated readings are those that the sensors' own definitions say, with the noise asked for."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify import simulate_readings

TS = jnp.linspace(0.0, 2.0, 41)
TOP = rj.Inertia.from_principal(1.0, 1.0, 0.4)
RATE = 3.0
Q = rj.quaternion.exp(jnp.array([0.4, -0.2, 0.7]))
# About its axis it turns steadily: q(t) = q exp(t Ω), Ω constant.
STEADY = rj.Attitude(Q, [0.0, 0.0, RATE])


def turned(t):
    return rj.quaternion.multiply(Q, rj.quaternion.exp(t * jnp.array([0.0, 0.0, RATE])))


def test_vector_sensors_of_a_steady_spin():
    bias, place = jnp.array([0.1, -0.2, 0.3]), jnp.array([0.05, 0.0, 0.2])
    world, down = jnp.array([2.0, 0.5, 1.0]), jnp.array([0.0, 0.0, -9.81])
    gyro, force, field = simulate_readings(
        (
            identify.Gyro(bias=bias, scale=[1.0, 1.0, 1.1], limit=[5.0, 0.1, 5.0]),
            identify.Accelerometer(place=place, gravity=down),
            identify.Magnetometer(field=world),
        ),
        TOP,
        STEADY,
        TS,
    )
    np.testing.assert_allclose(gyro, np.tile([0.1, -0.1, 1.1 * RATE + 0.3], (41, 1)), rtol=1e-12)
    inward = jnp.array([-(RATE**2) * place[0], 0.0, 0.0])
    seen = jax.jit(jax.vmap(lambda t, v: rj.quaternion.rotate_inverse(turned(t), v), (0, None)))
    up = seen(TS, -down)
    np.testing.assert_allclose(force, np.asarray(inward) + np.asarray(up), rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(field, seen(TS, world), rtol=1e-10, atol=1e-10)


def test_noise_is_the_error_of_the_readings():
    sensors = (
        identify.AttitudeSensor(0.05, mounting=[0.1, 0.2, 0.3]),
        identify.Direction([0.0, 0.3, 1.0], [0.02, 0.3]),
    )
    key = jax.random.key(1)
    read = simulate_readings(sensors, TOP, STEADY, TS, key=key)
    field = rj.equations_of_motion(TOP, STEADY)
    for sensor, values, each in zip(sensors, read, jax.random.split(key, 2), strict=True):
        drawn = sensor.noise[None] * jax.random.normal(each, (41, sensor.components))

        def error(t, value, sensor=sensor):
            state = rj.Attitude(turned(t), [0.0, 0.0, RATE])
            return sensor.error(identify.SensorInput(t, state, TOP, field), value)

        found = jax.jit(jax.vmap(error))(TS, values)
        np.testing.assert_allclose(jnp.linalg.norm(values, axis=1), 1.0, rtol=1e-12)
        length = jnp.linalg.norm(drawn, axis=1)
        np.testing.assert_allclose(jnp.linalg.norm(found, axis=1), length, rtol=1e-9)
        if isinstance(sensor, identify.AttitudeSensor):
            np.testing.assert_allclose(found, drawn, atol=1e-12)


def test_under_a_law_with_states_and_a_late_clock():
    # A motor of 0.2 N m speeds the wheel up: the body gets the reaction, −0.2 / 2.0 rad/s².
    wheels = rj.torques.ReactionWheels([[0.0, 0, 1]], [0.1], [0.0], motor=[0.2])
    rest = wheels.without_wheels(rj.Inertia.from_principal(1.0, 2.0, 2.1))
    sensors = (identify.Accelerometer(place=[0.1, 0.0, 0.0]), identify.Gyro(offset=0.25))
    force, rates = simulate_readings(sensors, rest, rj.Spin([0.0, 0, 0]), [0.0, 1.0], wheels)
    slope = -0.2 / 2.0
    np.testing.assert_allclose(force[:, 1], [0.1 * slope] * 2, rtol=1e-9)
    np.testing.assert_allclose(force[:, 0], [0.0, -0.1 * slope**2], atol=1e-12)
    np.testing.assert_allclose(rates[:, 2], [0.25 * slope, 1.25 * slope], rtol=1e-9)


class Compass(identify.AbstractSensor):
    """The heading, as an angle: its readings are one number, its error two."""

    reading_shape: ClassVar[tuple] = ()
    components: ClassVar[int] = 2
    feels: ClassVar[type] = rj.motion.HasAttitude
    unit: ClassVar[str] = "rad"
    noise: Any = None

    def error(self, motion, reading):
        return jnp.stack([reading, reading])


@pytest.mark.usefixtures("unhooked")
def test_mistakes_are_named():
    spin = rj.Spin([0.0, 0.0, 1.0])
    with pytest.raises(TypeError, match="AttitudeSensor needs a state with HasAttitude, got Spin"):
        simulate_readings(identify.AttitudeSensor(), TOP, spin, TS)
    with pytest.raises(ValueError, match="Gyro: noise=None gives no size"):
        simulate_readings(identify.Gyro(), TOP, spin, TS, key=jax.random.key(0))
    with pytest.raises(ValueError, match=r"Compass: .*write a method reading_of"):
        simulate_readings(Compass(), TOP, STEADY, TS)
    with pytest.raises(TypeError, match=r"state0: wanted .* got Inertia; the order is sensor, b"):
        simulate_readings(identify.Gyro(), spin, TOP, TS)
    record = identify.Recording([0.0, 1.0], (identify.Gyro(), np.ones((2, 3))))
    with pytest.raises(TypeError, match=r"got Inertia; give a known body as Known\(body\)"):
        identify.Model(record, TOP)
    with pytest.raises(TypeError, match=r"typical: .*one number, kg m², got Inertia; give a known"):
        identify.Principal(TOP)
