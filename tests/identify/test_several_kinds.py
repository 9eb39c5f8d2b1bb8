"""Recordings of several kinds in one model: a free throw, a driven turn, a body in a hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from identify.test_held_body import GUESS, NOISE, TOOL, T as T_HELD, model_of, wrench_of
from once import once
from scipy.optimize import least_squares

import rigidjax as rj
from rigidjax import identify

BODY = rj.Inertia(jnp.array([[1.0, 0.05, 0.0], [0.05, 1.6, 0.02], [0.0, 0.02, 2.1]]))
LONG = jnp.linspace(0.0, 3.45, 70)
SHORT = LONG[:40]
PUSH = jnp.array([0.3, -0.2, 0.25])
GYRO, STAR = 0.01, 0.004
CHART = identify.Tensor(1.5)


def gyro(omega, seed, ts=SHORT):
    read = np.asarray(rj.simulate(BODY, rj.Spin(omega), LONG).ys.omega)[: len(ts)]
    read = read + GYRO * np.random.default_rng(seed).normal(size=read.shape)
    return identify.Recording(ts, (identify.Gyro(GYRO, bias=[0.0] * 3), read))


def turn():
    sensor, start = identify.AttitudeSensor(STAR), rj.Attitude([1.0, 0, 0, 0], [0.2, 0.5, 0.1])
    law = rj.torques.ConstantTorque(PUSH)
    read = identify.simulate_readings(sensor, BODY, start, LONG, law, key=jax.random.key(4))
    return identify.Recording(LONG, (sensor, read))


PUSHED = identify.Free(lambda s: s.torque.torque, "push", scale=0.1, prior=10.0)


@pytest.fixture(scope="module")
def kinds():
    throws = identify.Model([gyro([0.4, 1.2, -0.3], 1), gyro([1.0, 0.2, 0.5], 2, LONG[:55])], CHART)
    driven = identify.Model(
        turn(), CHART, torque=rj.torques.ConstantTorque(1.3 * PUSH), free=[PUSHED]
    )
    return {"throw": throws, "driven": driven}


@pytest.fixture(scope="module")
def both(kinds):
    known = identify.Measured(lambda p: p.values["push"][0], 0.3, 0.002, "push along x")
    return identify.fit(identify.Model(kinds, measured=[known]), starts=2)


def test_a_fit_of_two_kinds_is_scipys_of_all_residuals(both):
    throws, driven = both.model.recordings[:2], both.model.recordings[2]

    @once
    def residuals(z):
        tensor = rj.body.symmetric3.from_components(*z[:6])
        body, push = rj.Inertia(tensor), z[6:9]
        free = jax.vmap(lambda rate: rj.simulate(body, rj.Spin(rate), LONG).ys.omega)
        out = [
            (record.readings[0].values - there[: len(record.t)]) / GYRO
            for record, there in zip(throws, free(z[9:15].reshape(2, 3)), strict=True)
        ]
        start = rj.Attitude(rj.rotation.quaternion.exp(z[15:18]), z[18:21])
        law = rj.torques.ConstantTorque(push)
        there = rj.simulate(body, start, driven.t, law, rtol=1e-10, atol=1e-12).ys.q
        turned = jax.vmap(rj.rotation.quaternion.log)(
            jax.vmap(rj.rotation.quaternion.multiply)(
                jax.vmap(rj.rotation.quaternion.conjugate)(there), driven.readings[0].values
            )
        )
        out.append(turned / STAR)
        rest = jnp.append((push - 1.3 * PUSH) / 10.0, (0.3 - push[0]) / 0.002)
        return jnp.concatenate([*(part.reshape(-1) for part in out), rest])

    components = BODY.tensor[jnp.array([0, 1, 2, 0, 0, 1]), jnp.array([0, 1, 2, 1, 2, 2])]
    rates = jnp.array([0.4, 1.2, -0.3, 1.0, 0.2, 0.5, 0, 0, 0, 0.2, 0.5, 0.1])
    z = np.concatenate([components, PUSH, rates])
    found = least_squares(lambda z: np.asarray(residuals(z)), z, jac="3-point", xtol=1e-12)
    tensor = np.asarray(rj.body.symmetric3.from_components(*found.x[:6]))
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    deviation = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(both.body.tensor, tensor, rtol=0, atol=1e-3 * deviation[0])
    low, high = both.interval_of(
        lambda p: jnp.concatenate([p.body.tensor.diagonal(), p.values["push"]])
    )
    wide = np.concatenate([deviation[:3], deviation[6:9]]) * 2 * 1.959964
    np.testing.assert_allclose(high - low, wide, rtol=1e-3)
    # The priors of the push are no readings.
    chi2 = 2 * found.cost - np.sum(((found.x[6:9] - 1.3 * np.asarray(PUSH)) / 10.0) ** 2)
    np.testing.assert_allclose(both.chi2, chi2, rtol=1e-6)
    assert both.dof == 3 * (40 + 55 + 70) + 1 - 21
    assert both.ok


def test_what_a_fit_of_two_kinds_says(both):
    names = [quantity.name for quantity in both.quantities]
    assert "Ωx [throw 1]" in names and "Ωz [driven]" in names and "push y" in names
    assert set(both.state0) == {"throw", "driven"} and both.state0["throw"].omega.shape == (2, 3)
    assert "measured push along x: " in str(both)
    assert [e.shape for e in both.residuals] == [(3, 70, 3), (3, 70, 3)]
    assert (both.residuals[0][2] == 0).all() and (both.residuals[1][:2] == 0).all()
    assert both.rms[0] == pytest.approx(GYRO * np.sqrt(3), rel=0.15)
    assert [len(record.t) for record in both.model.recordings] == [40, 55, 70]
    motion, scenes = once(lambda x: (both.model.motion(x), both.model.scenes(x)))(both.x)
    assert motion["driven"].q.shape == (70, 4)
    np.testing.assert_allclose(scenes["driven"].torque.torque[0], both.values["push"])
    rows = identify.expected_quantities(both.model, both.x)
    assert [row.name for row in rows] == names


@pytest.mark.parametrize("index", [0, 1, 2])
def test_each_recording_of_a_fit_is_drawn(both, index):
    figure = rj.plot.fit(both, index=index)
    assert len(figure.axes) == 2
    assert rj.plot.residuals(both, index=index) is not None


@pytest.fixture(scope="module")
def alike():
    """Two recordings of one kind, and of two kinds."""
    records = {"a": gyro([0.4, 1.2, -0.3], 1), "b": gyro([1.0, 0.2, 0.5], 2, LONG)}
    bias = [identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.01, prior=0.02)]
    single = identify.Model(list(records.values()), identify.Ratios(), free=bias)
    parts = {n: identify.Model(r, identify.Ratios(), free=bias) for n, r in records.items()}
    return single, identify.Model(parts)


def test_two_kinds_alike_have_the_errors_of_one_kind(alike):
    single, joint = alike
    assert joint.size == single.size  # the bias, by its name, is one number of both
    (wanted,), found = (
        once(lambda omega, m=m: m.errors(m.start(BODY, omega)))(jnp.array([0.9, 0.5, 0.2]))
        for m in alike
    )
    np.testing.assert_allclose(found[0][0], wanted[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(found[1][1], wanted[1], rtol=0, atol=1e-13)


def test_two_kinds_alike_are_one_kind(alike):
    single, joint = alike
    alone, found = identify.fit(single, starts=1), identify.fit(joint, starts=1)
    # A search ends within a ten-thousandth of a standard deviation of the minimum.
    np.testing.assert_allclose(found.body.tensor, alone.body.tensor, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.values["bias"], alone.values["bias"], rtol=0, atol=1e-6)
    assert found.chi2 == pytest.approx(alone.chi2, rel=1e-6) and found.dof == alone.dof
    for mine, theirs in zip(found.quantities, alone.quantities, strict=True):
        np.testing.assert_allclose(mine.interval(), theirs.interval(), rtol=1e-4, atol=2e-6)


def test_unknown_noise_is_estimated_for_each_kind():
    noisy = [gyro([0.4, 1.2, -0.3], 1), gyro([1.0, 0.2, 0.5], 2, LONG)]
    noisy = [
        identify.Recording(r.t, (identify.Gyro(), np.asarray(r.readings[0].values) * 1.0))
        for r in noisy
    ]
    parts = {n: identify.Model(r, identify.Ratios()) for n, r in zip("ab", noisy, strict=True)}
    found = identify.fit(identify.Model(parts), starts=1)
    assert found.ok
    for sensor, row in ((0, 0), (1, 1)):
        np.testing.assert_allclose(found.noise[sensor][row], GYRO, rtol=0.2)


def test_a_hand_and_a_throw_weigh_one_body():
    rng = np.random.default_rng(3)
    held = model_of(wrench_of(TOOL) + NOISE * rng.normal(size=(T_HELD.size, 6)))
    free = rj.Inertia(TOOL.inertia.tensor)
    read = np.asarray(rj.simulate(free, rj.Spin([6.0, 3.0, 5.0]), LONG).ys.omega)[:40]
    read = read + 0.01 * rng.normal(size=read.shape)
    record = identify.Recording(SHORT, (identify.Gyro(0.01), read))
    thrown = identify.Model(record, identify.Mass(GUESS))
    hand = identify.fit(held)
    both = identify.fit(identify.Model({"hand": held, "throw": thrown}))
    assert both.ok
    largest = lambda p: p.body.inertia.moments[2]
    (low, high), (least, most) = both.interval_of(largest), hand.interval_of(largest)
    assert low <= TOOL.inertia.moments[2] <= high
    ratio = lambda p: p.body.inertia.moments[1] / p.body.inertia.moments[2]
    one, other = both.interval_of(ratio), hand.interval_of(ratio)
    assert one[1] - one[0] < 0.2 * (other[1] - other[0])
    assert high - low < most - least
    assert {q.name for q in both.quantities} >= {"mass", "com x", "Ωx [throw]"}


def test_a_measured_number_far_from_the_readings_is_said():
    weight = lambda p: p.body.mass  # the same function is the same program
    far, near = (identify.Measured(weight, kg, 0.001, "weight") for kg in (0.75, 0.7002))
    held = dataclasses.replace(model_of(wrench_of(TOOL)), measured=(far,))
    found = identify.fit(held)
    assert "the measured weight is" in str(found.explanation)
    found = identify.fit(dataclasses.replace(held, measured=(near,)))
    assert found.ok and "measured weight: +0.18 standard deviations" in str(found)


def test_what_several_kinds_refuse(kinds, both):
    one = kinds["throw"]
    with pytest.raises(ValueError, match="two kinds of recordings"):
        identify.Model({"throw": one})
    with pytest.raises(TypeError, match="give torque to the Model of one kind"):
        identify.Model(kinds, torque=rj.torques.Damping([0.1] * 3))
    with pytest.raises(TypeError, match="'b': wanted a Model of one kind, got Recording"):
        identify.Model({"a": one, "b": turn()})
    other = identify.Model(turn(), identify.Tensor(1.4))
    with pytest.raises(ValueError, match="the same chart of the body"):
        identify.Model({"a": one, "b": other})
    with pytest.raises(ValueError, match="no model with several kinds"):
        identify.Model({"a": both.model, "b": one})
    with pytest.raises(ValueError, match="a Free of this name"):
        identify.Model(kinds | {"again": _with_push(2.0)})
    with pytest.raises(ValueError, match="LogDensity: wanted a model of one kind"):
        identify.LogDensity(both)
    with pytest.raises(ValueError, match="wanted one recording, got 3"):
        identify.first_belief(both.model, both.x, rate=0.1)


def _with_push(size):
    law = rj.torques.ConstantTorque(size * PUSH)
    return identify.Model(turn(), CHART, torque=law, free=[PUSHED])


def test_each_body_of_several_is_one_in_all_kinds():
    charts = {"a": identify.Ratios(), "b": identify.Ratios()}
    first = identify.Model(
        {"a": [gyro([0.4, 1.2, -0.3], 1)], "b": [gyro([1.0, 0.2, 0.5], 2)]}, charts
    )
    law = rj.torques.ConstantTorque([0.0, 0.0, 0.0])
    other = {"b": [gyro([0.9, 0.3, 0.7], 3)]}
    second = identify.Model(other, {"b": charts["b"]}, torque=law)
    joint = identify.Model({"one": first, "two": second})
    assert joint.size == first.size + 3
    x = joint.start({"b": BODY}, [1.0, 0.5, 0.2])
    assert set(joint.bodies(x)) == {"a", "b"}
    parts = [part.model.bodies(part.take(x))["b"].tensor for part in joint.parts]
    np.testing.assert_array_equal(*parts)
    np.testing.assert_array_equal(joint.bodies(x)["b"].tensor, parts[0])
