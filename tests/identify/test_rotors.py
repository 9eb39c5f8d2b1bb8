"""A thrown drone: what its gyro and the speeds or commands of its rotors show."""

import functools
import re

import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify, torques

T = 2.5e-3 * np.arange(180)
BODY = rj.Inertia(np.array([[2.1e-3, 1e-4, -5e-5], [1e-4, 2.6e-3, 8e-5], [-5e-5, 8e-5, 3.9e-3]]))
PLACES = np.array([[0.08, -0.1, 0.0], [-0.08, -0.1, 0.0], [-0.08, 0.1, 0.0], [0.08, 0.1, 0.0]])
UP, SPINS, FULL = np.tile([0.0, 0, 1], (4, 1)), np.array([1.0, -1, 1, -1]), 1400.0
THRUST, DRAG, ROTOR, LAG = np.array([1.4, 1.5, 1.6, 1.5]) * 1e-6, 2.2e-8, 9e-6, 0.025
BIAS = identify.Free(lambda s: s.sensors[0].bias, "bias", scale=0.05)
BEGIN = 0.03 + 0.1 * np.arange(4)
COMMANDS = np.where((T[:, None] > BEGIN) & (T[:, None] < BEGIN + 0.06), 0.7, 0.1)


@functools.cache
def flight():
    """The readings of a gyro, and the speeds of the rotors, which follow their commands."""
    motors = torques.Lagged(torques.Held(T, FULL * COMMANDS), LAG)
    law = torques.Rotors(PLACES, UP, SPINS, THRUST, DRAG, motors, ROTOR)
    sol = rj.simulate(BODY, rj.Spin([3.0, -4.0, 2.0]), T, law)
    rng = np.random.default_rng(3)
    return np.asarray(sol.ys.omega) + 0.02 * rng.normal(size=(T.size, 3)), np.asarray(sol.own[0])


def by_speed(*, order=(0, 1, 2, 3), spins=SPINS, unit=1.0, further=()):
    rates, speeds = flight()
    law = torques.Rotors(
        PLACES[list(order)], UP, spins, np.full(4, 1e-6 / unit**2), 1e-8 / unit**2,
        torques.Delayed(torques.Input("speeds"), 0.0), ROTOR,
    )  # fmt: skip
    free = [
        identify.Free(lambda s: s.torque.thrust, "thrust", scale=0.1, positive=True),
        identify.Free(lambda s: s.torque.drag, "drag", scale=1e-8 / unit**2),
        BIAS,
    ]
    gyro, inputs = identify.Gyro(bias=[0.0] * 3), {"speeds": torques.Series(T, unit * speeds)}
    record = identify.Recording(T, (gyro, rates), inputs=inputs)
    return identify.Model(record, identify.Tensor(2e-3), torque=law, free=[*free, *further])


def test_speeds_of_the_rotors_show_the_moments_and_each_thrust():
    """The truth is within the intervals; speeds in rpm fit as well, and the status asks for them."""
    found = identify.fit(by_speed(), starts=1)
    assert found.status.startswith("ok") and "rpm" not in found.status
    assert found.model.state_kind is rj.Spin
    truth = dict(zip(("I1", "I2", "I3"), np.linalg.eigvalsh(BODY.tensor), strict=True))
    truth |= {f"thrust {k}": one for k, one in enumerate(THRUST)} | {"drag": DRAG}
    for name, number in truth.items():
        low, high = found.interval(0.99)[name]
        assert low < number < high and high - low < 0.3 * number, name
    in_rpm = identify.fit(by_speed(unit=30 / np.pi), starts=1)
    assert in_rpm.status.endswith("the speeds of the rotors are in rad/s, not rpm")
    np.testing.assert_allclose(in_rpm.body.moments / found.body.moments, 30 / np.pi, rtol=1e-3)


def test_without_a_known_thrust_or_inertia_only_ratios_show():
    rotor = identify.Free(lambda s: s.torque.inertia, "rotor", scale=1e-5)
    found = identify.fit(by_speed(further=[rotor]), starts=1)
    numbers = "I1, I2, I3, thrust 0, thrust 1, thrust 2, thrust 3, drag and rotor"
    assert f"{numbers} rise together: only their ratios are determined." in found.identifiability


@pytest.mark.parametrize(
    ("order", "spins", "remedy"),
    [
        ((2, 0, 3, 1), SPINS, r"rows \[1, 3, 0, 2\] .* spins \(1, -1, 1, -1\)"),
        ((0, 1, 2, 3), -SPINS, r"rows \[0, 1, 2, 3\] .* spins \(1, -1, 1, -1\)"),
    ],
    ids=["order", "sense"],
)
def test_rotors_in_another_order_or_sense_are_the_cause(order, spins, remedy):
    found = identify.fit(by_speed(order=order, spins=spins), starts=1)
    assert not found.ok
    (cause,) = found.causes
    assert "rotors in another order or sense of turning" in cause.words
    assert re.search(remedy, cause.remedy)


def by_command(commands, spins=SPINS):
    law = torques.Rotors(
        PLACES, UP, spins, THRUST * FULL**2, DRAG * FULL**2,
        torques.Lagged(torques.Input("u"), 0.03), ROTOR * FULL,
    )  # fmt: skip
    free = [
        identify.Free(lambda s: s.torque.drag, "drag", scale=0.01),
        identify.Free(lambda s: s.torque.inertia, "rotor", scale=0.01),
        identify.Free(lambda s: s.torque.speeds.time, "lag", scale=0.01),
    ]
    record = identify.Recording(T, (identify.Gyro(0.02), flight()[0]), inputs={"u": commands})
    return identify.Model(record, identify.Tensor(2e-3), torque=law, free=free)


def test_pulses_one_by_one_show_what_pulses_together_do_not():
    """The plan of a throw; the fit of commands alone has the planned deviations, and finds the lag.
    With the spins reversed drag and inertia come out below zero, and the report says so.
    """
    together = np.tile(COMMANDS.max(1, keepdims=True), (1, 4))
    deviations = []
    for commands in (COMMANDS, together):
        model = by_command(commands)
        x = model.start(BODY, [3.0, -4.0, 2.0])
        deviations.append({q.name: q.deviation for q in identify.expected_quantities(model, x)})
    one_by_one, at_once = deviations
    for name in ("I1", "I2", "I3"):
        assert one_by_one[name] < 2e-5 and at_once[name] > 20 * one_by_one[name]
    found = identify.fit(by_command(COMMANDS), starts=1)
    assert found.status.startswith("ok")
    lag = next(q for q in found.quantities if q.name == "lag")
    assert abs(lag.value - LAG) < 4 * lag.deviation < 0.1 * LAG
    assert lag.deviation == pytest.approx(one_by_one["lag"], rel=0.3)
    turned = identify.fit(by_command(COMMANDS, -SPINS), starts=1)
    assert turned.values["drag"] < 0 and "below zero if the spins are wrong" in turned.advice
    np.testing.assert_allclose(turned.body.moments, found.body.moments, rtol=1e-3)
