"""Recordings whose inputs are samples, each held until the next one: the motion is that of a batch."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify, torques
from rigidjax.identify import Free, Gyro, Known, Model, Recording

H = 0.05
BODY = rj.Inertia.from_principal(1.0, 2.0, 2.5)
RNG = np.random.default_rng(3)
GAIN = np.array([0.5, -0.3, 0.8])


class Push(torques.AbstractTorque):
    """A driven torque along an axis of the body."""

    feels = rj.motion.HasSpin
    gain: jax.Array = eqx.field(converter=jnp.asarray)
    source: torques.Input | torques.Delayed | torques.Held = torques.Input("u")

    @property
    def jump_times(self):
        return self.source.jump_times

    def __call__(self, t, state, body):
        return self.gain * self.source(t)


def driven(count, law, start):
    """Times, the input, and the rates of a batch's steps of order 4."""
    u = RNG.normal(size=count)
    begin = rj.Spin(np.asarray(start)[None])
    run = rj.batch.rollout(BODY, begin, H, count - 1, law, inputs={"u": u[None, :-1]}, save_every=1)
    motion = getattr(run, "motion", run)
    return 2.0 + H * np.arange(count), u, np.concatenate([begin.omega, motion.omega[0]])


@pytest.mark.parametrize("delay", [None, 1.3 * H])
def test_the_motion_is_that_of_a_batch_and_its_numbers_come_back(delay):
    source = torques.Input("u") if delay is None else torques.Delayed(torques.Input("u"), delay)
    law = Push(GAIN, source)
    runs = [driven(41, law, [0.5, 1.0, -0.4]), driven(30, law, [-0.2, 0.3, 1.1])]
    recordings = [Recording(t, (Gyro(1e-3), w), inputs={"u": u}) for t, u, w in runs]
    free = [Free(lambda s: s.torque.gain, "gain")]
    found = identify.fit(
        Model(recordings, Known(BODY), torque=Push(np.ones(3), source), free=free), tolerance=1e-6
    )
    assert found.ok
    np.testing.assert_allclose(found.values["gain"], GAIN, rtol=0, atol=1e-9)
    at = found.model.motion(found.x)
    for k, (t, _, w) in enumerate(runs):
        np.testing.assert_allclose(at.omega[k, : t.size], w, rtol=0, atol=1e-9)
    # From the numbers of the batch itself the motion is the same to round-off.
    one = Model(recordings[0], Known(BODY), torque=law)
    begin = one.start(omega=jnp.array([0.5, 1.0, -0.4]))
    np.testing.assert_allclose(one.motion(begin).omega, runs[0][2], rtol=0, atol=1e-14)


def test_a_sensor_reads_the_torque_of_held_samples():
    """An accelerometer off the centre feels the angular acceleration, which jumps with the input."""
    t, u, _ = driven(30, Push(GAIN), [0.5, 1.0, -0.4])
    start = rj.Attitude([1.0, 0, 0, 0], [0.5, 1.0, -0.4])
    sensors = Gyro(1e-3), identify.Accelerometer(1e-3, place=[0.3, -0.2, 0.4])
    law = Push(GAIN, torques.Held(t, u))
    rates, forces = identify.simulate_readings(sensors, BODY, start, t, law)
    record = Recording(
        t, (sensors[0], rates), (sensors[1], forces), (identify.AttitudeSensor(1e-3), np.tile([1.0, 0, 0, 0], (30, 1)), np.arange(30) == 0), inputs={"u": u}
    )  # fmt: skip
    model = Model(record, Known(BODY), torque=Push(GAIN))
    off = model.errors(model.start(omega=start.omega))
    # Steps of order 4 from sample to sample.
    np.testing.assert_allclose(off[0], 0.0, atol=1e-7)
    np.testing.assert_allclose(off[1], 0.0, atol=1e-7)


def test_samples_that_no_torque_reads_may_have_any_times():
    t = np.array([0.0, 0.1, 0.3, 0.35])
    record = Recording(t, (Gyro(1e-3), np.ones((4, 3))), inputs={"u": np.ones(4)})
    model = Model(record, Known(BODY))
    assert model.integrator is None


UNEVEN = np.array([0.0, 0.1, 0.3, 0.4])


EVEN = H * np.arange(4.0)


def record(t=EVEN):
    return Recording(t, (Gyro(1e-3), np.ones((4, 3))), inputs={"u": np.ones(4)})


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Model([record(), record(UNEVEN)], Known(BODY), torque=Push(GAIN)), r"inputs\['u'\]: samples are held through even steps, and the times of recording 1 have steps from 0\.1 to 0\.2 s"),
        (lambda: Model(record(), Known(BODY), torque=Push(GAIN), integrator=identify.Adaptive()), "integrator: samples as inputs are held through one step"),
        (lambda: Recording(UNEVEN, (Gyro(1e-3), np.ones((4, 3))), inputs={"u": np.ones(3)}), "wanted a sample for each of 4 times"),
        (lambda: Model(record(), Known(BODY), torque=Push(GAIN, torques.Input("v"))), "it reads 'v', and recording 0 has 'u'"),
    ],
)  # fmt: skip
def test_mistakes_are_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
