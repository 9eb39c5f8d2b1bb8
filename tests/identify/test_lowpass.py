"""Readings that were filtered, and a gyro that feels acceleration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.data.stacking import pick
from rigidjax.identify.model.model import sensor_errors
from rigidjax.identify.sensors import SensorInput

BODY = rj.Inertia.from_principal(1.0, 2.0, 2.7)


def answer(order, cutoff, frequency, phase, t):
    """The steady answer of the analogue filter to sin(2π f t + phase)."""
    b, a = signal.butter(order, 2 * np.pi * cutoff, analog=True)
    (gain,) = signal.freqs(b, a, [2 * np.pi * frequency])[1]
    return np.imag(gain * np.exp(1j * (2 * np.pi * frequency * t + phase)))


@pytest.mark.parametrize("order", [1, 2])
def test_sines_come_out_as_from_the_analogue_filter(order):
    jitter = np.random.default_rng(0).uniform(-0.2, 0.2, 1000)
    t = 0.002 * (np.arange(1000) + jitter)
    waves = ((5.0, 0.0), (2.0, 1.0), (20.0, 0.3))
    u = np.stack([np.sin(2 * np.pi * f * t + p) for f, p in waves], axis=1)
    y = identify.LowPass(20.0, order)(jnp.asarray(t), jnp.asarray(u))
    late = t > 0.3
    wanted = np.stack([answer(order, 20.0, f, p, t) for f, p in waves], axis=1)
    error = np.abs(np.asarray(y) - wanted)[late].max(axis=0)
    # The cubic through the samples is off by (2π f h)⁴ or so; the filter lets half of it through.
    assert (error < [5e-6, 5e-7, 1e-3]).all()
    np.testing.assert_allclose(np.abs(wanted[late, 2]).max(), 2**-0.5, rtol=1e-3)


@pytest.mark.parametrize("order", [1, 2])
def test_cubics_are_exact_and_the_start_is_that_of_a_steady_turn(order):
    t = jnp.linspace(0.0, 1.0, 21)
    y = identify.LowPass(3.0, order)(t, (0.7 - 2.0 * t)[:, None])
    lag = (1.0 if order == 1 else 2**0.5) / (2 * np.pi * 3.0)
    np.testing.assert_allclose(y[:, 0], 0.7 - 2.0 * (t - lag), atol=1e-13)
    parabola = identify.LowPass(3.0, order)(t, (t**2)[:, None])[:, 0]
    more = 2 / (2 * np.pi * 3.0) ** 2
    np.testing.assert_allclose(parabola, t**2 - 2 * lag * t + more, atol=1e-12)


def test_after_a_gap_it_begins_anew():
    t = np.concatenate([np.arange(10), 50.0 + np.arange(10)]) * 0.01
    u = np.where(t < 0.3, 1.0, 5.0)[:, None]
    y = identify.LowPass(1.0)(jnp.asarray(t), jnp.asarray(u))
    np.testing.assert_allclose(y, u, atol=1e-14)


@pytest.mark.parametrize("order", [1, 2])
def test_the_derivative_by_the_cutoff(order):
    t = jnp.linspace(0.0, 1.0, 201)
    u = jnp.sin(12.0 * t)[:, None]
    at = lambda cutoff: identify.LowPass(cutoff, order)(t, u)[150, 0]
    step = 1e-4
    differences = (at(8.0 + step) - at(8.0 - step)) / (2 * step)
    for derivative in (jax.grad(at)(8.0), jax.jacfwd(at)(8.0)):
        np.testing.assert_allclose(derivative, differences, rtol=1e-6)


def test_the_model_goes_through_the_filter_and_so_do_its_derivatives():
    fine = jnp.linspace(0.0, 2.0, 2001)
    omega = rj.simulate(BODY, rj.Spin([3.0, 0.5, 4.0]), fine).ys.omega
    b, a = signal.butter(2, 2 * np.pi * 6.0, analog=True)
    filtered = np.stack([signal.lsim((b, a), w, fine)[1] for w in np.asarray(omega).T], axis=1)
    t = fine[::20]
    gyro = identify.Gyro(0.01, lowpass=identify.LowPass(6.0, 2))
    record = identify.Recording(t, (gyro, filtered[::20]))
    move = identify.Free(lambda s: s.sensors[0].lowpass.cutoff, "cutoff", positive=True)
    problem = identify.Model(record, identify.PrincipalRatios(), free=[move])
    flat = problem.start(BODY, [3.0, 0.5, 4.0])

    def errors(x):
        record, reference = pick(problem.records, 0), pick(problem.reference, 0)
        return sensor_errors(problem, problem.index.rows(x)[0], record, reference, None)[0]

    # SciPy's filter begins at rest; by then it has forgotten that.
    np.testing.assert_allclose(errors(flat)[t > 0.5], 0.0, atol=1e-4)
    jacobian = jax.jacfwd(errors)(flat)
    step = 1e-5
    for i in range(flat.size):
        way = step * jnp.eye(flat.size)[i]
        differences = (errors(flat + way) - errors(flat - way)) / (2 * step)
        np.testing.assert_allclose(jacobian[..., i], differences, atol=1e-6)


def test_a_fit_of_filtered_rates_needs_the_filter():
    fine = jnp.linspace(0.0, 3.0, 6001)
    begin = rj.simulate(BODY, rj.Spin([3.0, 0.5, 4.0]), fine).ys.omega
    b, a = signal.butter(2, 2 * np.pi * 4.0, analog=True)
    filtered = np.stack([signal.lsim((b, a), w, fine)[1] for w in np.asarray(begin).T], axis=1)
    seen = filtered[2000::20]
    t = fine[2000::20]
    noise = 1e-3 * np.random.default_rng(0).standard_normal(seen.shape)
    found = {}
    for lowpass in (None, identify.LowPass(4.0, 2)):
        record = identify.Recording(t, (identify.Gyro(1e-3, lowpass=lowpass), seen + noise))
        problem = identify.Model(record, identify.PrincipalRatios())
        found[lowpass is None] = identify.fit(problem, starts=1)
    assert found[False].ok, found[False].status
    low, high = found[False].interval(0.99)["Ix/Iz"]
    assert low < 1 / 2.7 < high
    assert not found[True].ok
    assert found[True].chi2 > 1.5 * found[False].chi2


def test_a_gyro_that_feels_acceleration():
    state = rj.Attitude(rj.quaternion.exp(jnp.array([0.3, -0.2, 0.5])), [1.0, 2.0, -0.5])
    field = rj.solve.equations_of_motion(BODY, state, None)
    matrix = 1e-3 * np.array([[1.0, 0.2, 0.0], [0.0, -2.0, 0.3], [0.1, 0.0, 0.5]])
    place, gravity = [0.1, 0.0, -0.05], [0.0, 0.0, -9.81]
    gyro = identify.Gyro(0.01, g_sensitivity=matrix, place=place, gravity=gravity)
    felt = identify.Accelerometer(0.1, place=place, gravity=gravity)
    moment = SensorInput(jnp.asarray(0.0), state, BODY, field)
    force = -felt.error(moment, jnp.zeros(3))
    np.testing.assert_allclose(
        -gyro.error(moment, jnp.zeros(3)), state.omega + matrix @ force, rtol=1e-14
    )
    assert gyro.feels is not identify.Gyro(0.01, g_sensitivity=matrix).feels


def test_mistakes_are_named():
    with pytest.raises(ValueError, match="cutoff: wanted a positive frequency, Hz, got -1"):
        identify.LowPass(-1.0)
    with pytest.raises(ValueError, match="order: wanted 1 or 2, got 3"):
        identify.LowPass(1.0, 3)
    with pytest.raises(ValueError, match="t: wanted increasing times"):
        identify.LowPass(1.0)(jnp.zeros(3), jnp.ones((3, 1)))
    with pytest.raises(TypeError, match=r"lowpass: wanted LowPass\(cutoff in Hz\)"):
        identify.Gyro(0.1, lowpass=20.0)
    with pytest.raises(ValueError, match="place and gravity need a g_sensitivity"):
        identify.Gyro(0.1, place=[0, 0, 0])
    with pytest.raises(ValueError, match=r"g_sensitivity: wanted shape \(3, 3\)"):
        identify.Gyro(0.1, g_sensitivity=[0.0, 0, 0])
    t = jnp.linspace(0.0, 1.0, 20)
    gyro = identify.Gyro(0.1, lowpass=identify.LowPass(5.0))
    record = identify.Recording(t, (gyro, jnp.ones((20, 3))))
    with pytest.raises(ValueError, match="a lowpass has states of its own"):
        identify.first_belief(identify.Model(record, identify.Known(BODY)), rate=0.1)


@pytest.mark.parametrize("order", [1, 2])
def test_a_shorter_record_is_filtered_as_if_it_were_alone(order):
    """Beside a longer one it is continued at its last time, where the filter was NaN."""
    t = jnp.linspace(0.0, 1.0, 30)
    omega = rj.simulate(BODY, rj.Spin([3.0, 0.5, 4.0]), t).ys.omega
    gyro = identify.Gyro(1e-3, lowpass=identify.LowPass(4.0, order))
    long, short = (identify.Recording(t[:n], (gyro, omega[:n])) for n in (30, 17))
    errors = []
    for records in ([short], [long, short]):
        problem = identify.Model(records, identify.PrincipalRatios())
        errors.append(problem.errors(problem.start(BODY, [3.0, 0.5, 4.0]))[0])
    np.testing.assert_allclose(errors[1][1, :17], errors[0][:17], rtol=0, atol=1e-13)
    assert np.isfinite(errors[1]).all()
