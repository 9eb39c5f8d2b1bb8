"""SciPy's `Rotation` is taken wherever a quaternion is: it is active, and its components scalar last."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rigidjax as rj
from rigidjax import identify

ONE = Rotation.from_euler("ZYX", [0.4, -0.9, 2.1])
MANY = Rotation.random(5, random_state=0)
V = np.array([0.3, -1.2, 0.7])


def test_the_maps_take_one():
    turned = rj.quaternion.rotate(ONE, V)
    np.testing.assert_allclose(turned, ONE.apply(V), atol=1e-15)
    np.testing.assert_allclose(rj.quaternion.to_matrix(ONE), ONE.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(rj.quaternion.log(ONE), ONE.as_rotvec(), atol=1e-15)
    np.testing.assert_allclose(rj.euler.from_quaternion(ONE, "ZYX"), [0.4, -0.9, 2.1], atol=1e-15)
    np.testing.assert_array_equal(rj.quaternion.to_xyzw(ONE), ONE.as_quat())


def test_states_take_one_and_many():
    attitude = rj.Attitude(ONE, V)
    np.testing.assert_array_equal(attitude.q, ONE.as_quat()[[3, 0, 1, 2]])
    rigid = rj.Rigid(V, V, ONE, V)
    np.testing.assert_array_equal(rigid.q, attitude.q)
    batch = rj.Attitude(MANY, np.tile(V, (5, 1)))
    rotated = jax.vmap(rj.quaternion.rotate)(batch.q, batch.omega)
    np.testing.assert_allclose(rotated, MANY.apply(V), atol=1e-15)
    np.testing.assert_allclose(rj.quaternion.check(MANY), batch.q, atol=1e-15)


def test_bodies_take_one():
    body = rj.shapes.box(1.0, [0.3, 0.2, 0.1])
    m = ONE.as_matrix()
    wanted = m @ np.asarray(body.inertia.tensor) @ m.T
    np.testing.assert_allclose(body.rotate(ONE).inertia.tensor, wanted, atol=1e-17)


def test_readings_of_an_attitude_sensor_may_be_many():
    t = np.arange(5.0)
    record = identify.Recording(t, (identify.AttitudeSensor(0.01), MANY))
    np.testing.assert_array_equal(record.readings[0].values, MANY.as_quat()[:, [3, 0, 1, 2]])


def test_where_no_attitude_is_wanted_it_is_refused(unhooked):
    with pytest.raises(ValueError, match=r"omega: wanted shape \(3,\), got \(4,\)"):
        rj.Spin(ONE)
    with pytest.raises(TypeError, match=r"xyzw: wanted components \(x, y, z, w\), got a Rotation"):
        rj.quaternion.from_xyzw(ONE)
    np.testing.assert_array_equal(
        rj.quaternion.from_xyzw(jnp.asarray(ONE.as_quat())), rj.Attitude(ONE, V).q
    )
