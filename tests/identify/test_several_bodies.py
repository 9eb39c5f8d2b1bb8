"""Several bodies read by one sensor: what is shared, what a group or a recording has of its own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.model.free import local, places
from rigidjax.identify.search.noise import estimate_noise
from rigidjax.identify.search.stages import evaluate

BODIES = {
    "box": rj.Inertia.from_principal(1.0, 1.6, 2.1),
    "rod": rj.Inertia.from_principal(0.4, 1.9, 2.0),
}
RATES = {
    "box": ([0.4, 1.2, -0.3], [1.0, 0.2, 0.5]),
    "rod": ([1.5, 0.3, 0.6], [-0.5, 0.8, 0.9]),
}
DRAG = {"box": [0.05, 0.08, 0.02], "rod": [0.01, 0.03, 0.03]}
SKEW = np.array([0.02, -0.01, 0.03])
SIGMA = 0.004
TS = np.arange(60) * 0.05


def throw(name, omega, own, seed):
    """A damped body with a wheel inside; the gyro's axes are not orthogonal."""
    speed = rj.torques.Series(TS, 3.0 * np.tanh(TS))
    wheel = rj.torques.Flywheel(rj.torques.Wheel(0.2, [0.0, 0.0, 1.0], speed))
    law = rj.torques.Sum(wheel, rj.torques.Damping(DRAG[name]))
    ys = np.asarray(rj.simulate(BODIES[name], rj.Spin(omega), jnp.asarray(TS), law).ys.omega)
    a, b, c = SKEW
    read = ys @ np.array([[1.0, a, b], [0.0, 1.0, c], [0.0, 0.0, 1.0]]).T + own
    read = read + SIGMA * np.random.default_rng(seed).normal(size=read.shape)
    start = rj.torques.Sum(wheel, rj.torques.Damping([0.0, 0.0, 0.0]))
    return identify.Recording(
        TS, (identify.Gyro(SIGMA, bias=[0.0] * 3, skew=[0.0] * 3), read), torque=start
    )


FREE = [
    identify.Free(lambda s: s.torque.parts[1].coefficient, "drag", scale=0.05, each="body"),
    identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.05, spread=0.01),
    identify.Free(lambda s: s.sensors[0].skew, "skew", scale=0.02),
]
BIAS = np.array([0.03, -0.02, 0.01])


@pytest.fixture(scope="module")
def records():
    rng = np.random.default_rng(5)
    return {
        name: [
            throw(name, omega, BIAS + 0.01 * rng.normal(size=3), 10 * len(name) + k)
            for k, omega in enumerate(rates)
        ]
        for name, rates in RATES.items()
    }


@pytest.fixture(scope="module")
def found(records):
    charts = {"box": identify.Tensor(1.5), "rod": identify.Known(BODIES["rod"])}
    return identify.fit(identify.Model(records, charts, free=FREE), starts=1)


def test_one_sensor_is_found_from_two_bodies_of_which_one_is_known(found):
    assert found.ok
    bounds = found.interval(0.999)
    truth = {"I1 [box]": 1.0, "I2 [box]": 1.6, "I3 [box]": 2.1, "Ixy [box]": 0.0}
    for name, drag in DRAG.items():
        truth |= {f"drag {a} [{name}]": v for a, v in zip("xyz", drag, strict=True)}
    truth |= {f"skew {a}": v for a, v in zip("xyz", SKEW, strict=True)}
    for name, value in truth.items():
        low, high = bounds[name]
        assert low <= value <= high, name
        assert high - low < 0.4
    assert set(found.body) == {"box", "rod"}
    np.testing.assert_array_equal(found.body["rod"].tensor, BODIES["rod"].tensor)
    assert found.values["drag"].shape == (2, 3) and found.values["bias"].shape == (3,)
    assert found.values["bias, own"].shape == (4, 3)
    assert "Ωx [rod 1]" in bounds and "bias x, own [box 0]" in bounds
    assert any("I1 [box]" in line for line in found.identifiability)


def test_the_shared_bias_is_as_sure_as_its_spread_allows(found):
    # Four recordings that deviate by 0.01 each: the mean of four.
    low, high = found.interval(0.95)["bias x"]
    assert 0.8 * 0.005 < (high - low) / (2 * 1.96) < 1.5 * 0.005
    assert low <= BIAS[0] <= high


def test_each_recording_depends_on_its_own_body_and_group(found):
    problem, at = found.model, found.x
    mine = local(problem, at)
    # Of the known body no number is free: its columns are those of no number.
    where = np.asarray(places(problem, at))
    size = sum(x.size for x in (at.body, *at.shared, at.own.spin, *at.own.each))
    np.testing.assert_array_equal(where[0, :6], np.arange(6))
    assert (where[2:, :6] == size).all()
    np.testing.assert_array_equal(mine.shared[0][0], at.shared[0][0])
    np.testing.assert_array_equal(mine.shared[0][3], at.shared[0][1])
    # A shared value and a deviation have the same derivative.
    blocks = np.asarray(evaluate(at, problem)[1][0][0])
    np.testing.assert_array_equal(blocks[..., 9:12], blocks[..., 18:21])


@pytest.mark.parametrize(
    ("each", "wanted"),
    [
        (["fine", "coarse", "rough", "rough"], [0.02, 0.05, 0.1, 0.1]),
        (True, [0.02, 0.05, 0.1, 0.1]),
        ("body", [0.0381, 0.0381, 0.1, 0.1]),
        (False, [0.0757] * 4),
    ],
)
def test_noise_is_estimated_by_group(records, each, wanted):
    silent = {
        name: [
            identify.Recording(r.t, (identify.Gyro(), r.readings[0].values), torque=r.torque)
            for r in rows
        ]
        for name, rows in records.items()
    }
    charts = {name: identify.Known(body) for name, body in BODIES.items()}
    problem = identify.Model(silent, charts, noise_each=each)
    rng = np.random.default_rng(3)
    errors = (np.array([0.02, 0.05, 0.1, 0.1])[:, None, None] * rng.normal(size=(4, 60, 3)),)
    first = (jnp.ones((4, 3)),)
    (_, ends), blocks = evaluate(problem.start(), problem)
    found = (jax.tree.map(jnp.asarray, errors), ends), blocks
    _, (noise,) = estimate_noise(problem, found, first, problem.start())
    np.testing.assert_allclose(noise[:, 0], wanted, rtol=0.15)


def test_the_skew_of_a_sensor_and_the_tilt_of_a_wheel():
    state = rj.Spin([1.0, 2.0, 3.0])
    moment = identify.SensorInput(jnp.zeros(()), state, None, lambda t, y, args: y)
    gyro = identify.Gyro(bias=[0.1, 0, 0], scale=[2.0, 1, 1], skew=[0.01, 0.02, 0.03])
    np.testing.assert_allclose(gyro.error(moment, jnp.zeros(3)), [-2.26, -2.09, -3.0], rtol=1e-12)
    wheel = rj.torques.Wheel(2.0, [0.0, 0.0, 1.0], lambda t: t, tilt=[0.3, 0.4])
    np.testing.assert_allclose(wheel(1.0), 2 * np.array([0.3, 0.4, 1]) / np.sqrt(1.25), rtol=1e-12)
    for axis in (np.eye(3)[0], np.eye(3)[1], np.array([0.6, 0.0, -0.8])):
        leaning = rj.torques.Wheel(1.0, axis, lambda t: t, tilt=[0.3, 0.4]).direction
        np.testing.assert_allclose(leaning @ axis, 1 / np.sqrt(1.25), rtol=1e-12)


MISTAKES = [
    (lambda r: dict(body=identify.Tensor(1.0)), TypeError, "both recordings and charts by name"),
    (lambda r: dict(body={"box": identify.Tensor(1.0)}), ValueError, r"recordings of \['box', 'rod'\]"),
    (lambda r: dict(free=[identify.Free(lambda x: x.readings[0].sensor.bias, "b", each=["a"])]), ValueError, "one label for each of 4 recordings, got 1"),
    (lambda r: dict(noise_each=3), TypeError, "noise_each: wanted True, False, .body., or a sequence of labels"),
    (lambda r: dict(recording=r | {"rod": []}), ValueError, "no recording of 'rod'"),
    (lambda r: dict(prior=identify.Entropic(BODIES["box"], 1.0)), ValueError, "a prior is about one body"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "kind", "words"), MISTAKES)
@pytest.mark.usefixtures("unhooked")
def test_mistakes_are_named(records, change, kind, words):
    charts = {"box": identify.Tensor(1.5), "rod": identify.Known(BODIES["rod"])}
    given = {"recording": records, "body": charts} | change(records)
    with pytest.raises(kind, match=words):
        identify.Model(given.pop("recording"), given.pop("body"), **given)


@pytest.mark.usefixtures("unhooked")
def test_a_spread_needs_a_shared_value():
    with pytest.raises(ValueError, match="each=True has none; give prior"):
        identify.Free(lambda s: s.sensors[0].bias, "b", each=True, spread=0.1)
    with pytest.raises(ValueError, match=r"each: wanted .*body.*got .*throw"):
        identify.Free(lambda s: s.sensors[0].bias, "b", each="throw")
    with pytest.raises(TypeError, match="each: wanted True, False"):
        identify.Free(lambda s: s.sensors[0].bias, "b", each=None)
