"""The linear filter and smoother against dense linear algebra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from rigidjax.identify import LinearModel, linear_filter, linear_smooth
from rigidjax.identify.filtering import roots

N, M, K, T = 3, 2, 2, 6


def model_of(rng, changing):
    steps, times = ((T - 1,), (T,)) if changing else ((), ())
    return LinearModel(
        np.eye(N) + 0.3 * rng.normal(size=(*steps, N, N)),
        rng.normal(size=(*steps, N, M)),
        rng.normal(size=(*times, K, N)),
        0.5 + rng.uniform(size=(*times, K)),
        push=rng.normal(size=(*steps, N)),
        offset=rng.normal(size=(*times, K)),
    )


def dense(model, readings, seen, mean, root):
    """Everything as one normal distribution of (x₀, u₁ … u_{T−1}), conditioned at once."""
    f, g, d = (
        np.broadcast_to(a, (T - 1, *a.shape[-b:]))
        for a, b in ((model.transition, 2), (model.noise, 2), (model.push, 1))
    )
    h, r, c = (
        np.broadcast_to(a, (T, *a.shape[-b:]))
        for a, b in ((model.matrix, 2), (model.deviation, 1), (model.offset, 1))
    )
    count = N + M * (T - 1)
    rows, shifts = [np.hstack([root, np.zeros((N, count - N))])], [mean]
    for k in range(T - 1):
        row = f[k] @ rows[-1]
        row[:, N + M * k : N + M * k + M] += g[k]
        rows.append(row)
        shifts.append(f[k] @ shifts[-1] + d[k])
    big = np.concatenate([h[k] @ rows[k] for k in range(T)])
    centre = np.concatenate([h[k] @ shifts[k] + c[k] for k in range(T)])
    keep = seen.reshape(-1)
    big, centre, y = big[keep], centre[keep], readings.reshape(-1)[keep]
    s = big @ big.T + np.diag(r.reshape(-1)[keep] ** 2)
    z = big.T @ np.linalg.solve(s, y - centre)
    spread = np.eye(count) - big.T @ np.linalg.solve(s, big)
    means = np.stack([shifts[k] + rows[k] @ z for k in range(T)])
    covs = np.stack([rows[k] @ spread @ rows[k].T for k in range(T)])
    logp = scipy.stats.multivariate_normal(centre, s).logpdf(y)
    return means, covs, z[N:].reshape(T - 1, M), spread[N:, N:], logp


@pytest.mark.parametrize("changing", [True, False])
def test_against_dense_linear_algebra(changing):
    rng = np.random.default_rng(3)
    model = model_of(rng, changing)
    readings, seen = rng.normal(size=(T, K)), rng.uniform(size=(T, K)) < 0.7
    mean, root = rng.normal(size=N), np.tril(rng.normal(size=(N, N)))
    means, covs, kicks, spread, logp = dense(model, readings, seen, mean, root)
    given = np.where(seen, readings, np.nan)
    found = linear_smooth(model, given, mean, root, seen)
    np.testing.assert_allclose(found.mean, means, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.covariance, covs, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.kicks, kicks, rtol=0, atol=1e-12)
    for k in range(T - 1):
        here = slice(M * k, M * k + M)
        np.testing.assert_allclose(found.kick_covariance[k], spread[here, here], rtol=0, atol=1e-12)
    assert abs(float(found.log_likelihood) - logp) < 1e-11
    passed = linear_filter(model, given, mean, root, seen)
    np.testing.assert_allclose(passed.mean[-1], means[-1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(passed.covariance[-1], covs[-1], rtol=0, atol=1e-12)
    assert abs(float(passed.log_likelihood) - logp) < 1e-11


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


def test_what_is_refused():
    eye = np.eye(2)
    with pytest.raises(ValueError, match=r"deviation: wanted positive.*singular"):
        LinearModel(eye, eye, eye, [1.0, 0.0])
    with pytest.raises(ValueError, match="matrix: wanted shape"):
        LinearModel(eye, eye, np.ones((1, 3)), [1.0])
    model = LinearModel(np.ones((4, 2, 2)), eye, eye, [1.0, 1.0])
    with pytest.raises(ValueError, match="transition: wanted 2 rows for 3 times, got 4"):
        linear_filter(model, np.zeros((3, 2)), np.zeros(2), eye)
    good = LinearModel(eye, eye, eye, [1.0, 1.0])
    with pytest.raises(ValueError, match=r"readings: contains NaN.*mask it"):
        linear_filter(good, np.full((3, 2), np.nan), np.zeros(2), eye)
