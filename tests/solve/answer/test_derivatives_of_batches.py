"""A derivative of a batch, as of a cost of many bodies, is the batch of the derivatives.

`jax.grad` of a sum over `jax.vmap` batches a compiled function first and differentiates it then:
another order than `jax.vmap` of `jax.grad`. JAX has no check of the shapes of a rule there.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once

import rigidjax as rj
from rigidjax import exact

TENSOR = jnp.array([[1.0, 0.1, 0.0], [0.1, 1.7, 0.05], [0.0, 0.05, 2.4]])
OMEGA, Q = jnp.array([0.3, 2.0, -0.4]), jnp.array([0.6, 0.0, 0.8, 0.0])
TS = jnp.array([0.0, 0.4, 1.1])
TOP = rj.torques.HeavyTop(1.0, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0])
EQUAL = dict(stepsize_controller=dfx.ConstantStepSize(), dt0=0.1, adjoint=dfx.ForwardMode())


def attitude(omega):
    return rj.Attitude(Q, omega)


def end(start, *law, **how):
    return lambda tensor, omega: rj.simulate(rj.Inertia(tensor), start(omega), TS, *law, **how).ys


def rigid(tensor, omega):
    second = 0.5 * jnp.trace(tensor) * jnp.eye(3) - tensor
    body = rj.MassProperties(2.0, jnp.zeros(3), second)
    return rj.simulate(body, rj.Rigid(omega, Q[:3], Q, omega), TS).ys


def rolled(tensor, omega):
    start = rj.Attitude(Q[None], omega[None])
    return rj.batch.rollout(rj.Inertia(tensor[None]), start, 0.1, 5, TOP)


SCENES = {
    "Spin": end(rj.Spin),
    "Attitude": end(attitude),
    "Rigid": rigid,
    "adaptive": end(attitude, TOP),
    "equal steps": end(attitude, TOP, solver=rj.solvers.Splitting4(), **EQUAL),
    "accuracy": end(attitude, TOP, accuracy=1e-6),
    "event": end(attitude, event=lambda t, y, args: y.omega[0] - 0.2),
    "closed form": lambda tensor, omega: exact.free_body(rj.Inertia(tensor), attitude(omega), 1.3),
    "body period": lambda tensor, omega: exact.body_period(rj.Inertia(tensor), omega),
    "precession": lambda tensor, omega: exact.precession_period(rj.Inertia(tensor), omega),
    "rollout": rolled,
    "principal axes": lambda tensor, omega: rj.body.principal(tensor),
}


@pytest.mark.parametrize("which", [(0, 0), (0, None), (None, 0)], ids=["both", "bodies", "rates"])
@pytest.mark.parametrize("name", SCENES)
def test_a_derivative_of_a_batch_is_the_batch_of_derivatives(name, which):
    run, scales = SCENES[name], jnp.array([1.0, 1.3, 0.8])
    along = jnp.cos(TENSOR + TENSOR.T), jnp.sin(OMEGA)
    points = [
        a if axis is None else jnp.stack([s * a for s in scales])
        for a, axis in zip((TENSOR, OMEGA), which, strict=True)
    ]
    shown = [
        a if axis is None else jnp.broadcast_to(a, (3, *a.shape))
        for a, axis in zip(along, which, strict=True)
    ]
    batch = jax.vmap(jax.jit(run), which)
    both = lambda *args: jax.jvp(run, args, along)
    found, wanted = once(
        lambda *points: (
            jax.jvp(batch, tuple(points), tuple(shown)),
            jax.vmap(both, which)(*points),
        )
    )(*points)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
