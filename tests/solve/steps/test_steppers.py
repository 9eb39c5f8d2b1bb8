"""Steppers: the step of a body under a torque, chosen by what the torque says that it looks at."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax.motion.equations import AttitudeEquations
from rigidjax.motion.torques.base import may_read_attitude, may_read_rate
from rigidjax.solve import fixed
from rigidjax.solve.steps import components, explicit
from rigidjax.solve.steps.equal_steps import loop_low_order
from rigidjax.solve.steps.steppers import stepper_of

BODY = rj.Inertia([[1.6, 0.1, 0.0], [0.1, 2.0, 0.2], [0.0, 0.2, 3.0]])
START = rj.Attitude([0.8, -0.2, 0.4, 0.4], [1.3, 0.7, -1.6])
TOP = rj.torques.HeavyTop(1.0, [0.1, 0.0, 0.4], [0.0, 0.0, -2.0])
DAMPING = rj.torques.Damping([0.1, 0.1, 0.1])
PUSH = rj.torques.ConstantTorque([0.0, 0.0, 1.0])


class Unsaid(eqx.Module):
    """A law of time only, that does not say so."""

    def __call__(self, t, state, body):
        return jnp.stack([jnp.sin(t), 0.0 * t, 0.0 * t])


class SaysSpin(rj.torques.AbstractTorque):
    """Looks at the attitude against its word."""

    feels = rj.motion.HasSpin

    def __call__(self, t, state, body):
        return state.q[:3]


class SaysRateFree(rj.torques.AbstractTorque):
    """Looks at the rate against its word."""

    feels = rj.motion.HasAttitude
    rate_free = True

    def __call__(self, t, state, body):
        return -0.1 * state.omega


@pytest.mark.parametrize(
    ("law", "attitude", "rate"),
    [
        (None, False, False),
        (TOP, True, False),
        (DAMPING, False, True),
        (PUSH, False, False),
        (Unsaid(), True, True),
        (rj.torques.Sum(DAMPING, PUSH), False, True),
        (rj.torques.Sum(PUSH, rj.torques.Sum(TOP, PUSH)), True, False),
        (rj.torques.Sum(PUSH, rj.torques.Sum(Unsaid())), True, True),
    ],
    ids=lambda law: type(law).__name__,
)
def test_a_law_says_what_it_looks_at(law, attitude, rate):
    assert may_read_attitude(law) is attitude
    assert may_read_rate(law) is rate


@pytest.mark.parametrize("law", [Unsaid(), rj.torques.Sum(PUSH, Unsaid())], ids=["one", "sum"])
def test_what_a_law_does_not_say_is_asked_for(law):
    field = AttitudeEquations(BODY, law)
    with pytest.raises(TypeError, match=r"depends on the attitude, or does not say.*HasSpin"):
        stepper_of(rj.solvers.Magnus4(), field, START)
    with pytest.raises(TypeError, match=r"depends on the body rate.*rate_free = True"):
        stepper_of(rj.solvers.Splitting4(), field, START)
    # Unless told otherwise, such a law gets the method that is right for all.
    many = jax.tree.map(lambda a: jnp.stack([a, a]), rj.Attitude([1.0, 0, 0, 0], START.omega))
    four = rj.solvers.RungeKutta4()
    chosen, wanted = (rj.batch.rollout(BODY, many, 0.01, 4, law, solver=s) for s in (None, four))
    np.testing.assert_array_equal(chosen.q, wanted.q)


def test_a_law_that_breaks_its_word_gives_no_wrong_number():
    field = AttitudeEquations(BODY, SaysSpin())
    ts = jnp.array([0.0, 0.1])
    with pytest.raises(TypeError, match=r"SaysSpin looks at state\.q.*by feels"):
        fixed(rj.solvers.Magnus4(), field, ts, START, 2)
    term, solver = dfx.ODETerm(field), rj.solvers.Magnus4()
    one = jax.jit(lambda y: solver.step(term, 0.0, 0.1, y, None, None, False)[0])(START)
    assert bool(jnp.isnan(one.omega).all())
    field = AttitudeEquations(BODY, SaysRateFree())
    ys = jax.jit(lambda y: fixed(rj.solvers.Splitting2(), field, ts, y, 2))(START)
    assert bool(jnp.isnan(ys.omega[1]).all())


@pytest.mark.oldest
@pytest.mark.parametrize("law", [TOP, DAMPING], ids=["top", "damping"])
def test_derivatives_of_equal_steps(law):
    """Reverse mode, forward mode with a number of steps that is traced, central differences."""
    ts = jnp.array([0.0, 0.11, 0.3])
    unit = rj.Attitude(START.q / jnp.linalg.norm(START.q), START.omega)
    basis = np.zeros((6, 3, 3))
    for i, (a, b) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]):
        basis[i, a, b] = basis[i, b, a] = 1.0

    def loss(six, count):
        tensor = BODY.tensor + jnp.tensordot(six, jnp.asarray(basis), 1)
        field = AttitudeEquations(rj.Inertia(tensor), law)
        return jnp.sum(fixed(rj.solvers.RungeKutta4(), field, ts, unit, count).omega ** 2)

    def all_of(six):
        far = jax.vmap(lambda d: loss(six + d, 3) - loss(six - d, 3))(1e-5 * jnp.eye(6)) / 2e-5
        return jax.grad(loss)(six, 3), jax.jacfwd(loss)(six, jnp.asarray(3)), far

    back, forward, far = jax.jit(all_of)(jnp.zeros(6))
    np.testing.assert_allclose(back, forward, rtol=0, atol=1e-12)
    np.testing.assert_allclose(back, far, rtol=0, atol=1e-8)


@pytest.mark.oldest
@pytest.mark.parametrize(
    ("plain", "law", "dtype"),
    [
        (explicit.RungeKutta4(), TOP, jnp.float64),
        (explicit.RungeKutta4(), Unsaid(), jnp.float32),
        (explicit.Tsitouras5(), Unsaid(), jnp.float64),
    ],
    ids=["top", "by time", "order 5"],
)
def test_stages_in_a_loop_take_the_steps_of_those_written_out(plain, law, dtype):
    """Values and derivatives by the rate, in both modes."""
    rolled = loop_low_order(plain)
    assert rolled is not plain
    body, start, ts, law = jax.tree.map(
        lambda a: jnp.asarray(a, dtype), (BODY, START, np.array([0.3, 0.5, 0.9]), law)
    )
    start = rj.Attitude(start.q / jnp.linalg.norm(start.q), start.omega)

    def run(omega, solver):
        ys = fixed(solver, AttitudeEquations(body, law), ts, rj.Attitude(start.q, omega), 3)
        return jnp.concatenate([ys.q[-1], ys.omega[-1]])

    def all_of(omega, solver):
        forward = jax.jacfwd(run)(omega, solver)
        return run(omega, solver), forward, jax.jacrev(run)(omega, solver)

    found, wanted = (jax.jit(lambda w, s=s: all_of(w, s))(start.omega) for s in (rolled, plain))
    rounding = 30 * float(jnp.finfo(dtype).eps)
    for a, b in zip(found, wanted, strict=True):
        assert a.dtype == b.dtype == dtype
        np.testing.assert_allclose(a, b, rtol=0, atol=rounding)
    np.testing.assert_allclose(found[1], found[2], rtol=0, atol=rounding)


def test_trees_come_back_as_they_were():
    tree = {
        "a": jnp.arange(6.0).reshape(2, 3),
        "b": jnp.array(1.0),
        "c": jnp.zeros((0, 3)),
        "d": jnp.ones(50),
    }
    parts = components.split_scalars(tree)
    assert len(parts) == 8
    back = components.join_scalars(parts, tree)
    assert jax.tree.all(jax.tree.map(lambda x, y: bool((x == y).all()), back, tree))
