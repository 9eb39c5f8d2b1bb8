"""Attitudes and rates from readings alone; SciPy's `align_vectors` is the oracle."""

import jax.numpy as jnp
import numpy as np
import pytest
import turns
from scipy.spatial.transform import Rotation

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.data.reference_states import attitudes, rates

TS = np.linspace(0.0, 1.0, 30)
PLACES = np.array([[0.1, 0.0, 0.0], [0.0, 0.2, 0.0], [-0.1, -0.1, 0.15], [0.0, 0.1, -0.1]])
WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])


@pytest.fixture(scope="module")
def motion():
    body = rj.Inertia.from_principal(1.0, 1.6, 2.1)
    return rj.simulate(body, rj.Attitude([0.5, 0.5, -0.5, 0.5], [2.0, 4.0, -1.0]), TS).ys


def markers(motion, places, sigma):
    rng = np.random.default_rng(1)
    drift = np.outer(TS, [1.0, 2.0, 3.0])
    out = []
    for place in places:
        at = turns.to_world(motion.q, jnp.asarray(place))
        out.append(
            (identify.Marker(place), np.asarray(at) + drift + sigma * rng.normal(size=(30, 3)))
        )
    return identify.Recording(TS, *out)


def directions(motion, worlds, mounting=None):
    out = []
    for world in worlds:
        seen = turns.to_body(motion.q, jnp.asarray(world))
        if mounting is not None:
            seen = seen @ rj.so3.exp(-jnp.asarray(mounting)).T
        out.append((identify.Direction(world, mounting=mounting), np.asarray(seen)))
    return identify.Recording(TS, *out)


def test_markers_show_the_rotation_nearest_to_them(motion):
    record = markers(motion, PLACES, 2e-3)
    t, q = attitudes(record)
    np.testing.assert_array_equal(t, TS)
    seen = np.stack([np.asarray(r.values) for r in record.readings], axis=1)
    for k in range(0, 30, 7):
        best, _ = Rotation.align_vectors(seen[k] - seen[k].mean(0), PLACES - PLACES.mean(0))
        np.testing.assert_allclose(
            Rotation.from_quat(np.roll(q[k], -1)).as_matrix(), best.as_matrix(), atol=1e-12
        )


@pytest.mark.parametrize("mounting", [None, [0.3, -0.2, 0.1]])
def test_two_directions_show_the_attitude(motion, mounting):
    _, q = attitudes(directions(motion, WORLD, mounting))
    np.testing.assert_allclose(np.abs(np.sum(q * np.asarray(motion.q), axis=1)), 1.0, atol=1e-12)


def test_what_leaves_a_turn_free_shows_none(motion):
    line = np.outer([0.0, 0.1, 0.3], [1.0, 2.0, 0.5])
    for record in (
        directions(motion, WORLD[:1]),
        markers(motion, PLACES[:2], 0.0),
        markers(motion, line, 0.0),
    ):
        t, q = attitudes(record)
        assert t.size == 0 and q.shape == (0, 4)
        assert rates(record)[1].shape == (0, 3)


def test_masked_frames_are_left_out(motion):
    record = markers(motion, PLACES, 0.0)
    values = [np.array(r.values) for r in record.readings]
    values[1][4] = np.nan
    mask = np.arange(30) != 4
    masked = identify.Recording(
        TS, *((r.sensor, v, mask) for r, v in zip(record.readings, values, strict=True))
    )
    np.testing.assert_array_equal(attitudes(masked)[0], np.delete(TS, 4))


def test_rates_between_attitudes_are_the_body_rate(motion):
    t, w = rates(markers(motion, PLACES, 1e-3))
    true = np.stack([np.interp(t, TS, np.asarray(motion.omega)[:, k]) for k in range(3)], axis=1)
    # Over 0.3 rad: the axis moves by a few per cent, the noise is a hundredth of a radian.
    assert np.abs(w - true).max() < 0.1 * np.linalg.norm(true, axis=1).max()


def test_an_attitude_sensor_that_is_mounted_askew(motion):
    mounting = jnp.array([0.3, -0.2, 0.1])
    read = turns.perturbed(motion.q, jnp.tile(mounting, (30, 1)))
    # Every other reading with the other sign: the same attitude.
    read = np.asarray(read) * np.where(np.arange(30) % 2, -1.0, 1.0)[:, None]
    record = identify.Recording(TS, (identify.AttitudeSensor(mounting=mounting), read))
    _, q = attitudes(record)
    np.testing.assert_allclose(np.abs(np.sum(q * np.asarray(motion.q), axis=1)), 1.0, atol=1e-12)
    t, w = rates(record)
    true = np.stack([np.interp(t, TS, np.asarray(motion.omega)[:, k]) for k in range(3)], axis=1)
    assert np.abs(w - true).max() < 0.02 * np.linalg.norm(true, axis=1).max()


def test_a_model_starts_at_the_attitude_that_markers_or_directions_show(motion):
    fall, box = rj.torques.UniformGravity([0.0, 0.0, 0.0]), rj.shapes.box(1.0, [0.3, 0.2, 0.1])
    dots = markers(motion, PLACES, 0.0)
    along = [(identify.Direction(w, 0.01), turns.to_body(motion.q, jnp.asarray(w))) for w in WORLD]
    for record in (dots, identify.Recording(TS, *along)):
        model = identify.Model(record, identify.Known(box), torque=fall)
        q = model.reference.state.q[0]
        np.testing.assert_allclose(abs(float(q @ motion.q[0])), 1.0, atol=1e-12)
