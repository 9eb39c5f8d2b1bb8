"""The smoother against dense least squares, and how its deviations hold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from identify.filtering import records
from once import once

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.filtering.steps import ExtendedState, dynamics_of
from rigidjax.motion.manifold import minus, plus

COUNT = 5


@pytest.fixture(scope="module")
def short():
    """A few readings far apart of a body pushed hard: the motion is far from linear."""
    process = rj.torques.RandomTorque(0.05)
    keys = jax.random.split(jax.random.key(5), 3)
    ts = 0.25 * jnp.arange(COUNT, dtype=float)
    real = records.truth(keys[0], process, records.START, ts, 5)
    record = identify.Recording(
        ts,
        (identify.Gyro(0.1), records.gyro(keys[1], real.states.omega, 0.1)),
        (
            identify.Direction(records.SUN, 0.1),
            records.direction(keys[2], real.states.q, records.SUN, 0.1),
        ),
    )
    model = records.known(record, process)
    first = identify.first_belief(model, state=records.START, rate=0.3, attitude=0.3)
    found = identify.smooth(model, first, substeps=1, tolerance=1e-9, iterations=30)
    return model, record, first, found


def test_it_is_the_most_probable_motion(short):
    model, record, first, found = short
    scene = identify.Scene(records.BODY, None, model.process, record.sensors, None)
    dynamics = dynamics_of(scene, (), first.x)

    def residuals(z):
        """Of the first error and all kicks, in unit normal numbers."""
        x = plus(first.x, first.root @ z[:6])
        out = []
        for k in range(COUNT):
            if k:
                kicks = z[6 * k : 6 * k + 6]
                x = dynamics.advance(record.t[k - 1], record.t[k] - record.t[k - 1], x, kicks)
            moment = identify.SensorInput(record.t[k], x.motion, records.BODY, dynamics.field)
            for reading in record.readings:
                sensor = reading.sensor
                out.append(sensor.error(moment, reading.values[k]) / sensor.noise)
        return jnp.concatenate([z, *out]), x

    value = once(lambda z: residuals(z)[0])
    slope = once(jax.jacfwd(lambda z: residuals(z)[0]))
    best = scipy.optimize.least_squares(
        lambda z: np.asarray(value(z)), np.zeros(6 * COUNT), jac=lambda z: np.asarray(slope(z)),
        xtol=1e-14, ftol=1e-14, gtol=1e-12,
    )  # fmt: skip
    last = once(lambda z: residuals(z)[1])(best.x)
    end = jax.tree.map(lambda leaf: leaf[-1], found.belief.x)
    np.testing.assert_allclose(minus(end, last), 0, atol=1e-7)
    # The deviations are those of the same problem's normal equations.
    spread = np.linalg.inv(best.jac.T @ best.jac)
    moved = once(jax.jacfwd(lambda z: minus(residuals(z)[1], last)))(best.x)
    np.testing.assert_allclose(found.belief.covariance[-1], moved @ spread @ moved.T, atol=1e-7)
    # The kicks, whose first three numbers are the mean torque of a step.
    step = float(record.t[1] - record.t[0])
    size = np.sqrt(0.05 / step)
    kicks = best.x[6:].reshape(COUNT - 1, 6)[:, :3]
    np.testing.assert_allclose(found.pushes[0].mean[1:], size * kicks, atol=1e-6)
    deviation = np.sqrt(np.diagonal(spread))[6:].reshape(COUNT - 1, 6)[:, :3]
    np.testing.assert_allclose(found.pushes[0].deviation[1:], size * deviation, atol=1e-6)


def test_it_knows_more_than_the_filter(short):
    model, _, first, found = short
    passed = identify.filter(model, first, substeps=1)
    sizes = [np.linalg.slogdet(run.belief.root[0])[1] for run in (found, passed)]
    assert sizes[0] < sizes[1] - 1
    assert found.change < 1e-9 and found.words == "followed"
    assert isinstance(found.belief.x, ExtendedState)


def test_a_torque_that_is_not_in_the_equations_is_seen():
    # A constant torque about one axis for a while; the model knows only that torques last some 0.5 s.
    ts = 0.02 * np.arange(150)
    push = np.where((ts > 1) & (ts < 2), 0.5, 0.0)
    law = rj.torques.Tabulated(ts, np.stack([0 * push, push, 0 * push], axis=1))
    real = rj.simulate(records.BODY, rj.Spin(records.START.omega), ts, law).ys
    noisy = records.gyro(jax.random.key(0), real.omega, 0.01)
    record = identify.Recording(ts, (identify.Gyro(0.01), noisy))
    model = records.known(record, rj.torques.CorrelatedTorque(0.05, 0.5))
    first = identify.first_belief(model, state=rj.Spin(records.START.omega), rate=0.1)
    found = identify.smooth(model, first)
    torque = np.asarray(found.belief.torques[0])[found.rows]
    band = 2 * np.asarray(found.belief.deviation)[found.rows, 3:]
    inside = (ts > 1.2) & (ts < 1.8)
    np.testing.assert_allclose(torque[inside, 1].mean(), 0.5, atol=0.05)
    np.testing.assert_allclose(torque[ts < 0.8].mean(axis=0), 0, atol=0.05)
    away = np.abs(torque - np.stack([0 * push, push, 0 * push], axis=1))
    calm = (np.abs(ts - 1) > 0.1) & (np.abs(ts - 2) > 0.1)
    assert (away[calm] < band[calm]).mean() > 0.85
    (push_found,) = found.pushes
    np.testing.assert_allclose(push_found.mean[found.rows], torque, atol=1e-15)
    np.testing.assert_allclose(push_found.deviation[found.rows], 0.5 * band, rtol=1e-12)


def test_pushes_stand_in_the_order_of_the_process(short):
    """The equal of a long memory and a slow drift: the torque that is correlated comes first."""
    model, _, first, found = short
    process = rj.torques.Sum(rj.torques.CorrelatedTorque(1e-12, 1.0), model.process)
    both = identify.Model(model.recording, model.charts[0], process=process)
    first = identify.first_belief(both, state=first.state, rate=0.3, attitude=0.3)
    again = identify.smooth(both, first, substeps=1, tolerance=1e-9, iterations=30)
    correlated, white = again.pushes
    np.testing.assert_allclose(white.mean, found.pushes[0].mean, atol=1e-5)
    assert float(jnp.max(jnp.abs(correlated.mean))) < 1e-5
    assert float(jnp.max(correlated.deviation)) < 1e-5


def test_a_motion_that_does_not_settle_is_told(short):
    model, _, _, _ = short
    wrong = rj.Attitude(rj.quaternion.exp(jnp.array([2.5, 0.0, 0.0])), records.START.omega)
    first = identify.first_belief(model, state=wrong, rate=0.3, attitude=0.3)
    with pytest.raises(ValueError, match=r"smooth: the motion still moves|lost"):
        identify.smooth(model, first, substeps=1, iterations=1)
