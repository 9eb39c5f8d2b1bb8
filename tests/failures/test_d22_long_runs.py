"""Row D22: a million steps of a free body. Bar: energy and momentum to 1e-11 / 1e-4.

Equal steps carry what additions lose. In float64 energy and momentum keep 2e-14 (DormandPrince8) and
2e-15 (Splitting2). In float32 they keep 2e-5 and 2e-6: weights of a method that are rounded to
float32 leave the first, a plain sum left 1.8e-4 and 9.9e-4. A free body needs no steps: the closed
form has no drift in either precision.

Row D19's |L| to 1e-12 over 1e6 steps of a splitting at hΩ = 1 is met: 2.4e-15.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax.motion.equations import AttitudeEquations
from rigidjax.solve import fixed

STEPS, LOOKS = 1_000_000, 101


@pytest.mark.slow
@pytest.mark.parametrize(
    ("solver", "dtype", "bars"),
    [
        (rj.solvers.DormandPrince8(), jnp.float64, (1e-13, 1e-13)),
        (rj.solvers.DormandPrince8(), jnp.float32, (5e-5, 5e-5)),
        (rj.solvers.Splitting2(), jnp.float64, (1e-14, 1e-14)),
        (rj.solvers.Splitting2(), jnp.float32, (1e-5, 1e-5)),
    ],
    ids=["DormandPrince8-f64", "DormandPrince8-f32", "Splitting2-f64", "Splitting2-f32"],
)
def test_d22_a_million_steps(solver, dtype, bars):
    body = rj.Inertia(jnp.diag(jnp.array([1.0, 2.0, 3.0], dtype)))
    start = rj.Attitude(jnp.array([1.0, 0, 0, 0], dtype), jnp.array([1.0, 0.7, 0.4], dtype))
    ts = jnp.linspace(0.0, 0.01 * STEPS, LOOKS, dtype=dtype)
    field = AttitudeEquations(body)
    n = jnp.asarray(STEPS // (LOOKS - 1))
    ys = jax.jit(lambda ts, n: fixed(solver, field, ts, start, n))(ts, n)
    double = lambda tree: jax.tree.map(lambda leaf: leaf.astype(jnp.float64), tree)
    away = rj.drift(double(ts), double(ys), double(body))
    norm = float(jnp.abs(jnp.linalg.norm(double(ys).q, axis=1) - 1).max())
    found = {name: float(value) for name, value in away.items()}
    print(f"D22 {type(solver).__name__} {np.dtype(dtype).name}: {found}, |q| − 1 {norm:.1e}")
    assert found["energy"] < bars[0] and found["momentum"] < bars[1]
    assert norm < (1e-14 if dtype == jnp.float64 else 3e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dtype", "steps", "solver", "bar"),
    [
        (jnp.float32, 1_000_000, None, 5e-6),
        (jnp.float64, 10_000_000, rj.solvers.DormandPrince8(), 1e-12),
    ],
    ids=["a million in float32", "ten millions in float64"],
)
def test_d22_a_rollout(dtype, steps, solver, bar):
    """The errors of the sums grow as the root of their number."""
    away = long_rollout(dtype, steps, solver)
    print(f"D22 rollout {np.dtype(dtype).name}: {away}")
    assert max(away.values()) < bar


@pytest.mark.parametrize("solver", [None, rj.solvers.RungeKutta4(), rj.solvers.Splitting2()])
def test_d22_a_tenth_of_it_in_float32(solver):
    """Plain sums are off by 1e-5 here."""
    away = long_rollout(jnp.float32, STEPS // 10, solver)
    print(f"D22 rollout of a tenth, {type(solver).__name__}: {away}")
    assert max(away.values()) < 3e-6


def long_rollout(dtype, steps, solver):
    body = rj.Inertia(jnp.diag(jnp.array([1.0, 2.0, 3.0], dtype))[None])
    start = rj.Attitude(jnp.array([[1.0, 0, 0, 0]], dtype), jnp.array([[1.0, 0.7, 0.4]], dtype))
    h, every = jnp.asarray(0.01, dtype), steps // 100
    ys = rj.batch.rollout(body, start, h, steps, solver=solver, save_every=every)
    ys, body = (jax.tree.map(lambda a: a[0].astype(jnp.float64), tree) for tree in (ys, body))
    ts = float(h) * every * jnp.arange(1.0, 101.0)
    return {name: float(away) for name, away in rj.drift(ts, ys, body).items()}


@pytest.mark.slow
def test_d19_the_length_of_the_momentum_over_a_million_steps():
    body = rj.Inertia.from_principal(1.0, 1.8, 2.5)
    field = AttitudeEquations(body)
    start = rj.Attitude([1.0, 0, 0, 0], [0.3, 0.2, 1.0])
    ts = jnp.linspace(0.0, 1e6, LOOKS)
    ys = jax.jit(lambda ts, n: fixed(rj.solvers.Splitting2(), field, ts, start, n))(
        ts, jnp.asarray(STEPS // (LOOKS - 1))
    )
    size = np.linalg.norm(np.asarray(ys.omega) * np.array([1.0, 1.8, 2.5]), axis=1)
    print(f"D19 |L| over 1e6 steps at hΩ = 1: {np.abs(size / size[0] - 1).max():.1e}")
    np.testing.assert_allclose(size, size[0], rtol=1e-13)


@pytest.mark.parametrize(("dtype", "bar"), [(jnp.float64, 1e-11), (jnp.float32, 1e-4)])
def test_d22_the_closed_form_has_no_drift(dtype, bar):
    """At the last of the same million steps, and on the way there: within the bar in both."""
    body = rj.Inertia(jnp.diag(jnp.array([1.0, 2.0, 3.0], dtype)))
    start = rj.Attitude(jnp.array([1.0, 0, 0, 0], dtype), jnp.array([1.0, 0.7, 0.4], dtype))
    ts = jnp.linspace(0.0, 0.01 * STEPS, LOOKS, dtype=dtype)
    ys = rj.simulate(body, start, ts).ys
    double = lambda tree: jax.tree.map(lambda leaf: leaf.astype(jnp.float64), tree)
    away = {name: float(v) for name, v in rj.drift(double(ts), double(ys), double(body)).items()}
    print(f"D22 closed form {np.dtype(dtype).name}: {away}")
    assert max(away.values()) < bar
