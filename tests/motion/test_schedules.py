"""A torque that jumps: its times are data, and a step controller that has them gets it right."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from once import once
from systems.marching import rk4

import rigidjax as rj
from rigidjax import torques
from rigidjax.motion.equations import EulerEquations

BODY = rj.Inertia.from_principal(1.0, 1.3, 1.6)
START = rj.Spin([0.3, 1.0, 0.2])
EDGES = np.array([1.0, 1.0 + 1 / 3])


def pulse(edges):
    return torques.Pulses(edges, [[0.0, 0.0, 3.0]])


@eqx.filter_jit
def solve(edges, tolerance, adjoint):
    law = pulse(edges)
    controller = dfx.ClipStepSizeController(
        dfx.PIDController(rtol=tolerance, atol=tolerance), jump_ts=law.jump_times
    )
    return dfx.diffeqsolve(
        dfx.ODETerm(EulerEquations(BODY, law)),
        dfx.Tsit5(),
        0.0,
        3.0,
        0.1,
        START,
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=4096,
    ).ys.omega[-1]


@jax.jit
def exact(edges):
    """Three pieces, marched apart: free, pushed, free."""
    free = EulerEquations(BODY)
    pushed = EulerEquations(BODY, torques.ConstantTorque([0.0, 0.0, 3.0]))
    y = rk4(free, START, edges[0], 1000)
    y = rk4(pushed, y, edges[1] - edges[0], 1000)
    return rk4(free, y, 3.0 - edges[1], 2000).omega


def test_a_pulse_is_not_stepped_over():
    wanted = exact(jnp.asarray(EDGES))
    for tolerance in (1e-3, 1e-6, 1e-9):
        found = solve(jnp.asarray(EDGES), jnp.array(tolerance), dfx.ForwardMode())
        assert float(jnp.abs(found - wanted).max()) < 10 * tolerance


def test_the_slope_by_the_times_of_the_jumps():
    """Of the switch time itself, which plain AD without the jumps says is zero."""
    edges = jnp.asarray(EDGES)
    wanted = once(jax.jacfwd(exact))(edges)
    tolerance = jnp.array(1e-9)
    forward = once(jax.jacfwd(lambda e: solve(e, tolerance, dfx.ForwardMode())))(edges)
    np.testing.assert_allclose(forward, wanted, atol=1e-6)
    weights = jnp.array([0.3, -1.0, 0.7])
    back = once(
        jax.grad(lambda e: jnp.sum(weights * solve(e, tolerance, dfx.RecursiveCheckpointAdjoint())))
    )(edges)
    np.testing.assert_allclose(back, weights @ wanted, atol=1e-6)
    differences = [
        (exact(edges.at[i].add(1e-4)) - exact(edges.at[i].add(-1e-4))) / 2e-4 for i in (0, 1)
    ]
    np.testing.assert_allclose(wanted, np.stack(differences, axis=1), atol=1e-7)
