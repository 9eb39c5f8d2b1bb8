"""Several bodies read by one sensor: what is shared, what a group or a recording has of its own."""

import jax.numpy as jnp
import numpy as np
import pytest
from once import once

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.search.noise import estimate_noise
from rigidjax.identify.search.stages import blocks_at

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


SPEED = rj.torques.Series(TS, 3.0 * np.tanh(TS))
WHEEL = rj.torques.Flywheel(rj.torques.Wheel(0.2, [0.0, 0.0, 1.0], SPEED))
LAW = rj.torques.Sum(WHEEL, rj.torques.Damping([0.0, 0.0, 0.0]))


def throw(name, omega, own, seed):
    """A damped body with a wheel inside; the gyro's axes are not orthogonal."""
    law = rj.torques.Sum(WHEEL, rj.torques.Damping(DRAG[name]))
    ys = np.asarray(rj.simulate(BODIES[name], rj.Spin(omega), jnp.asarray(TS), law).ys.omega)
    a, b, c = SKEW
    read = ys @ np.array([[1.0, a, b], [0.0, 1.0, c], [0.0, 0.0, 1.0]]).T + own
    read = read + SIGMA * np.random.default_rng(seed).normal(size=read.shape)
    return identify.Recording(TS, (identify.Gyro(SIGMA, bias=[0.0] * 3, skew=[0.0] * 3), read))


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
    return identify.fit(identify.Model(records, charts, torque=LAW, free=FREE), starts=1)


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


def test_the_shared_bias_is_as_sure_as_its_spread_allows(found):
    # Four recordings that deviate by 0.01 each: the mean of four.
    low, high = found.interval(0.95)["bias x"]
    assert 0.8 * 0.005 < (high - low) / (2 * 1.96) < 1.5 * 0.005
    assert low <= BIAS[0] <= high


def test_each_recording_depends_on_its_own_body_and_group(found):
    model, x = found.model, found.x
    # Of the known body no number is free: its columns are those of no number.
    where = np.asarray(model.index.places)
    np.testing.assert_array_equal(where[0, :6], np.arange(6))
    assert (where[2:, :6] == x.size).all()
    drag = model.scenes(x).torque.parts[1].coefficient
    np.testing.assert_array_equal(drag, found.values["drag"][np.array([0, 0, 1, 1])])
    bias = model.scenes(x).sensors[0].bias
    np.testing.assert_array_equal(bias, found.values["bias, own"])
    # A shared value and a deviation have the same derivative.
    blocks = np.asarray(blocks_at(model, x)[1][0])
    np.testing.assert_array_equal(blocks[..., 9:12], blocks[..., 18:21])


def test_derivatives_of_one_recording_are_those_of_all_numbers_there(found):
    """Against differences of errors by every free number, recording by recording."""
    model, x, h = found.model, np.asarray(found.x), 1e-5
    blocks, where = np.asarray(blocks_at(model, found.x)[1][0]), model.index.places
    errors = once(lambda x: model.errors(x)[0])
    for place in range(x.size):
        step = h * np.eye(x.size)[place]
        wanted = (errors(x + step) - errors(x - step)) / (2 * h)
        here = np.asarray(where == place)
        found = np.einsum("rtkm,rm->rtk", blocks, here.astype(float))
        np.testing.assert_allclose(found, wanted, atol=1e-7)


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
        name: [identify.Recording(r.t, (identify.Gyro(), r.readings[0].values)) for r in rows]
        for name, rows in records.items()
    }
    charts = {name: identify.Known(body) for name, body in BODIES.items()}
    model = identify.Model(silent, charts, torque=LAW, noise_each=each)
    rng = np.random.default_rng(3)
    errors = (np.array([0.02, 0.05, 0.1, 0.1])[:, None, None] * rng.normal(size=(4, 60, 3)),)
    first = (jnp.ones((4, 3)),)
    blocks = blocks_at(model, model.start())._replace(value=tuple(map(jnp.asarray, errors)))
    _, (noise,) = estimate_noise(model, model.start(), blocks, first)
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
    (lambda r: dict(chart=identify.Tensor(1.0)), TypeError, "both recordings and charts by name"),
    (lambda r: dict(chart={"box": identify.Tensor(1.0)}), ValueError, r"recordings of \['box', 'rod'\]"),
    (lambda r: dict(free=[identify.Free(lambda s: s.sensors[0].bias, "b", each=["a"])]), ValueError, "one label for each of 4 recordings, got 1"),
    (lambda r: dict(noise_each=3), TypeError, "noise_each: wanted True, False, .body., or a sequence of labels"),
    (lambda r: dict(recording=r | {"rod": []}), ValueError, "wanted a recording of 'rod', got none"),
    (lambda r: dict(prior=identify.Entropic(BODIES["box"], 1.0)), ValueError, "a prior is about one body"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "kind", "words"), MISTAKES)
@pytest.mark.usefixtures("unhooked")
def test_mistakes_are_named(records, change, kind, words):
    charts = {"box": identify.Tensor(1.5), "rod": identify.Known(BODIES["rod"])}
    given = {"recording": records, "chart": charts} | change(records)
    with pytest.raises(kind, match=words):
        identify.Model(given.pop("recording"), given.pop("chart"), **given)


@pytest.mark.usefixtures("unhooked")
def test_a_spread_needs_a_shared_value():
    with pytest.raises(ValueError, match="wanted no spread with each=True"):
        identify.Free(lambda s: s.sensors[0].bias, "b", each=True, spread=0.1)
    with pytest.raises(ValueError, match=r"each: wanted .*body.*got .*throw"):
        identify.Free(lambda s: s.sensors[0].bias, "b", each="throw")
    with pytest.raises(TypeError, match="each: wanted True, False"):
        identify.Free(lambda s: s.sensors[0].bias, "b", each=None)


@pytest.mark.parametrize(
    ("body", "got"), [({"cone": BODIES["box"]}, "'cone'"), (BODIES["rod"], "Inertia$")]
)
def test_a_start_names_the_bodies_that_it_takes(records, body, got):
    charts = {name: identify.Known(body) for name, body in BODIES.items()}
    with pytest.raises(ValueError, match=r"a dict such as \{'box': .* among box, rod, .*" + got):
        identify.Model(records, charts, torque=LAW).start(body)
