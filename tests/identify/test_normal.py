"""Normal equations without the numbers of one recording alone, beside the whole matrix."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.model.normal import NormalMatrix, OwnBlocks, normal_matrix
from rigidjax.identify.search.stages import blocks_at
from rigidjax.identify.uncertainty import covariance as uncertainty

RNG = np.random.default_rng(0)
TS = np.linspace(0.0, 2.0, 20)
BODY = rj.Inertia.from_principal(1.0, 1.6, 2.1)
BIAS = lambda s: s.sensors[0].bias
SCALE = lambda s: s.sensors[0].scale
SKEW = lambda s: s.sensors[0].skew


def records(count, noise=0.01):
    rng = np.random.default_rng(1)
    out = []
    for _ in range(count):
        omega = 3.0 * rng.normal(size=3)
        rates = np.asarray(rj.simulate(BODY, rj.Spin(omega), TS).ys.omega)
        gyro = identify.Gyro(noise, bias=np.zeros(3), scale=np.ones(3), skew=np.zeros(3))
        out.append(identify.Recording(TS, (gyro, rates + 0.01 * rng.normal(size=rates.shape))))
    return out


def several(count=9):
    """A problem with numbers of every kind: of all, of a group, of each, with deviations."""
    labels = ["a", "b", "c"] * (count // 3)
    free = [
        identify.Free(SCALE, "scale", scale=0.01, each=True, prior=0.1),
        identify.Free(BIAS, "bias", scale=0.02, each=labels, spread=0.01),
        identify.Free(SKEW, "skew", scale=0.01, prior=0.05),
    ]
    return identify.Model(records(count), identify.Ratios(), free=free)


def start_of(problem):
    return problem.start(BODY) + 0.01 * RNG.normal(size=problem.size)


def blocks_of(problem, dtype=float):
    where = np.asarray(problem.index.places)
    rows = RNG.normal(size=(problem.count, 30, 3, where.shape[1])).astype(dtype)
    return rows, where, problem.size, np.asarray(problem.index.alone)


def dense(rows, where, size):
    """JᵀJ by the definition: every row in the columns of all numbers."""
    out = np.zeros((size, size))
    for block, columns in zip(rows, where, strict=True):
        wide = np.zeros((block.shape[0] * block.shape[1], size + 1))
        for k, column in enumerate(columns):
            wide[:, column] += block.reshape(-1, columns.size)[:, k]
        out += wide[:, :size].T @ wide[:, :size]
    return out


def test_columns_of_one_recording_alone():
    problem = several()
    where, alone = np.asarray(problem.index.places), np.asarray(problem.index.alone)
    counts = np.bincount(where.ravel(), minlength=problem.size + 1)
    # Every number is one of a recording's.
    assert (counts[:-1] > 0).all()
    # Scale, rate and the deviation of the bias, each three numbers.
    assert alone.size == 9 and (counts[where[:, alone]] == 1).all()
    others = np.setdiff1d(np.arange(where.shape[1]), alone)
    assert (counts[where[:, others]] > 1).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_it_is_the_whole_matrix(dtype):
    problem = several()
    rows, where, size, alone = blocks_of(problem, dtype)
    wanted = dense(rows, where, size)
    exact = 2e-4 if dtype == np.float32 else 1e-11
    unit, more = (RNG.uniform(0.5, 2.0, size).astype(dtype) for _ in range(2))
    x, sides = RNG.normal(size=size).astype(dtype), RNG.normal(size=(size, 2)).astype(dtype)
    for own in (None, alone):
        found = normal_matrix((jnp.asarray(rows),), jnp.asarray(where), size, own)
        assert found.core.shape[0] == (size if own is None else size - own.size * problem.count)
        np.testing.assert_allclose(found.diagonal, np.diag(wanted), rtol=exact)
        np.testing.assert_allclose(found @ jnp.asarray(x), wanted @ x, rtol=exact, atol=100 * exact)
        whole = wanted * np.outer(unit, unit) + np.diag(more)
        made = found.scaled(jnp.asarray(unit)).add_diagonal(jnp.asarray(more))
        for side in (x, sides):
            solved = np.linalg.solve(whole, side)
            near = exact * np.abs(solved).max()
            np.testing.assert_allclose(made.solve(jnp.asarray(side)), solved, atol=near)
    body = np.zeros((2, size), dtype)
    body[:, :4] = RNG.normal(size=(2, 4))
    wider = found.add_rows(jnp.asarray(body))
    np.testing.assert_allclose(
        wider @ jnp.asarray(x), wanted @ x + body.T @ (body @ x), atol=100 * exact
    )


def test_a_matrix_that_is_not_positive_has_no_solution():
    core = jnp.asarray([[1.0, 2.0], [2.0, 1.0]])
    assert not jnp.isfinite(NormalMatrix(core).solve(jnp.ones(2))).all()
    own, sides = jnp.ones((1, 1, 1)), jnp.asarray([[[2.0]]])
    arrow = NormalMatrix(jnp.ones((1, 1)), OwnBlocks(own, sides, jnp.asarray([[1]])))
    assert not jnp.isfinite(arrow.solve(jnp.ones(2))).all()


def jacobian(linear):
    """The weighted Jacobian, row by row, in the columns of all numbers."""
    rows = [np.diag(linear.prior_weights), linear.extra_slopes]
    for block, where in zip(linear.weighted_jacobian, linear.places, strict=True):
        wide = np.zeros((len(block), linear.free_count + 1))
        np.add.at(wide.T, where, block.T)
        rows.append(wide[:, :-1])
    return np.concatenate(rows)


def linear_at(problem, sigma=0.01):
    start = start_of(problem)
    noise = (jnp.full((problem.count, 3), sigma),)
    return uncertainty.linearise(problem, start, noise, blocks_at(problem, start))


def near_a_guess():
    """A problem of one recording, with a prior of the body."""
    return identify.Model(records(1), identify.Ratios(), prior=identify.Entropic(BODY, 50.0))


@pytest.mark.parametrize("count", [1, 3, 9])
def test_the_covariance_is_the_inverse_of_the_information_and_the_sandwich_its_product(count):
    problem = several(count) if count > 1 else near_a_guess()
    linear = linear_at(problem)
    rows = jacobian(linear)
    wanted = np.linalg.pinv(rows) @ np.linalg.pinv(rows).T
    found = uncertainty.white_covariance(linear)
    size = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(
        found.determined / np.outer(size, size), wanted / np.outer(size, size), atol=1e-9
    )
    assert len(found.null_directions) == 0

    # The sandwich is the product of its definition.
    _, triangles = np.linalg.qr(linear.weighted_jacobian)
    meat = RNG.normal(size=(count, triangles.shape[2], triangles.shape[1]))
    meat = meat @ meat.swapaxes(1, 2)
    # Priors have their own information in the middle.
    middle = np.diag(linear.prior_weights**2) + linear.extra_slopes.T @ linear.extra_slopes
    for triangle, where, m in zip(triangles, linear.places, meat, strict=True):
        wide = np.zeros((len(triangle), linear.free_count + 1))
        wide[:, where] = triangle
        middle += wide[:, :-1].T @ m @ wide[:, :-1]
    wanted = found.determined @ middle @ found.determined
    sandwich = found.root.sandwich_covariance(triangles, linear.places, meat)
    size = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(
        sandwich / np.outer(size, size), wanted / np.outer(size, size), atol=1e-7
    )


def test_what_is_not_determined_is_found_in_the_shared_numbers_and_in_those_of_one_recording():
    # Free motion shows no scale, and a gyro without bias, scale and noise of its own none either:
    # of nine recordings the third has no weight at all.
    problem = identify.Model(records(9), identify.Tensor(1.0))
    linear = linear_at(problem)
    slopes = linear.slopes[0].copy()
    slopes[2] = 0.0
    linear = dataclasses.replace(linear, slopes=(slopes,))
    found = uncertainty.white_covariance(linear)
    rows = jacobian(linear)
    size = np.sqrt(np.sum(rows**2, axis=0))
    # A column of round-off is none.
    size = np.maximum(size, 1e-6 * size.max())
    assert (
        len(found.null_directions)
        == linear.free_count - np.linalg.matrix_rank(rows / size, 1e-8)
        == 4
    )
    reach = np.abs(rows @ found.null_directions.T).max(axis=0)
    assert (reach < 1e-7 * np.abs(rows).max()).all()
    # Within the others it is the inverse: H C H = H.
    half = rows / size
    information, covariance = half.T @ half, found.determined * np.outer(size, size)
    np.testing.assert_allclose(information @ covariance @ information, information, atol=1e-8)
    blind = np.isinf(np.diag(found.covariance))
    third = np.asarray(linear.places[2])[-3:]
    assert (
        blind[third].all()
        and blind[:6].any()
        and not blind[np.asarray(linear.places[3])[-3:]].any()
    )


def test_fewer_readings_than_numbers_are_told():
    few = [
        identify.Recording(TS[:2], (r.readings[0].sensor, r.readings[0].values[:2]))
        for r in records(9)
    ]
    free = [
        identify.Free(where, name, scale=0.01, each=True)
        for where, name in ((SKEW, "skew"), (SCALE, "scale"))
    ]
    linear = linear_at(identify.Model(few, identify.Ratios(), free=free))
    found = uncertainty.white_covariance(linear)
    # Six numbers read and nine of its own in each recording, and five of all.
    assert len(found.null_directions) == linear.free_count - 54 == 32


def test_many_recordings_are_fitted_as_few_are():
    problem = several(18)
    found = identify.fit(problem, starts=1)
    assert found.search.word == "found"
    blocks = blocks_at(problem, found.x)
    linear = uncertainty.linearise(problem, found.x, found.noises, blocks)
    step = found.determined_covariance @ linear.misfit_gradient
    # At the least misfit the gradient vanishes, in standard deviations.
    assert np.abs(step / np.sqrt(np.diag(np.asarray(found.determined_covariance)))).max() < 1e-3
