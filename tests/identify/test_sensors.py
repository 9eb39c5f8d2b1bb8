"""What each sensor reads, against the motion of a point worked out in the world."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once
from scipy.interpolate import CubicSpline

import rigidjax as rj
from rigidjax.identify.sensors.base import SensorInput

BODY = rj.shapes.box(1.3, [0.1, 0.2, 0.3])
GRAVITY = jnp.array([0.0, 0.0, -9.81])
Q = rj.quaternion.exp(jnp.array([0.4, -0.7, 0.2]))
OMEGA = jnp.array([1.0, -2.0, 0.5])
PLACE = jnp.array([0.05, -0.02, 0.08])


def moment(state, body, torque=None):
    return SensorInput(jnp.asarray(0.3), state, body, rj.equations_of_motion(body, state, torque))


def along(state, body, point, torque=None):
    """Position in the world of a body point at a time after this state, by small exact steps."""

    def position(s):
        field = rj.equations_of_motion(body, state, torque)
        # Taylor to third order: its second derivative at s = 0 is exact.
        rate, at = field(0.0, state, None), state
        twice = jax.jvp(lambda y: field(0.0, y, None), (state,), (rate,))[1]
        now = jax.tree.map(lambda y, a, b: y + s * a + 0.5 * s * s * b, at, rate, twice)
        start = now.x if isinstance(state, rj.Rigid) else jnp.zeros(3)
        return start + rj.quaternion.rotate(now.q, point)

    return position


def test_gyro_reads_the_rate_through_its_errors():
    turn = jnp.array([0.02, -0.01, 0.03])
    gyro = rj.identify.Gyro(0.1, bias=[0.1, 0.2, 0.3], scale=[1.1, 0.9, 1.0], mounting=turn)
    axes = rj.so3.exp(turn)
    read = jnp.array([1.1, 0.9, 1.0]) * (axes.T @ OMEGA) + jnp.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(
        gyro.error(moment(rj.Spin(OMEGA), BODY.inertia), read), 0, atol=1e-15
    )


@pytest.mark.parametrize("torque", [None, "damping"])
def test_accelerometer_is_the_second_derivative_of_where_it_sits(torque):
    law = None if torque is None else rj.torques.Damping([0.1, 0.2, 0.3])
    state = rj.Attitude(Q, OMEGA)
    here = moment(state, BODY.inertia, law)
    second = once(jax.jacfwd(jax.jacfwd(along(state, BODY.inertia, PLACE, law))))(0.0)
    force = rj.quaternion.rotate(rj.quaternion.conjugate(Q), second)
    falling = rj.identify.Accelerometer(place=PLACE)
    np.testing.assert_allclose(falling.error(here, force), 0, atol=1e-12)
    pivot = rj.identify.Accelerometer(place=PLACE, gravity=GRAVITY)
    weight = rj.quaternion.rotate(rj.quaternion.conjugate(Q), second - GRAVITY)
    np.testing.assert_allclose(pivot.error(here, weight), 0, atol=1e-12)


def test_accelerometer_on_a_body_that_moves():
    body = rj.MassProperties(1.3, [0.01, 0.02, -0.01], BODY.second_moment)
    state = rj.Rigid([1.0, 2, 3], [0.5, 0, 0], Q, OMEGA)
    wind = rj.torques.UniformGravity(GRAVITY)
    second = once(jax.jacfwd(jax.jacfwd(along(state, body, PLACE - body.com, wind))))(0.0)
    force = rj.quaternion.rotate(rj.quaternion.conjugate(Q), second - GRAVITY)
    sensor = rj.identify.Accelerometer(place=PLACE, gravity=GRAVITY)
    np.testing.assert_allclose(sensor.error(moment(state, body, wind), force), 0, atol=1e-12)


def test_marker_magnetometer_and_direction():
    state = rj.Rigid([1.0, 2, 3], [0.5, 0, 0], Q, OMEGA)
    here = moment(state, BODY)
    matrix = np.asarray(rj.quaternion.to_matrix(Q))
    seen = jnp.asarray(np.asarray(state.x) + matrix @ np.asarray(PLACE))
    np.testing.assert_allclose(rj.identify.Marker(PLACE).error(here, seen), 0, atol=1e-15)
    pinned = rj.identify.Marker(PLACE, origin=[5.0, 0, 0])
    turned = jnp.asarray(np.array([5.0, 0, 0]) + matrix @ np.asarray(PLACE))
    np.testing.assert_allclose(pinned.error(here, turned), 0, atol=1e-15)
    field = jnp.array([2.0, 0.3, -1.0])
    inside = jnp.asarray(matrix.T @ np.asarray(field))
    np.testing.assert_allclose(
        rj.identify.Magnetometer(field=field).error(here, inside), 0, atol=1e-15
    )
    sun = rj.identify.Direction(field, 0.01)
    unit = inside / jnp.linalg.norm(inside)
    np.testing.assert_allclose(sun.error(here, unit), 0, atol=1e-15)
    for angle in (1e-6, 0.1, 1.5, 3.0):
        axis = jnp.cross(unit, jnp.array([0.0, 0.0, 1.0]))
        off = rj.so3.exp(angle * axis / jnp.linalg.norm(axis)) @ unit
        length = jnp.linalg.norm(sun.error(here, off))
        np.testing.assert_allclose(length, 2 * np.sin(angle / 2), rtol=1e-9)


def test_attitude_reads_the_same_for_q_and_minus_q_bit_for_bit():
    sensor = rj.identify.AttitudeSensor(0.1, mounting=[0.1, 0.0, 0.2])
    here = moment(rj.Attitude(Q, OMEGA), BODY.inertia)
    read = rj.quaternion.exp(jnp.array([0.5, 0.4, -0.3]))
    np.testing.assert_array_equal(sensor.error(here, read), sensor.error(here, -read))
    placed = rj.quaternion.multiply(Q, rj.quaternion.exp(sensor.mounting))
    turn = jnp.array([0.3, -0.2, 0.1])
    read = rj.quaternion.multiply(placed, rj.quaternion.exp(turn))
    np.testing.assert_allclose(sensor.error(here, read), turn, atol=1e-15)


def test_readings_as_matrices_and_euler_angles_are_the_same():
    angles = np.array([[0.3, 0.4, 0.5], [1.0, 0.2, -0.4]])
    matrices = np.stack([np.asarray(rj.euler.to_matrix(jnp.asarray(a), "ZYX")) for a in angles])
    sensor = rj.identify.AttitudeSensor(0.01)
    one = rj.identify.Recording([0.0, 1.0], (sensor, matrices)).readings[0].values
    degrees = jnp.asarray(np.degrees(angles))
    two = once(jax.vmap(lambda a: rj.euler.to_quaternion(jnp.deg2rad(a), "ZYX")))(degrees)
    np.testing.assert_allclose(np.abs(np.sum(one * two, axis=1)), 1, atol=1e-15)
    # A gap is masked as any other.
    matrices = np.concatenate([matrices, np.full((1, 3, 3), np.nan)])
    with pytest.raises(ValueError, match="the reading at index 2 contains NaN"):
        rj.identify.Recording([0.0, 1.0, 2.0], (sensor, matrices))
    gap = rj.identify.Recording([0.0, 1.0, 2.0], (sensor, matrices, [True, True, False]))
    np.testing.assert_array_equal(gap.readings[0].values, one)


class Tachometer(rj.identify.AbstractSensor):
    """A user's own: it reads |Ω|²."""

    noise: jax.Array | None = None
    reading_shape = (1,)
    components = 1
    unit = "rad²/s²"
    feels = rj.identify.Gyro.feels

    def error(self, moment, reading):
        return reading - jnp.sum(moment.state.omega**2)[None]


def test_a_sensor_of_ones_own():
    ts = jnp.linspace(0.0, 6.0, 40)
    body = rj.Inertia.from_principal(1.0, 1.6, 2.1)
    ys = rj.simulate(body, rj.Spin([0.3, 1.2, 0.4]), ts).ys
    squares = jnp.sum(ys.omega**2, axis=1, keepdims=True)
    record = rj.identify.Recording(ts, (Tachometer(), squares), (rj.identify.Gyro(1e-4), ys.omega))
    problem = rj.identify.Model(record, rj.identify.PrincipalRatios())
    truth = problem.start(body, ys.omega[0])
    for error in problem.errors(truth):
        np.testing.assert_allclose(error, 0, atol=1e-12)


def test_mistakes_in_a_sensor_of_ones_own_are_named():
    class Scalar(Tachometer):
        def error(self, moment, reading):
            return super(Scalar, self).error(moment, reading)[0]  # noqa: UP008

    class Pointing(Tachometer):
        def error(self, moment, reading):
            return reading - moment.state.q[:1]

    ts, body = jnp.linspace(0.0, 6.0, 40), rj.Inertia.from_principal(1.0, 1.6, 2.1)
    readings = jnp.ones((40, 1))

    def errors(sensor):
        gyro = (rj.identify.Gyro(1e-4), jnp.ones((40, 3)))
        record = rj.identify.Recording(ts, (sensor, readings), gyro)
        problem = rj.identify.Model(record, rj.identify.PrincipalRatios())
        return problem.errors(problem.start(body, [1.0, 1.0, 1.0]))

    with pytest.raises(ValueError, match=r"Scalar.error: wanted .* of shape \(1,\), .*got \(\)"):
        errors(Scalar())
    with pytest.raises(
        TypeError, match=r"Pointing.error: 'Spin' .*set feels = rj.motion.HasAttitude"
    ):
        errors(Pointing())
    with pytest.raises(ValueError, match=r"Tachometer: noise: wanted an array of shape \(1,\)"):
        errors(Tachometer(0.01))


MISTAKES = [
    (lambda: rj.identify.Recording([0.0, 1.0], rj.identify.Gyro(), np.ones((2, 3))), r"got Gyro; as in Recording\(t, "),
    (lambda: rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), np.ones((3, 2)))), "transposed"),
    (lambda: rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), np.ones((4, 3)))), "t has 2 times"),
    (lambda: rj.identify.Gyro(bias=[0.0, 0.0]), r"bias: wanted shape \(3,\)"),
    (lambda: rj.identify.Gyro(limit=-1.0), "limit: wanted a positive full scale"),
    (lambda: rj.identify.Gyro(0.01, tolerance=0.02), r"tolerance: wanted Tolerance\(scale=.*got float"),
    (lambda: rj.identify.Accelerometer(place=[0.0] * 3, tolerance={"scale": 0.1}), "tolerance: wanted Tolerance.*got dict"),
    (lambda: rj.identify.Magnetometer(field=[1.0, 0, 0], tolerance=[0.1] * 3), "tolerance: wanted Tolerance.*got list"),
    (lambda: rj.identify.Tolerance(clock=0.0), "Tolerance: clock: .*leave clock out.*got 0.0"),
    (lambda: rj.identify.Tolerance(0.1, -1.0), "Tolerance: cross_axis: .*leave cross_axis out.*got -1.0"),
    (lambda: rj.identify.Gyro(scale=[1.0, np.nan, 1.0]), "scale.*NaN"),
    (lambda: rj.identify.Accelerometer(place=None), "place: wanted three numbers, got None"),
    (lambda: rj.identify.Direction([0.0, 0.0, 0.0]), "got a vector of length zero"),
    (lambda: rj.identify.Direction([0.0, 0, 1], [0.1, 0.1, 0.1]), r"one number or two, got shape \(3,\)"),
    (lambda: rj.identify.Recording([0.0, 1.0], (rj.identify.AttitudeSensor(), np.stack([np.diag([1.0, 1, -1])] * 2))), "index 0 is no rotation.*det = -1"),
    (lambda: rj.identify.Recording([0.0, 1.0], (rj.identify.Direction([0.0, 0, 1]), [[0.0, 0, 1], [0.0, 0, 2]])), "direction at index 1 is not of length 1"),
    (lambda: rj.identify.Recording([0.0, 1.0], (rj.identify.Gyro(), np.zeros((2, 3)), [False, False])), "it is masked|is masked"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "words"), MISTAKES)
@pytest.mark.usefixtures("unhooked")
def test_mistakes_are_named(call, words):
    with pytest.raises((TypeError, ValueError), match=words):
        call()


def test_a_wheel_follows_its_log():
    t = np.linspace(0.0, 1.0, 101)
    speed = rj.torques.Series(t, np.sin(3 * t))
    wheel = rj.torques.Wheel(2.0, [0.0, 0.0, 1.0], speed, delay=0.1)
    np.testing.assert_allclose(wheel(0.456)[2], 2 * np.sin(3 * 0.556), atol=1e-8)
    slope = jax.jacfwd(wheel)(0.456)[2]
    np.testing.assert_allclose(slope, 6 * np.cos(3 * 0.556), atol=1e-5)
    # At the first sample itself the slope is whole, not half: a solver starts there.
    np.testing.assert_allclose(jax.jacfwd(speed)(0.0), 3.0, atol=1e-4)
    np.testing.assert_array_equal(speed(5.0), speed(1.0))
    assert eqx.tree_equal(speed, rj.torques.Series(t, np.sin(3 * t)))
    with pytest.raises(ValueError, match="evenly spaced"):
        rj.torques.Series([0.0, 1.0, 2.0, 4.0], np.zeros(4))


@eqx.filter_jit
def values_and_slopes(series, at):
    return jax.vmap(series)(at), jax.vmap(jax.jacfwd(series))(at)


def test_a_series_is_scipys_spline():
    rng = np.random.default_rng(0)
    for n in (4, 5, 40):
        t, v = 3.0 + 0.25 * np.arange(n), rng.normal(size=(n, 3))
        series, spline = rj.torques.Series(t, v), CubicSpline(t, v)
        at = rng.uniform(t[0], t[-1], 50)
        found, slope = values_and_slopes(series, at)
        np.testing.assert_allclose(found, spline(at), rtol=0, atol=1e-13)
        np.testing.assert_allclose(slope, spline(at, 1), rtol=0, atol=1e-12)


def test_a_series_and_a_wheel_can_be_made_under_a_trace():
    t, v = jnp.arange(6.0), jnp.asarray([0.0, 1.0, 0.5, -1.0, 2.0, 0.0])
    read = lambda t, v, axis: rj.torques.Wheel(2.0, axis, rj.torques.Series(t, v))(2.3)[0]
    axis = jnp.asarray([0.6, 0.0, 0.8])
    wanted = read(t, v, axis)
    np.testing.assert_allclose(eqx.filter_jit(read)(t, v, axis), wanted, rtol=1e-15)
    many = jax.vmap(read, (None, 0, None))(t, jnp.stack([v, 2 * v]), axis)
    np.testing.assert_allclose(many, [wanted, 2 * wanted], rtol=1e-14)
    # Linear in the values; with the times the reading moves the other way.
    slope = jax.jit(jax.grad(read, 1))(t, v, axis)
    np.testing.assert_allclose(slope @ v, wanted, rtol=1e-13)
    earlier = jax.grad(lambda shift: read(t + shift, v, axis))(0.0)
    speed = jax.grad(lambda at: 2.0 * 0.6 * rj.torques.Series(t, v)(at))(2.3)
    np.testing.assert_allclose(earlier, -speed, rtol=1e-12)
    for bad, words in (
        ((t.at[1].set(1.5), v), "evenly spaced"),
        ((t, v * jnp.nan), "contains NaN"),
    ):
        with pytest.raises(RuntimeError, match=words):
            eqx.filter_jit(read)(*bad, axis)
    with pytest.raises(RuntimeError, match="wanted a unit vector"):
        eqx.filter_jit(read)(t, v, 2 * axis)


@pytest.mark.usefixtures("unhooked")
def test_a_recording_under_a_trace_is_refused_in_words():
    gyro, ts, values = rj.identify.Gyro(0.1), jnp.arange(4.0), jnp.ones((4, 3))
    # Known numbers make one within a trace, too.
    assert (
        jax.jit(lambda x: x * rj.identify.Recording(np.arange(4.0), (gyro, np.ones((4, 3)))).t)(
            2.0
        )[3]
        == 6
    )
    for traced in (
        lambda x: rj.identify.Recording(ts + x, (gyro, values)).t,
        lambda x: rj.identify.Recording(ts, (gyro, values + x)).t,
        lambda x: rj.identify.Recording(ts, (gyro, values, values[:, 0] > x)).t,
    ):
        with pytest.raises(TypeError, match=r"Recording: wanted known numbers.*outside of jit"):
            jax.jit(traced)(0.0)


def test_a_gyro_that_feels_acceleration():
    state = rj.Attitude(rj.quaternion.exp(jnp.array([0.3, -0.2, 0.5])), [1.0, 2.0, -0.5])
    body = rj.Inertia.from_principal(1.0, 2.0, 2.7)
    field = rj.solve.equations_of_motion(body, state, None)
    matrix = 1e-3 * np.array([[1.0, 0.2, 0.0], [0.0, -2.0, 0.3], [0.1, 0.0, 0.5]])
    place, gravity = [0.1, 0.0, -0.05], [0.0, 0.0, -9.81]
    gyro = rj.identify.Gyro(0.01, g_sensitivity=matrix, place=place, gravity=gravity)
    felt = rj.identify.Accelerometer(0.1, place=place, gravity=gravity)
    now = SensorInput(jnp.asarray(0.0), state, body, field)
    force = -felt.error(now, jnp.zeros(3))
    np.testing.assert_allclose(
        -gyro.error(now, jnp.zeros(3)), state.omega + matrix @ force, rtol=1e-14
    )
    assert gyro.feels is not rj.identify.Gyro(0.01, g_sensitivity=matrix).feels
    with pytest.raises(ValueError, match="place and gravity need a g_sensitivity"):
        rj.identify.Gyro(0.1, place=[0, 0, 0])
    with pytest.raises(ValueError, match=r"g_sensitivity: wanted shape \(3, 3\)"):
        rj.identify.Gyro(0.1, g_sensitivity=[0.0, 0, 0])
