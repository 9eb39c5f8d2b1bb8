"""What a NumPy masked array hides is not read, or refused in words: never taken for a number."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import _checks, body, exact, identify, plot, torques, tumblers
from rigidjax.motion.conserved import drift

WILD = 1e7
TS = np.linspace(0.0, 4.0, 41)
RATES = np.stack([np.sin(TS), np.cos(TS), 0.3 * TS], axis=1)
BODY = rj.Inertia.from_principal(1.0, 2.0, 2.5)
TOP = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
FACES = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
QUATERNIONS = np.tile([1.0, 0.0, 0.0, 0.0], (41, 1))


def hidden(values, at=-1):
    """The values with one that is masked, and wild beneath its mask."""
    values = np.array(values, float)
    mask = np.zeros(values.shape, bool)
    values.flat[at], mask.flat[at] = WILD, True
    return np.ma.masked_array(values, mask)


def table(cls):
    return {
        f"{cls.__name__}, times": lambda: cls(hidden(TS), RATES),
        f"{cls.__name__}, values": lambda: cls(TS, hidden(RATES)),
    }


class Turn(eqx.Module):
    """A torque that is its input."""

    source: Any

    def __call__(self, t, state, body):
        return self.source(t)


DOORS = {
    **table(torques.Linear),
    **table(torques.Held),
    **table(torques.Series),
    **table(torques.Tabulated),
    "Pulses, edges": lambda: torques.Pulses(hidden(TS), RATES[:-1]),
    "Pulses, torques": lambda: torques.Pulses(TS, hidden(RATES[:-1])),
    "Chebyshev": lambda: torques.Chebyshev(0.0, 1.0, hidden(np.ones((2, 3, 4)))),
    "ConstantTorque": lambda: torques.ConstantTorque(hidden([0.0, 1.0, 2.0])),
    "HeavyTop": lambda: torques.HeavyTop(1.0, hidden([0.0, 0.0, 1.0]), [0.0, 0.0, -9.81]),
    "two_frequencies, t": lambda: tumblers.two_frequencies(hidden(TS), RATES[:, 0]),
    "two_frequencies, values": lambda: tumblers.two_frequencies(TS, hidden(RATES[:, 0])),
    "two_frequencies, noise": lambda: tumblers.two_frequencies(TS, RATES[:, 0], hidden(TS + 1)),
    "Recording, t": lambda: identify.Recording(hidden(TS), (identify.Gyro(0.1), RATES)),
    "Gyro": lambda: identify.Gyro(hidden([0.1, 0.1, 0.1])),
    "Direction": lambda: identify.Direction(hidden([0.0, 0.0, 1.0]), 0.1),
    "windows, t": lambda: identify.windows(hidden(TS), rj.Spin(RATES), length=3),
    "windows, inputs": lambda: identify.windows(TS, rj.Spin(RATES), {"u": hidden(RATES)}, length=3),
    "Spin": lambda: rj.Spin(hidden([0.0, 1.0, 2.0])),
    "Spin, in a list": lambda: rj.Spin([0.0, np.ma.masked, 2.0]),
    "Inertia": lambda: rj.Inertia(hidden(np.eye(3))),
    "simulate": lambda: rj.simulate(BODY, rj.Spin([0.0, 1.0, 0.1]), hidden(TS)),
    "free_body": lambda: exact.free_body(BODY, rj.Spin([0.0, 1.0, 0.1]), hidden(1.0)),
    "rollout, inputs": lambda: rj.batch.rollout(
        BODY,
        rj.Spin(np.zeros((1, 3))),
        0.1,
        4,
        Turn(torques.Input("u")),
        inputs={"u": hidden(np.ones((1, 4, 3)))},
    ),
    "wahba": lambda: rj.so3.wahba(hidden(np.eye(3)), np.eye(3)),
    "wahba, weights": lambda: rj.so3.wahba(np.eye(3), np.eye(3), hidden([1.0, 1.0, 1.0])),
    "mean_quaternion": lambda: rj.so3.mean_quaternion(hidden(QUATERNIONS)),
    "points, masses": lambda: rj.shapes.points(hidden([1.0, 1.0]), [[1.0, 0, 0], [-1.0, 0, 0]]),
    "points, places": lambda: rj.shapes.points([1.0, 1.0], hidden([[1.0, 0, 0], [-1.0, 0, 0]])),
    "mesh, corners": lambda: rj.shapes.mesh(hidden(TOP), FACES, 1.0),
    "mesh, faces": lambda: rj.shapes.mesh(TOP, hidden(FACES), 1.0),
    "principal": lambda: body.principal(hidden(np.eye(3))),
    "drift": lambda: drift(hidden(TS), rj.Spin(RATES), BODY),
    "plot.motion": lambda: plot.motion(hidden(TS), rj.Spin(RATES)),
}


@pytest.mark.parametrize("door", DOORS)
def test_masked_entries_are_refused_in_words(door, unhooked):
    with pytest.raises(ValueError, match=r"masked array with 1 of \d+ entries masked, the first"):
        DOORS[door]()


def test_an_array_without_masked_entries_is_an_array():
    whole = np.ma.masked_array(RATES, np.zeros(RATES.shape, bool))
    np.testing.assert_array_equal(rj.Spin(whole).omega, RATES)
    data, mask = _checks.data_and_mask(whole)
    assert mask is None and type(data) is np.ndarray


GYRO = identify.Gyro(0.1)


@pytest.mark.parametrize(
    ("values", "mask"),
    [
        (hidden(RATES, 23), None),
        (RATES, np.ma.masked_array(np.ones(41, bool), np.arange(41) == 7)),
        (hidden(RATES, 23), np.ma.masked_array(np.ones(41, int), np.zeros(41, bool))),
    ],
)
def test_a_masked_reading_is_not_read(values, mask, unhooked):
    other = (identify.Gyro(0.2), RATES)
    pair = (GYRO, values) if mask is None else (GYRO, values, mask)
    read = identify.Recording(TS, pair, other).readings[0]
    assert np.flatnonzero(~np.asarray(read.mask)).tolist() == [7]
    assert float(jnp.abs(read.values).max()) < 2.0


def test_a_masked_row_keeps_its_time_between_readings(unhooked):
    record = identify.Recording(TS, (GYRO, hidden(RATES, 23)))
    assert record.t.shape == (41,) and not bool(record.readings[0].mask[7])
    assert record.size == 3 * 40
    # The motion starts at a reading.
    late = identify.Recording(TS, (GYRO, hidden(RATES, 1)))
    np.testing.assert_array_equal(late.t, TS[1:])


def test_a_masked_attitude_is_not_read(unhooked):
    sensor = identify.AttitudeSensor(0.1)
    for values in (QUATERNIONS, np.tile(np.eye(3), (41, 1, 1))):
        masked = hidden(values, 5 * values[0].size)
        record = identify.Recording(TS, (sensor, masked), (GYRO, RATES))
        assert np.flatnonzero(~np.asarray(record.readings[0].mask)).tolist() == [5]
        np.testing.assert_array_equal(record.readings[0].values, QUATERNIONS)


def test_a_masked_quantity_of_astropy_is_not_read(unhooked):
    units, masked = (
        pytest.importorskip("astropy.units"),
        pytest.importorskip("astropy.utils.masked"),
    )
    values = np.where(np.arange(41)[:, None] == 9, WILD, np.degrees(RATES))
    rates = masked.Masked(values * units.deg / units.s, mask=values == WILD)
    read = identify.Recording(TS, (GYRO, rates), (identify.Gyro(0.2), RATES)).readings[0]
    assert np.flatnonzero(~np.asarray(read.mask)).tolist() == [9]
    np.testing.assert_allclose(read.values[0], RATES[0], rtol=1e-14)
    with pytest.raises(ValueError, match="41 entries masked"):
        tumblers.two_frequencies(masked.Masked(TS * units.s, mask=TS == 2.0), RATES[:, 0])
