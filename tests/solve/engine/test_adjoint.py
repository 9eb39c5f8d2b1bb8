"""Derivatives of adaptive runs: each mode against the others, closed forms and differences."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once

import rigidjax as rj
from rigidjax.motion.equations import AttitudeEquations
from rigidjax.motion.torques.base import jump_times_of
from rigidjax.solve import adaptive
from rigidjax.solve.engine import adjoint, loop as adaptive_loop
from rigidjax.solve.programs import batching

Q = np.array([0.8, -0.2, 0.4, 0.4]) / np.linalg.norm([0.8, -0.2, 0.4, 0.4])
TENSOR = np.array([[1.0, 0.05, -0.1], [0.05, 1.7, 0.2], [-0.1, 0.2, 2.2]])
EDGES = jnp.array([0.4, 0.7, 1.1])
TIMES = jnp.array([0.0, 0.3, 0.6, 0.75, 1.5])


class Wheel(eqx.Module):
    """A torque that depends on time, attitude, rate, and a table of whole numbers."""

    wheel: jax.Array
    rows: jax.Array

    def __call__(self, t, state, body):
        turning = jnp.cross(self.wheel[self.rows], state.omega)
        pull = rj.quaternion.rotate_inverse(state.q, jnp.stack([jnp.sin(t), 0 * t, jnp.cos(3 * t)]))
        return turning + pull


def scenes(p):
    """Laws with all numbers with respect to which they can be differentiated."""
    top = rj.torques.HeavyTop(1.0 + p[0], jnp.array([0.0, 0.1, 0.4]) + p[1], [0.0, 0.0, -9.81])
    pulses = rj.torques.Pulses(EDGES + p[:3], [[0.5, 0.0, 1.0], [0.0, -2.0, 0.3]])
    wheel = Wheel(jnp.array([0.3, 0.1, -0.2]) + p[:3], jnp.array([2, 0, 1]))
    return {"pulses": rj.torques.Sum(pulses, top), "wheel": wheel}


def run(name, ts, p, weights, max_steps=100_000):
    """A number made of all states at all times; `p` (3,) of the law, (6,) of the body, (7,) start."""
    law, body, start = p[:3], p[3:9], p[9:]
    tensor = jnp.asarray(TENSOR) + jnp.diag(body[:3])
    tensor = tensor + _symmetric(body[3:])
    torque = scenes(law)[name]
    field = AttitudeEquations(rj.Inertia(tensor), torque)
    y0 = rj.Attitude(jnp.asarray(Q) + start[:4], jnp.array([1.3, 0.7, -1.6]) + start[4:])
    jumps = jump_times_of(torque)
    out = adaptive(
        rj.solvers.DormandPrince8(), field, ts, y0, rtol=1e-10, atol=1e-12, jumps=jumps,
        max_steps=max_steps,
    )  # fmt: skip
    flat = jnp.concatenate([out.ys.q, out.ys.omega], axis=1)
    return (weights[: flat.shape[0]] * jnp.sin(flat)).sum()


def _symmetric(off):
    zero = jnp.zeros(())
    a, b, c = off
    return jnp.stack([jnp.stack([zero, a, b]), jnp.stack([a, zero, c]), jnp.stack([b, c, zero])])


WEIGHTS = jnp.asarray(np.random.default_rng(1).normal(size=(5, 7)))


@pytest.mark.parametrize("name", ["pulses", pytest.param("wheel", marks=pytest.mark.slow)])
def test_reverse_is_forward_to_round_off_and_close_to_differences(name):
    p = jnp.zeros(16)
    value = once(lambda p: run(name, TIMES, p, WEIGHTS))

    @once
    def both(p, direction):
        # One tangent, in random directions: as telling as all of them, and quick to compile.
        ahead = jax.jvp(lambda p: run(name, TIMES, p, WEIGHTS), (p,), (direction,))[1]
        return jax.grad(lambda p: run(name, TIMES, p, WEIGHTS))(p), ahead

    rng = np.random.default_rng(2)
    for _ in range(3):
        direction = jnp.asarray(rng.normal(size=16))
        back, ahead = both(p, direction)
        np.testing.assert_allclose(back @ direction, ahead, rtol=1e-11)
    step = 1e-4 * direction
    slope = (
        8 * (value(p + step) - value(p - step)) - value(p + 2 * step) + value(p - 2 * step)
    ) / 12
    np.testing.assert_allclose(back @ step, slope, rtol=1e-6)


@pytest.mark.oldest
@pytest.mark.parametrize(
    ("name", "ts"),
    [("wheel", (0.0, 0.3, 0.6)), pytest.param("pulses", (0.0, 0.3, 1.1), marks=pytest.mark.slow)],
)
def test_every_order_of_transformations(name, ts):
    """Forward, reverse, forward over reverse, and batches of each."""
    r, ts = np.random.default_rng(5), jnp.array(ts)
    p = jnp.asarray(0.05 * r.normal(size=(3, 3)))
    base = jnp.asarray(np.concatenate([np.zeros(13), r.normal(size=3)]))

    def one(small):
        # By the torque, the body and the start.
        return run(name, ts, base.at[jnp.array([1, 5, 14])].add(small), WEIGHTS)

    value, slope = once(one), once(jax.grad(one))
    wanted = np.stack([slope(row) for row in p])
    bend = np.zeros((3, 3))
    for i in range(3):
        h = 1e-4 * np.eye(3)[i]
        rise = (value(p[0] + h) - value(p[0] - h)) / 2e-4
        np.testing.assert_allclose(wanted[0][i], rise, atol=1e-6)
        bend[i] = (slope(p[0] + h) - slope(p[0] - h)) / 2e-4
    many = once(jax.vmap(jax.grad(one)))(p)
    ahead = once(jax.vmap(jax.jacfwd(one)))(p)
    scale = np.abs(wanted).max()
    for found in (many, ahead):
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-10 * scale)
    second = once(jax.hessian(one))(p[0])
    np.testing.assert_allclose(second, second.T, atol=1e-9 * np.abs(bend).max())
    np.testing.assert_allclose(second, bend, atol=1e-5 * np.abs(bend).max())
    if name == "pulses":
        together = jax.jit(jax.grad(lambda p: jax.vmap(one)(p).sum()))(p)
        np.testing.assert_allclose(together, wanted, rtol=1e-9, atol=1e-10 * scale)
        seconds = jax.jit(jax.vmap(jax.hessian(one)))(p)
        np.testing.assert_allclose(seconds[0], second, atol=1e-9 * np.abs(bend).max())


def test_reverse_over_reverse_is_refused():
    def one(c):
        return run("wheel", TIMES[jnp.array([0, 2])], jnp.zeros(16).at[0].set(c), WEIGHTS)

    with pytest.raises(TypeError, match=r"wanted jax\.jacfwd\(jax\.grad\(f\)\)"):
        jax.jit(jax.grad(jax.grad(one))).lower(0.1)


@pytest.mark.slow
def test_times_batches_and_second_derivatives():
    p = jnp.zeros(16)

    def value(ts, p):
        return run("pulses", ts, p, WEIGHTS)

    @jax.jit
    def all_of(ts, p, turn):
        by_time, _ = slopes = jax.grad(value, (0, 1))(ts, p)
        ahead = jax.jacfwd(value, (0, 1))(ts, p)
        many = jax.vmap(jax.grad(value, (0, 1)), (None, 0))(ts, jnp.stack([p, p + 0.01 * turn]))
        second = jax.jvp(lambda p: jax.grad(value, 1)(ts, p), (p,), (turn,))[1]
        return by_time, slopes, ahead, many, second

    turn = jnp.asarray(np.random.default_rng(3).normal(size=16))
    by_time, slopes, ahead, many, second = all_of(TIMES, p, turn)
    for alone, lane, forward in zip(slopes, many, ahead, strict=True):
        np.testing.assert_allclose(lane[0], alone, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(forward, alone, rtol=1e-10, atol=1e-10)
    plain, slope = jax.jit(value), jax.jit(jax.grad(value, 1))
    moved = slope(TIMES, p + 0.01 * turn)
    np.testing.assert_allclose(many[1][1], moved, rtol=1e-10, atol=1e-10)
    for i in range(5):
        h = 1e-5 * (np.arange(5) == i)
        rise = (plain(TIMES + h, p) - plain(TIMES - h, p)) / 2e-5
        np.testing.assert_allclose(by_time[i], rise, atol=2e-7)
    h = 1e-5 * turn
    bend = (slope(TIMES, p + h) - slope(TIMES, p - h)) / 2e-5
    np.testing.assert_allclose(second, bend, atol=1e-4 * np.abs(bend).max())


@pytest.mark.parametrize(
    ("name", "second"), [("wheel", False), pytest.param("pulses", True, marks=pytest.mark.slow)]
)
def test_many_segments_are_one(monkeypatch, name, second):
    ts = jnp.linspace(0.0, 1.5, 9)
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(9, 7)))
    turn = jnp.asarray(np.random.default_rng(2).normal(size=16))

    def slopes(p):
        def value(p):
            return run(name, ts, p, weights, 300)

        found = jax.grad(value)(p), jax.jvp(value, (p,), (turn,))[1]
        return (*found, jax.jacfwd(jax.grad(value))(p)) if second else found

    whole = once(slopes)(jnp.zeros(16))
    monkeypatch.setattr(adaptive_loop, "SEGMENT", 7)
    segments = once(lambda p: slopes(p))(jnp.zeros(16))
    for a, b in zip(segments, whole, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10 * np.abs(b).max())


def test_more_times_in_a_step_than_it_looks_at(monkeypatch):
    # A loose tolerance: about eight steps for 60 times, four of which are looked at together; the
    # rows of some steps, taken again for the rest, lie on both sides of a segment's end.
    ts = jnp.sort(jnp.concatenate([TIMES, jnp.linspace(0.001, 1.2, 55)]))
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(60, 7)))
    turn = jnp.asarray(np.random.default_rng(2).normal(size=16))
    monkeypatch.setattr(adaptive_loop, "SEGMENT", 7)

    def value(ts, p):
        torque = scenes(p[:3])["pulses"]
        field = AttitudeEquations(rj.Inertia(jnp.asarray(TENSOR) + jnp.diag(p[3:6])), torque)
        y0 = rj.Attitude(jnp.asarray(Q) + p[9:13], jnp.array([1.3, 0.7, -1.6]) + p[13:])
        out = adaptive(
            rj.solvers.DormandPrince8(), field, ts, y0, rtol=1e-4, atol=1e-6,
            jumps=jump_times_of(torque), max_steps=300,
        )  # fmt: skip
        return (weights * jnp.sin(jnp.concatenate([out.ys.q, out.ys.omega], 1))).sum(), out

    @once
    def of_all(ts, p):
        (_, out), (by_ts, by_p) = jax.value_and_grad(value, (0, 1), has_aux=True)(ts, p)
        push = jnp.sin(3 * ts), turn
        ahead = jax.jvp(lambda ts, p: value(ts, p)[0], (ts, p), push)[1]
        return out, by_ts @ push[0] + by_p @ turn, ahead, by_ts

    p = jnp.zeros(16)
    out, back, ahead, by_ts = of_all(ts, p)
    assert out.num_steps < 15
    np.testing.assert_allclose(back, ahead, rtol=1e-12)
    # Against the state at each time from a run that stops there, and the slope of the state.
    best = rj.simulate(
        rj.Inertia(TENSOR), rj.Attitude(Q, [1.3, 0.7, -1.6]), ts[jnp.diff(ts, prepend=-1.0) > 0],
        scenes(p)["pulses"], rtol=1e-12, atol=1e-14,
    )  # fmt: skip
    found = out.ys.omega[jnp.diff(ts, prepend=-1.0) > 0]
    np.testing.assert_allclose(found, best.ys.omega, rtol=0, atol=5e-4)
    step = 1e-6
    moved = [once(lambda ts, p: value(ts, p)[0])(ts.at[30].add(s), p) for s in (step, -step)]
    np.testing.assert_allclose(by_ts[30], (moved[0] - moved[1]) / (2 * step), atol=1e-7)


def test_a_segment_run_again_may_take_other_steps(monkeypatch):
    # As where another program rounds otherwise; the times lie on both sides of each segment's end.
    ts = jnp.linspace(0.0, 1.5, 9)
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(9, 7)))

    def value(p):
        return run("wheel", ts, p, weights, 300)

    p, turn = jnp.zeros(16), jnp.asarray(np.random.default_rng(2).normal(size=16))
    whole = once(jax.grad(value))(p)
    recorded, factor = adaptive_loop.record_segment, [1.3]

    def otherwise(method, *rest):
        # A smaller error is that of a looser tolerance.
        def control(again, states, numbers):
            *sides, error = numbers
            return method.control(again, states, (*sides, error / factor[0]))

        return recorded(method._replace(control=control), *rest)

    monkeypatch.setattr(adaptive_loop, "SEGMENT", 7)
    monkeypatch.setattr(adjoint, "record_segment", otherwise)
    slopes = once(lambda p: (jax.grad(value)(p), jax.jvp(value, (p,), (turn,))[1]))
    reverse, forward = slopes(p)
    scale = float(jnp.abs(whole).max())
    np.testing.assert_allclose(reverse, whole, rtol=0, atol=1e-6 * scale)
    np.testing.assert_allclose(forward, whole @ turn, rtol=0, atol=1e-6 * scale)
    # Without room for them there are no numbers, rather than wrong ones.
    factor[0] = 1e-5
    monkeypatch.setattr(adaptive_loop, "_MORE", 0)
    assert np.isnan(once(lambda p: jax.grad(value)(p))(p)).any()


def test_second_derivatives_of_blocks_of_bodies_are_those_of_each_alone(monkeypatch):
    # The small one of the next test: three blocks, one with a place left over, and segments run
    # again. Steps recorded row by row fail here, by 1e-2; in one block, or by `once`, they do not.
    r = np.random.default_rng(5)
    p, turn = (jnp.asarray(0.1 * r.normal(size=(5, 16))) for _ in range(2))
    slope = jax.grad(lambda p: run("pulses", jnp.array([0.0, 1.1]), p, WEIGHTS, 300))
    bend = once(lambda p, turn: jax.jvp(slope, (p,), (turn,))[1])
    wanted = [bend(*row) for row in zip(p, turn, strict=True)]
    monkeypatch.setattr(batching, "BLOCK", 2)
    monkeypatch.setattr(adaptive_loop, "SEGMENT", 7)
    found = jax.jit(lambda p, turn: jax.jvp(jax.vmap(slope), (p,), (turn,))[1])(p, turn)
    np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-8)


@pytest.mark.long
def test_a_batch_of_products_of_second_derivatives_with_directions():
    law = rj.torques.Damping([0.3, 0.1, 0.2])

    def energy(omega):
        sol = rj.simulate(BODY, rj.Spin(omega), [0.0, 1.0], law, throw=False)
        return jnp.sum(sol.ys.omega[-1] ** 2)

    def bend(omega, turn):
        return jax.jvp(jax.grad(energy), (omega,), (turn,))[1]

    omega = jnp.array([[0.1, 0.2, 1.0], [0.3, 1.2, 1.0]])
    found = once(jax.vmap(bend))(omega, omega[::-1])
    slope, step = once(jax.vmap(jax.grad(energy))), 1e-4 * omega[::-1]
    rise = slope(omega + step) - slope(omega - step)
    np.testing.assert_allclose(found, rise / 2e-4, rtol=1e-6)


@pytest.mark.slow
def test_bodies_in_lanes_are_bodies_alone(monkeypatch):
    # Steps of different number, jumps, saved times, a law of each body's own and one for all.
    size = 10
    r = np.random.default_rng(5)
    p = jnp.asarray(np.concatenate([0.02 * r.normal(size=(size, 13)), r.normal(size=(size, 3))], 1))
    turn, shared = jnp.asarray(r.normal(size=p.shape)), jnp.zeros(3)
    ts = jnp.array([0.0, 0.3, 1.1])

    def slope(p, shared):
        p = p.at[3:6].add(shared)
        return jax.grad(lambda p: run("pulses", ts, p, WEIGHTS, 300))(p)

    def total(shared):
        def one(p):
            return run("pulses", ts, p.at[3:6].add(shared), WEIGHTS, 300)

        return jax.vmap(one)(p).sum()

    alone = jax.jit(slope)
    wanted = np.stack([alone(row, shared) for row in p])
    # Blocks with bodies left over, and segments that are run again.
    monkeypatch.setattr(batching, "BLOCK", 4)
    monkeypatch.setattr(adaptive_loop, "SEGMENT", 7)
    together = jax.vmap(lambda p: slope(p, shared))
    found = jax.jit(together)(p)
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-10 * np.abs(wanted).max())
    by_shared = jax.jit(jax.grad(total))(shared)
    np.testing.assert_allclose(by_shared, wanted[:, 3:6].sum(0), rtol=1e-9)
    bend = jax.jit(lambda p: jax.jvp(together, (p,), (turn,))[1])(p)
    bent = jax.jit(lambda p, turn: jax.jvp(lambda p: slope(p, shared), (p,), (turn,))[1])
    for k in (0, 9):
        np.testing.assert_allclose(bend[k], bent(p[k], turn[k]), rtol=1e-8, atol=1e-8)


@pytest.mark.oldest
def test_through_simulate_each_rung_and_what_is_refused():
    ts = [0.0, 0.2, 1.0]
    damping = rj.torques.Damping([0.3, 0.3, 0.3])
    body = rj.Inertia.from_principal(2.0, 2.0, 2.0)

    def rate(c, inertia):
        body = rj.Inertia(inertia * jnp.eye(3))
        out = rj.simulate(
            body,
            rj.Spin([0.0, 0.0, 1.5]),
            ts,
            rj.torques.Damping(c * jnp.ones(3)),
            solver=rj.solvers.DormandPrince8(),
            rtol=1e-12,
        )
        return out.ys.omega[-1, 2]

    # ω = ω0 exp(−c t / I)
    by_c, by_inertia = once(jax.grad(rate, (0, 1)))(jnp.asarray(0.3), jnp.asarray(2.0))
    end = 1.5 * np.exp(-0.15)
    np.testing.assert_allclose(by_c, -end / 2, rtol=1e-10)
    np.testing.assert_allclose(by_inertia, end * 0.3 / 4, rtol=1e-10)
    ahead = once(jax.jacfwd(rate, (0, 1)))(jnp.asarray(0.3), jnp.asarray(2.0))
    np.testing.assert_allclose(ahead, [by_c, by_inertia], rtol=1e-12)
    start, ours = rj.Spin([0.0, 0.0, 1.5]), rj.solvers.DormandPrince8()
    late = rj.simulate(body, start, ts, damping, solver=ours, max_steps=2, throw=False)
    assert late.result == dfx.RESULTS.max_steps_reached
    assert np.all(np.isnan(late.ys.omega[-1])) and np.all(np.isfinite(late.ys.omega[0]))


BODY = rj.Inertia.from_principal(1.0, 1.6, 2.1)


def last_rate(omega, end, height, ts=(), throw=True):
    """A rate at the end of a run of the top, by its start, the time of its end, and its height."""
    top = rj.torques.HeavyTop(1.0, jnp.array([0.0, 0.0, 1.0]) * height, [0.0, 0.0, -2.0])
    ts = jnp.stack([jnp.zeros(()), *ts, end])
    sol = rj.simulate(
        BODY, rj.Attitude([1.0, 0, 0, 0], omega), ts, top,
        solver=rj.solvers.DormandPrince8(), throw=throw,
    )  # fmt: skip
    return sol.ys.omega[-1, 0] + sol.ys.omega[0, 1] * sol.ys.omega[1, 2]


@pytest.mark.parametrize(
    "lane",
    [
        pytest.param(0, marks=pytest.mark.slow),
        pytest.param(1, marks=pytest.mark.slow),
        pytest.param(2, marks=pytest.mark.slow),
    ],
)
def test_the_gradient_of_a_batch_is_the_batch_of_gradients(lane):
    # Each input alone batched: the others, and what depends on them alone, are shared.
    args = (jnp.array([0.4, 1.2, 1.5]), jnp.asarray(0.7), jnp.asarray(0.5))
    axes = tuple(0 if i == lane else None for i in range(3))
    rows = jnp.stack([args[lane], args[lane] * 1.1])
    many = tuple(rows if i == lane else arg for i, arg in enumerate(args))

    def total(*many):
        return jax.vmap(last_rate, axes)(*many).sum()

    found = jax.jit(jax.grad(total, (0, 1, 2)))(*many)
    alone = jax.jit(jax.grad(last_rate, (0, 1, 2)))
    one, two = (alone(*[row if i == lane else arg for i, arg in enumerate(args)]) for row in rows)
    for i in range(3):
        wanted = jnp.stack([one[i], two[i]]) if i == lane else one[i] + two[i]
        np.testing.assert_allclose(found[i], wanted, rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("throw", [True, False])
def test_a_batch_by_a_time_between_that_the_end_does_not_feel(throw):
    omega, end, height = jnp.array([0.4, 1.2, 1.5]), jnp.asarray(0.7), jnp.asarray(0.5)

    def of(between):
        return last_rate(omega, end, height, (between,), throw)

    times = jnp.array([0.2, 0.3])
    found = jax.jit(jax.grad(lambda ts: jax.vmap(of)(ts).sum()))(times)
    np.testing.assert_allclose(found, [jax.jit(jax.grad(of))(t) for t in times], rtol=1e-10)
