"""A body on a torsion bar: periods beside a weighing, the bar's stiffness free, plans of hangings."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from identify.test_held_body import GUESS, TOOL

import rigidjax as rj
from rigidjax import identify
from rigidjax.suspensions import TorsionBar, period

STIFFNESS, ROD, SIGMA = 0.35, 2e-3, 1e-4  # N m/rad, kg m², s
AXES = np.array(
    [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, 1], [1, 0, 1], [1, 2, 0]], float
)
AXES = AXES / np.linalg.norm(AXES, axis=1)[:, None]
T = np.linspace(0.0, 3.0, 4)
STILL = rj.torques.LoggedMotion(T, np.zeros((4, 3)), np.tile([1.0, 0, 0, 0], (4, 1)))
TENSOR = np.asarray(TOOL.inertia.tensor)
MOMENTS = np.append(np.einsum("ai,ij,aj->a", AXES, TENSOR, AXES), ROD)
TRUE = 2 * np.pi * np.sqrt(MOMENTS / STIFFNESS)

NAMES = ["Ixx", "Iyy", "Izz", "Iyz", "Ixz", "Ixy", "stiffness"]


def swings(point):
    bar = point.values["stiffness"]
    hung = jax.vmap(lambda axis: period(point.body, TorsionBar(axis, bar)))(jnp.asarray(AXES))
    return jnp.append(hung, 2 * jnp.pi * jnp.sqrt(ROD / bar))  # the last is a rod on the same bar


def weighing(noise, mass=float(TOOL.mass)):
    """A body at rest on a sensor shows its weight, and the place of its line."""
    sensor = identify.ForceTorque(noise, gravity=[0.0, 0.0, -9.81])
    x, y, _ = TOOL.com
    row = mass * 9.81 * np.array([0.0, 0.0, 1.0, y, -x, 0.0])
    record = identify.Recording(T, (sensor, np.tile(row, (4, 1))), inputs={"motion": STILL})
    stiffness = identify.Free(0.9 * STIFFNESS, "stiffness", scale=0.1, unit="N m")
    timed = [identify.Measured(swings, TRUE, SIGMA, "period")]
    torque = rj.torques.Carried()
    return identify.Model(
        record, identify.Mass(GUESS), torque=torque, free=[stiffness], measured=timed
    )


@pytest.fixture(scope="module")
def found():
    return identify.fit(weighing((1e-3, 1e-4)))


def propagated(sigmas):
    """The deviations of six components and the stiffness, by the closed forms, in NumPy."""
    i, j = np.array([(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)]).T
    twice = np.where(i == j, 1.0, 2.0)
    by_tensor = np.vstack([twice * AXES[:, i] * AXES[:, j], np.zeros(6)])
    by_tensor = 0.5 * (TRUE / MOMENTS)[:, None] * by_tensor
    rows = np.column_stack([by_tensor, -0.5 * TRUE / STIFFNESS]) / np.asarray(sigmas)[:, None]
    return np.sqrt(np.diag(np.linalg.inv(rows.T @ rows)))


def test_periods_and_a_weight_give_the_body(found):
    assert found.ok
    np.testing.assert_allclose(found.body.inertia.tensor, TENSOR, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.body.mass, TOOL.mass, rtol=1e-9)
    np.testing.assert_allclose(found.values["stiffness"], STIFFNESS, rtol=1e-7)
    rows = {quantity.name: quantity for quantity in found.quantities}
    deviations = [rows[name].deviation for name in NAMES]
    np.testing.assert_allclose(deviations, propagated(np.full(8, SIGMA)), rtol=1e-4)
    assert "measured period 7: " in str(found)
    # What no weight and no period shows.
    assert np.isinf(rows["com z"].deviation)
    assert "Com z is not determined" in str(found)


def test_a_plan_counts_what_is_measured_beside(found):
    """A hanging that is left out has a large deviation: one program for all choices."""
    off = np.where(np.arange(8) == 3, 1e3, SIGMA)
    (timed,) = found.model.measured
    timed = dataclasses.replace(timed, sigma=jnp.asarray(off))
    model = dataclasses.replace(found.model, measured=(timed,))
    x = model.start(TOOL).at[10].set(0.1 * STIFFNESS / 0.1)
    rows = {row.name: row.deviation for row in identify.expected_quantities(model, x)}
    np.testing.assert_allclose([rows[name] for name in NAMES], propagated(off), rtol=1e-6)
    # Nothing but the periods depends on the stiffness, in units of 0.1 N m.
    slopes = 0.05 * TRUE / STIFFNESS / off
    information = identify.fisher(model, x)[10, 10]
    np.testing.assert_allclose(information, slopes @ slopes, rtol=1e-9)


@pytest.mark.usefixtures("unhooked")
def test_a_number_beside_the_scene_is_checked():
    with pytest.raises(TypeError, match="Free 'length': wanted an array of numbers, got str"):
        identify.Free("length", "length")
    with pytest.raises(ValueError, match="Free 'length'"):
        identify.Free(np.nan, "length")


@pytest.mark.usefixtures("unhooked")
def test_measured_numbers_are_checked():
    of = lambda point: point
    with pytest.raises(ValueError, match=r"'T': sigma: wanted one or \(2,\), got \(3,\)"):
        identify.Measured(of, [1.0, 2.0], [0.1, 0.1, 0.1], "T")
    with pytest.raises(ValueError, match="'T': sigma: wanted a positive number"):
        identify.Measured(of, [1.0, 2.0], [0.1, 0.0], "T")
    with pytest.raises(ValueError, match=r"'T': value: wanted a number or \(k,\) numbers"):
        identify.Measured(of, np.ones((2, 2)), 0.1, "T")
    two = identify.Measured(of, [1.0, 2.0], [0.5, 0.1], "T")
    np.testing.assert_allclose(two.residual(jnp.array([2.0, 1.0])), [-2.0, 10.0])
    with pytest.raises(ValueError, match=r"'T': wanted \(2,\) of `of`, got \(3,\)"):
        two.residual(jnp.ones(3))
