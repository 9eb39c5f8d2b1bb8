"""Intervals where noise and widths are estimated from few errors: Student's."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.uncertainty.degrees_of_freedom import student_quantile

SPHERE = rj.Inertia.from_principal(1.0, 1.0, 1.0)


def two_gyros(few, *, count=60, noises=(0.02, 0.1), given=(False, False)):
    """Rates of a sphere by a gyro, and by one with a bias that reads `few` times: bias,
    interval.
    """
    random, times = np.random.default_rng(few), jnp.linspace(0.0, 1.0, count)
    first, second = (size * random.normal(size=(count, 3)) for size in noises)
    first, second = first + np.array([1.0, 0.2, -0.3]), second + np.array([1.3, 0.2, -0.4])
    seen = np.arange(count) < few
    kinds = [size if known else None for size, known in zip(noises, given, strict=True)]
    record = identify.Recording(
        times,
        (identify.Gyro(kinds[0]), first),
        (identify.Gyro(kinds[1], bias=[0.0, 0.0, 0.0]), second, seen),
    )
    bias = identify.Free(lambda s: s.sensors[1].bias, "bias")
    found = identify.fit(identify.Model(record, identify.Known(SPHERE), free=[bias]), starts=1)
    return found, first, second[seen]


@pytest.mark.parametrize(
    ("few", "given"), [(2, (False, False)), (30, (False, False)), (4, (True, False))]
)
def test_few_readings_of_unknown_noise_give_the_interval_of_student(few, given):
    """The bias is the difference of two means; a sensor has one noise for its three channels. The
    noise that is known worst counts: Welch's interval is a little narrower.
    """
    found, first, second = two_gyros(few, given=given)
    assert found.correlation <= 1.5
    parts, degrees = [], []
    for rows, known in zip((first, second), given, strict=True):
        freedom = np.inf if known else 3 * (len(rows) - 1)
        square = 0.02**2 if known else np.sum((rows - rows.mean(axis=0)) ** 2) / freedom
        parts.append(square / len(rows))
        degrees.append(freedom)
    welch = sum(parts) ** 2 / sum(p**2 / d for p, d in zip(parts, degrees, strict=True))
    half = scipy.stats.t.ppf(0.975, min(degrees)) * np.sqrt(sum(parts))
    assert 1.0 <= half / (scipy.stats.t.ppf(0.975, welch) * np.sqrt(sum(parts))) < 1.1
    middle = second.mean(axis=0) - first.mean(axis=0)
    np.testing.assert_allclose(found.noise[1], np.sqrt(parts[1] * len(second)), rtol=1e-3)
    for axis, wanted in zip("xyz", middle, strict=True):
        ends = found.interval()[f"bias {axis}"]
        np.testing.assert_allclose(ends, [wanted - half, wanted + half], rtol=2e-3, atol=1e-4)
    low, high = found.interval_of(lambda point: point.values["bias"])
    np.testing.assert_allclose([low, high], [middle - half, middle + half], rtol=2e-3, atol=1e-4)


def test_a_shared_number_of_few_recordings_has_the_interval_of_student():
    """Biases that scatter: their mean is known to the scatter of few, three numbers each."""
    count, random, times = 3, np.random.default_rng(3), jnp.linspace(0.0, 1.0, 20)
    states = rj.simulate(SPHERE, rj.Attitude([1.0, 0, 0, 0], [0.0, 0.0, 1.0]), times).ys
    own = 0.05 * random.normal(size=(count, 3))
    records = [
        identify.Recording(
            times,
            (identify.AttitudeSensor(1e-5), states.q),
            (identify.Gyro(1e-4, bias=[0.0, 0, 0]), np.asarray(states.omega) + bias),
        )
        for bias in own
    ]
    move = identify.Free(lambda s: s.sensors[1].bias, "bias", scale=0.1, spread="estimated")
    problem = identify.Model(records, identify.Known(SPHERE), free=[move])
    low, high = identify.fit(problem, starts=1).interval_of(lambda point: point.values["bias"])
    size = np.sqrt(np.sum((own - own.mean(axis=0)) ** 2) / (3 * (count - 1)))
    half = scipy.stats.t.ppf(0.975, 3 * (count - 1)) * size / np.sqrt(count)
    np.testing.assert_allclose(
        [low, high], own.mean(axis=0) + np.array([[-half], [half]]), rtol=0.02
    )


def test_a_number_that_a_prior_knows_takes_nothing_from_the_errors():
    random, times = np.random.default_rng(1), jnp.linspace(0.0, 1.0, 4)
    rates = 1.0 + 0.1 * random.normal(size=(4, 3))
    record = identify.Recording(times, (identify.Gyro(bias=[0.0, 0.0, 0.0]), rates))
    bias = identify.Free(lambda s: s.sensors[0].bias, "bias", prior=1e-6)
    found = identify.fit(identify.Model(record, identify.Known(SPHERE), free=[bias]), starts=1)
    wanted = np.sqrt(np.sum((rates - rates.mean(axis=0)) ** 2) / (3 * 3))
    np.testing.assert_allclose(found.noise[0], wanted, rtol=1e-3)


def test_quantiles():
    degrees = np.array([1.0, 2.0, 5.0, 300.0, np.inf])
    wanted = [*scipy.stats.t.ppf(0.95, degrees[:-1]), scipy.stats.norm.ppf(0.95)]
    np.testing.assert_allclose(student_quantile(0.9, degrees), wanted, rtol=1e-12)
    with pytest.raises(ValueError, match=r"level: wanted a level between 0 and 1, got 1\.96"):
        identify.fit(rj.datasets.toutatis.model()).quantities[0].interval(1.96)


@pytest.mark.parametrize(
    ("share", "loss"), [(0.0, identify.SoftL1(1.0)), (0.1, identify.Huber())], ids=["none", "many"]
)
def test_the_noise_beside_a_loss_is_that_of_ordinary_readings(share, loss):
    """Weighted squares gave half of it without outliers, and twice of it with a tenth of them."""
    random = np.random.default_rng(0)
    errors = 0.02 * random.normal(size=(300, 3))
    errors[random.random(300) < share] *= 20.0
    record = identify.Recording(jnp.linspace(0.0, 1.0, 300), (identify.Gyro(), 1.0 + errors))
    found = identify.fit(identify.Model(record, identify.Known(SPHERE), loss=loss), starts=1)
    # A tenth of outliers moves the median of the others to 0.556, and the noise by 8 %.
    np.testing.assert_allclose(found.noise[0], 0.02 * (1.0 + 0.8 * share), rtol=0.06)
