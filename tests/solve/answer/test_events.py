"""Events and crossings: exact times, two in a step, touches, derivatives, words."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once
from scipy.integrate import solve_ivp

import rigidjax as rj
from rigidjax import torques

BODY = rj.Inertia.from_principal(1.0, 2.0, 3.0)
FLIPPING = rj.Attitude([1.0, 0, 0, 0], [0.0, 1.0, 0.01])
TIGHT = dict(rtol=1e-12, atol=1e-14)
TOP_BODY = rj.Inertia.from_principal(1.0, 1.4, 0.8)
Q = np.array([0.8, -0.2, 0.4, 0.4])


def middle(t, state, body):
    return state.omega[1]


class Nothing(torques.AbstractTorque):
    """A torque of zero: the free motion, but through a solver."""

    feels = rj.motion.HasSpin

    def __call__(self, t, state, body):
        return jnp.zeros_like(state.omega)


def height(t, state, body):
    return state.x[2]


def throw(speed, ceiling, end=3.0, **how):
    """Times at which a stone thrown up passes a height; its motion is one step of the method."""
    start = rj.Point([0.0, 0.0, 0.0], jnp.stack([jnp.zeros(()), jnp.zeros(()), speed]))
    law = rj.frames.Force(lambda t, state, body: jnp.array([0.0, 0.0, -2.0]))
    how = dict(max_crossings=4) | how
    return rj.crossings(None, start, 0.0, end, lambda t, s, b: s.x[2] - ceiling, law, **how)


@pytest.mark.parametrize(
    "torque", [pytest.param(None, marks=pytest.mark.long), Nothing()], ids=["free", "forced"]
)
def test_the_flip_of_a_free_body(torque):
    # The time with fifty digits (tests/failures/test_d04_flip_time.py).
    event = rj.Event(middle)
    out = rj.simulate(BODY, FLIPPING, [0.0, 5.0, 15.0, 20.0], torque, event=event, **TIGHT)
    exact = 9.4255178968436496622
    assert abs(float(out.event_time) - exact) < (1e-13 if torque is None else 1e-11)
    there = rj.exact.free_body(BODY, FLIPPING, exact)
    np.testing.assert_allclose(out.event_state.omega, there.omega, atol=1e-11)
    np.testing.assert_allclose(out.event_state.q, there.q, atol=1e-11)
    assert out.result == dfx.RESULTS.event_occurred
    assert np.isfinite(out.ys.q[:2]).all() and np.isnan(out.ys.q[2:]).all()


def test_none_at_all_and_batches_of_both():
    def run(level):
        event = lambda t, state, body: state.omega[1] - level
        out = rj.simulate(BODY, FLIPPING, [0.0, 4.0, 20.0], Nothing(), event=event)
        return out.event_time, out.ys.omega[-1], out.result == dfx.RESULTS.event_occurred

    times, ends, met = jax.jit(jax.vmap(run))(jnp.array([0.5, 2.0]))
    assert met.tolist() == [True, False]
    assert np.isfinite(times[0]) and np.isnan(times[1])
    assert np.isnan(ends[0]).all()
    wanted = rj.exact.free_body(BODY, FLIPPING, 20.0).omega
    np.testing.assert_allclose(ends[1], wanted, atol=1e-7)


def test_two_in_one_step_and_touches():
    # x = v t − t²: passes a height c at ½(v ∓ √(v² − 4c)).
    passes = once(lambda *at: throw(*at).times)
    for ceiling in (0.5, 0.999, 1 - 1e-8):
        times = passes(jnp.asarray(2.0), jnp.asarray(ceiling))
        gap = np.sqrt(1 - ceiling)
        np.testing.assert_allclose(times[:2], [1 - gap, 1 + gap], atol=1e-11 / gap)
        assert np.isnan(times[2:]).all()
    # The first steps grow tenfold each: the last two are longer than the whole flight.
    assert int(throw(jnp.asarray(2.0), 1.5).num_steps) < 15
    for ceiling in (1 + 1e-8, 1.5):
        times = passes(jnp.asarray(2.0), jnp.asarray(ceiling))
        assert np.isnan(times).all()
    up = throw(jnp.asarray(2.0), 0.5, direction=1)
    down = throw(jnp.asarray(2.0), 0.5, direction=-1)
    assert (int(up.count), int(down.count)) == (1, 1)
    gap = np.sqrt(0.5)
    np.testing.assert_allclose([up.times[0], down.times[0]], [1 - gap, 1 + gap], atol=1e-12)


def cubic(roots, **how):
    """Times at which a point is at zero whose height is (t − a)(t − b)(t − c): all in one step."""
    a, b, c = roots
    up = jnp.array([0.0, 0.0, 1.0])
    start = rj.Point(-a * b * c * up, (a * b + b * c + c * a) * up)
    law = rj.frames.Force(lambda t, state, body: (6 * t - 2 * (a + b + c)) * up)
    how = dict(max_crossings=6) | how
    return rj.crossings(None, start, 0.0, 4.0, lambda t, s, b: s.x[2], law, **how)


@pytest.mark.long
def test_a_zero_that_is_a_touch_beside_one_that_is_not():
    # The touch need not count; the crossing before or after it does, once.
    run = once(lambda roots: cubic(roots).times)
    for roots, wanted in (([1.0, 2.0, 2.0], 1.0), ([2.0, 2.0, 3.0], 3.0)):
        times = np.asarray(run(jnp.array(roots)))
        met = times[np.isfinite(times)]
        assert np.abs(met - wanted).min() < 1e-11
        assert all(min(abs(t - wanted), abs(t - 2.0)) < 1e-6 for t in met) and met.size <= 3
    # A height that is only touched, and one missed by a hair.
    passes = once(lambda *at: throw(*at).times)
    for ceiling in (1.0, 1 + 1e-14):
        assert np.isnan(passes(jnp.asarray(2.0), jnp.asarray(ceiling))).all()


@pytest.mark.parametrize("roots", [[1.0, 2.0, 3.0], [1.0, 1.1, 1.2], [0.5, 3.0, 3.3]])
def test_three_in_one_step(roots):
    run = once(lambda roots: cubic(roots).times)
    np.testing.assert_allclose(run(jnp.array(roots))[:4], [*roots, np.nan], atol=1e-11)
    down = once(lambda roots: cubic(roots, direction=-1).times)
    np.testing.assert_allclose(down(jnp.array(roots))[:2], [roots[1], np.nan], atol=1e-11)


def test_a_start_on_the_section_does_not_count():
    out = throw(jnp.asarray(2.0), 0.0)
    np.testing.assert_allclose(out.times[: int(out.count)], [2.0], atol=1e-12)
    # From a crossing on to the next one, as a return map does.
    again = throw(jnp.asarray(2.0), jnp.asarray(1e-18))
    np.testing.assert_allclose(again.times[: int(again.count)], [2.0], atol=1e-12)


@pytest.mark.long
def test_free_crossings_to_round_off():
    # Ω2 is a Jacobi function: its zeros are half a period apart (Landau and Lifshitz, eq 37.10).
    start = rj.Spin([0.3, 1.0, 0.4])
    found = rj.crossings(BODY, start, 0.0, 100.0, middle, max_crossings=64)
    count = int(found.count)
    half = 0.5 * float(rj.exact.body_period(BODY, start.omega))
    assert count == int((100.0 - float(found.times[0])) / half) + 1
    np.testing.assert_allclose(np.diff(found.times[:count]), half, rtol=0, atol=1e-12)
    assert np.isnan(found.times[count:]).all() and not bool(found.full)
    assert np.abs(found.states.omega[:count, 1]).max() < 1e-14
    # The axis of a symmetric body goes round the momentum at |L|/I₁.
    body = rj.Inertia.from_principal(2.0, 2.0, 0.7)
    momentum = np.array([2.0 * 0.8, 0.0, 0.7 * 1.5])
    size = np.linalg.norm(momentum)
    # Turned so that the momentum is up: the axis starts in the plane of x and z.
    tilt = np.arctan2(momentum[0], momentum[2])
    q = [np.cos(tilt / 2), 0.0, -np.sin(tilt / 2), 0.0]
    top = rj.Attitude(q, [0.8, 0.0, 1.5])
    axis = lambda t, state, body: rj.quaternion.rotate(state.q, jnp.array([0.0, 0, 1]))[0]
    found = rj.crossings(body, top, 0.0, 50.0, axis, max_crossings=40)
    count = int(found.count)
    wanted = (np.arange(count) + 0.5) * np.pi * 2.0 / size
    assert wanted[-1] < 50 < wanted[-1] + np.pi * 2.0 / size
    np.testing.assert_allclose(found.times[:count], wanted, rtol=0, atol=1e-12)


def heavy(omega, mass, level, **how):
    top = torques.HeavyTop(mass, [0.1, 0.0, 0.3], [0.0, 0.0, -9.81])
    condition = lambda t, state, body: state.omega[0] - level
    how = dict(direction=1, max_crossings=6, **TIGHT) | how
    return rj.crossings(TOP_BODY, rj.Attitude(Q, omega), 0.0, 30.0, condition, top, **how)


OMEGA = np.array([0.5, -0.3, 4.0])


@pytest.mark.long
def test_a_heavy_top_against_scipy():
    i1, i2, i3 = 1.0, 1.4, 0.8
    com, down = np.array([0.1, 0.0, 0.3]), np.array([0.0, 0.0, -9.81])

    def slope(t, y):
        q, w = y[:4], y[4:]
        s, v = q[0], q[1:]
        pull = down + 2 * np.cross(-v, np.cross(-v, down) + s * down)
        torque = np.cross(com, pull)
        rate = (torque - np.cross(w, np.array([i1, i2, i3]) * w)) / np.array([i1, i2, i3])
        return np.concatenate([[-v @ w / 2], (s * w + np.cross(v, w)) / 2, rate])

    def level(t, y):
        return y[4] - 0.2

    level.direction = 1
    out = solve_ivp(
        slope, (0, 12), [*Q, *OMEGA], "DOP853", rtol=1e-12, atol=1e-13, events=level, max_step=0.05
    )
    found = heavy(jnp.asarray(OMEGA), jnp.asarray(1.0), jnp.asarray(0.2))
    count = min(6, len(out.t_events[0]))
    assert count > 2
    np.testing.assert_allclose(found.times[:count], out.t_events[0][:count], atol=1e-8)
    np.testing.assert_allclose(found.states.omega[:count], out.y_events[0][:count, 4:], atol=1e-7)


@pytest.mark.slow
def test_derivatives_of_crossings():
    def numbers(omega, mass, level):
        found = heavy(omega, mass, level, max_crossings=3)
        return jnp.concatenate([found.times, found.states.q[-1], found.states.omega[-1]])

    at = tuple(map(jnp.asarray, (OMEGA, 1.0, 0.2)))
    three = (0, 1, 2)
    forward = once(jax.jacfwd(numbers, three))(*at)
    reverse = once(jax.jacrev(numbers, three))(*at)
    for a, b in zip(forward, reverse, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    run = once(numbers)
    both = once(lambda *at: jax.jvp(lambda level: numbers(*at[:2], level), at[2:], at[2:])[0])
    np.testing.assert_allclose(both(*at), run(*at), rtol=1e-12, atol=1e-12)
    moves = [*([e, 0.0, 0.0] for e in np.eye(3)), [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    found = np.column_stack([forward[0], forward[1], forward[2]])
    for column, move in zip(found.T, moves, strict=True):
        wanted = slope_of(lambda s: run(*(a + s * m for a, m in zip(at, move, strict=True))))
        np.testing.assert_allclose(column, wanted, rtol=1e-8, atol=1e-8)
    second = once(jax.jacfwd(jax.jacrev(numbers, 2), 2))(*at)
    first = once(jax.jacfwd(numbers, 2))
    wanted = slope_of(lambda s: first(at[0], at[1], at[2] + s))
    np.testing.assert_allclose(second, wanted, rtol=1e-6, atol=1e-6)


def slope_of(f, h=1e-3):
    """Differences of order six."""
    rows = [f(k * h) - f(-k * h) for k in (1, 2, 3)]
    return (45 * rows[0] - 9 * rows[1] + rows[2]) / (60 * h)


@pytest.mark.parametrize(
    "torque",
    [
        pytest.param(None, id="free", marks=pytest.mark.slow),
        pytest.param(Nothing(), id="forced", marks=pytest.mark.long),
    ],
)
def test_derivatives_of_an_event(torque):
    def numbers(omega, level):
        event = lambda t, state, body: state.omega[1] - level
        start = rj.Attitude(Q / np.linalg.norm(Q), omega)
        out = rj.simulate(BODY, start, [0.0, 20.0], torque, event=event, **TIGHT)
        return jnp.concatenate([out.event_time[None], out.event_state.q, out.event_state.omega])

    at = jnp.array([0.3, 1.0, 0.4]), jnp.asarray(0.1)
    forward = once(jax.jacfwd(numbers, (0, 1)))(*at)
    reverse = once(jax.jacrev(numbers, (0, 1)))(*at)
    for a, b in zip(forward, reverse, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)
    run = once(numbers)
    for i, e in enumerate(np.eye(3)):
        wanted = slope_of(lambda s: run(at[0] + s * e, at[1]))
        np.testing.assert_allclose(forward[0][:, i], wanted, rtol=1e-8, atol=1e-8)
    wanted = slope_of(lambda s: run(at[0], at[1] + s))
    np.testing.assert_allclose(forward[1], wanted, rtol=1e-8, atol=1e-8)
    if torque is None:
        # The closed form's second derivatives have tests of their own, and compile for minutes.
        return
    second = once(jax.jacfwd(jax.jacrev(numbers, 1), 0))(*at)
    first = once(jax.jacfwd(numbers, 1))
    for i, e in enumerate(np.eye(3)):
        wanted = slope_of(lambda s: first(at[0] + s * e, at[1]))
        np.testing.assert_allclose(second[:, i], wanted, rtol=1e-7, atol=1e-7)


@pytest.mark.oldest
def test_the_slope_of_a_crossing_is_that_of_its_closed_form():
    # About a principal axis Ω = 1 + τ t/I: 2 at t = I/τ.
    def time(torque, moment):
        body = rj.Inertia.from_principal(2.0, 3.0, moment)
        law = torques.ConstantTorque(jnp.array([0.0, 0.0, 1.0]) * torque)
        two = lambda t, state, body: state.omega[2] - 2.0
        return rj.crossings(body, rj.Spin([0.0, 0, 1]), 0.0, 9.0, two, law, max_crossings=1).times[
            0
        ]

    value, slopes = once(jax.value_and_grad(time, (0, 1)))(jnp.asarray(0.8), jnp.asarray(4.0))
    np.testing.assert_allclose([value, *slopes], [5.0, -4.0 / 0.64, 1 / 0.8], rtol=1e-11)


@pytest.mark.oldest
def test_jumps_are_stops_and_have_derivatives():
    # About a principal axis Ω = 1 + (t − edge)/2 from the edge on: 2 at edge + 2.
    body = rj.Inertia.from_principal(2.0, 3.0, 4.0)

    def time(edge):
        law = torques.Pulses(jnp.stack([edge, edge + 9.0]), [[0.0, 0.0, 2.0]])
        event = rj.Event(lambda t, state, body: state.omega[2] - 2.0, direction=1)
        return rj.simulate(body, rj.Spin([0.0, 0, 1]), [0.0, 8.0], law, event=event).event_time

    value, slope = once(jax.value_and_grad(time))(jnp.asarray(1.3))
    np.testing.assert_allclose([value, slope], [3.3, 1.0], atol=1e-12)


@pytest.mark.long
def test_back_in_time_and_moments_of_a_clock():
    back = throw(jnp.asarray(-2.0), 0.5, end=-3.0)
    gap = np.sqrt(0.5)
    np.testing.assert_allclose(back.times[: int(back.count)], [gap - 1, -gap - 1], atol=1e-12)
    flip = rj.crossings(BODY, FLIPPING, 0.0, -20.0, middle, max_crossings=2)
    mirrored = rj.Attitude([1.0, 0, 0, 0], -FLIPPING.omega)
    wanted = rj.crossings(BODY, mirrored, 0.0, 20.0, middle, max_crossings=2)
    np.testing.assert_allclose(flip.times[0], -wanted.times[0], atol=1e-11)
    every = lambda t, state, body: jnp.sin(np.pi * t / 0.7)
    found = rj.crossings(
        BODY, FLIPPING, 0.1, 10.0, every, Nothing(), max_crossings=20, max_step=0.5
    )
    np.testing.assert_allclose(found.times[:14], 0.7 * np.arange(1, 15), atol=1e-13)
    assert int(found.count) == 14


def test_full_is_told_and_bodies_are_alone():
    rates = jnp.array([[0.3, 1.0, 0.4], [0.0, 1.0, 0.01], [np.nan, 1.0, 0.0]])

    def one(omega):
        found = rj.crossings(
            BODY, rj.Spin(omega), 0.0, 20.0, middle, Nothing(), max_crossings=3, **TIGHT
        )
        return found.times, found.count, found.full, found.result == dfx.RESULTS.successful

    times, count, full, good = once(jax.vmap(one))(rates)
    assert full.tolist() == [True, False, False]
    assert good.tolist() == [False, True, False]
    assert count.tolist() == [3, 1, 0]
    alone = rj.crossings(BODY, rj.Spin(rates[0]), 0.0, 20.0, middle, max_crossings=3)
    np.testing.assert_allclose(times[0], alone.times, atol=1e-9)
    np.testing.assert_allclose(times[1, 0], 9.4255178968436496622, atol=1e-9)


def test_words(unhooked):
    run = lambda **how: rj.simulate(BODY, FLIPPING, [0.0, 1.0], Nothing(), **how)
    with pytest.raises(TypeError, match="the difference, not its sign"):
        run(event=lambda t, state, body: state.omega[1] > 0)
    with pytest.raises(ValueError, match=r"condition: .*one real number, zero at the event"):
        run(event=lambda t, state, body: state.omega)
    with pytest.raises(ValueError, match=r"event does not go with solver=Tsit5"):
        run(event=middle, solver=dfx.Tsit5())
    with pytest.raises(TypeError, match=r"condition: wanted a function \(t, state, body\)"):
        rj.Event(Nothing)
    with pytest.raises(ValueError, match=r"direction: wanted 1 .on the way up., .*got 2"):
        rj.Event(middle, direction=2)
    with pytest.raises(ValueError, match="max_step: wanted a positive step"):
        rj.Event(middle, max_step=0.0)
    with pytest.raises(ValueError, match="max_crossings: wanted a whole number of at least 1"):
        rj.crossings(BODY, FLIPPING, 0.0, 1.0, middle, max_crossings=0)
    with pytest.raises(ValueError, match="t1: wanted another time than t0, got 1 for both"):
        rj.crossings(BODY, FLIPPING, 1.0, 1.0, middle)
    spin, turned = rj.Spin([0.0, 1.0, 0.01]), lambda t, state, body: state.q[1]
    with pytest.raises(
        TypeError, match=r"condition looks at state.q, the attitude, and Spin has none"
    ):
        rj.simulate(BODY, spin, [0.0, 1.0], event=turned)
    with pytest.raises(
        ValueError, match=r"condition: wanted a number .*got NaN at the start, t = 0"
    ):
        run(event=lambda t, state, body: jnp.log(-1.0 - t))
    with pytest.raises(TypeError, match="solver: wanted an explicit method"):
        rj.crossings(BODY, FLIPPING, 0.0, 1.0, middle, solver=dfx.Tsit5())


def test_events_under_laws_with_states_of_their_own():
    """One wheel about the axis of the turn: Ω = Ω₀ − u t/I, the wheel's momentum h = h₀ + u t."""
    body = rj.Inertia.from_principal(1.0, 2.0, 3.0)

    def still(omega, motor):
        wheel = rj.torques.ReactionWheels([[0.0, 0, 1]], [0.1], [30.0], motor[None])
        start = rj.Spin(jnp.stack([0.0 * omega, 0.0 * omega, omega]))
        stops = rj.Event(lambda t, state, body: state.motion.omega[2])
        sol = rj.simulate(body, start, [0.0, 4.0, 8.0], wheel, event=stops)
        return sol.event_time, (sol, wheel, start)

    at = jnp.asarray(1.0), jnp.asarray(0.5)
    time, (sol, wheel, start) = still(*at)
    np.testing.assert_allclose(time, 6.0, rtol=1e-9)
    np.testing.assert_allclose(sol.event_state.own[0], [0.1 * 31.0 + 3.0], rtol=1e-9)
    np.testing.assert_allclose(sol.own[0][1], [0.1 * 31.0 + 2.0], rtol=1e-9)
    assert np.isnan(sol.own[0][2]).all() and np.isnan(sol.ys.omega[2]).all()
    when = lambda *numbers: still(*numbers)[0]
    slopes = jax.jacfwd(when, argnums=(0, 1))(*at)
    np.testing.assert_allclose(slopes, [6.0, -12.0], rtol=1e-7)
    np.testing.assert_allclose(jax.grad(when)(*at), 6.0, rtol=1e-7)
    full = lambda t, state, body: state.own[0][0] - 3.6
    found = rj.crossings(body, start, 0.0, 8.0, full, wheel, max_crossings=2)
    np.testing.assert_allclose(found.times, [1.0, np.nan], rtol=1e-9)
    np.testing.assert_allclose(found.states.motion.omega[0, 2], 1 - 0.5 / 3, rtol=1e-9)
    with pytest.raises(ValueError, match="transition_matrix: wanted a torque without states"):
        rj.simulate(body, start, [0.0, 1.0], wheel).transition_matrix()


def test_back_in_time_with_wheels():
    body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.4, 1.0, 0.1])

    def wheels(speed):
        return rj.torques.ReactionWheels([[0.0, 0, 1]], [0.1], [speed], viscous=1e-3)

    there = rj.simulate(body, start, [0.0, 2.0], wheels(30.0))
    omega, momentum = there.ys.omega[-1], there.own[0][-1, 0]
    speed = momentum / 0.1 - omega[2]
    back = rj.simulate(body, rj.Spin(omega), [2.0, 0.0], wheels(speed))
    np.testing.assert_allclose(back.ys.omega[-1], start.omega, atol=1e-8)
    np.testing.assert_allclose(back.own[0][-1, 0], 0.1 * (30.0 + 0.1), rtol=1e-8)


# The rates of a flip pass zero at 9.4255 s: conditions that jump there, with and without slopes.
JUMPS = {
    "sign": lambda t, state, body: jnp.sign(state.omega[1]),
    "level": lambda t, state, body: jnp.where(state.omega[1] > 0, 2.0, -0.5),
    "slope before": lambda t, state, body: jnp.where(state.omega[1] > 0, state.omega[1] + 1, -1.0),
    "slope after": lambda t, state, body: jnp.where(state.omega[1] > 0, 1.0, state.omega[1] - 1),
}


@pytest.mark.parametrize("law", [None, Nothing()], ids=["free", "forced"])
@pytest.mark.parametrize("name", JUMPS)
def test_a_condition_that_jumps_is_met_where_it_jumps(name, law):
    def meet(scale, condition):
        start = rj.Spin(scale * jnp.array([0.0, 1.0, 0.01]))
        sol = rj.simulate(BODY, start, [0.0, 5.0, 12.0], law, event=condition, **TIGHT)
        return sol.event_time, sol.event_state.omega

    right, rates = meet(1.0, middle)
    time, omega = meet(1.0, JUMPS[name])
    np.testing.assert_allclose(time, right, rtol=1e-12)
    np.testing.assert_allclose(omega, rates, atol=1e-9)
    along = jax.jvp(lambda scale: meet(scale, JUMPS[name]), (1.0,), (1.0,))[1]
    assert np.isnan(along[0]) and np.all(np.isnan(along[1]))
    start = rj.Spin([0.0, 1.0, 0.01])
    passed = rj.crossings(BODY, start, 0.0, 12.0, JUMPS[name], law, max_crossings=2, **TIGHT)
    np.testing.assert_allclose(passed.times[0], right, rtol=1e-12)
