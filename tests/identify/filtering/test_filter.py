"""The filter against dense linear algebra, against itself, and on what it must refuse."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.stats
from identify.filtering import records
from once import filter_once, once

import rigidjax as rj
from rigidjax import identify

DT, COUNT = 0.1, 12


def van_loan(a, b, h):
    """exp(a h) and the covariance that white noise through b gathers in h: Van Loan 1978."""
    n = a.shape[0]
    big = np.block([[-a, b @ b.T], [np.zeros((n, n)), a.T]])
    e = scipy.linalg.expm(big * h)
    grown = e[n:, n:].T
    return grown, grown @ e[:n, n:]


def dense(grown, strewn, matrix, variance, cov0, mean0, readings):
    """Means and covariances of all states given all readings, and the log-density: no recursion."""
    n, count = len(mean0), len(readings)
    means, blocks = [mean0], [cov0]
    for _ in range(count - 1):
        means.append(grown @ means[-1])
        blocks.append(grown @ blocks[-1] @ grown.T + strewn)
    cov = np.zeros((count * n, count * n))
    for i in range(count):
        for j in range(i + 1):
            c = np.linalg.matrix_power(grown, i - j) @ blocks[j]
            cov[i * n : i * n + n, j * n : j * n + n] = c
            cov[j * n : j * n + n, i * n : i * n + n] = c.T
    h = np.kron(np.eye(count), matrix)
    mean, y = np.concatenate(means), readings.reshape(-1)
    s = h @ cov @ h.T + np.kron(np.eye(count), np.diag(variance))
    gain = np.linalg.solve(s, h @ cov).T
    after = mean + gain @ (y - h @ mean)
    spread = cov - gain @ h @ cov
    logp = scipy.stats.multivariate_normal(h @ mean, s).logpdf(y)
    return after.reshape(count, n), spread, logp


def test_a_sphere_with_a_torque_that_remembers_and_a_bias_that_drifts_is_a_linear_model():
    # Ω, τ, bias in one number about each axis, then the three axes side by side.
    moment, density, memory, drift, noise = 2.0, 0.4, 0.8, 0.01, 0.3
    a = np.array([[0.0, 1 / moment, 0.0], [0.0, -1 / memory, 0.0], [0.0, 0.0, 0.0]])
    b = np.diag([0.0, np.sqrt(density) / memory, np.sqrt(drift)])
    h = DT / 8
    grown, strewn = van_loan(a, b, h)
    for _ in range(3):
        strewn = grown @ strewn @ grown.T + strewn
        grown = grown @ grown
    cov0 = np.diag([0.5**2, density / (2 * memory), 0.2**2])
    rng = np.random.default_rng(0)
    readings = rng.normal(size=(COUNT, 3))
    matrix = np.array([[1.0, 0.0, 1.0]])
    record = identify.Recording(
        DT * np.arange(COUNT), (identify.Gyro(noise, bias=[0.0, 0.0, 0.0]), readings)
    )
    model = identify.Model(
        record,
        identify.Known(rj.Inertia.from_principal(moment, moment, moment)),
        process=rj.torques.CorrelatedTorque(density, memory),
        walks=[identify.Walk(lambda s: s.sensors[0].bias, 0.2, drift)],
    )
    first = identify.first_belief(model, state=rj.Spin([0.1, 0.2, 0.3]), rate=0.5)
    found = identify.filter(model, first, substeps=8)
    total = 0.0
    for axis in range(3):
        mean0 = np.array([0.1 * (axis + 1), 0.0, 0.0])
        mean, cov, logp = dense(
            grown, strewn, matrix, [noise**2], cov0, mean0, readings[:, axis : axis + 1]
        )
        total += logp
        last = [found.states.omega[-1, axis], found.belief.torques[0][-1, axis]]
        last.append(found.belief.walks[0][-1, axis])
        # Two Legendre polynomials of the noise a step: (h/T)⁴/720.
        np.testing.assert_allclose(np.array(last), mean[-1], rtol=0, atol=1e-6)
        pick = np.ix_([axis, 3 + axis, 6 + axis], [axis, 3 + axis, 6 + axis])
        np.testing.assert_allclose(
            np.asarray(found.belief.covariance[-1])[pick], cov[-3:, -3:], rtol=0, atol=1e-6
        )
    assert abs(float(found.log_likelihood) - total) < 1e-5


def test_a_spin_near_an_axis_is_a_linear_model():
    # dΩ₁ = (I₂−I₃)/I₁ Ω₃ Ω₂, dΩ₂ = (I₃−I₁)/I₂ Ω₃ Ω₁, and δθ' = δΩ − Ω × δθ.
    i1, i2, i3 = 1.0, 2.0, 2.5
    spin, density, small = 1.3, 1e-14, 1e-6
    a = np.zeros((4, 4))
    a[0, 1], a[1, 0] = (i2 - i3) / i1 * spin, (i3 - i1) / i2 * spin
    a[2, 0], a[3, 1] = 1.0, 1.0
    a[2, 3], a[3, 2] = spin, -spin
    b = np.zeros((4, 2))
    b[0, 0], b[1, 1] = np.sqrt(density) / i1, np.sqrt(density) / i2
    grown, strewn = van_loan(a, b, DT)
    rng = np.random.default_rng(1)
    readings = small * rng.normal(size=(COUNT, 2))
    # Along the axis a rate and angle that are known; across it small ones.
    omega = np.column_stack([readings, np.full(COUNT, spin)])
    record = identify.Recording(DT * np.arange(COUNT), (identify.Gyro([small, small, 1e3]), omega))
    state = rj.Attitude([1.0, 0, 0, 0], [0.0, 0.0, spin])
    body = identify.Known(rj.Inertia.from_principal(i1, i2, i3))
    model = identify.Model(record, body, process=rj.torques.RandomTorque(density))
    first = identify.first_belief(
        model, state=state, rate=[small, small, 0.0], attitude=[small, small, 0.0]
    )
    found = identify.filter(model, first, substeps=8)
    matrix = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0]])
    mean, cov, _ = dense(
        grown, strewn, matrix, [small**2] * 2, small**2 * np.eye(4), np.zeros(4), readings
    )
    last = found.belief
    np.testing.assert_allclose(last.state.omega[-1, :2] / small, mean[-1, :2] / small, atol=1e-5)
    pick = np.ix_([3, 4, 0, 1], [3, 4, 0, 1])
    got = np.asarray(last.covariance[-1])[pick] / small**2
    np.testing.assert_allclose(got, cov[-4:, -4:] / small**2, atol=1e-5)
    # The turn across the axis, seen from a body that only spun about it.
    spun = rj.quaternion.about_axis(jnp.array([0.0, 0, 1]), spin * DT * (COUNT - 1))
    turn = rj.quaternion.log(
        rj.quaternion.multiply(rj.quaternion.conjugate(spun), last.state.q[-1])
    )
    np.testing.assert_allclose(turn[:2] / small, mean[-1, 2:] / small, atol=1e-5)


@pytest.fixture(scope="module")
def tumbling():
    model, real = records.tumble()
    first = identify.first_belief(model, state=records.START, rate=0.3, attitude=0.3)
    return model, model.recording, real, first, identify.filter(model, first)


def test_errors_and_innovations_are_as_large_as_the_filter_says(tumbling):
    _, record, real, _, found = tumbling
    error = jax.vmap(
        lambda q, p: rj.quaternion.log(rj.quaternion.multiply(rj.quaternion.conjugate(q), p))
    )(found.states.q, real.states.q)
    e = np.concatenate([error, real.states.omega - found.states.omega], axis=1)
    nees = np.einsum("ti,ti->t", e, np.linalg.solve(found.belief.covariance, e[..., None])[..., 0])
    # Errors at neighbouring times are alike: 200 of them count as some 20.
    assert (
        scipy.stats.chi2.ppf(0.001, 120) / 20 < nees.mean() < scipy.stats.chi2.ppf(0.999, 120) / 20
    )
    for nis, size in zip(found.nis, (3, 2), strict=True):
        count = size * len(record.t)
        low, high = scipy.stats.chi2.ppf([0.001, 0.999], count)
        assert low < float(nis.sum()) < high
    assert found.words == "followed"


def test_steps_one_by_one_are_the_filter(tumbling):
    model, record, _, first, found = tumbling
    belief = first
    for k in range(3):
        readings = (reading.values[k] for reading in record.readings)
        belief = identify.step(model, belief, record.t[k], *readings)
    np.testing.assert_allclose(belief.state.q, found.states.q[2], rtol=0, atol=1e-13)
    np.testing.assert_allclose(belief.covariance, found.belief.covariance[2], rtol=0, atol=1e-13)


class Speed(identify.AbstractSensor):
    """The size of the rate, rad/s: a reading that is one number."""

    reading_shape, components, unit = (), 1, "rad/s"
    feels, noise = rj.motion.HasSpin, jnp.array([0.1])

    def error(self, motion, reading):
        return (reading - jnp.linalg.norm(motion.state.omega))[None]


def test_steps_take_readings_of_one_number():
    record = identify.Recording([0.0, 0.1], (Speed(), [1.0, 1.0]))
    model = records.known(record)
    first = identify.first_belief(model, state=rj.Spin([0.0, 0.0, 1.1]), rate=0.1)
    seen, gap = (identify.step(model, first, 0.0, 1.0, mask=[seen]) for seen in (True, False))
    np.testing.assert_allclose(gap.state.omega, first.state.omega, rtol=1e-15)
    np.testing.assert_allclose(seen.state.omega, [0.0, 0.0, 1.05], rtol=1e-14)
    np.testing.assert_allclose(seen.deviation, [0.1, 0.1, 0.1 / 2**0.5], rtol=1e-14)


def test_the_scene_at_the_free_numbers_is_what_is_filtered():
    """Body, torque, bias, noise and initial state at x are those of a model that has them."""
    short, process = records.spinning(), rj.torques.RandomTorque(1e-3)
    read = short.readings[0].values

    def model_of(chart, bias, coefficient, free=()):
        record = identify.Recording(short.t, (identify.Gyro(0.02, bias=bias), read))
        damping = rj.torques.Damping(coefficient)
        return identify.Model(record, chart, torque=damping, process=process, free=free)

    free = [
        identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.1),
        identify.Free(lambda s: s.torque.coefficient, "damping", positive=True),
    ]
    model = model_of(identify.Principal(), [0.0, 0.0, 0.0], [0.1, 0.2, 0.3], free)
    x = model.start(records.BODY, omega=[0.3, 0.9, 0.1])
    bias, damping = model.slots
    x = x.at[bias.shared[0]].set(jnp.array([0.2, 0.0, -0.1]))
    x = x.at[damping.shared[0]].set(jnp.log(2.0))
    other = model_of(identify.Known(records.BODY), [0.02, 0.0, -0.01], [0.2, 0.4, 0.6])
    first = identify.first_belief(model, x, rate=0.1)
    np.testing.assert_allclose(first.state.omega, [0.3, 0.9, 0.1], rtol=1e-14)
    ours = identify.filter(model, first, x, substeps=1)
    wanted = identify.filter(other, first, substeps=1)
    np.testing.assert_allclose(ours.states.omega, wanted.states.omega, rtol=1e-12)
    np.testing.assert_allclose(ours.log_likelihood, wanted.log_likelihood, rtol=1e-12)
    assert float(abs(ours.log_likelihood - identify.log_likelihood(model, first, 0 * x))) > 0.1


@pytest.mark.slow
def test_more_steps_between_readings_change_little(tumbling):
    model, _, _, first, found = tumbling
    finer = identify.filter(model, first, substeps=3)
    np.testing.assert_allclose(finer.states.q, found.states.q, atol=1e-7)
    assert abs(float(finer.log_likelihood - found.log_likelihood)) < 1e-4


def test_a_gap_is_followed_in_steps_that_the_rate_asks_for():
    model, _ = records.tumble()
    record = model.recording
    seen = np.ones(len(record.t), bool)
    seen[20:90] = False
    gapped = identify.Recording(record.t, *((r.sensor, r.values, seen) for r in record.readings))
    assert gapped.t.shape == (130,)
    first = identify.first_belief(model, state=records.START, rate=0.3, attitude=0.3)
    found = identify.filter(records.known(gapped, model.process), first)
    # The same as steps through the times that were dropped.
    belief = first
    for k in range(0, 92):
        readings = (reading.values[k] for reading in record.readings)
        flags = [bool(reading.mask[k] & seen[k]) for reading in record.readings]
        belief = identify.step(model, belief, record.t[k], *readings, mask=flags)
    np.testing.assert_allclose(found.states.q[21], belief.state.q, atol=1e-7)
    np.testing.assert_allclose(found.belief.deviation[21], belief.deviation, rtol=1e-5)


def test_what_a_masked_reading_holds_does_not_matter(tumbling):
    model, record, _, first, _ = tumbling
    seen = np.arange(len(record.t)) % 3 != 1
    readings = [(r.sensor, np.array(r.values)) for r in record.readings]
    other = np.where(seen[:, None], readings[0][1], np.nan)
    runs = []
    for values in (readings[0][1], other):
        masked = identify.Recording(record.t, (readings[0][0], values, seen), *readings[1:])
        runs.append(identify.filter(records.known(masked, model.process), first))
    np.testing.assert_array_equal(runs[0].belief.root, runs[1].belief.root)
    np.testing.assert_array_equal(runs[0].states.q, runs[1].states.q)


def test_a_channel_at_its_full_scale_is_left_out(tumbling):
    model, record, _, first, _ = tumbling
    clipped = np.clip(np.asarray(record.readings[0].values), -0.9, 0.9)
    full = np.abs(clipped) >= 0.9
    assert 0.05 < full.mean() < 0.9
    gyro = identify.Gyro(0.02, limit=0.9)
    rest = [(r.sensor, r.values) for r in record.readings[1:]]
    limited = identify.Recording(record.t, (gyro, clipped), *rest)
    found = identify.filter(records.known(limited, model.process), first)
    np.testing.assert_array_equal(found.readings[0].mask, ~full)
    assert found.words == "followed"
    told = identify.Recording(record.t, (identify.Gyro(1e-4), clipped), *rest)
    with pytest.raises(ValueError, match=r"lost|broken"):
        identify.filter(records.known(told, model.process), first)


@pytest.mark.slow
def test_a_sensor_that_is_late_is_seen_where_it_was():
    ts = 0.05 * jnp.arange(40, dtype=float)
    late = 0.03
    real = rj.simulate(records.BODY, records.START, jnp.concatenate([ts, ts[-1:] + 1])).ys
    moved = jax.vmap(rj.exact.FreeBody(records.BODY, records.START))(ts - late)
    gyro = identify.Gyro(0.01, offset=-late)
    record = identify.Recording(ts, (gyro, moved.omega))
    model = records.known(record)
    first = identify.first_belief(model, state=rj.Spin(records.START.omega), rate=0.0)
    found = identify.filter(model, first)
    assert float(jnp.abs(found.readings[0].innovation).max()) < 1e-7
    np.testing.assert_allclose(found.states.omega, real.omega[:-1], atol=1e-7)


RANDOM, CORRELATED = rj.torques.RandomTorque(1e-4), rj.torques.CorrelatedTorque(1e-2, 0.5)
DRAG = rj.torques.Damping([0.1, 0.2, 0.3])


class Push(rj.torques.AbstractTorque):
    """A torque, N m, that is an input."""

    feels = rj.motion.HasSpin
    source: rj.torques.Input

    def __call__(self, t, state, body):
        return self.source(t)


@pytest.mark.parametrize("more", [(), (DRAG,)])
@pytest.mark.parametrize("process", [None, rj.torques.Sum(RANDOM, CORRELATED)])
def test_a_torque_of_the_recording_acts_beside_the_models(more, process):
    short, push = records.spinning(), [0.0, 0.3, 0.0]
    readings = [(r.sensor, r.values) for r in short.readings]
    logs = {
        "samples": np.tile(push, (len(short.t), 1)),
        "function": rj.torques.Held([0.0, 1.0], [push, push]),
    }
    law = Push(rj.torques.Input("push"))
    runs = []
    for record, acting in (
        (short, rj.torques.ConstantTorque(push)),
        *(
            (identify.Recording(short.t, *readings, inputs={"push": log}), law)
            for log in logs.values()
        ),
        (short, None),
    ):
        laws = [*more, *([] if acting is None else [acting])]
        model = records.known(record, process, torque=rj.torques.Sum(*laws) if laws else None)
        first = identify.first_belief(model, state=rj.Spin(records.START.omega), rate=0.3)
        runs.append(identify.filter(model, first, substeps=1, throw=False))
    constant, *logged, without = runs
    for run in logged:
        for ours, wanted in zip(jax.tree.leaves(run), jax.tree.leaves(constant), strict=True):
            np.testing.assert_allclose(ours, wanted, rtol=1e-12, atol=1e-14)
    assert float(jnp.abs(without.log_likelihood - constant.log_likelihood)) > 0.1


def likelihood(x):
    """Of two moments and a density, on the smallest program."""
    body = identify.Known(rj.Inertia.from_principal(x[0], x[1], 2.5))
    process = rj.torques.RandomTorque(jnp.exp(x[2]))
    model = identify.Model(records.spinning(), body, process=process)
    first = identify.first_belief(model, state=rj.Spin(records.START.omega), rate=0.3)
    return identify.log_likelihood(model, first, substeps=1)


AT = jnp.array([1.0, 2.0, np.log(1e-2)])


def test_derivatives_of_the_likelihood_are_right():
    records.spinning()  # made outside of the trace, and kept
    step = 1e-5
    run = filter_once(likelihood)
    wanted = [(run(AT.at[i].add(step)) - run(AT.at[i].add(-step))) / (2 * step) for i in range(3)]
    np.testing.assert_allclose(once(jax.jacfwd(likelihood))(AT), wanted, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_forward_and_reverse_mode_agree_to_second_order():
    records.spinning()
    forward = once(jax.jacfwd(likelihood))(AT)
    np.testing.assert_allclose(once(jax.grad(likelihood))(AT), forward, rtol=1e-9)
    hessians = [
        once(jax.jacfwd(jax.jacfwd(likelihood)))(AT),
        once(jax.jacfwd(jax.grad(likelihood)))(AT),
    ]
    np.testing.assert_allclose(hessians[1], hessians[0], rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("density", [0.0, 1e-24])
def test_without_noise_it_is_the_likelihood_of_the_fit(density):
    short = records.spinning()
    state0 = rj.Spin(records.START.omega + 0.01)
    turned = once(jax.vmap(rj.exact.FreeBody(records.BODY, state0)))(short.t - short.t[0])
    wanted = scipy.stats.norm.logpdf(short.readings[0].values - turned.omega, scale=0.02).sum()
    model = records.known(short, rj.torques.RandomTorque(density))
    first = identify.first_belief(model, state=state0, rate=0.0)
    got = identify.log_likelihood(model, first, substeps=8)
    assert abs(float(got) / wanted - 1) < 1e-9


@pytest.mark.slow
def test_covariances_stay_positive_in_single_precision(tumbling):
    model, _, _, _, found = tumbling
    start = rj.Attitude(
        jnp.array([1.0, 0, 0, 0], jnp.float32), jnp.asarray(records.START.omega, jnp.float32)
    )
    first = identify.first_belief(model, state=start, rate=0.3, attitude=0.3)
    single = identify.filter(model, first)
    assert single.belief.root.dtype == jnp.float32
    np.testing.assert_allclose(single.states.q, found.states.q, atol=2e-5)
    np.testing.assert_allclose(single.belief.deviation, found.belief.deviation, rtol=2e-4)


@pytest.mark.slow
def test_a_batch_of_records_is_each_of_them():
    models = [records.tumble(count=20, seed=seed)[0] for seed in (0, 1)]
    first = identify.first_belief(models[0], state=records.START, rate=0.3, attitude=0.3)

    def likelihood_of(readings):
        where = lambda model: [reading.values for reading in model.records.readings]
        return identify.log_likelihood(eqx.tree_at(where, models[0], readings), first, substeps=1)

    each = [[reading.values for reading in model.records.readings] for model in models]
    both = jax.vmap(likelihood_of)([jnp.stack(pair) for pair in zip(*each, strict=True)])
    wanted = [identify.log_likelihood(model, first, substeps=1) for model in models]
    np.testing.assert_allclose(both, jnp.stack(wanted), rtol=1e-12)


@pytest.mark.slow
def test_a_million_steps_in_single_precision_leave_a_positive_covariance():
    count = 1_000_000
    ts = np.arange(count) * 1e-3
    key = jax.random.key(0)
    omega = jnp.tile(jnp.array([0.0, 0.0, 1.0]), (count, 1)) + 0.01 * jax.random.normal(
        key, (count, 3)
    )
    record = identify.Recording(ts, (identify.Gyro(0.01), omega))
    model = records.known(record, rj.torques.RandomTorque(1e-8))
    start = rj.Attitude(jnp.array([1.0, 0, 0, 0], jnp.float32), jnp.array([0.0, 0, 1], jnp.float32))
    first = identify.first_belief(model, state=start, rate=1.0, attitude=1e-3)
    found = identify.filter(model, first)
    cov = np.asarray(found.belief.root[-1], float)
    values = np.linalg.eigvalsh(cov @ cov.T)
    assert values.min() > 0 and found.words == "followed"
    exact = rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1])
    precise = identify.first_belief(model, state=exact, rate=1.0, attitude=1e-3)
    double = identify.filter(model, precise)
    np.testing.assert_allclose(
        found.belief.deviation[-1, 3:], double.belief.deviation[-1, 3:], rtol=1e-2
    )


class TestBadInput:
    record = identify.Recording([0.0, 0.1], (identify.Gyro(0.1), [[1.0, 0, 0]] * 2))
    model = records.known(record)

    def start(self):
        return identify.first_belief(self.model, rate=0.1)

    def test_densities(self):
        with pytest.raises(ValueError, match="density: wanted a finite number that is not below"):
            rj.torques.RandomTorque(-1.0)
        with pytest.raises(ValueError, match="density: wanted one number or 3"):
            rj.torques.RandomTorque([1.0, 2.0])
        with pytest.raises(ValueError, match="time: wanted a positive correlation time"):
            rj.torques.CorrelatedTorque(1.0, 0.0)
        with pytest.raises(ValueError, match="density: wanted a finite"):
            identify.Walk(lambda s: s.sensors[0].bias, 1.0, -1.0)

    def test_readings_out_of_order(self):
        later = eqx.tree_at(lambda b: b.t, self.start(), jnp.array(1.0))
        with pytest.raises(ValueError, match="out of order"):
            identify.filter(self.model, later)
        with pytest.raises(ValueError, match="out of order"):
            identify.step(self.model, later, 0.5, jnp.zeros(3))

    def test_a_sensor_without_noise(self):
        record = identify.Recording([0.0, 0.1], (identify.Gyro(), [[1.0, 0, 0]] * 2))
        for run in (
            lambda model: identify.filter(model, self.start()),
            lambda model: identify.smooth(model, self.start()),
            lambda model: identify.log_likelihood(model, self.start()),
            lambda model: identify.step(model, self.start(), 0.1, jnp.zeros(3)),
        ):
            with pytest.raises(ValueError, match=r"wanted its noise.*Gyro\(noise="):
                run(records.known(record))

    def test_nan(self):
        with pytest.raises(ValueError, match=r"contains NaN; give .* if it is a gap"):
            identify.step(self.model, self.start(), 0.1, jnp.full(3, jnp.nan))

    def test_a_step_without_each_reading(self):
        with pytest.raises(
            ValueError, match=r"readings: wanted one entry for each sensor \(Gyro\), got 0"
        ):
            identify.step(self.model, self.start(), 0.1)
        with pytest.raises(
            ValueError, match=r"mask: wanted one entry for each sensor \(Gyro\), got 2"
        ):
            identify.step(self.model, self.start(), 0.1, jnp.zeros(3), mask=[True, False])

    def test_several_recordings(self):
        model = records.known([self.record, self.record])
        for run in (
            lambda: identify.first_belief(model, rate=0.1),
            lambda: identify.filter(model, self.start()),
            lambda: identify.log_likelihood(model, self.start()),
        ):
            with pytest.raises(ValueError, match=r"model: wanted one recording, got 2.*jax\.vmap"):
                run()

    def test_a_body_that_is_not_known(self):
        model = identify.Model(self.record, identify.Ratios())
        with pytest.raises(ValueError, match=r"x: wanted the parameters.*fit\(model\)\.x"):
            identify.first_belief(model, rate=0.1)
        with pytest.raises(ValueError, match="x: wanted the 8 parameters of this model"):
            identify.filter(model, self.start(), jnp.zeros(3))

    def test_a_walk_that_finds_nothing(self):
        for where, words in (
            (lambda s: s.sensors[0].bias, "None is there; give the sensor a starting value"),
            (lambda s: s.sensors[3], "nothing is there"),
            (lambda s: s.process.density, "Walk: wanted a number of a sensor"),
        ):
            with pytest.raises(ValueError, match=words):
                records.known(self.record, RANDOM, walks=[identify.Walk(where, 1.0)])

    @pytest.mark.usefixtures("unhooked")
    def test_walks_that_do_not_fit(self):
        gyro = identify.Gyro(0.1, bias=[0.0, 0.0, 0.0])
        record = identify.Recording([0.0, 0.1], (gyro, [[1.0, 0, 0]] * 2))
        walk = identify.Walk(lambda s: s.sensors[0].bias, 1.0)
        with pytest.raises(ValueError, match="another Walk moves the same numbers"):
            records.known(record, walks=[walk, walk])
        with pytest.raises(TypeError, match="walks: wanted a sequence of Walk"):
            records.known(record, walks=[1.0])
        wide = identify.Walk(lambda s: s.sensors[0].bias, [1.0, 2.0])
        with pytest.raises(ValueError, match=r"deviation: wanted one number or shape \(3,\)"):
            records.known(record, walks=wide)

    @pytest.mark.usefixtures("unhooked")
    def test_an_unknown_torque_that_is_given_as_known(self):
        with pytest.raises(TypeError, match="torque: wanted the known torque, got a RandomTorque"):
            records.known(self.record, torque=rj.torques.Sum(DRAG, RANDOM))
        with pytest.raises(TypeError, match="process: wanted a RandomTorque, a CorrelatedTorque"):
            records.known(self.record, DRAG)

    def test_a_first_belief_without_a_deviation(self):
        with pytest.raises(ValueError, match="attitude: wanted the standard deviation"):
            identify.first_belief(self.model, state=records.START, rate=0.1)
        with pytest.raises(ValueError, match="rate: wanted a finite"):
            identify.first_belief(self.model, rate=-1.0)
        with pytest.raises(ValueError, match="attitude: a Spin has no attitude"):
            identify.first_belief(self.model, rate=0.1, attitude=0.1)

    def test_readings_that_show_no_attitude(self):
        record = identify.Recording(
            [0.0, 0.1], (identify.Direction([0.0, 0, 1], 0.1), [[0.0, 0, 1]] * 2)
        )
        with pytest.raises(ValueError, match="state: the readings alone show no initial attitude"):
            identify.first_belief(records.known(record), rate=0.1, attitude=0.1)

    def test_a_state_that_the_sensor_cannot_see(self):
        record = identify.Recording(
            [0.0, 0.1], (identify.Direction([0.0, 0, 1], 0.1), [[0.0, 0, 1]] * 2)
        )
        words = r"sensor 0, Direction, needs a state with HasAttitude, got Spin; .* an Attitude"
        with pytest.raises(TypeError, match=words):
            identify.filter(records.known(record), self.start())

    def test_a_lost_filter(self):
        t = np.arange(0, 3, 0.1)
        omega = np.tile([0.0, 0.0, 1.0], (t.size, 1))
        omega[t > 1] = [0.0, 0.0, -1.0]
        record = identify.Recording(t, (identify.Gyro(0.01), omega))
        model = records.known(record, rj.torques.RandomTorque(1e-12))
        first = identify.first_belief(model, rate=0.1)
        with pytest.raises(ValueError, match=r"lost: no reading.*more than a second.*at 2 s"):
            identify.filter(model, first)
        found = identify.filter(model, first, throw=False)
        assert int(found.status) == 1 and "lost" in found.words
        assert abs(float(found.lost_at) - 2.0) < 1e-9
