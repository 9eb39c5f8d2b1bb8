"""Fits: exact data come back exactly, intervals cover, masks mask, mistakes are named.

Most of a fit is compiling. Fits of `PrincipalRatios` to 80 readings of a gyro of known noise, here
and in other files, are one set of programs.
"""

import dataclasses
import re
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.data import stacking

BRICK = Path(__file__).parents[3] / "shared" / "data" / "nesc_brick" / "tumbling_brick.csv"
MOMENTS = np.array([1.0, 1.6, 2.1])
TURN = rj.quaternion.exp(jnp.array([0.3, -0.5, 0.2]))


@pytest.fixture(scope="module")
def tumble():
    body = rj.Inertia.from_principal(*MOMENTS).rotate(TURN)
    ts = jnp.linspace(0.0, 12.0, 80)
    return body, ts, rj.simulate(body, rj.Attitude([1.0, 0, 0, 0], [0.4, 1.2, -0.3]), ts).ys


@pytest.mark.skipif(not BRICK.exists(), reason="NASA's check case is not beside this checkout")
def test_nasa_brick_returns_its_ratios():
    # NASA/TM-2015-218675, case 2: I = (0.00189422, 0.006211019, 0.007194665) slug ft².
    t, *rates = rj.identify.read_table(BRICK, ("t", "p_deg_s", "q_deg_s", "r_deg_s")).values()
    record = rj.identify.Recording(t, (rj.identify.Gyro(), np.deg2rad(rates).T))
    found = rj.identify.fit(rj.identify.Model(record, rj.identify.Ratios()), starts=2)
    assert found.ok
    moments = np.asarray(found.body.moments)
    np.testing.assert_allclose(
        moments[:2] / moments[2], [0.2632811952, 0.8632811952], rtol=1e-9, atol=0
    )


@pytest.mark.slow
def test_full_tensor_comes_back_from_exact_rates(tumble):
    body, ts, ys = tumble
    record = rj.identify.Recording(ts, (rj.identify.Gyro(1e-3), ys.omega))
    found = rj.identify.fit(rj.identify.Model(record, rj.identify.Ratios()), starts=2)
    assert found.ok
    scaled = np.asarray(found.body.tensor) / np.trace(found.body.tensor) * np.trace(body.tensor)
    np.testing.assert_allclose(scaled, body.tensor, atol=1e-7)
    np.testing.assert_allclose(found.state0.omega, ys.omega[0], atol=1e-7)


def test_a_masked_reading_is_an_absent_one(tumble):
    _, ts, ys = tumble
    noisy = np.asarray(ys.omega) + 0.01 * np.random.default_rng(1).normal(size=(80, 3))
    mask = np.ones(80, bool)
    mask[[3, 40, 41]] = False
    results = []
    for filler in (np.nan, 1e6):
        values = np.where(mask[:, None], noisy, filler)
        record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), values, mask))
        problem = rj.identify.Model(record, rj.identify.PrincipalRatios())
        results.append(rj.identify.fit(problem, starts=1))
    for a, b in zip(jax.tree.leaves(results[0].x), jax.tree.leaves(results[1].x), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.usefixtures("unhooked")
def test_an_interval_of_a_whole_number_is_refused_and_float32_is_said(tumble):
    _, ts, ys = tumble
    record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), ys.omega))
    found = rj.identify.fit(rj.identify.Model(record, rj.identify.PrincipalRatios()), starts=1)
    for function, kind in (
        (lambda point: 3, "int"),
        (lambda point: jnp.argmax(point.body.moments), "int"),
        (lambda point: point.body.moments > 0.5, "bool"),
    ):
        with pytest.raises(TypeError, match=f"wanted numbers that vary smoothly, got {kind}"):
            found.interval_of(function)
    low, high = found.interval_of(lambda point: [point.state0.omega[0], 2.0])
    assert low[0] < high[0] and low[1] == high[1] == 2.0
    assert "float64" not in str(found)
    # Without its errors, which are float64, as no fit mixes the two.
    single = eqx.tree_at(lambda f: f.point.x, found, found.x.astype(np.float32))
    single = dataclasses.replace(single, linear=None)
    last = rj.identify.report.verdict(single).splitlines()[-1]
    assert last.startswith("A fit is better in float64: this one was computed in float32")


@pytest.mark.slow
def test_estimated_noise_is_the_noise(tumble):
    _, ts, ys = tumble
    rng = np.random.default_rng(2)
    readings = []
    gyro = np.asarray(ys.omega) + 0.02 * rng.normal(size=(80, 3))
    turns = jnp.asarray(0.05 * rng.normal(size=(80, 3)))
    attitude = jax.vmap(lambda q, e: rj.quaternion.multiply(q, rj.quaternion.exp(e)))(ys.q, turns)
    readings = [(rj.identify.Gyro(), gyro), (rj.identify.AttitudeSensor(), -attitude)]
    record = rj.identify.Recording(ts, *readings)
    problem = rj.identify.Model(record, rj.identify.Ratios(), loss=rj.identify.SoftL1())
    found = rj.identify.fit(problem, starts=2)
    assert found.ok
    # 80 × 3 readings: the estimate has a standard error of 5 %; a tenth of that is the loss's.
    np.testing.assert_allclose(found.noise[0], 0.02, rtol=0.2)
    np.testing.assert_allclose(found.noise[1], 0.05, rtol=0.2)


# The noise known, and estimated (another program).
@pytest.mark.parametrize("noise", [0.01, pytest.param(None, marks=pytest.mark.slow)])
def test_a_wrong_motion_is_not_called_success(tumble, noise):
    _, ts, _ = tumble
    readings = np.random.default_rng(3).normal(size=(80, 3))
    record = rj.identify.Recording(ts, (rj.identify.Gyro(noise), readings))
    found = rj.identify.fit(rj.identify.Model(record, rj.identify.PrincipalRatios()), starts=2)
    assert found.explanation.word == "does not explain the readings"
    assert found.identifiability[0].startswith("This fit does not explain the data")


@pytest.mark.slow
@pytest.mark.parametrize("loss", [rj.identify.SoftL1(), rj.identify.Huber()])
def test_a_wrong_motion_is_not_called_outliers(tumble, loss):
    _, ts, _ = tumble
    rng = np.random.default_rng(3)
    record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), rng.normal(size=(80, 3))))
    found = rj.identify.fit(rj.identify.Model(record, rj.identify.Ratios(), loss=loss), starts=2)
    assert found.explanation.word == "does not explain the readings"
    assert found.identifiability[0].startswith("This fit does not explain the data")


def test_a_recording_prints_what_it_holds():
    gyro = rj.identify.Gyro(0.1), jnp.ones((5, 3)) * 1.23456789
    stars = rj.identify.AttitudeSensor(0.1), jnp.array([[1.0, 0, 0, 0]] * 5), [False] + [True] * 4
    speed = rj.torques.Held([0.0, 1.0], [1.0, 2.0])
    ts = jnp.linspace(0.0, 1.0, 5)
    record = rj.identify.Recording(ts, gyro, stars, inputs={"speed": speed, "heat": ts})
    assert repr(record) == (
        "Recording(5 times 0 … 1 s; Gyro: 5 readings from [1.23457, 1.23457, 1.23457]; "
        "AttitudeSensor: 4 readings from [1, 0, 0, 0]; inputs: speed, heat)"
    )
    lately = rj.identify.Recording(1.7e9 + np.linspace(0.0, 10.0, 5), gyro)
    assert repr(lately).startswith("Recording(5 times 1700000000 … 1700000010 s; ")
    problem = rj.identify.Model([record, record], rj.identify.PrincipalRatios())
    # With a leading axis it has no words of its own.
    assert "values=f64[2,5,3]" in repr(problem)


def test_a_plain_function_turns_a_body(tumble):
    body, ts, ys = tumble
    gyro = (rj.identify.Gyro(0.01), ys.omega)
    # A push of none: the ratios are those of the free body.
    record = rj.identify.Recording(ts, gyro)
    none = lambda t, state, body: 0 * state.omega
    model = rj.identify.Model(record, rj.identify.Ratios(), torque=none)
    found = rj.identify.fit(model, starts=2)
    moments, wanted = (np.linalg.eigvalsh(one.tensor) for one in (found.body, body))
    np.testing.assert_allclose(moments / moments[-1], wanted / wanted[-1], rtol=1e-4)


def test_a_fit_that_stops_early_says_so_and_keeps_its_best(tumble):
    _, ts, ys = tumble
    record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), ys.omega))
    problem = rj.identify.Model(record, rj.identify.PrincipalRatios())
    stopped, later = (rj.identify.fit(problem, starts=1, max_steps=n) for n in (1, 2))
    assert not stopped.ok and not stopped.starts[0].converged
    assert np.isfinite(stopped.body.tensor).all()
    # The best so far: with one more step it is no worse, and it is better than no motion at all.
    still = float((np.asarray(ys.omega) ** 2).sum() / 0.01**2 / 2)
    assert later.starts[0].cost <= stopped.starts[0].cost < still


def test_interrupting_keeps_what_was_found(tumble):
    _, ts, ys = tumble
    record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), ys.omega))

    def stop(line):
        raise KeyboardInterrupt

    found = rj.identify.fit(
        rj.identify.Model(record, rj.identify.Ratios()), starts=4, progress=stop
    )
    assert len(found.starts) == 1
    assert not found.ok and "search: found (interrupted after 1 of 4 starts)" in found.status


@pytest.mark.parametrize("good", [True, False])
def test_interrupting_is_said_whatever_else_is(tumble, good):
    """Of the starts, of a motion that explains nothing."""
    _, ts, ys = tumble
    read = ys.omega if good else np.random.default_rng(3).normal(size=ys.omega.shape)
    record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), read))
    problem = rj.identify.Model(record, rj.identify.Ratios())

    def stop(line):
        if line.startswith("start 2"):
            raise KeyboardInterrupt

    model = "explains the readings" if good else "does not explain the readings"
    found = rj.identify.fit(problem, starts=4, progress=stop)
    assert not found.ok and found.explanation.word == model
    assert "interrupted after 2 of 4 starts" in found.search.reasons


def test_two_numbers_of_one_name_are_refused(tumble):
    """Values and intervals go by name: one would be shown with the interval of the other."""
    _, ts, ys = tumble
    gyro = rj.identify.Gyro(0.01, bias=[0.0, 0.0, 0.0])
    record = rj.identify.Recording(ts, (gyro, ys.omega), (gyro, ys.omega))
    free = [
        rj.identify.Free(lambda s: s.sensors[0].bias, "bias"),
        rj.identify.Free(lambda s: s.sensors[1].bias, "bias"),
    ]
    with pytest.raises(ValueError, match="Free 'bias': another Free has this name"):
        rj.identify.Model(record, rj.identify.Ratios(), free=free)
    for name in ("I1/I3", "Ωx"):
        free = [rj.identify.Free(lambda s: s.sensors[0].bias, name)]
        with pytest.raises(ValueError, match=f"Free '{name}': a quantity of the body has this"):
            rj.identify.Model(record, rj.identify.Ratios(), free=free)


def test_what_cannot_be_seen_is_said():
    # Spin about a principal axis: rates alone show nothing of the shape.
    ts = jnp.linspace(0.0, 5.0, 80)
    omega = np.broadcast_to([0.0, 0.0, 1.0], (80, 3))
    noisy = omega + 0.01 * np.random.default_rng(4).normal(size=(80, 3))
    record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), noisy))
    found = rj.identify.fit(rj.identify.Model(record, rj.identify.PrincipalRatios()), starts=3)
    words = " ".join(found.identifiability)
    assert "is not determined by these data" in words
    assert "cannot show the absolute inertia" in words


MISTAKES = [
    (([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0]])), r"Gyro: wanted readings of shape \(2, 3\), got \(1, 3\)"),
    (([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0], [np.nan, 0, 0]])), "Gyro: the reading at index 1 contains NaN; mask it"),
    (([0.0, 1.0], (rj.identify.Gyro(), [[1.0, 0, 0], [-np.inf, 0, 0]])), "Gyro: the reading at index 1 is infinite; mask it"),
    (([0.0, 1.0], (rj.identify.AttitudeSensor(), [[1.0, 0, 0, 0], [2.0, 0, 0, 0]])), "quaternion at index 1 is not unit.*scalar first"),
    (([1.0, 0.0], (rj.identify.Gyro(), np.zeros((2, 3)))), r"t\[1\] is not above"),
    (([0.0, np.nan], (rj.identify.Gyro(), np.zeros((2, 3)))), "t: contains NaN or infinity at index 1"),
    (([0.0, 1.0],), "at least one pair"),
    (([0.0, 1.0], (rj.identify.Gyro(), np.zeros((2, 3)), [True])), r"mask of shape \(2,\), got \(1,\)"),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "words"), MISTAKES)
@pytest.mark.usefixtures("unhooked")
def test_mistakes_in_a_recording_are_named(arguments, words):
    with pytest.raises(ValueError, match=words):
        rj.identify.Recording(*arguments)


@pytest.mark.parametrize(
    ("sensor", "values"),
    [
        (rj.identify.Gyro(0.01), np.zeros((40, 3))),
        (rj.identify.AttitudeSensor(0.01), np.tile([0.6, 0.48, 0.64, 0.0], (40, 1))),
    ],
)
def test_a_body_at_rest_is_refused_in_words(sensor, values):
    """As the command line says it, also with a start of one's own."""
    record = rj.identify.Recording(0.1 * np.arange(40), (sensor, values))
    model = rj.identify.Model(record, rj.identify.Ratios())
    words = (
        "fit: the rates of recording 1 are all zero: a body at rest shows nothing of its inertia"
    )
    for how in ({}, {"starts": 1, "initial": jnp.zeros(model.size)}):
        with pytest.raises(ValueError, match=words):
            rj.identify.fit(model, **how)


def test_a_recording_at_rest_beside_one_in_motion_is_named(tumble):
    _, ts, ys = tumble
    rates = [ys.omega, jnp.zeros_like(ys.omega)]
    records = [rj.identify.Recording(ts, (rj.identify.Gyro(0.01), one)) for one in rates]
    with pytest.raises(ValueError, match="fit: the rates of recording 2 are all zero"):
        rj.identify.fit(rj.identify.Model(records, rj.identify.Ratios()))


@pytest.mark.usefixtures("unhooked")
def test_other_mistakes_are_named(tumble):
    _, ts, ys = tumble
    record = rj.identify.Recording(ts, (rj.identify.Gyro(0.01), ys.omega))
    problem = rj.identify.Model(record, rj.identify.Ratios())
    with pytest.raises(TypeError, match="wanted a Model, got Recording"):
        rj.identify.fit(record)
    for many in (10_001, 10**11):
        with pytest.raises(ValueError, match=f"starts: wanted .* at most 10000, got {many}"):
            rj.identify.fit(problem, starts=many)
    half = eqx.tree_at(lambda r: r.t, record, record.t.astype(jnp.float16))
    with pytest.raises(TypeError, match="recording: wanted float32 or float64, got float16"):
        rj.identify.Model(half, rj.identify.Ratios())
    broken = rj.Inertia(np.diag([1.0, 2.0, np.nan]))
    with pytest.raises(ValueError, match="body: contains NaN"):
        rj.identify.Model(record, rj.identify.PrincipalRatios()).start(broken)
    with pytest.raises(ValueError, match=r"rtol: wanted one number, got shape \(2,\)"):
        rj.identify.Adaptive(rtol=np.ones(2))
    with pytest.raises(TypeError, match=r"such as Ratios\(\) or .*got Inertia"):
        rj.identify.Model(record, rj.Inertia.from_principal(1.0, 2.0, 3.0))
    with pytest.raises(TypeError, match="wanted a Recording, got Model"):
        rj.identify.Model(problem, rj.identify.Ratios())
    with pytest.raises(TypeError, match="got ndarray for a sensor"):
        rj.identify.Recording(ts, (np.zeros(3), ys.omega))
    with pytest.raises(ValueError, match="starts: wanted a whole number of at least 1, got 0"):
        rj.identify.fit(problem, starts=0)
    with pytest.raises(ValueError, match="positive standard deviation"):
        rj.identify.Gyro(noise=-1.0)
    with pytest.raises(ValueError, match=r"one number or three, got shape \(2,\)"):
        rj.identify.Gyro(noise=[1.0, 2.0])
    with pytest.raises(ValueError, match=r"level between 0 and 1, got 95"):
        rj.identify.fit(problem, starts=1).interval(95)


def test_a_record_of_another_length_is_the_same_program(caplog):
    """The appended readings change nothing: neither the result, nor its intervals, nor a word."""

    def fitted(count, factor=1.0):
        ts = jnp.linspace(0.0, 8.0, 100)[:count]
        law = rj.torques.Damping([0.02, 0.02, 0.02])
        motion = rj.simulate(rj.Inertia.from_principal(1.0, 1.6, 2.1), rj.Spin([0.4, 1.2, -0.3]), ts, law)  # fmt: skip
        noise = np.random.default_rng(0).normal(size=(100, 3))[:count]
        record = identify.Recording(ts, (identify.Gyro(), motion.ys.omega + 0.01 * noise))
        law = rj.torques.Damping([factor * 0.02] * 3)
        return identify.fit(identify.Model(record, identify.Tensor(1.0), torque=law), starts=1)

    fitted(95)
    with jax.log_compiles(), caplog.at_level("WARNING"):
        short = fitted(92)
    # `simulate` is another one, with what it does beside.
    programs = set(re.findall(r"Compiling jit\((\w+)\)", caplog.text))
    named = {
        "marquardt",
        "all_errors",
        "_linearised_fields",
        "_quantities_at",
    }
    assert not programs & named
    assert short.residuals[0].shape == (92, 3) and short.model.recording.t.shape == (92,)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stacking, "pad_to_few", lambda problem: problem)
        plain = fitted(92)
    assert short.status == plain.status
    assert jax.tree.structure(short) == jax.tree.structure(plain)
    np.testing.assert_allclose(
        np.array(list(short.interval().values())), np.array(list(plain.interval().values())),
        rtol=1e-6, atol=1e-9,
    )  # fmt: skip
    # The torque counted twice: the same residuals with twice the moments, and a line that says so.
    twice = fitted(92, 2.0)
    np.testing.assert_allclose(twice.body.moments, 2.0 * short.body.moments, rtol=1e-4)
    np.testing.assert_allclose(twice.chi2, short.chi2, rtol=1e-6)
    assert "a wheel counted twice" in short.identifiability[-1]
