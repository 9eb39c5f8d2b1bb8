"""The posterior density, its transforms and its draws."""

import dataclasses
import functools
import re
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from identify.filtering import records
from once import filter_once, once

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.answer.answers import Answer
from rigidjax.identify.answer.parts import Assessment, BestPoint, Uncertainty
from rigidjax.identify.filtering.terms import curvature
from rigidjax.identify.model.model import error_jacobians
from rigidjax.identify.uncertainty.covariance import linearise

# The places of the initial rate among the parameters of `model`.
SPIN = slice(2, 5)


@functools.cache
def model():
    ts = jnp.linspace(0.0, 6.0, 60)
    real = once(jax.vmap(rj.exact.FreeBody(records.BODY, rj.Spin(records.START.omega))))(ts)
    omega = records.gyro(jax.random.key(3), real.omega, 0.02)
    record = identify.Recording(ts, (identify.Gyro(0.02), omega))
    return identify.Model(record, identify.PrincipalRatios())


@pytest.fixture(scope="module")
def fitted():
    """A fit as it might be, for a fit compiles long: the truth, and some covariance."""
    at = model().start(records.BODY, omega=records.START.omega)
    root = np.tril(np.random.default_rng(0).normal(size=(5, 5)))
    covariance = 1e-4 * (jnp.eye(5) + root @ root.T)
    nothing, noises = jnp.zeros((0, 5)), (jnp.full((1, 3), 0.02),)
    slopes = filter_once(error_jacobians)(model(), at)
    return identify.Fit(
        BestPoint(model(), at, noises),
        Uncertainty(covariance, covariance, "", nothing),
        Assessment(Answer("found"), Answer("explains the readings"), (), 0.0, 1, 1.0),
        (), (), linearise(model(), at, noises, slopes),
    )  # fmt: skip


def changed(fit, **fields):
    """A fit with other fields of its parts, by their names there."""
    for name in ("point", "uncertainty"):
        part = getattr(fit, name)
        own = {key: fields.pop(key) for key in list(fields) if hasattr(part, key)}
        fit = dataclasses.replace(fit, **{name: dataclasses.replace(part, **own)})
    assert not fields
    return fit


def places_of(density, count):
    """The places in x of the last numbers that a density adds to those of the fit."""
    return [int(slot.shared.item()) for slot in density.model.slots[-count:]]


@functools.cache
def whole_fit():
    return identify.fit(model(), starts=1)


def test_without_a_process_it_is_normal_about_the_motion(fitted):
    density = identify.LogDensity(fitted)
    assert density.size == 5
    x = density.x0 + 0.01
    errors = fitted.model.errors(x)
    wanted = sum(scipy.stats.norm.logpdf(e, scale=0.02).sum() for e in errors)
    assert abs(float(density(x)) / wanted - 1) < 1e-12
    np.testing.assert_allclose(density.covariance, fitted.covariance)
    np.testing.assert_allclose(density.unpack(density.x0).body.tensor, fitted.body.tensor)


def test_its_width_is_that_of_white_errors_whatever_the_intervals_allow_for(fitted):
    wide = changed(fitted, kind="sandwich: the errors are autocorrelated")
    density = identify.LogDensity(wide)
    columns, h = [], 1e-5
    for step in h * np.eye(5):
        up, down = (density.unpack(density.x0 + s * step).x for s in (1, -1))
        apart = model().errors(up)[0] - model().errors(down)[0]
        columns.append(np.ravel(apart) / (2 * h * 0.02))
    wanted = np.linalg.inv(np.array(columns) @ np.array(columns).T)
    np.testing.assert_allclose(density.covariance, wanted, rtol=1e-4, atol=1e-4 * np.max(wanted))
    # A torque that is integrated out makes it wide again: there the sandwich is nearer.
    integrated = identify.LogDensity(wide, rj.torques.RandomTorque(1e-4), deviation=None)
    np.testing.assert_allclose(integrated.covariance, fitted.covariance)
    # Unless it is singular, which has no root.
    flat = changed(wide, covariance=1e-4 * jnp.ones((5, 5)))
    integrated = identify.LogDensity(flat, rj.torques.RandomTorque(1e-4), deviation=None)
    np.testing.assert_allclose(integrated.covariance, density.covariance)


def test_a_noise_that_is_unknown_is_one_number_as_in_the_fit(fitted):
    record = model().recordings[0]
    unknown = (identify.Gyro(), record.readings[0].values)
    other = identify.Model(identify.Recording(record.t, unknown), identify.PrincipalRatios())
    density = identify.LogDensity(changed(fitted, model=other))
    assert density.size == 6
    (place,) = places_of(density, 1)
    np.testing.assert_allclose(density.covariance[place, place], 1 / (2 * 180))
    x = density.x0.at[place].set(np.log(2.0))
    wanted = scipy.stats.norm.logpdf(model().errors(fitted.x)[0], scale=0.04).sum()
    np.testing.assert_allclose(density(x), wanted, rtol=1e-12)
    np.testing.assert_allclose(density.unpack(x).noise[0], 0.04)


@pytest.mark.oldest
def test_its_gradient_is_right(fitted):
    """Through its own rule and that of the errors, recording by recording: central differences."""
    density = identify.LogDensity(fitted)
    x, h = np.asarray(density.x0) + 0.01, 1e-5
    value = jax.jit(lambda x: density(x))
    slope = jax.jit(jax.grad(lambda x: density(x)))(x)
    far = [(float(value(x + d)) - float(value(x - d))) / (2 * h) for d in h * np.eye(x.size)]
    np.testing.assert_allclose(slope, far, rtol=1e-5, atol=1e-5 * np.abs(far).max())


def test_its_gradient_over_a_batch_of_draws_is_that_of_each(fitted):
    """The noises do not move with x: in the batch they are shared, in the derivative they are not."""
    density = identify.LogDensity(fitted)
    x = density.x0[None] + 0.01 * jnp.arange(3.0)[:, None]
    each = jax.jit(lambda x: density(x))
    found, wanted = jax.jit(
        lambda x: (
            jax.grad(lambda x: jnp.sum(jax.vmap(each)(x)))(x),
            jax.vmap(jax.grad(density))(x),
        )
    )(x)
    np.testing.assert_allclose(found, wanted, rtol=1e-10, atol=1e-10 * jnp.abs(wanted).max())
    # A compiled function of the density itself.
    whole = eqx.filter_jit(lambda density, x: density(x))
    found = jax.grad(lambda x: whole(density, x))(x[0])
    np.testing.assert_allclose(found, wanted[0], rtol=1e-10, atol=1e-10 * jnp.abs(wanted).max())


@pytest.mark.slow
def test_a_process_of_no_density_changes_nothing(fitted):
    plain = identify.LogDensity(fitted)
    with_one = identify.LogDensity(fitted, rj.torques.RandomTorque(0.0), deviation=None)
    x = plain.x0 + 0.01
    # Equal steps of the classical method against the closed form.
    assert abs(float(with_one(x) / plain(x)) - 1) < 1e-6
    step = 1e-6
    slope = jax.grad(with_one)(x)
    up, down = (with_one(x.at[0].add(sign * step)) for sign in (1, -1))
    np.testing.assert_allclose(slope[0], (up - down) / (2 * step), rtol=1e-4)


def test_a_density_that_is_unknown_is_one_number_more(fitted):
    density = identify.LogDensity(fitted, rj.torques.RandomTorque(1e-4), deviation=2.0)
    assert density.size == 6
    (place,) = places_of(density, 1)
    x = density.x0.at[place].set(jnp.log(3.0))
    np.testing.assert_allclose(density.unpack(x).process.density, 3e-4)
    known = identify.LogDensity(fitted, rj.torques.RandomTorque(3e-4), deviation=None)
    prior = -0.5 * (np.log(3.0) / 2.0) ** 2
    np.testing.assert_allclose(density(x), known(jnp.delete(x, place)) + prior, rtol=1e-12)


def test_the_process_of_the_model_is_that_of_the_density(fitted):
    record, chart = model().recording, identify.PrincipalRatios()
    process = rj.torques.RandomTorque(1e-4)
    other = changed(fitted, model=identify.Model(record, chart, process=process))
    ours, wanted = identify.LogDensity(other), identify.LogDensity(fitted, process)
    assert ours.size == 6
    x = wanted.x0 + 0.01
    np.testing.assert_allclose(ours(x), wanted(x), rtol=1e-14)
    # The filter at x is that of the density.
    scene = ours.model
    known = identify.first_belief(scene, x, rate=0.0)
    of_filter = identify.log_likelihood(scene, known, x, substeps=scene.filter_steps)
    prior = -0.5 * float(0.01 / 2.0) ** 2
    np.testing.assert_allclose(of_filter + prior, ours(x), rtol=1e-12)
    # The model itself has fewer numbers, and a fit of it leaves the torque out: both are said.
    for use in (other.model.unpack, lambda x: identify.filter(other.model, known, x)):
        with pytest.raises(ValueError, match=r"got shape \(6,\).*goes with density.model"):
            use(x)
    assert re.search("takes the unknown torque as zero: .*filter.* identify.refit", other.advice)
    assert "as zero" not in fitted.advice


def test_a_process_of_two_parts_has_the_numbers_of_both(fitted):
    white, coloured = rj.torques.RandomTorque(1e-4), rj.torques.CorrelatedTorque(1e-3, 0.5)
    density = identify.LogDensity(fitted, rj.torques.Sum(white, coloured))
    assert density.size == 8
    factors = jnp.log(jnp.array([2.0, 3.0, 4.0]))
    x = density.x0.at[jnp.array(places_of(density, 3))].set(factors)
    point = once(lambda x: density.unpack(x))(x)
    parts = point.process.parts
    np.testing.assert_allclose(parts[0].density, 2e-4)
    np.testing.assert_allclose(parts[1].density, 3e-3)
    np.testing.assert_allclose(parts[1].time, 2.0)
    assert {"density 0", "density 1", "time 1"} <= set(point.values)


def test_a_walk_without_drift_is_a_bias_that_is_integrated_out(fitted):
    """The covariance of the readings has one more part, the same at all times: dense algebra."""
    record, deviation = model().recording, 0.05
    gyro = identify.Gyro(0.02, bias=[0.0, 0.0, 0.0])
    seen = identify.Recording(record.t, (gyro, record.readings[0].values))
    walk = identify.Walk(lambda s: s.sensors[0].bias, deviation)
    other = identify.Model(seen, identify.PrincipalRatios(), walks=[walk])
    density = identify.LogDensity(changed(fitted, model=other))
    x = density.x0 + 0.01
    errors, found = once(lambda x: (model().errors(x)[0], density(x)))(x)
    times = len(errors)
    covariance = 0.02**2 * np.eye(times) + deviation**2 * np.ones((times, times))
    logs = scipy.stats.multivariate_normal(np.zeros(times), covariance).logpdf(np.asarray(errors).T)
    # Fixed steps of the filter against the closed form.
    assert abs(float(found) / logs.sum() - 1) < 1e-6


def test_a_noise_that_is_unknown_moves_no_other_number(fitted):
    # Inside the filter the sensor has a noise, and with it one leaf more than in the problem.
    record = model().recordings[0]
    bias = identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.1, prior=0.1)
    values = []
    for noise in (None, 0.02):
        gyro = identify.Gyro(noise, bias=[0.01, -0.02, 0.03])
        seen = identify.Recording(record.t, (gyro, record.readings[0].values))
        other = identify.Model(seen, identify.PrincipalRatios(), free=[bias])
        at = other.start(records.BODY, omega=records.START.omega)
        at = at.at[other.slots[0].shared[0]].set(jnp.array([1.0, -1.0, 0.5]))
        covariance = 1e-4 * jnp.eye(8)
        found = changed(
            fitted, model=other, x=at, covariance=covariance, determined=covariance,
            null_directions=jnp.zeros((0, 8)),
        )  # fmt: skip
        with_one = identify.LogDensity(found, rj.torques.RandomTorque(1e-4), deviation=None)
        values.append(float(with_one(with_one.x0)))
    np.testing.assert_allclose(values[0], values[1], rtol=1e-12)


@pytest.mark.oldest
def test_the_gradient_with_a_process_is_right_recording_by_recording(fitted):
    """Noise, a shared bias with deviations and the process: central differences."""
    record = model().recordings[0]
    reading = identify.Gyro(bias=[0.0, 0.0, 0.0]), record.readings[0].values
    cut = [
        identify.Recording(record.t[k : k + 12], (reading[0], reading[1][k : k + 12]))
        for k in (0, 20)
    ]
    bias = identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.1, spread=0.1)
    both = identify.Model(cut, identify.PrincipalRatios(), free=[bias], noise_each=True)
    at = both.start(records.BODY)
    size = at.size
    covariance = 1e-4 * jnp.eye(size)
    found = changed(
        fitted, model=both, x=at, covariance=covariance, determined=covariance,
        noises=(jnp.full((2, 3), 0.02),), null_directions=jnp.zeros((0, size)),
    )  # fmt: skip
    density = identify.LogDensity(found, rj.torques.RandomTorque(1e-3))
    assert density.size == size + 2 + 1
    x, h = np.asarray(density.x0) + 0.01, 1e-5
    slope, ahead = jax.jit(lambda x: (jax.grad(density)(x), jax.jacfwd(density)(x)))(x)
    np.testing.assert_allclose(slope, ahead, rtol=1e-12, atol=1e-12 * np.abs(slope).max())
    steps = h * jnp.eye(x.size)
    moved = jax.jit(jax.vmap(density))(jnp.concatenate([x[None] + steps, x[None] - steps]))
    far = (moved[: x.size] - moved[x.size :]) / (2 * h)
    np.testing.assert_allclose(slope, far, rtol=1e-5, atol=1e-6 * np.abs(far).max())


def test_any_sampler_will_do(fitted):
    def laplace(key, density, start):
        """Independent draws of the normal distribution that the numbers are scaled to."""
        assert np.isfinite(jax.eval_shape(density, start).size)
        return jax.random.normal(key, (500, start.size))

    density = identify.LogDensity(fitted)
    drawn = identify.posterior(density, jax.random.key(0), sampler=laplace)
    assert drawn.x.shape == (4, 500, 5)
    np.testing.assert_allclose(drawn.x.mean((0, 1)), density.x0, atol=5e-3)
    spread = np.cov(np.asarray(drawn.x).reshape(-1, 5).T)
    np.testing.assert_allclose(np.diagonal(spread), np.diagonal(fitted.covariance), rtol=0.2)
    # Independent draws are worth about what they are.
    assert (drawn.rhat < 1.01).all() and (np.abs(drawn.ess / 2000 - 1) < 0.3).all()
    assert drawn.points.body.tensor.shape == (4, 500, 3, 3)
    # A draw's moments are roots of its own tensor, which those of a batch of bodies are not.
    moments = drawn.map(lambda point: point.body.moments)
    one = np.linalg.eigvalsh(drawn.points.body.tensor[2, 7])
    np.testing.assert_allclose(moments[2, 7], one, rtol=1e-9)


def test_chains_of_many_recordings_are_those_of_their_keys_too(fitted):
    many = identify.Model([model().recordings[0]] * 8, identify.PrincipalRatios())
    at = many.start(records.BODY)
    covariance = jnp.diag(jnp.linspace(1e-4, 1e-2, 26))
    found = changed(
        fitted, model=many, x=at, covariance=covariance, determined=covariance,
        noises=(jnp.full((8, 3), 0.02),), null_directions=jnp.zeros((0, 26)),
    )  # fmt: skip

    def laplace(key, density, start):
        return jax.random.normal(key, (500, start.size))

    drawn = identify.posterior(identify.LogDensity(found), jax.random.key(0), sampler=laplace)
    assert drawn.x.shape == (4, 500, 26)
    np.testing.assert_allclose(drawn.x.var((0, 1)), np.diagonal(covariance), rtol=0.2)
    assert len(np.unique(np.asarray(drawn.x[:, 0, 0]))) == 4


def test_draws_that_depend_on_the_last_are_worth_less(fitted):
    rho = 0.8

    def slow(key, density, start):
        def step(z, key):
            z = rho * z + np.sqrt(1 - rho**2) * jax.random.normal(key, z.shape)
            return z, z

        return jax.lax.scan(step, start, jax.random.split(key, 4000))[1]

    drawn = identify.posterior(identify.LogDensity(fitted), jax.random.key(1), sampler=slow)
    wanted = 16000 * (1 - rho) / (1 + rho)
    assert (np.abs(drawn.ess / wanted - 1) < 0.3).all()


@pytest.mark.parametrize("acceptance", [0.8, 0.65])
def test_nuts_draws_from_a_normal_distribution(acceptance):
    root = np.array([[1.0, 0.0], [1.5, 0.5]])
    inverse = np.linalg.inv(root @ root.T)
    sampler = identify.Nuts(samples=2000, warmup=300, acceptance=acceptance)
    draw = jax.jit(lambda key: sampler(key, lambda z: -0.5 * z @ inverse @ z, jnp.zeros(2)))
    # blackjax leans on the promotions that our tests forbid.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        drawn = np.asarray(draw(jax.random.key(0)))
    assert drawn.shape == (2000, 2)
    np.testing.assert_allclose(drawn.mean(0), 0.0, atol=0.2)
    np.testing.assert_allclose(np.cov(drawn.T), root @ root.T, atol=0.35)


def test_without_arviz_the_way_to_it_is_named(fitted, monkeypatch):
    """On Python 3.11 there is none: the extra leaves it out."""
    monkeypatch.setitem(sys.modules, "arviz", None)
    density = identify.LogDensity(fitted, rj.torques.RandomTorque(1e-4), deviation=2.0)
    drawn = identify.Posterior(density, density.x0[None, None])
    words = r"to_arviz: arviz is missing; in the clone: pip install '.\[posterior\]'$"
    if sys.version_info < (3, 12):
        words = "to_arviz: arviz needs Python 3.12 or later"
    with pytest.raises(ModuleNotFoundError, match=words):
        drawn.to_arviz()


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # entries that are constant
def test_draws_go_to_arviz(fitted):
    arviz = pytest.importorskip("arviz")
    density = identify.LogDensity(fitted, rj.torques.RandomTorque(1e-4), deviation=2.0)
    x = density.x0[None, None] + 0.01 * jax.random.normal(jax.random.key(0), (4, 50, density.size))
    drawn = identify.Posterior(density, x)
    table = drawn.to_arviz()
    assert {"inertia[0, 0]", "density[0]"} <= set(arviz.summary(table).index)
    assert table["posterior"]["omega0"].shape[:2] == (4, 50)
    np.testing.assert_allclose(table["posterior"]["density"], drawn.points.process.density)


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_several_bodies_go_to_arviz_by_name(fitted):
    arviz = pytest.importorskip("arviz")
    record = model().recordings[0]
    chart = identify.PrincipalRatios()
    both = identify.Model({"a": record, "b": record}, {"a": chart, "b": chart})
    at = both.start({"a": records.BODY, "b": records.BODY})
    size = at.size
    covariance = 1e-4 * jnp.eye(size)
    noises = (jnp.full((2, 3), 0.02),)
    found = changed(
        fitted, model=both, x=at, covariance=covariance, determined=covariance, noises=noises,
        null_directions=jnp.zeros((0, size)),
    )  # fmt: skip
    density = identify.LogDensity(found)
    x = density.x0[None, None] + 0.01 * jax.random.normal(jax.random.key(0), (2, 8, size))
    table = identify.Posterior(density, x).to_arviz()
    assert {"inertia [a]", "inertia [b]"} <= set(table["posterior"].data_vars)
    assert "inertia [a][0, 0]" in arviz.summary(table).index


@pytest.mark.usefixtures("unhooked")
def test_what_is_refused(fitted):
    with pytest.raises(TypeError, match="density: wanted LogDensity"):
        identify.posterior(fitted, jax.random.key(0))
    for wrong in (0.0, 1.0, -0.5):
        with pytest.raises(ValueError, match="acceptance: wanted"):
            identify.Nuts(acceptance=wrong)
    with pytest.raises(TypeError, match="process: wanted a RandomTorque, a CorrelatedTorque"):
        identify.LogDensity(fitted, records.BODY)


def test_without_blackjax_it_says_what_is_missing(fitted, monkeypatch):
    monkeypatch.setitem(sys.modules, "blackjax", None)
    with pytest.raises(ImportError, match="blackjax is missing"):
        identify.posterior(identify.LogDensity(fitted), jax.random.key(0))


@pytest.mark.slow
def test_a_fit_of_what_is_well_determined_is_found_again():
    fitted = whole_fit()
    found = identify.refit(identify.LogDensity(fitted))
    assert found.converged
    deviation = np.sqrt(np.diagonal(fitted.covariance))
    np.testing.assert_allclose(found.x, found.density.x0, atol=1e-2 * deviation.min())
    np.testing.assert_allclose(np.sqrt(np.diagonal(found.covariance)), deviation, rtol=0.05)
    low, high = found.interval_of(shape)
    wanted = np.log([fitted.interval()[name] for name in ("Ix/Iz", "Iy/Iz")]).T
    # The fit's reach is Student's.
    np.testing.assert_allclose([low, high], wanted, atol=0.1 * (high - low).max())


def shape(point):
    """Logarithms of the two ratios of moments."""
    i = jnp.diagonal(point.body.tensor)
    return jnp.log(jnp.stack([i[0] / i[2], i[1] / i[2]]))


@pytest.mark.slow
def test_a_torque_that_the_fit_knows_nothing_of():
    # Nine tenths of the misfit is the torque's: the plain fit is refused, this one holds the truth.
    process = rj.torques.RandomTorque(1e-3)
    ts = jnp.linspace(0.0, 4.0, 80)
    made = []
    for k in range(3):
        keys = jax.random.split(jax.random.key(k), 2)
        spin = rj.Spin(records.START.omega + 0.3 * k)
        real = records.truth(keys[0], process, spin, ts, 2)
        omega = records.gyro(keys[1], real.states.omega, 0.02)
        made.append(identify.Recording(ts, (identify.Gyro(0.02), omega)))
    plain = identify.fit(identify.Model(made, identify.PrincipalRatios()), starts=2)
    assert not plain.ok
    found = identify.refit(identify.LogDensity(plain, rj.torques.RandomTorque(1e-4)))
    assert found.converged

    low, high = found.interval_of(shape, 0.999)
    wanted = np.log([1 / 2.5, 2 / 2.5])
    assert (low < wanted).all() and (wanted < high).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_nuts_agrees_with_the_fit_where_it_is_well_determined():
    fitted = whole_fit()
    pytest.importorskip("blackjax")
    density = identify.LogDensity(fitted)
    # blackjax leans on the promotions that our tests forbid.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        drawn = identify.posterior(density, jax.random.key(0), sampler=identify.Nuts(500, 300))
    assert (drawn.rhat < 1.01).all() and (drawn.ess > 500).all()
    x = np.asarray(drawn.x).reshape(-1, density.size)
    deviation = np.sqrt(np.diagonal(fitted.covariance))
    np.testing.assert_allclose(x.mean(axis=0), density.x0, atol=0.3 * deviation.max())
    np.testing.assert_allclose(x.std(axis=0), deviation, rtol=0.15)


def test_weighted_draws_stand_for_the_density(fitted):
    # Nearly normal here: the draws have the mean and the covariance of the curvature.
    density = identify.LogDensity(fitted)
    found = identify.refit(density, draws=4000, key=jax.random.key(1))
    assert found.draws.shape == (4000, density.size) and found.effective_count > 1500
    np.testing.assert_allclose(found.weights.sum(), 1.0)
    # Each weight is as large as the density over that of the t, whose logarithm is written out.
    root = 1.2 * np.linalg.cholesky(found.covariance)
    far = np.linalg.solve(root, (np.asarray(found.draws) - np.asarray(found.x)).T)
    proposed = scipy.stats.multivariate_t.logpdf(far.T, df=6, shape=np.eye(density.size))
    logs = np.asarray([density(x) for x in found.draws[:5]]) - proposed[:5]
    np.testing.assert_allclose(np.diff(np.log(found.weights[:5])), np.diff(logs), atol=1e-8)
    deviation = np.sqrt(np.diagonal(found.covariance))
    draws, weights = np.asarray(found.draws), np.asarray(found.weights)
    mean = weights @ draws
    np.testing.assert_allclose((mean - np.asarray(found.x)) / deviation, 0.0, atol=0.15)
    apart = (draws - mean) / deviation
    spread = (weights[:, None] * apart).T @ apart
    wanted = np.asarray(found.covariance) / np.outer(deviation, deviation)
    np.testing.assert_allclose(spread, wanted, atol=0.15)
    ratio = found.interval_of(lambda point: point.body.moments[0] / point.body.moments[2])
    assert [end.shape for end in ratio] == [(), ()] and 0.35 < ratio[0] < 0.4 < ratio[1] < 0.45
    # Where the draws are worth nothing the curvature is taken: what is linear in x is normal.
    one = jnp.zeros_like(found.weights).at[0].set(1.0)
    poor = eqx.tree_at(lambda f: f.weights, found, one)
    low, high = poor.interval_of(lambda point: point.x[SPIN])
    at = poor.point.x[SPIN]
    np.testing.assert_allclose(0.5 * (low + high), at, atol=1e-12)
    low2, high2 = found.interval_of(lambda point: point.x[SPIN])
    np.testing.assert_allclose(high2 - low2, high - low, rtol=0.15)
    early = eqx.tree_at(lambda f: f.converged, poor, jnp.asarray(False))
    with pytest.raises(TypeError, match="wanted numbers that vary smoothly, got int"):
        poor.interval_of(lambda point: jnp.argmax(point.body.moments))
    with pytest.raises(ValueError, match="the search did not reach the maximum"):
        early.interval_of(lambda point: point.x[SPIN])
    with pytest.raises(ValueError, match="draws: wanted"):
        identify.refit(density, draws=0)


@pytest.mark.parametrize("process", [None, rj.torques.RandomTorque(0.03 / 11)])
def test_the_information_is_the_covariance_of_the_gradient(fitted, process):
    """At the truth, over readings made by the model: with noise and torque among the numbers."""
    ts, many = 0.1 * jnp.arange(25, dtype=float), 400
    # The ratios of `records.BODY`, as large as `PrincipalRatios` makes them.
    body = rj.Inertia.from_principal(4.0 / 11, 8.0 / 11, 10.0 / 11)

    seen = identify.Recording(ts, (identify.Gyro(), jnp.ones((25, 3))))
    other = identify.Model(seen, identify.PrincipalRatios())
    at = other.start(records.BODY, omega=records.START.omega)
    found = changed(fitted, model=other, x=at)
    density = identify.LogDensity(found, process, deviation=50.0)

    def one(key):
        keys = jax.random.split(key, 2)
        torque = rj.torques.RandomTorque(0.0) if process is None else process
        real = records.truth(keys[0], torque, rj.Spin(records.START.omega), ts, 2, body=body)
        omega = records.gyro(keys[1], real.states.omega, 0.02)
        where = lambda d: d.model.records.readings[0].values
        return curvature(eqx.tree_at(where, density, omega[None]).model, density.x0)

    keys = jax.random.split(jax.random.key(5), many)
    found = jax.jit(lambda keys: jax.lax.map(one, keys))(keys)
    root = np.linalg.cholesky(np.mean(found.gram, axis=0))
    normal = np.linalg.solve(root, np.asarray(found.slope).T)
    assert normal.shape[0] == (6 if process is None else 7)
    # Mean squares of independent standard normal numbers, to four of their deviations.
    np.testing.assert_allclose(
        normal @ normal.T / many, np.eye(len(root)), atol=4 * np.sqrt(2 / many)
    )


def test_a_fit_that_failed_without_the_torque_is_refused_with_the_way_out(fitted):
    lost = changed(fitted, covariance=jnp.full((5, 5), jnp.inf))
    with pytest.raises(ValueError, match=r"fewer parameters\. *"):
        identify.LogDensity(lost)
    with pytest.raises(ValueError, match="begin from a first guess"):
        identify.LogDensity(lost, rj.torques.RandomTorque(1e-4))
