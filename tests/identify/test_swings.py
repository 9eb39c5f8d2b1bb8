"""A gyro's log of a body on a suspension, through the rooms of `identify`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.data.reference_states import require_no_swing
from rigidjax.identify.search.starts import starting_points
from rigidjax.suspensions import Axle, Friction, Strings, TorsionBar

G = 9.80665
AXIS = np.array([0.36, -0.48, 0.8])
SIDE = np.array([0.8, 0.6, 0.0])
CLUB = rj.shapes.box(0.8, [0.05, 0.1, 0.5]).shift(0.25 * SIDE)
HUNG = Axle(AXIS, [0.0, 0.0, 0.0], G * SIDE)
STRINGS = Strings(2, 0.1, 0.12, 0.7, AXIS)
BAR = TorsionBar(AXIS, 0.05)


def off_by(body, factor):
    return rj.MassProperties(body.mass, body.com, factor * body.second_moment)


def swung(moment, slope, start, ts, viscous=0.0):
    """The angle and rate of M γ̈ = −V'(γ) − c γ̇ by SciPy."""

    def field(t, y):
        return [y[1], (-slope(y[0]) - viscous * y[1]) / moment]

    how = dict(t_eval=ts, rtol=1e-12, atol=1e-13, method="DOP853")
    return solve_ivp(field, (ts[0], ts[-1]), start, **how).y


def model_of(law, body, start, ts, noise=0.05):
    gyro = identify.Gyro(noise)
    key = jax.random.key(0)
    readings = identify.simulate_readings(gyro, body, rj.Turn(*start), ts, law, key=key)
    record = identify.Recording(ts, (gyro, readings))
    return identify.Model(record, identify.Moment(off_by(body, 1.4), law), torque=law)


def test_a_pendulum():
    ts = np.linspace(0.0, 30.0, 1500)
    model = model_of(HUNG, CLUB, (0.9, -1.0), ts)
    assert model.size == 3  # the moment, the angle, the rate
    fit = identify.fit(model)
    assert fit.ok, fit.status
    moment = AXIS @ np.asarray(CLUB.inertia.tensor) @ AXIS + 0.8 * 0.25**2
    ends = fit.interval(0.95)
    assert ends["moment"][0] < moment < ends["moment"][1]
    assert ends["moment"][1] - ends["moment"][0] < 1e-3 * moment
    ends = fit.interval(0.999)
    assert ends["angle"][0] < 0.9 < ends["angle"][1]
    assert ends["rate"][0] < -1.0 < ends["rate"][1]
    assert isinstance(fit.state0, rj.Turn)
    names = [row[0] for row in identify.report.rows(fit)]
    assert names == ["moment", "angle at the start", "rate at the start"]


def test_the_readings_are_those_of_another_solver():
    ts = np.linspace(0.0, 5.0, 101)
    moment = float(HUNG.moment(CLUB, 0.0))
    _, rate = swung(moment, lambda a: 0.8 * G * 0.25 * np.sin(a), (0.9, -1.0), ts)
    turn = np.array([0.02, -0.03, 0.01])
    gyro = identify.Gyro(0.1, mounting=turn)
    seen = rate[:, None] * (np.asarray(rj.rotation.so3.exp(-turn)) @ AXIS)
    model = identify.Model(
        identify.Recording(ts, (gyro, seen)), identify.Moment(CLUB, HUNG), torque=HUNG
    )
    x = jnp.array([0.0, 0.9, -1.0 / float(model.typical_rate)])
    np.testing.assert_allclose(model.errors(x)[0], 0.0, atol=1e-9)


@pytest.mark.parametrize("law", [HUNG, STRINGS, BAR], ids=["axle", "strings", "bar"])
@pytest.mark.parametrize("guess", [0.5, 3.0])
def test_the_start_is_near(law, guess):
    """The period, and the angle through which the body turns first, give all three numbers."""
    ts = np.linspace(0.0, 12.0, 700)
    body = CLUB.inertia if law is BAR else CLUB
    start = (0.3, 0.5 if law is BAR else 1.2)
    ys = rj.simulate(body, rj.Turn(*start), ts, law).ys
    read = np.asarray(ys.rate)[:, None] * AXIS + 0.05 * np.random.default_rng(1).normal(
        size=(700, 3)
    )
    first = off_by(CLUB, guess)
    chart = identify.Moment(first.inertia if law is BAR else first, law)
    record = identify.Recording(ts, (identify.Gyro(0.05), read))
    model = identify.Model(record, chart, torque=law)
    (x,) = starting_points(model, 8, None)
    found = model.unpack(x)
    wanted = float(law.moment(body, 0.0))
    assert abs(float(law.moment(found.body, 0.0)) / wanted - 1) < 0.02
    assert abs(float(found.state0.angle) - start[0]) < 0.05
    assert abs(float(found.state0.rate) - start[1]) < 0.3


def test_friction_and_a_clock_on_strings():
    ts = np.linspace(0.0, 25.0, 1000)
    law = Strings(2, 0.1, 0.12, 0.7, AXIS, friction=Friction(4e-4))
    free = [
        identify.Free(lambda s: s.torque.friction.viscous, "friction", scale=1e-3),
        identify.Free(lambda s: s.sensors[0].mounting, "mounting", prior=0.1),
    ]
    model = model_of(law, CLUB, (0.8, 0.0), ts)
    record = model.recording
    read = np.asarray(record.readings[0].values) @ np.asarray(
        rj.rotation.so3.exp(jnp.array([0.03, -0.02, 0.0]))
    )
    gyro = identify.Gyro(0.05, mounting=np.zeros(3), offset=0.0)
    start = Strings(2, 0.1, 0.12, 0.7, AXIS, friction=Friction(0.0))
    guess = identify.Moment(off_by(CLUB, 0.7), start)
    turned = identify.Recording(record.t, (gyro, read))
    fit = identify.fit(identify.Model(turned, guess, torque=start, free=free))
    assert fit.ok, fit.status
    ends = fit.interval(0.95)
    moment = AXIS @ np.asarray(CLUB.inertia.tensor) @ AXIS
    assert ends["moment"][0] < moment < ends["moment"][1]
    assert ends["friction"][0] < 4e-4 < ends["friction"][1]


def test_a_chart_that_the_swing_shows_in_part():
    """Of six numbers of an inertia on a bar one is determined; the others are said not to be."""
    ts = np.linspace(0.0, 20.0, 800)
    bar = TorsionBar([0.0, 1.0, 0.0], 0.05)
    body = CLUB.inertia
    gyro = identify.Gyro(0.02)
    readings = identify.simulate_readings(
        gyro, body, rj.Turn(0.4, 0.0), ts, bar, key=jax.random.key(3)
    )
    record = identify.Recording(ts, (gyro, readings))
    fit = identify.fit(identify.Model(record, identify.Tensor(0.01), torque=bar))
    low, high = fit.interval(0.95)["Iyy"]
    assert low < float(body.tensor[1, 1]) < high < 1.01 * low
    assert all(np.isinf(fit.interval(0.95)[name][1]) for name in ("Ixx", "Izz"))
    assert any("not determined" in line for line in fit.identifiability)


def test_a_support_feels_the_weight_and_the_pull_of_the_swing():
    """At the lowest place the force is m (g + w² d) upwards, and of an axle without friction the
    torque about it is zero.
    """
    felt = identify.ForceTorque(gravity=G * SIDE)
    ts = np.linspace(0.0, 1.0, 5)
    force = identify.simulate_readings(felt, CLUB, rj.Turn(0.0, 3.0), ts, HUNG)
    np.testing.assert_allclose(force[0, :3], -0.8 * (G + 9.0 * 0.25) * SIDE, atol=1e-9)
    np.testing.assert_allclose(force[:, 3:] @ AXIS, 0.0, atol=1e-9)
    # A phone on the same pendulum: the specific force at the axle is −g, at rest and not.
    still = identify.Accelerometer(gravity=G * SIDE, place=[0.0, 0.0, 0.0])
    turned = identify.simulate_readings(still, CLUB, rj.Turn(0.0, 3.0), ts, HUNG)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), G, atol=1e-9)


def test_a_swing_and_a_throw_in_one_fit():
    """The throw shows the ratios, the swing the scale."""
    ts = np.linspace(0.0, 10.0, 500)
    chart = identify.Mass(off_by(CLUB, 1.5), ["inertia"])
    gyro = identify.Gyro(0.02)
    read = identify.simulate_readings(
        gyro, CLUB, rj.Turn(0.9, 0.0), ts, HUNG, key=jax.random.key(1)
    )
    late = np.linspace(0.0, 1.0, 201)
    thrown = rj.simulate(CLUB.inertia, rj.Spin([3.0, 2.0, 9.0]), late).ys.omega
    thrown = thrown + 0.02 * jax.random.normal(jax.random.key(2), thrown.shape)
    kinds = {
        "swing": identify.Model(identify.Recording(ts, (gyro, read)), chart, torque=HUNG),
        "throw": identify.Model(identify.Recording(late, (gyro, thrown)), chart),
    }
    fit = identify.fit(identify.Model(kinds))
    assert fit.ok, fit.status
    ends = fit.interval(0.999)
    held = [
        ends[f"I{k}"][0] < float(m) < ends[f"I{k}"][1]
        for k, m in enumerate(CLUB.inertia.moments, 1)
    ]
    assert all(held)
    assert {"angle [swing]", "rate [swing]", "Ωx [throw]"} <= set(ends)


def test_what_a_suspension_is_not_for():
    ts = np.linspace(0.0, 2.0, 50)
    record = identify.Recording(ts, (identify.Gyro(0.1), np.sin(ts)[:, None] * AXIS))
    with pytest.raises(TypeError, match="gravity needs the mass"):
        identify.Model(record, identify.Tensor(), torque=HUNG)
    noise = rj.torques.RandomTorque([0.1, 0.1, 0.1])
    with pytest.raises(ValueError, match="a filter does not follow"):
        identify.Model(record, identify.Moment(CLUB, HUNG), torque=HUNG, process=noise)
    with pytest.raises(ValueError, match="wanted a moment about the axis"):
        identify.Moment(rj.Inertia.from_principal(0.0, 1.0, 1.0), TorsionBar([1.0, 0.0, 0.0], 1.0))
    with pytest.raises(TypeError, match="suspension"):
        identify.Moment(CLUB, rj.torques.ConstantTorque([0.0, 0.0, 1.0]))


def test_rates_of_a_swing_ask_for_a_suspension():
    ts = np.linspace(0.0, 10.0, 400)
    noise = 0.1 * np.random.default_rng(0).normal(size=(400, 3))
    record = identify.Recording(ts, (identify.Gyro(), np.cos(3 * ts)[:, None] * AXIS + noise))
    with pytest.raises(ValueError, match=r"about one axis, \[0.3.*Moment\(guess, law\)"):
        identify.fit(identify.Model(record, identify.Ratios()))


@pytest.mark.parametrize("moments", [(1.0, 1.001, 1.002), (1.0, 2.0, 2.9), (0.02, 1.0, 1.01)])
def test_free_bodies_are_no_swings(moments):
    """A flip about the middle axis goes there and back, too, but never stands still."""
    ts = np.linspace(0.0, 400.0, 4000)
    body = rj.Inertia.from_principal(*moments)
    for first in ([1e-4, 1.0, 1e-4], [0.0, 1e-3, 1.0], [0.3, 0.4, 0.5]):
        require_no_swing(np.asarray(rj.simulate(body, rj.Spin(first), ts).ys.omega), "rates")
