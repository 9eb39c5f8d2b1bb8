"""The linear smoother against dense linear algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats

from rigidjax.identify.filtering import roots
from rigidjax.identify.filtering.linear import Moves, linear_smooth
from rigidjax.identify.filtering.steps import LinearReadings

N, M, K, T = 3, 2, 2, 6


def dense(moves, readings, mean, root):
    """Everything as one normal distribution of (x₀, u₁ … u_{T−1}), conditioned at once."""
    count = N + M * (T - 1)
    rows, shifts = [np.hstack([root, np.zeros((N, count - N))])], [mean]
    for k in range(T - 1):
        row = moves.transition[k] @ rows[-1]
        row[:, N + M * k : N + M * k + M] += moves.noise[k]
        rows.append(row)
        shifts.append(moves.transition[k] @ shifts[-1] + moves.push[k])
    big = np.concatenate([readings.matrix[k] @ rows[k] for k in range(T)])
    centre = np.concatenate([readings.matrix[k] @ shifts[k] for k in range(T)])
    keep = readings.mask.reshape(-1)
    big, centre, y = big[keep], centre[keep], readings.error.reshape(-1)[keep]
    s = big @ big.T + np.diag(readings.deviation.reshape(-1)[keep] ** 2)
    z = big.T @ np.linalg.solve(s, y - centre)
    spread = np.eye(count) - big.T @ np.linalg.solve(s, big)
    means = np.stack([shifts[k] + rows[k] @ z for k in range(T)])
    covs = np.stack([rows[k] @ spread @ rows[k].T for k in range(T)])
    logp = scipy.stats.multivariate_normal(centre, s).logpdf(y)
    return means, covs, z[N:].reshape(T - 1, M), spread[N:, N:], logp


def test_against_dense_linear_algebra():
    rng = np.random.default_rng(3)
    moves = Moves(
        np.eye(N) + 0.3 * rng.normal(size=(T - 1, N, N)),
        rng.normal(size=(T - 1, N, M)),
        rng.normal(size=(T - 1, N)),
    )
    seen = rng.uniform(size=(T, K)) < 0.7
    readings = LinearReadings(
        rng.normal(size=(T, K, N)), rng.normal(size=(T, K)), 0.5 + rng.uniform(size=(T, K)), seen
    )
    mean, root = rng.normal(size=N), np.tril(rng.normal(size=(N, N)))
    means, covs, kicks, spread, logp = dense(moves, readings, mean, root)
    found = jax.jit(linear_smooth)(moves, readings, mean, root)
    made = found.root @ jnp.swapaxes(found.root, -1, -2)
    np.testing.assert_allclose(found.mean, means, rtol=0, atol=1e-12)
    np.testing.assert_allclose(made, covs, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.kicks, kicks, rtol=0, atol=1e-12)
    for k in range(T - 1):
        here = slice(M * k, M * k + M)
        np.testing.assert_allclose(found.kick_covariance[k], spread[here, here], rtol=0, atol=1e-12)
    assert abs(float(found.log_likelihood) - logp) < 1e-11


def test_roots_of_a_covariance_that_is_singular():
    row = jnp.array([1.0, 2.0, 2.0])
    a = jnp.stack([row, 2 * row, jnp.array([0.0, 1.0, 0.0]), jnp.zeros(3)])
    root = roots.triangular_root(a)
    np.testing.assert_allclose(root @ root.T, a @ a.T, atol=1e-14)
    assert np.isfinite(jax.jacfwd(roots.triangular_root)(a)).all()


def test_a_million_to_one_in_single_precision():
    # Where the covariance itself loses its sign: P = diag(1, 1) read to 1e-6 along (1, 1).
    one = jnp.ones(1, jnp.float32)
    found = roots.kalman_update(
        jnp.zeros(2, jnp.float32),
        jnp.eye(2, dtype=jnp.float32),
        jnp.ones((1, 2), jnp.float32),
        one,
        1e-12 * one,
        one > 0,
    )
    root = np.asarray(found.root, float)
    across = np.array([1.0, -1.0]) / np.sqrt(2)
    assert abs(np.linalg.norm(root.T @ across) - 1) < 1e-6
    assert np.linalg.norm(root.T @ np.ones(2)) < 1e-3
