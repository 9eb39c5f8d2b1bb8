"""What cannot be said is NaN, and so is its derivative: bodies that cannot be, and states not reached."""

import functools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once

import rigidjax as rj
from rigidjax import shapes, torques

BODY = rj.Inertia.from_principal(1.0, 1.6, 2.2)
DAMPING = torques.Damping([0.1, 0.2, 0.3])
OMEGA = jnp.array([1.0, 2.0, 3.0])
IMPOSSIBLE = {
    "negative": ([-1.0, 1.6, 2.2], "triangle inequality"),
    "triangle": ([1.0, 1.0, 9.0], "triangle inequality"),
    "zero": ([0.0, 2.0, 2.0], "a principal moment is zero"),
}


@pytest.mark.parametrize("torque", [None, DAMPING], ids=["free", "forced"])
@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_a_traced_body_that_cannot_be_has_no_motion(name, torque):
    moments, words = IMPOSSIBLE[name]

    def run(moments, throw):
        sol = rj.simulate(
            rj.Inertia(jnp.diag(moments)), rj.Spin(OMEGA), [0.0, 1.0], torque, throw=throw
        )
        return sol.ys.omega[-1], sol.result == dfx.RESULTS.nonfinite_input

    good = jnp.array([1.0, 1.6, 2.2])
    both = jax.vmap(lambda m: run(m, False))(jnp.stack([good, jnp.array(moments)]))
    assert both[1].tolist() == [False, True] and bool(jnp.isnan(both[0][1]).all())
    two = jax.vmap(lambda m: run(m, False))(jnp.stack([good, good]))
    np.testing.assert_array_equal(both[0][0], two[0][0])
    with pytest.raises(RuntimeError, match=words):
        eqx.filter_jit(lambda m: run(m, True))(jnp.array(moments))


@functools.cache
def door(way):
    """A compiled run of two bodies by one way into the library."""
    states = rj.Attitude(jnp.tile(jnp.eye(4)[0], (2, 1)), jnp.tile(OMEGA, (2, 1)))

    @jax.jit
    def run(moments):
        bodies = rj.Inertia(jax.vmap(jnp.diag)(moments))
        if way == "crossings":
            across = lambda t, state, body: state.omega[1]
            one = lambda body: rj.crossings(
                body, rj.Spin(OMEGA), 0.0, 20.0, across, max_crossings=3
            )
            return jax.vmap(lambda body: (one(body).count, one(body).result))(bodies)
        if way == "rollout":
            sol = rj.batch.simulate(bodies, states, rj.batch.Steps(0.01, 8))
            return rj.batch.rollout(bodies, states, 0.01, 8).omega, sol.result
        torque = None if way == "closed form" else DAMPING
        sol = rj.batch.simulate(bodies, states, [0.0, 1.0], torque)
        return sol.ys.omega[:, -1], sol.result

    return run


@pytest.mark.parametrize("name", IMPOSSIBLE)
@pytest.mark.parametrize("way", ["closed form", "adaptive", "rollout", "crossings"])
def test_every_door_refuses_it_alone(name, way):
    run, moments = door(way), jnp.array([[1.0, 1.6, 2.2], IMPOSSIBLE[name][0]])
    out, result = run(moments)
    assert (result == dfx.RESULTS.nonfinite_input).tolist() == [False, True]
    if way == "crossings":
        assert int(out[0]) == 3 and int(out[1]) == 0
    else:
        assert bool(jnp.isfinite(out[0]).all()) and bool(jnp.isnan(out[1]).all())


def test_a_negative_mass_is_named_and_has_no_energy():
    state = rj.Rigid(jnp.zeros(3), OMEGA, jnp.eye(4)[0], OMEGA)

    def run(mass, throw):
        body = shapes.box(mass, [0.3, 0.2, 0.1])
        sol = rj.simulate(body, state, [0.0, 1.0], torques.Drag(0.1), throw=throw)
        return sol.ys.omega[-1], sol.result == dfx.RESULTS.nonfinite_input

    omega, ill = jax.vmap(lambda mass: run(mass, False))(jnp.array([1.0, -1.0]))
    assert ill.tolist() == [False, True] and bool(jnp.isnan(omega[1]).all())
    with pytest.raises(RuntimeError, match="wanted a positive mass"):
        eqx.filter_jit(lambda mass: run(mass, True))(jnp.asarray(-1.0))
    assert bool(jnp.isnan(jax.jit(lambda m: shapes.sphere(m, 0.1).mass)(-1.0)))


def _too_few_steps(omega):
    sol = rj.simulate(BODY, rj.Spin(omega), [0.0, 5.0, 10.0], DAMPING, max_steps=3, throw=False)
    return sol.ys.omega[-1]


def _never(omega):
    far = lambda t, state, body: state.omega[0] - 100.0
    return rj.simulate(BODY, rj.Spin(omega), [0.0, 5.0], DAMPING, event=far).event_time


def _after(omega):
    down = lambda t, state, body: state.omega[0] - 0.01
    return rj.simulate(BODY, rj.Spin(omega), [0.0, 5.0], DAMPING, event=down).ys.omega[-1]


def _too_fast(omega):
    fast = rj.Spin(1e200 * omega)
    return rj.simulate(BODY, fast, [0.0, 5.0], DAMPING, throw=False).ys.omega[-1]


def _no_more(omega):
    far = lambda t, state, body: state.omega[0] - 100.0
    return rj.crossings(BODY, rj.Spin(omega), 0.0, 5.0, far, max_crossings=2).times


@pytest.mark.parametrize(
    "value",
    [pytest.param(_too_few_steps, marks=pytest.mark.oldest), _never, _after, _too_fast, _no_more],
)
def test_where_a_value_is_nan_its_derivative_is(value):
    assert bool(jnp.isnan(value(OMEGA)).all())
    for mode in (jax.jacrev, jax.jacfwd):
        assert bool(jnp.isnan(mode(value)(OMEGA)).all())


def test_what_was_reached_keeps_its_gradient():
    def reached(omega):
        down = lambda t, state, body: state.omega[0] - 0.01
        sol = rj.simulate(BODY, rj.Spin(omega), [0.0, 0.2, 5.0], DAMPING, event=down)
        return jnp.nansum(sol.ys.omega)

    def alone(omega):
        return jnp.sum(rj.simulate(BODY, rj.Spin(omega), [0.0, 0.2], DAMPING).ys.omega)

    np.testing.assert_allclose(jax.grad(reached)(OMEGA), jax.grad(alone)(OMEGA), rtol=1e-8)
    np.testing.assert_allclose(
        jax.hessian(reached)(OMEGA), jax.hessian(alone)(OMEGA), rtol=1e-6, atol=1e-8
    )


@pytest.mark.parametrize("torque", [None, DAMPING], ids=["free", "forced"])
def test_a_condition_that_is_zero_all_along_is_never_met(torque):
    start = rj.Spin([0.0, 0.0, 1.0])
    still = lambda t, state, body: state.omega[1]
    found = rj.crossings(BODY, start, 0.0, 10.0, still, torque, max_crossings=5)
    assert int(found.count) == 0 and found.result == dfx.RESULTS.successful
    sol = rj.simulate(BODY, start, [0.0, 10.0], torque, event=still)
    assert sol.result == dfx.RESULTS.successful and bool(jnp.isnan(sol.event_time))
    # Zero at first, then not: it leaves zero without crossing it, and crosses it once at 4 s.
    later = lambda t, state, body: jnp.where(t < 2.0, 0.0, (t - 2.0) * (4.0 - t))
    found = rj.crossings(BODY, start, 0.0, 10.0, later, torque, max_crossings=5, max_step=0.5)
    np.testing.assert_allclose(found.times[: int(found.count)], [4.0], rtol=1e-12)


class Nothing(torques.AbstractTorque):
    """A torque of zero: the free motion, but through a solver."""

    feels = rj.motion.HasSpin

    def __call__(self, t, state, body):
        return jnp.zeros_like(state.omega)


def numbers_of(state, tensor, axis, across):
    """Energy, |L|², |q|², rates along two axes, where one points, L, Ω."""
    momentum = rj.quaternion.rotate(state.q, tensor @ state.omega)
    energy = 0.5 * jnp.sum(state.omega * (tensor @ state.omega))
    points = rj.quaternion.rotate(state.q, across) @ axis
    squares = [jnp.sum(momentum**2), jnp.sum(state.q**2)]
    first = jnp.stack([energy, *squares, state.omega @ axis, state.omega @ across, points])
    return jnp.concatenate([first, momentum, state.omega])


@pytest.mark.parametrize("dtype", [jnp.float64, pytest.param(jnp.float32, marks=pytest.mark.long)])
@pytest.mark.parametrize(
    "torque", [pytest.param(None, marks=pytest.mark.long), Nothing()], ids=["free", "forced"]
)
def test_a_condition_that_is_zero_but_for_round_off_is_never_met(torque, dtype):
    def count(weights, tensor, omega, axis, across, level):
        start = rj.Attitude(jnp.eye(4, dtype=dtype)[0], omega)
        first = numbers_of(start, tensor, axis, across)

        def condition(t, state, body):
            return weights @ (numbers_of(state, tensor, axis, across) - first) + level

        body = rj.Inertia(tensor)
        ends = jnp.asarray(0.0, dtype), jnp.asarray(60.0, dtype)
        return rj.crossings(body, start, *ends, condition, torque, max_crossings=20).count

    rng, cases = np.random.default_rng(1), []
    turned = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(3)]
    tensors = [
        axes @ np.diag(moments) @ axes.T
        for axes, moments in zip(turned, ([1, 1.6, 2.2], [2, 2, 0.7], [1, 1.6, 2.2]), strict=True)
    ]
    # What is conserved; the rate about the axis of a symmetric body; turns about principal axes.
    omega = rng.normal(size=3)
    for i in (0, 1, 2, 6, 7, 8):
        cases.append((np.eye(12)[i], tensors[0], omega, *turned[0].T[:2], 0.0))
    cases.append((np.eye(12)[3], tensors[1], omega, *turned[1].T[[2, 0]], 0.0))
    for axis in turned[2].T[[0, 2]]:
        for i in (4, 5, 9, 10, 11):
            cases.append((np.eye(12)[i], tensors[2], axis, axis, turned[2].T[1], 0.0))
    # And true oscillations about a principal axis, of 10³ to 10⁶ times the round-off.
    for size in float(jnp.finfo(dtype).eps) * 10.0 ** np.arange(3, 7):
        omega = turned[2] @ [size, size, 1.0]
        cases.append((np.eye(12)[4], tensors[2], omega, *turned[2].T[[2, 1]], size))
    args = [jnp.asarray(np.stack(column), dtype) for column in zip(*cases, strict=True)]
    # The frequency of these is √(0.6 · 1.2/1.6) rad/s: 13 zeros in 60 s.
    assert once(jax.vmap(count))(*args).tolist() == [0] * 17 + [13] * 4


def test_times_that_float32_cannot_tell_apart_are_named():
    ts = jnp.array([1.7e9, 1.7e9 + 1000.0], jnp.float32)
    start = rj.Spin(OMEGA.astype(jnp.float32))
    body = jax.tree.map(lambda a: a.astype(jnp.float32), BODY)
    law = jax.tree.map(lambda a: a.astype(jnp.float32), DAMPING)
    with pytest.raises(RuntimeError, match="count time from a later origin, or use float64"):
        rj.simulate(body, start, ts, law)


def test_float64_is_not_advised_to_a_run_in_float64():
    law = lambda t, state, body: jnp.cos(40 * t) * jnp.ones(3)
    epoch = 1.6e9
    with pytest.raises(
        RuntimeError, match=r"float64 the times near 1e9 s are 1\.2e-07 s apart: count"
    ) as told:
        rj.simulate(BODY, rj.Spin(OMEGA), [epoch, epoch + 5.0], law, rtol=1e-11)
    assert "use float64" not in str(told.value) and "float32" not in str(told.value)
    assert "such as the first time of the run" in str(told.value)
    with pytest.raises(ValueError, match="such as the first time of the run"):
        rj.simulate(BODY, rj.Spin(OMEGA), [epoch, epoch + 5.0], law, dt0=1e-7)
