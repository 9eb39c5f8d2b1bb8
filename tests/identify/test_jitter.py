"""Time stamps that scatter: whitened errors against NumPy, and simulated throws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.filtering.steps import require_sensors
from rigidjax.identify.model.terms import decorrelate

BODY = rj.Inertia.from_principal(1.0, 1.6, 2.1)
TRUTH = np.array([1.0 / 2.1, 1.6 / 2.1])
TS = np.linspace(0.0, 1.0, 101)
TAU, SIGMA, THROWS = 5e-3, 0.02, 40


def throw(seed, tau=TAU):
    """Rates of a throw at 8 rad/s, each read at a time of its own."""
    way = np.random.default_rng(seed).normal(size=3)
    start = rj.Spin(8.0 * way / np.linalg.norm(way))
    gyro = identify.Gyro(SIGMA, jitter=tau)
    return identify.simulate_readings(gyro, BODY, start, TS, key=jax.random.key(seed))


def fitted(gyro, rates):
    record = identify.Recording(TS, (gyro, rates))
    return identify.fit(identify.Model(record, identify.PrincipalRatios()), starts=1)


@jax.jit
def decorrelated(e, v):
    slope = jax.jacfwd(lambda e: decorrelate(e, v)[0])
    return *decorrelate(e, v), slope(e)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("size", [0.0, 1e-3, 1.0, 1e3])
def test_independent_errors_are_those_of_choleskys_factor(dtype, size):
    rng = np.random.default_rng(0)
    for k in (1, 2, 3):
        e, v = rng.normal(size=(2, k)).astype(dtype)
        v = (size * v).astype(dtype)
        covariance = np.eye(k) + np.outer(v.astype(float), v.astype(float))
        lower = np.linalg.cholesky(covariance)
        found, logs, slope = decorrelated(jnp.asarray(e), jnp.asarray(v))
        digits = 1e-9 if dtype is np.float64 else 2e-4
        wanted, scale = np.linalg.inv(lower), max(1.0, size)
        np.testing.assert_allclose(found, wanted @ e, rtol=digits, atol=digits)
        np.testing.assert_allclose(slope, wanted, rtol=digits, atol=digits)
        np.testing.assert_allclose(np.exp(logs.sum()), np.linalg.det(covariance), rtol=digits)
        # The length is that of Σ^(-1/2) e.
        values, ways = np.linalg.eigh(covariance)
        length = np.sum((ways.T @ e) ** 2 / values)
        np.testing.assert_allclose(np.sum(np.asarray(found) ** 2), length, rtol=digits * scale)


def test_throws_with_scattered_stamps_have_right_intervals():
    plain, errors, held, good, named = [], [], [], 0, []
    for seed in range(THROWS):
        rates = throw(seed)
        for gyro, out in (
            (identify.Gyro(SIGMA), plain),
            (identify.Gyro(SIGMA, jitter=TAU), errors),
        ):
            found = fitted(gyro, rates)
            out.append(np.log([q.value for q in found.quantities[:2]] / TRUTH))
            if gyro.jitter is None:
                # The remedy says how much jitter to give.
                remedies = [c.remedy for c in found.causes if c.name == "clock"]
                named += [float(text.rsplit("jitter=")[1]) for text in remedies]
        good += found.ok
        ends = np.array([found.interval()[q.name] for q in found.quantities[:2]])
        held.append((ends[:, 0] <= TRUTH) & (ends[:, 1] >= TRUTH))
        assert not found.causes
    before, after = (np.sqrt(np.mean(np.square(x))) for x in (plain, errors))
    print(good, before, after, np.mean(held), len(named), np.mean(named), np.std(named))
    assert good >= 0.9 * THROWS and after < 0.8 * before
    assert 0.9 <= np.mean(held) <= 0.99
    assert len(named) > 0.8 * THROWS and abs(np.mean(named) / TAU - 1) < 0.1


def test_an_unknown_noise_beside_a_given_jitter():
    found = fitted(identify.Gyro(jitter=TAU), throw(2))
    assert found.ok and abs(found.noise[0][0] / SIGMA - 1) < 0.2
    plain = fitted(identify.Gyro(), throw(2))
    assert identify.compare({"plain": plain, "jitter": found})[0].name == "jitter"
    # Errors stay those of the readings.
    np.testing.assert_allclose(found.rms, plain.rms, rtol=0.1)


def test_a_known_jitter_widens_what_is_expected():
    def deviation(jitter):
        record = identify.Recording(TS, (identify.Gyro(SIGMA, jitter=jitter), np.ones((101, 3))))
        problem = identify.Model(record, identify.PrincipalRatios())
        plan = problem.start(BODY, [5.0, 4.0, 4.0])
        return identify.expected_quantities(problem, plan)[0].deviation

    assert 1.05 * deviation(None) < deviation(TAU)


def test_channels_at_full_scale_beside_a_jitter():
    rates = np.clip(throw(0), -6.0, 6.0)
    assert (np.abs(rates).max(axis=1) == 6.0).mean() > 0.9
    found = fitted(identify.Gyro(jitter=TAU, limit=6.0), rates)
    assert found.ok and abs(found.noise[0][0] / SIGMA - 1) < 0.2


@pytest.mark.parametrize("wrong", [-1e-3, 0.0, np.nan])
def test_a_wrong_jitter_is_refused_in_words(wrong):
    with pytest.raises(ValueError, match="jitter: wanted a positive number of seconds"):
        identify.Gyro(SIGMA, jitter=wrong)


def test_where_jitter_has_no_meaning_it_is_refused_in_words():
    with pytest.raises(ValueError, match="jitter"):
        require_sensors([identify.Gyro(SIGMA, jitter=TAU)])


def test_the_log_density_is_that_of_the_full_covariance():
    found = fitted(identify.Gyro(SIGMA, jitter=TAU), throw(3))
    wanted = 0.0
    late = np.asarray(found.model.records.readings[0].jitter_error[0])
    for e, v in zip(np.asarray(found.residuals[0]), late, strict=True):
        covariance = SIGMA**2 * np.eye(3) + np.outer(v, v)
        wanted -= 0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1]
        wanted -= 0.5 * e @ np.linalg.solve(covariance, e)
    density = identify.LogDensity(found)
    np.testing.assert_allclose(density(density.x0), wanted, rtol=1e-10)
