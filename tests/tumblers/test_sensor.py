"""Light curves as a sensor: SciPy's rotations and the closed forms of `rigidjax.tumblers.brightness`."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once
from scipy.spatial.transform import Rotation

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify import SensorInput
from rigidjax.tumblers import Brightness, brightness

AXES = np.array([2.0, 1.3, 1.0])
SUN, OBSERVER = [1.0, 0.0, 0.0], [0.8, 0.6, 0.3]
TS = np.linspace(0.0, 20.0, 200)
BODY = rj.shapes.ellipsoid(1.0, AXES).inertia


def moment(q, body=BODY, t=0.0):
    return SensorInput(jnp.asarray(t), rj.Attitude(q, [0.0, 0.0, 1.0]), body, lambda t, y, args: y)


@pytest.mark.parametrize("unit", ["flux", "mag"])
def test_it_reads_the_ellipsoid_that_turns_as_the_body_does(unit):
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5])
    q = np.roll(turn.as_quat(), 1)
    seen = brightness.ellipsoid(AXES, turn.inv().apply(SUN), turn.inv().apply(OBSERVER))
    relative = float(seen) / (np.pi * np.prod(AXES) ** (2 / 3))
    wanted = 3.0 * relative if unit == "flux" else 15.0 - 2.5 * np.log10(relative)
    level = 3.0 if unit == "flux" else 15.0
    for axes in (None, 7.0 * AXES):
        sensor = Brightness(SUN, OBSERVER, unit=unit, level=level, semi_axes=axes)
        np.testing.assert_allclose(sensor.predict(moment(q)), wanted, rtol=1e-13)
    np.testing.assert_allclose(sensor.error(moment(q), jnp.asarray(wanted + 0.5)), [0.5])


def test_directions_may_move():
    table = rj.torques.Linear([0.0, 10.0], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    moving, still = Brightness(table, OBSERVER), Brightness([0.5, 0.5, 0.0], OBSERVER)
    at = moment([0.8, 0.6, 0.0, 0.0], t=5.0)
    np.testing.assert_allclose(moving.predict(at), still.predict(at), rtol=1e-14)


def test_tables_of_other_lengths_are_stacked():
    def record(count) -> Any:
        t = np.linspace(0.0, 10.0, count)
        table = rj.torques.Linear(t, np.stack([np.cos(t), np.sin(t), 0 * t], axis=1))
        return identify.Recording(TS[:20], (Brightness(table, OBSERVER, noise=0.1), np.ones(20)))

    problem = identify.Model([record(5), record(9)], identify.PrincipalRatios())
    table: Any = problem.records.readings[0].sensor.sun
    short = jax.tree.map(lambda leaf: leaf[0], table)
    for t in (0.0, 4.0, 10.0, 12.0):
        np.testing.assert_allclose(short(t), record(5).readings[0].sensor.sun(t), atol=1e-14)


def tumbling(unit="mag"):
    sensor = Brightness(SUN, OBSERVER, noise=0.02, unit=unit)
    state = rj.Attitude([1.0, 0.0, 0.0, 0.0], [0.3, 1.0, 0.4])
    motion = rj.simulate(BODY, state, TS).ys
    clean = once(
        jax.vmap(lambda t, y: sensor.predict(SensorInput(t, y, BODY, lambda t, y, args: y)))
    )
    values = np.asarray(clean(jnp.asarray(TS), motion))
    return sensor, values + 0.02 * np.random.default_rng(0).normal(size=TS.size)


@pytest.mark.long
def test_a_fit_and_a_design():
    sensor, values = tumbling()
    clouds = np.ones(TS.size, bool)
    clouds[60:80] = False
    values[60:80] = np.nan
    record = identify.Recording(TS, (sensor, values, clouds))

    def level_of(scene: Any) -> Any:
        return scene.sensors[0].level

    level = identify.Free(level_of, "level")
    problem = identify.Model(record, identify.PrincipalRatios(), free=[level])
    start = problem.start(BODY, [0.3, 1.02, 0.4])
    fit = identify.fit(problem, initial=start, starts=1)
    assert fit.ok and abs(fit.chi2 - fit.dof) < 5 * np.sqrt(2 * fit.dof)
    moments = np.asarray(BODY.moments)
    truth = {"Ix/Iz": moments[0] / moments[2], "Iy/Iz": moments[1] / moments[2], "level": 0.0}
    planned = identify.expected_quantities(problem, fit.x)
    for quantity, bound in zip(fit.quantities, planned, strict=True):
        np.testing.assert_allclose(quantity.deviation, bound.deviation, rtol=0.2)
        if quantity.name in truth:
            assert abs(quantity.value - truth[quantity.name]) < 4 * quantity.deviation


def test_derivatives_by_the_attitude():
    sensor = Brightness(SUN, OBSERVER, unit="mag")
    turn = jnp.array([0.2, -0.4, 0.7])

    def seen(v):
        return sensor.predict(moment(rj.quaternion.exp(v)))

    slope, h = once(jax.grad(seen))(turn), 1e-6
    quick = once(seen)
    for k in range(3):
        step = h * np.eye(3)[k]
        difference = (quick(turn + step) - quick(turn - step)) / (2 * h)
        np.testing.assert_allclose(slope[k], difference, atol=1e-8)


@pytest.mark.parametrize(
    ("given", "options", "error", "words"),
    [
        (([0.0, 0, 0], OBSERVER), {}, ValueError, "sun: wanted a direction, got a vector of len"),
        ((SUN, [1.0, 2.0]), {}, ValueError, r"observer: wanted shape \(3,\)"),
        ((np.ones((5, 3)), OBSERVER), {}, ValueError, r"sun: wanted .*torques.Linear\(times"),
        ((SUN, OBSERVER), {"unit": "magnitude"}, ValueError, "unit: wanted one of flux, mag"),
        ((SUN, OBSERVER), {"noise": 0.0}, ValueError, "noise: wanted a positive"),
        ((SUN, OBSERVER), {"level": -1.0}, ValueError, "level: wanted a positive flux"),
        ((SUN, OBSERVER), {"semi_axes": [1.0, 0, 1]}, ValueError, "semi_axes: wanted three posit"),
    ],
)
def test_what_is_refused(given, options, error, words):
    with pytest.raises(error, match=words):
        Brightness(*given, **options)


def test_magnitudes_given_as_a_flux_are_refused():
    with pytest.raises(ValueError, match="flux at index 0 is far below zero"):
        identify.Recording([0.0, 1.0], (Brightness(SUN, OBSERVER, noise=0.1), [-5.0, -5.0]))


def test_a_sensor_is_a_tree_of_numbers():
    sensor = Brightness(SUN, OBSERVER, noise=0.1, semi_axes=AXES)
    numbers = [leaf for leaf in jax.tree.leaves(sensor) if eqx.is_inexact_array(leaf)]
    assert len(numbers) == 5
