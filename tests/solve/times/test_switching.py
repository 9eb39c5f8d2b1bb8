"""Laws of one's own that switch: times found before the run, their derivatives, jumps of inertia.

The impulse of a torque about the third axis is a sum of lengths of time, and known in closed form.
"""

import warnings

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.flatten_util import ravel_pytree
from once import once

import rigidjax as rj
from rigidjax import torques
from rigidjax.solve.answer.run import equations_of_motion
from rigidjax.solve.programs.traced import trace_program
from rigidjax.solve.times.switching import find_switches

AXIS = np.array([0.0, 0.0, 1.0])
BODY = rj.Inertia.from_principal(1.0, 1.0, 2.0)
SHORT, LONG = (0.0, 2.0), (0.0, 20.0)
EDGES, ROWS = np.array([0.3, 0.7, 1.1, 1.6]), np.array([0.0, 2.0, -1.0, 3.0, 0.5])
long = pytest.mark.long


def push(on, value=1.0):
    return jnp.where(on, value, jnp.zeros_like(jnp.asarray(value)))


def impulse(value, ts=SHORT, rate=0.0, **options):
    """The impulse of a torque `value(t, rate)` about the third axis, by the run of a body at rest."""
    ts = jnp.asarray(ts)
    body = jax.tree.map(lambda a: a.astype(ts.dtype), BODY)
    start = rj.Spin(jnp.asarray(rate * AXIS, ts.dtype))

    def law(t, state, body):
        return jnp.asarray(AXIS, t.dtype) * jnp.asarray(value(t, state.omega[2]), t.dtype)

    end = rj.simulate(body, start, ts, law, **options).ys.omega[-1, 2]
    return 2.0 * (end - rate)


def edged(index, edge):
    return jnp.asarray(EDGES).at[index].set(edge)


def held(index, edge):
    edges = EDGES.copy()
    edges[index] = edge
    return float(np.sum(ROWS * np.diff([0.0, *edges, 2.0])))


def steps(h, end):
    count = np.floor(end / h)
    return h * count * (count - 1) / 2 + count * (end - count * h)


def saw(h, end):
    count = np.floor(end / h)
    return count * h**2 / 2 + (end - count * h) ** 2 / 2


def square(w, end):
    rest = end % (2 * np.pi / w)
    return min(rest, 2 * np.pi / w - rest)


@jax.custom_jvp
def gate(t, a):
    return jnp.where(t < a, 1.0 + t, -1.0)


gate.defjvp(lambda at, d: (gate(*at), jnp.where(at[0] < at[1], d[0], jnp.zeros_like(d[0]))))


# Value of the torque (t, rate, *numbers), numbers, its impulse in closed form, options.
CASES = {
    "lt": (lambda t, w, a: push(t < a), [1.31], lambda a: a, {}),
    "ge": (lambda t, w, a: push(t >= a), [0.77], lambda a: 2 - a, {}),
    "gt of a product": (lambda t, w, a, b: push(a * t > b**2), [1.7, 1.1], lambda a, b: 2 - b * b / a, {}),
    "the value of the torque, too": (lambda t, w, a: push(t <= a, a), [1.31], lambda a: a * a, {}),
    "beyond the end": (lambda t, w, a: push(t < a), [2.5], lambda a: 2.0, {}),
    "a firing of 1 ms": (lambda t, w, a, b: push((t > a) & (t < b), 1e3), [7.3, 7.301], lambda a, b: 1e3 * (b - a), dict(ts=LONG)),
    "one comparison met twice": (lambda t, w, a, d: push(jnp.abs(t - a) < d, 1e3), [7.3003, 4e-4], lambda a, d: 2e3 * d, dict(ts=LONG)),
    "sign": (lambda t, w, a: jnp.sign(t - a), [0.77], lambda a: 2 - 2 * a, {}),
    "sign of a sine": (lambda t, w, a: jnp.sign(jnp.sin(a * t)), [3.1], lambda a: square(a, 9.0), dict(ts=(0.0, 9.0))),
    "floor": (lambda t, w, h: jnp.floor(t / h), [0.45], lambda h: steps(h, 3.1), dict(ts=(0.0, 3.1))),
    "ceil": (lambda t, w, h: jnp.ceil(t / h) - 1, [0.45], lambda h: steps(h, 3.1), dict(ts=(0.0, 3.1))),
    "round": (lambda t, w, h: jnp.round(t / h - 0.5), [0.45], lambda h: steps(h, 3.1), dict(ts=(0.0, 3.1))),
    "a whole number": (lambda t, w, h: (t / h).astype(int), [0.45], lambda h: steps(h, 3.1), dict(ts=(0.0, 3.1))),
    "remainder": (lambda t, w, h: jnp.mod(t, h), [0.45], lambda h: saw(h, 3.1), dict(ts=(0.0, 3.1))),
    "a comparison of a remainder": (lambda t, w, h, d: push(jnp.mod(t, h) < d, 10.0), [0.45, 5e-3], lambda h, d: 70 * d, dict(ts=(0.0, 3.1))),
    "exponential": (lambda t, w, a: push(jnp.exp(-t / a) > 0.4), [0.9], lambda a: -a * np.log(0.4), {}),
    "a square": (lambda t, w, a, b: push(a * t**2 > b), [1.7, 1.1], lambda a, b: 2 - np.sqrt(b / a), {}),
    "heaviside": (lambda t, w, a: jnp.heaviside(t - a, 1.0), [0.77], lambda a: 2 - a, {}),
    "cond": (lambda t, w, a: lax.cond(t < a, lambda x: x * 0 + 2.0, lambda x: -x, t), [0.77], lambda a: 2 * a - (4 - a**2) / 2, {}),
    "inside a branch of cond": (lambda t, w, a: lax.cond(t > 0.5, lambda x: push(x < a, 2.0), lambda x: x * 0, t), [0.77], lambda a: 2 * (a - 0.5), {}),
    "switch": (lambda t, w, a: lax.switch((t / a).astype(int), [lambda x: 0 * x, lambda x: 0 * x + 3.0, lambda x: -x], t), [0.77], lambda a: 3 * a - (4 - 4 * a**2) / 2, {}),
    "select": (lambda t, w, a: lax.select(t < a, 1.0 + 0 * t, 0 * t), [0.77], lambda a: a, {}),
    "piecewise": (lambda t, w, a, b: jnp.piecewise(t, [t < a, t > b], [1.0, 2.0, 3.0]), [0.77, 1.2], lambda a, b: a + 2 * (2 - b) + 3 * (b - a), {}),
    "jit in a checkpoint": (lambda t, w, a: jax.checkpoint(jax.jit(lambda x: push(x < a, 2.0)))(1.0 * t), [0.77], lambda a: 2 * a, {}),
    "searchsorted": (lambda t, w, e: jnp.asarray(ROWS)[jnp.searchsorted(edged(1, e), t)], [0.72], lambda e: held(1, e), {}),
    "digitize": (lambda t, w, e: jnp.asarray(ROWS)[jnp.digitize(t, edged(2, e))], [1.12], lambda e: held(2, e), {}),
    "a count of edges": (lambda t, w, e: jnp.asarray(ROWS)[jnp.sum(t > edged(2, e))], [1.12], lambda e: held(2, e), {}),
    "clip": (lambda t, w, a, b: jnp.clip(t, a, b), [0.5, 1.2], lambda a, b: a**2 + (b**2 - a**2) / 2 + b * (2 - b), {}),
    "maximum": (lambda t, w, a: jnp.maximum(t, a), [0.8], lambda a: a**2 + (4 - a**2) / 2, {}),
    "abs": (lambda t, w, a: jnp.abs(t - a), [0.8], lambda a: a**2 / 2 + (2 - a) ** 2 / 2, {}),
    "backward in time": (lambda t, w, a: push(t < a, 3.0), [1.31], lambda a: -3 * a, dict(ts=(2.0, 0.0))),
    "backward over a firing": (lambda t, w, a: push((t >= a) & (t < a + 1e-3), 1e3 * (1 + t - a)), [7.3], lambda a: -1.0005, dict(ts=(20.0, 0.0))),
    "from t0 = 1e9": (lambda t, w, a: push(t - 1e9 < a), [1.31], lambda a: a, dict(ts=(1e9, 1e9 + 2))),
    "beside a comparison of the state": (lambda t, w, a: push((t > a) & (w > 0)), [0.6], lambda a: 2 - a, dict(rate=0.1)),
    "two at the same time": (lambda t, w, a, b: push(t < a) + 3.0 * push(t < b), [1.31, 1.31], lambda a, b: a + 3 * b, {}),
    "elements of one comparison at the same time": (lambda t, w, a, b: jnp.sum(push(t < jnp.stack([a, b])) * np.array([1.0, 3.0])), [1.31, 1.31], lambda a, b: a + 3 * b, {}),
    "the end of a square root": (lambda t, w, a: push(~jnp.isnan(jnp.sqrt(a - t)), 1.0 + t), [1.13], lambda a: a + a * a / 2, {}),
    "the end of a logarithm": (lambda t, w, a: push(jnp.isfinite(jnp.log(a - t))), [1.13], lambda a: a, {}),
    "a pole": (lambda t, w, a: push(1 / (t - a) > 0, 2.0), [0.71], lambda a: 4 - 2 * a, {}),
    "beside a pole": (lambda t, w, a: push(1 / (t - a) > 2.5, t), [0.71], lambda a: 0.4 * a + 0.08, {}),
    "a tangent": (lambda t, w, a: push(jnp.tan(t) > a), [0.6], lambda a: np.pi / 2 - np.arctan(a), {}),
    "the leap of an angle": (lambda t, w, a: jnp.arctan2(jnp.sin(a * t), jnp.cos(a * t)), [2.3], lambda a: 2 * a - 4 * np.pi + 2 * np.pi**2 / a, {}),
    "a complex wave": (lambda t, w, a: jnp.real(jnp.exp(lax.complex(0 * t, a * t))), [1.7], lambda a: np.sin(2 * a) / a, {}),
    "a complex wave compared": (lambda t, w, a: push(jnp.imag(jnp.exp(lax.complex(0 * t, a * t))) < 0.0), [2.3], lambda a: 2 - np.pi / a, {}),
    "clipped or not": (lambda t, w, a, b: push(jnp.clip(t, a, b) != t), [0.5, 1.2], lambda a, b: 2 - (b - a), {}),
    "a cond in a cond": (lambda t, w, a, b: lax.cond(t < a, lambda: 1.0 + t, lambda: lax.cond(t < b, lambda: -2.0 * t, lambda: 3.0 + 0 * t)), [0.6, 1.4], lambda a, b: a + a * a / 2 - (b * b - a * a) + 3 * (2 - b), {}),
    "a branch with a derivative rule": (lambda t, w, a: gate(t, a), [0.7], lambda a: a + a * a / 2 - (2 - a), {}),
    "50 edges": (lambda t, w, a: jnp.sum(push(t > a * np.linspace(0.1, 1.8, 50))), [1.02], lambda a: np.sum(2 - a * np.linspace(0.1, 1.8, 50)), {}),
    "searchsorted among 50": (lambda t, w, a: jnp.searchsorted(a * np.linspace(0.1, 1.8, 50), t).astype(float), [1.02], lambda a: np.sum(2 - a * np.linspace(0.1, 1.8, 50)), {}),
    "110 steps": (lambda t, w, h: jnp.floor(t / h), [0.018], lambda h: steps(h, 2.0), {}),
    "firings of a wave": (lambda t, w, a: push(jnp.cos(a * t) > np.cos(2e-3), 100.0), [3.13 * np.pi], lambda a: 100 * 63 * 2e-3 / a, dict(ts=LONG)),
    "an operand that jumps": (lambda t, w, a, b: push(push(t < a, t) + push(t >= a, 3 * t) > b), [0.9, 1.5], lambda a, b: 2 - a, {}),
    "pulses inside a function": (lambda t, w, a, b: torques.Pulses(jnp.stack([a, b]), 1e3 * AXIS[None])(t, rj.Spin(0 * AXIS), None)[2], [7.3, 7.301], lambda a, b: 1e3 * (b - a), dict(ts=LONG)),
    "a table inside a function": (lambda t, w, a: torques.Held(jnp.stack([0.0 * a, a]), np.array([1.0, 3.0]))(t), [0.9], lambda a: a + 3 * (2 - a), {}),
}  # fmt: skip


@pytest.mark.parametrize(
    "name",
    ["a firing of 1 ms", *(pytest.param(n, marks=long) for n in CASES if n != "a firing of 1 ms")],
)
def test_impulse_and_its_derivatives_are_exact(name):
    value, numbers, right, options = CASES[name]

    def program(numbers):
        return impulse(lambda t, w: value(t, w, *numbers), **options)

    def all_three(numbers):
        return *jax.value_and_grad(program)(numbers), jax.jacfwd(program)(numbers)

    came, *slopes = once(all_three)([jnp.asarray(x) for x in numbers])
    scale = 1e3 if options.get("ts") == LONG or options.get("ts") == LONG[::-1] else 1.0
    # A time of 1e9 s is known to 1.2e-7 s.
    tolerance = 4e-7 if name == "from t0 = 1e9" else 4e-12 * scale
    np.testing.assert_allclose(came, right(*numbers), rtol=0, atol=tolerance)
    for i in range(len(numbers)):
        moved = [[x + s * 1e-6 * (j == i) for j, x in enumerate(numbers)] for s in (1, -1)]
        slope = (right(*moved[0]) - right(*moved[1])) / 2e-6
        for way in slopes:
            np.testing.assert_allclose(way[i], slope, rtol=2e-9, atol=2e-9)


def test_a_run_in_float32_has_the_derivative():
    ts = np.asarray(SHORT, np.float32)
    program = lambda a: impulse(lambda t, w: push(t < a.astype(t.dtype)), ts)
    value, slope = once(jax.value_and_grad(program))(jnp.float32(1.3))
    assert value.dtype == jnp.float32
    np.testing.assert_allclose([value, slope], [1.3, 1.0], atol=2e-6)


@long
def test_solver_of_diffrax_ends_steps_there():
    law = lambda t, w, a: push((t > a) & (t < a + 1e-3), 1e3 * a)
    program = lambda a: impulse(lambda t, w: law(t, w, a), LONG, solver=dfx.Tsit5())
    value, slope = once(jax.value_and_grad(program))(jnp.asarray(7.3))
    np.testing.assert_allclose([value, slope], [7.3, 1.0], atol=1e-8)


def test_each_body_of_a_batch_has_its_times():
    ends = jnp.linspace(0.05, 2.2, 19)
    program = lambda a: impulse(lambda t, w: push(t < a, a))
    values, slopes = once(jax.vmap(jax.value_and_grad(program)))(ends)
    last = jnp.minimum(ends, 2.0)
    np.testing.assert_allclose(values, ends * last, atol=1e-13)
    np.testing.assert_allclose(slopes, jnp.where(ends < 2, 2 * ends, 2.0), atol=1e-12)


@long
@pytest.mark.parametrize("power", [1, 2])
def test_second_derivatives(power):
    program = lambda p: impulse(lambda t, w: push(p[0] * t**power > p[1] ** power))
    numbers = jnp.array([1.7, 1.1])
    right = jax.hessian(lambda p: 2 - p[1] / p[0] ** (1 / power))(numbers)
    np.testing.assert_allclose(once(jax.hessian(program))(numbers), right, atol=1e-9)


@pytest.mark.parametrize(
    ("law", "ends"),
    [
        (lambda t, s: jnp.sin(t) * s, 0),
        (lambda t, s: jnp.where(jnp.abs(s) < 1e-3, 1 - s * s / 6, jnp.sin(s) / s), 0),
        (lambda t, s: jnp.interp(t, np.linspace(0.0, 2.0, 1000), np.sin(np.linspace(0, 2, 1000))), 2),
        (lambda t, s: jnp.polyval(1e-9 * jnp.arange(20.0), t), 0),
        (lambda t, s: torques.Series(np.linspace(0.0, 2.0, 50), np.ones((50, 1)))(t)[0], 0),
        (lambda t, s: rj.so3.exp(jnp.stack([0.0, t, 0.0]))[0, 0], 0),
        (lambda t, s: jax.jit(lambda t: (jnp.round(t), 2 * t))(t)[1], 0),
    ],
    ids=["smooth", "branches of the state", "a long table", "a scan", "a series",
         "a turn of this package", "a jump that is not used"],
)  # fmt: skip
def test_continuous_laws_have_no_switches(law, ends):
    program = trace_program(lambda t, y: law(t, y[2]) * y, jnp.asarray(0.0), jnp.asarray(AXIS))
    analysis = find_switches(program.closed)
    assert not analysis.unfound
    assert len(analysis.switches) == ends


def frame_of_a_tumbling_body():
    """The frame of a free tumbling body."""
    start = rj.Attitude([1.0, 0.0, 0.0, 0.0], [0.3, 1.1, 0.2])
    body = rj.Inertia.from_principal(1.0, 1.6, 2.2)
    return rj.frames.MovingFrame(rj.simulate(body, start, [0.0, 1.0]))


@pytest.mark.parametrize(
    "frame",
    [
        rj.frames.MovingFrame(rj.frames.Uniform([0.0, 0.3, 1.5])),
        rj.scenes.turntable(1.5, 0.2),
        rj.frames.MovingFrame(rj.frames.Uniform([0.0, 0.3, 1.5]), lambda t: t * t * AXIS),
        frame_of_a_tumbling_body,
    ],
    ids=["uniform", "turntable that speeds up", "origin", "riding on a tumbling body"],
)
def test_a_frame_has_no_switches(frame):
    """Its matrix is computed by a function with jumps and kinks, and a free particle needs none."""
    frame = frame() if frame is frame_of_a_tumbling_body else frame
    field = equations_of_motion(None, rj.Point([1.0, 0.0, 0.0], [0.0, 0.2, 0.0]), frame)
    flat = lambda t, y: ravel_pytree(field(t, rj.Point(y[:3], y[3:]), None))[0]
    traced = trace_program(flat, jnp.asarray(0.0), jnp.ones(6)).closed
    assert not find_switches(traced).switches


def test_a_switch_within_a_function_of_jax_has_the_line_that_calls_it():
    traced = trace_program(lambda t, y: jnp.clip(t, 0.5, y), jnp.asarray(0.0), jnp.asarray(1.0))
    (switch,) = find_switches(traced.closed).switches
    assert "test_switching.py" in switch.line


@pytest.mark.parametrize(
    "value",
    [
        lambda t, w: lax.while_loop(lambda x: x < t, lambda x: x + 1.0, 0.0),
        lambda t, w: lax.fori_loop(0, 5, lambda i, x: x + push(t > 0.3 * i), 0.0),
        lambda t, w: jax.pure_callback(lambda t: np.where(t > 1, 1.0, 0.0), t, t),
        lambda t, w: jnp.argmax(jnp.stack([jnp.sin(t), jnp.cos(t)])),
    ],
    ids=["while_loop", "fori_loop", "callback", "argmax"],
)
def test_what_cannot_be_looked_for_is_said(value):
    with pytest.warns(UserWarning, match=r"(?s)test_switching\.py.*jump_times"):
        impulse(value)


def test_more_switches_than_places_are_said():
    with pytest.warns(
        UserWarning, match=r"(?s)more than 256 times.*test_switching\.py.*jump_times"
    ):
        impulse(lambda t, w: jnp.floor(t / 0.003), atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize(
    "value",
    [
        lambda t, a: jnp.sum(push(t > a * np.linspace(0.2, 1.7, 300))),
        lambda t, a: lax.fori_loop(0, 3, lambda i, x: x + push(t > a * i), 0.0),
    ],
    ids=["a table of 300", "a loop"],
)
def test_what_cannot_be_looked_for_is_said_when_a_derivative_is_traced(value):
    slope = jax.jit(jax.grad(lambda a: impulse(lambda t, w: value(t, a))))
    with pytest.warns(UserWarning, match=r"(?s)test_switching\.py.*jump_times"):
        slope.lower(jnp.asarray(1.1))


@long
def test_derivatives_of_switches_that_are_not_stored_are_unknown():
    program = lambda h: impulse(lambda t, w: jnp.floor(t / h), atol=1e-3, rtol=1e-3)
    assert np.isnan(jax.jit(jax.grad(program))(0.003))


class Burn(eqx.Module):
    end: jax.Array

    def __call__(self, t, state, body):
        return AXIS * jnp.where(t < self.end, 2.0, -2.0)


@pytest.mark.oldest
@pytest.mark.parametrize("make", [Burn, lambda end: Burn(end).__call__, lambda end: lambda *a: Burn(end)(*a)],
                         ids=["module", "method", "function"])  # fmt: skip
def test_crossing_after_a_switch(make):
    """The rate rises from 0.2 until `end`, and falls to `level` from there."""

    def crossing(p):
        condition = lambda t, state, body: state.omega[2] - p[1]
        found = rj.crossings(
            BODY,
            rj.Spin(0.2 * AXIS),
            0.0,
            9.0,
            condition,
            make(p[0]),
            max_crossings=1,
            direction=-1,
        )
        return found.times[0]

    value, slope = once(jax.value_and_grad(crossing))(jnp.array([2.3, 0.7]))
    np.testing.assert_allclose(value, 2 * 2.3 + 0.2 - 0.7, atol=1e-10)
    np.testing.assert_allclose(slope, [2.0, -1.0], atol=1e-10)


@pytest.mark.parametrize(
    ("solver", "ts"),
    [
        (rj.solvers.RungeKutta4(), (0.0, 1.5)),
        (rj.solvers.RungeKutta4(), (1.5, 0.0)),
        pytest.param(dfx.Tsit5(), (0.0, 1.5), marks=long),
        pytest.param(dfx.Tsit5(), (1.5, 0.0), marks=long),
    ],
)
def test_equal_steps_end_at_jumps(solver, ts):
    edges, rows = np.linspace(0.0, 1.5, 7), np.array([1.0, -2.0, 0.5, 4.0, -1.0, 2.0])
    laws = {
        "pulses": torques.Pulses(edges, rows[:, None] * AXIS),
        "held": torques.InSpace(torques.Held(edges, np.append(rows, 9.0)[:, None] * AXIS)),
        "found": lambda t, s, b: AXIS * jnp.asarray(rows)[jnp.sum(t >= edges[1:-1])],
        "table": torques.Tabulated([0.0, 1.5], np.stack([AXIS, AXIS])),
    }
    right = dict.fromkeys(laws, 0.25 * np.sum(rows)) | {"table": 1.5}
    start, equal = rj.Attitude([1.0, 0, 0, 0], np.zeros(3)), dfx.ConstantStepSize()
    for name, law in laws.items():
        sol = rj.simulate(BODY, start, ts, law, solver=solver, dt0=0.25, stepsize_controller=equal)
        sign = np.sign(ts[1] - ts[0])
        np.testing.assert_allclose(2 * sol.ys.omega[-1, 2], sign * right[name], atol=1e-12)


def test_tables_are_closed_at_both_ends():
    table = torques.Tabulated([0.0, 2.0], np.stack([AXIS, 3 * AXIS]))
    pulses = torques.Pulses([0.0, 2.0], 5 * AXIS[None])
    for law, values in ((table, [0.0, 1.0, 3.0, 0.0]), (pulses, [0.0, 5.0, 5.0, 0.0])):
        at = [law(t, rj.Spin(0 * AXIS), None)[2] for t in (-1e-9, 0.0, 2.0, 2.1)]
        np.testing.assert_allclose(at, values)


def pair(p, kinds, ts=SHORT):
    """The impulse of two laws that end at times p."""
    laws = {
        "pulses": lambda p, size: torques.Pulses(jnp.stack([0.0 * p, p]), size * AXIS[None]),
        "found": lambda p, size: lambda t, s, b: size * AXIS * push(t < p) * push(t >= 0.0),
        "table": lambda p, size: torques.InSpace(
            torques.Held(jnp.stack([p - 5.0, p]), np.stack([size * AXIS, 0 * AXIS]))
        ),
    }
    both = [laws[kind](p[i], 1.0 + 2 * i) for i, kind in enumerate(kinds)]
    start = rj.Attitude([1.0, 0, 0, 0], np.zeros(3))
    return 2 * rj.simulate(BODY, start, ts, torques.Sum(*both)).ys.omega[-1, 2]


@pytest.mark.parametrize(
    ("kinds", "ts"),
    [
        (("pulses", "pulses"), SHORT),
        pytest.param(("pulses", "found"), SHORT, marks=long),
        pytest.param(("table", "pulses"), SHORT, marks=long),
        pytest.param(("pulses", "pulses"), SHORT[::-1], marks=long),
        pytest.param(("found", "table"), SHORT[::-1], marks=long),
    ],
)
def test_two_jumps_at_the_same_time_have_their_own_derivatives(kinds, ts):
    program = lambda p: pair(p, kinds, ts)
    both = lambda p: (program(p), jax.grad(program)(p), jax.jacfwd(program)(p))
    value, *slopes = once(both)(jnp.array([1.3, 1.3]))
    sign = 1.0 if ts == SHORT else -1.0
    np.testing.assert_allclose(value, sign * 5.2, atol=1e-12)
    for slope in slopes:
        np.testing.assert_allclose(slope, [sign, 3 * sign], atol=1e-12)


class Doubled(eqx.Module):
    """A law that does not pass on the jumps of the one it holds."""

    inner: torques.Pulses

    def __call__(self, t, state, body):
        return 2.0 * self.inner(t, state, body)


def test_jumps_of_a_law_inside_a_law_of_ones_own():
    def program(a):
        law = Doubled(torques.Pulses(jnp.stack([a, a + 1e-3]), 1e3 * AXIS[None]))
        return 2 * rj.simulate(BODY, rj.Spin(0 * AXIS), LONG, law).ys.omega[-1, 2]

    value, slope = once(jax.value_and_grad(program))(jnp.asarray(7.3))
    np.testing.assert_allclose([value, slope], [2.0, 0.0], atol=1e-9)


class Motor(eqx.Module):
    """A motor with a state of its own, which is switched off at a time."""

    end: jax.Array
    state0: jax.Array

    def rate(self, t, own, state, body):
        return push(t < self.end) - own

    def __call__(self, t, state, body, own):
        return AXIS * own


def test_switch_in_the_rate_of_a_state_of_its_own():
    def program(end):
        law = Motor(end, jnp.zeros(()))
        return rj.simulate(BODY, rj.Spin(0 * AXIS), SHORT, law).own[0][-1]

    value, slope = once(jax.value_and_grad(program))(jnp.asarray(1.3))
    np.testing.assert_allclose(value, (1 - np.exp(-1.3)) * np.exp(-0.7), atol=1e-9)
    np.testing.assert_allclose(slope, np.exp(-0.7), atol=1e-9)


def test_event_after_a_short_firing():
    # The rate rises to 0.6 at once, and with 0.05/s from there on.
    law = lambda t, s, b: AXIS * (push((t > 5.3) & (t < 5.301), 1e3) + push(t > 6.0, 0.1))
    found = rj.simulate(
        BODY, rj.Spin(0.1 * AXIS), LONG, law, event=lambda t, s, b: s.omega[2] - 0.8
    )
    np.testing.assert_allclose(found.event_time, 10.0, atol=1e-9)


FIRST, LATER = np.diag([1.0, 2.0, 2.0]), np.diag([1.0, 2.0, 2.6])


def test_momentum_stays_where_the_inertia_jumps():
    # p' = −c p / I about the axis.
    def end(p):
        law = torques.ChangingInertia(
            lambda t: jnp.where(t < p[0], FIRST, LATER), torques.Damping(0.1 * np.ones(3))
        )
        start = rj.Spin(p[1] * AXIS)
        return rj.simulate(rj.Inertia(FIRST), start, [0.0, 10.0], law).ys.omega[-1, 2]

    right = lambda p: 2 * p[1] / 2.6 * jnp.exp(-0.1 * (p[0] / 2 + (10 - p[0]) / 2.6))
    numbers = jnp.array([4.2, 3.0])
    both = lambda p: (end(p), jax.grad(end)(p), jax.jacfwd(end)(p))
    value, *slopes = once(both)(numbers)
    np.testing.assert_allclose(value, right(numbers), rtol=1e-10)
    for slope in slopes:
        np.testing.assert_allclose(slope, jax.grad(right)(numbers), atol=2e-9)


@pytest.mark.parametrize("ts", [np.linspace(0.0, 9.0, 4), np.linspace(9.0, 0.0, 4)])
def test_momentum_in_space_stays_where_the_inertia_jumps(ts):
    tensor = lambda t: jnp.where(t < 4.2, FIRST, LATER)
    start = rj.Attitude([1.0, 0.0, 0.0, 0.0], [0.3, 0.2, 3.0])
    ys = rj.simulate(rj.Inertia(LATER), start, ts, torques.ChangingInertia(tensor)).ys
    momenta = [
        rj.quaternion.rotate(q, (FIRST if t < 4.2 else LATER) @ np.asarray(w))
        for t, q, w in zip(ts, ys.q, ys.omega, strict=True)
    ]
    np.testing.assert_allclose(momenta, np.stack([momenta[0]] * 4), atol=1e-7)


def test_event_beyond_a_jump_of_the_inertia():
    law = torques.ChangingInertia(
        lambda t: jnp.where(t < 2.2, FIRST, LATER), torques.ConstantTorque(-AXIS)
    )
    found = rj.simulate(
        rj.Inertia(FIRST), rj.Spin(3.0 * AXIS), [0.0, 9.0], law,
        event=lambda t, state, body: state.omega[2] - 1.0,
    )  # fmt: skip
    np.testing.assert_allclose(found.event_time, 6.0 - 2.6, atol=1e-10)
    np.testing.assert_allclose(found.event_state.omega[2], 1.0, atol=1e-10)


@pytest.mark.parametrize(
    "late",
    [
        np.diag([1.0, 1.0, 5.0]),
        np.diag([1.0, 2.0, -2.0]),
        np.array([[1.0, 0.3, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]]),
    ],
    ids=["triangle", "negative", "unsymmetric"],
)
def test_inertia_that_becomes_no_body_is_refused(late):
    law = torques.ChangingInertia(lambda t: FIRST + (late - FIRST) * jnp.clip(t / 10.0, 0.0, 1.0))
    start = rj.Spin([0.1, 0.2, 3.0])
    with pytest.raises(RuntimeError, match=r"ChangingInertia.*tensor of a body"):
        rj.simulate(rj.Inertia(FIRST), start, [0.0, 10.0], law)
    kept = rj.simulate(rj.Inertia(FIRST), start, [0.0, 1e-3, 10.0], law, throw=False)
    assert np.isnan(kept.ys.omega[-1]).all()


def test_tide_that_leaves_no_body_is_refused():
    law = torques.ChangingInertia(torques.Tide(9.0, 0.0, 1.0, lambda t: (2.0 - t) * np.eye(3)[0]))
    start = rj.Attitude([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.1])
    with pytest.raises(RuntimeError, match=r"ChangingInertia.*tensor of a body"):
        rj.simulate(rj.Inertia(3.0 * np.eye(3)), start, [0.0, 1.9], law)


@pytest.mark.parametrize("solver", [None, rj.solvers.Tsitouras5(), dfx.Tsit5()])
def test_longest_step_sees_a_short_bump(solver):
    width, size = 0.02, 30.0
    bump = lambda t, w: size * jnp.exp(-(((t - 3.1) / width) ** 2))
    right = size * width * np.sqrt(np.pi)
    found = impulse(bump, (0.0, 5.0), solver=solver, max_step=0.05)
    np.testing.assert_allclose(found, right, rtol=1e-7)
    back = impulse(bump, (5.0, 0.0), solver=solver, max_step=0.05)
    np.testing.assert_allclose(back, -right, rtol=1e-7)


def test_longest_step_of_other_runs():
    free = rj.simulate(BODY, rj.Spin([0.3, 0.1, 1.0]), [0.0, 5.0], max_step=0.1)
    assert int(free.stats["num_steps"]) == 0
    few = rj.simulate(BODY, rj.Spin(AXIS), [0.0, 5.0], torques.ConstantTorque(AXIS), max_step=0.1)
    assert int(few.stats["num_steps"]) >= 50
    with pytest.raises(ValueError, match=r"max_step without a stepsize_controller"):
        impulse(lambda t, w: t, max_step=0.1, dt0=0.1, stepsize_controller=dfx.ConstantStepSize())
    with pytest.raises(ValueError, match="max_step: wanted a positive"):
        impulse(lambda t, w: t, max_step=-0.1)


def test_words_at_a_switch_that_holds_the_state():
    friction = lambda t, state, body: -jnp.sign(state.omega)
    with pytest.raises(RuntimeError, match=r"t = 1\.0000.*at the switch.*Coulomb.*sign"):
        rj.simulate(BODY, rj.Spin(0.5 * AXIS), [0.0, 5.0], friction, max_steps=2000)


def test_words_after_many_turns():
    law = lambda t, state, body: -1e-3 * state.omega
    start = rj.Attitude([1.0, 0.0, 0.0, 0.0], [0.3, -0.2, 200.0])
    with pytest.raises(
        RuntimeError, match=r"steps a turn for 3\.\d+e\+06 turns.*max_steps=\d0_000_000"
    ):
        rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 2.5), start, [0.0, 1e5], law, max_steps=900)


def test_an_ordinary_law_says_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        impulse(lambda t, w: jnp.tanh(t) * jnp.where(w < 1e-3, 1 + w, jnp.exp(w)))
