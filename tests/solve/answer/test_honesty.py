"""What a run, a derivative and a fit cannot have seen they do not confirm: pulses, switches, zeros."""

import warnings

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once

import rigidjax as rj

BODY = rj.Inertia.from_principal(1.0, 1.4, 2.0)
Z = jnp.array([0.0, 0.0, 1.0])
FIXED = dict(solver=rj.solvers.Tsitouras5())


def gaussian(t, state, body):
    return 50.0 * Z * jnp.exp(-0.5 * ((t - 7.3131) / 2e-3) ** 2)


GAIN = 50.0 * 2e-3 * np.sqrt(2 * np.pi) / 2.0


def gain(sol):
    return float(sol.ys.omega[-1, 2] - sol.ys.omega[0, 2])


@pytest.mark.parametrize(
    "how", [{}, FIXED, dict(solver=dfx.Tsit5())], ids=["own", "five", "diffrax"]
)
@pytest.mark.parametrize("ts", [[0.0, 20.0], [20.0, 0.0]], ids=["forward", "back"])
def test_a_pulse_between_steps_is_no_known_motion(how, ts):
    sol = rj.simulate(BODY, rj.Spin([0.0, 0.0, 0.3]), ts, gaussian, **how)
    miss = abs(abs(gain(sol)) - GAIN)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert miss <= 3 * float(sol.error.total["omega"][-1])


def test_an_accuracy_holds_for_a_pulse_between_steps():
    ts = [0.0, 20.0]
    for width, accuracy in ((2e-3, 1e-6), (5e-4, 1e-8)):

        def law(t, state, body, width=width):
            return 50.0 * Z * jnp.exp(-0.5 * ((t - 3.777) / width) ** 2) / width * 1e-3

        sol = rj.simulate(BODY, rj.Spin([0.0, 0.0, 0.3]), ts, law, accuracy=accuracy)
        right = 0.05 * np.sqrt(2 * np.pi) / 2.0
        assert abs(gain(sol) - right) <= accuracy
        assert float(sol.error.relative[-1]) <= accuracy


def times_of_peaks(sol):
    from rigidjax.solve.answer import peaks

    return peaks.times_of_peaks(sol._setup, sol.ts, sol._states, sol.stats["num_steps"])


def peaks_of(law, ts, **how):
    start = rj.Spin([0.1, 0.2, 0.3])
    found = once(lambda: times_of_peaks(rj.simulate(BODY, start, ts, law, throw=False, **how)))
    return np.asarray(found())


def test_smooth_laws_of_time_have_no_peaks():
    smooth = {
        "swing": lambda t, state, body: jnp.cos(3.0 * t + 1.0) * state.omega,
        "fast": lambda t, state, body: jnp.sin(40.0 * t) * Z,
        "line": lambda t, state, body: (1.0 + 0.3 * t) * Z,
        "switch": lambda t, state, body: jnp.where(t < 4.1, 1.0, 0.2) * Z,
        "still": rj.torques.Damping([0.1, 0.1, 0.1]),
    }
    for name, law in smooth.items():
        assert peaks_of(law, [0.0, 30.0]).size == 0, name
    slow = {
        "decay": lambda t, state, body: jnp.exp(-0.1 * t) * Z,
        "orbit": lambda t, state, body: Z / (2.0 + jnp.cos(0.3 * t)),
        "square": lambda t, state, body: Z * (1.0 + 0.1 * t) ** 6,
    }
    for name, law in slow.items():
        assert not np.any(peaks_of(law, [0.0, 30.0])), name


# Shapes of width 1 about 0, by their narrow operations.
SHAPES = {
    "exp": lambda u: jnp.exp(-(u**2)),
    "flat": lambda u: jnp.exp(-(u**4)),
    "quotient": lambda u: 1 / (1 + u**2),
    "power": lambda u: (1 + u**2) ** -1.5,
    "tanh": lambda u: 1 - jnp.tanh(u) ** 2,
    "window": lambda u: jax.nn.sigmoid(9 * (u + 1)) - jax.nn.sigmoid(9 * (u - 1)),
    "cond": lambda u: jax.lax.cond(u > 1e9, jnp.sin, lambda u: jnp.exp(-(u**2)), u),
}


@pytest.mark.parametrize("name", SHAPES)
def test_a_peak_of_any_width_is_found(name):
    @jax.jit
    def found(centre, width):
        def law(t, state, body):
            return Z * (jnp.cos(t) + SHAPES[name]((t - centre) / width) / width)

        sol = rj.simulate(BODY, rj.Spin([0.1, 0.2, 0.3]), [0.0, 30.0], law, throw=False)
        return times_of_peaks(sol)

    rng = np.random.default_rng(len(name))
    for width in (1e-6, 1e-4, 1e-2):
        centre = rng.uniform(0.5, 29.5)
        assert np.min(np.abs(found(centre, width) - centre)) < 1.5 * width, width


def test_peaks_that_come_once_a_second_and_peaks_of_tables_are_found():
    train = peaks_of(
        lambda t, state, body: Z * jnp.exp(3e4 * (jnp.cos(2 * jnp.pi * t) - 1)), [0.0, 512.0]
    )
    found = train[train > 0]
    assert found.size > 3 and np.max(np.abs(found - np.round(found))) < 1e-3
    rows = jnp.zeros(2000).at[1234].set(5.0)
    times = jnp.linspace(0.0, 20.0, 2000)
    for table in (rj.torques.Series(times, rows), lambda t: jnp.interp(t, times, rows)):
        at = peaks_of(lambda t, state, body, table=table: Z * table(t), [0.0, 20.0], max_step=0.2)
        assert np.min(np.abs(at - times[1234])) < 0.02


class PulseOfAngle(eqx.Module):
    """A pulse where a wheel, whose angle is a table of straight lines, passes 2.3 rad."""

    angle: rj.torques.Linear

    def __call__(self, t, state, body):
        return 50.0 * Z * jnp.exp(-0.5 * ((self.angle(t) - 2.3) / 1e-3) ** 2)


def test_laws_that_declare_their_jumps_have_no_peaks():
    edges, rng = jnp.linspace(0.0, 9.0, 31), np.random.default_rng(3)
    pulses = rj.torques.Pulses(edges, jnp.asarray(rng.normal(size=(30, 3))))
    assert peaks_of(pulses, [0.0, 8.0]).size == 0
    both = peaks_of(rj.torques.Sum(pulses, gaussian), [0.0, 8.0])
    assert np.min(np.abs(both - 7.3131)) < 1e-4
    # A law may be a pulse as a function of a straight line: 0.5 rad/s, 2.3 rad at 4.6 s.
    angle = rj.torques.Linear(jnp.array([0.0, 9.0]), jnp.array([0.0, 4.5]))
    assert np.min(np.abs(peaks_of(PulseOfAngle(angle), [0.0, 8.0]) - 4.6)) < 1e-4


class Until(eqx.Module):
    end: jax.Array
    size: jax.Array

    def __call__(self, t, state, body):
        return Z * self.size * jnp.where(t < self.end, 1.0, 0.0)


class Burn(eqx.Module):
    stop: jax.Array

    def __call__(self, t, state, body):
        return Z * jnp.where(state.omega[2] < self.stop, 1.0, 0.25)


def last_rate(law, **tolerances):
    return rj.simulate(BODY, rj.Spin([0.0, 0.0, 0.0]), [0.0, 3.0], law, **tolerances).ys.omega[
        -1, 2
    ]


# The rate is size·end/2; or stop + (3 − 2 stop)/8, whose slope by `stop` comes from the switch.
TIMED = {
    "size": (lambda x, **how: last_rate(Until(x, x), **how), 1.1, 1.1),
    "time": (lambda x, **how: last_rate(Until(x, jnp.ones(())), **how), 1.7, 0.5),
}


@pytest.mark.parametrize("name", TIMED)
def test_a_derivative_by_a_switching_time_is_right_and_known(name):
    f, x, right = TIMED[name]
    error = rj.error_of(f, jnp.asarray(x))
    assert bool(error.known)
    off = abs(float(error.derivative) - right)
    assert off <= 2 * float(error.derivative_error) + 1e-15 and off < 1e-9


@pytest.mark.parametrize("stop", [0.6, 0.9])
def test_a_derivative_that_misses_a_switch_is_not_known(stop):
    with pytest.warns(UserWarning, match="a torque that switches at a time or a state"):
        error = rj.error_of(lambda x, **how: last_rate(Burn(x), **how), jnp.asarray(stop))
    assert not bool(error.known)
    assert abs(float(error.derivative) - 0.75) <= 2 * float(error.derivative_error)


def test_the_last_digits_of_zeros_count():
    body = rj.Inertia.from_principal(1.0, 2.0, 2.5)

    def f(change, **how):
        omega = jnp.stack([0.4 + change, jnp.ones_like(change), 0.2 + 0.0 * change])
        return rj.simulate(body, rj.Spin(omega), [0.0, 3e3], **how).ys.omega[-1, 0]

    error = rj.error_of(f, 0.0)
    other = rj.error_of(lambda x, **how: f(x - 0.4, **how), 0.4)
    for part in ("value_error", "derivative_error"):
        here, there = (float(np.asarray(getattr(e, part))) for e in (error, other))
        assert 0.1 * there < here < 30 * there, part


@pytest.mark.parametrize("moments", [[1.0, 1.0, 2.0], [0.8, 1.2, 2.0]])
def test_a_flat_body_has_a_difference_on_one_side(moments):
    def f(moments, **how):
        body = rj.Inertia.from_principal(*moments)
        law = rj.torques.Damping([0.1, 0.1, 0.1])
        return rj.simulate(body, rj.Spin([0.4, 1.1, 3.0]), [0.0, 1.0], law, **how).ys.omega[-1]

    error = rj.error_of(f, jnp.array(moments))
    assert bool(error.known) and float(error.derivative_error.max()) < 1e-6


def test_smooth_functions_agree_with_their_differences():
    from rigidjax.solve.answer.difference import (
        derivative_and_difference,
        step_and_two_points,
        values_at_two_points,
    )
    from rigidjax.solve.answer.error import FunctionError

    rng = np.random.default_rng(5)
    functions = (
        lambda x: jnp.sin(1e4 * x[0]) * x[1],
        lambda x: jnp.exp(-x[0]) - x[1] ** 3,
        lambda x: (x[0] - x[1]) ** 2,
        lambda x: jnp.stack([x[0] * x[1], 1e6 * x[1], 0.0 * x[0]]),
    )
    for f in functions:
        for _ in range(20):
            x = jnp.asarray(rng.normal(size=2))
            value, slope = f(x), jax.jacfwd(f)(x)
            error = FunctionError(value, 1e-10 * jnp.abs(value), slope, 1e-9 * jnp.abs(slope))
            step, sides = step_and_two_points(x, value, error.value_error, slope)
            values = values_at_two_points(lambda x, _: f(x), sides, jnp.zeros(2))
            assert not np.any(
                derivative_and_difference(x, value, step, sides, values, error).differ
            )
            wrong = eqx.tree_at(lambda e: e.derivative, error, 0.9 * slope)
            slopes = derivative_and_difference(x, value, step, sides, values, wrong)
            missed = np.abs(slopes.difference - slopes.derivative)
            assert np.any(slopes.differ) or missed.max() < 0.02 * np.abs(slopes.difference).max()
