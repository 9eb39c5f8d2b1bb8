"""What has a unit becomes numbers in SI, or is refused: it is never taken for a bare number."""

import jax.numpy as jnp
import numpy as np
import pint
import pytest
from astropy import units as u

import rigidjax as rj
from rigidjax import identify

REGISTRY = pint.UnitRegistry()
DEGREE = np.pi / 180


def of(values, unit, library):
    """Values in a unit such as `deg / s`."""
    return np.asarray(values) * library(unit)


LIBRARIES = {"astropy": u.Unit, "pint": REGISTRY.parse_units}


@pytest.mark.usefixtures("unhooked")
@pytest.mark.parametrize("library", LIBRARIES.values(), ids=LIBRARIES)
def test_units_become_si(library):
    rate = of([10.0, 20.0, 30.0], "deg / s", library)
    np.testing.assert_allclose(rj.Spin(rate).omega, np.array([10, 20, 30]) * DEGREE)
    # A list of numbers with units, as one writes them one by one.
    np.testing.assert_allclose(rj.Spin(list(rate)).omega, np.array([10, 20, 30]) * DEGREE)
    box = rj.shapes.box(of(190.0, "g", library), of([70.0, 140.0, 8.0], "mm", library))
    like = rj.shapes.box(0.19, [0.07, 0.14, 0.008])
    np.testing.assert_allclose(box.mass, like.mass)
    np.testing.assert_allclose(box.inertia.moments, like.inertia.moments)
    quarter = rj.quaternion.exp(of([0.0, 0.0, 90.0], "deg", library))
    np.testing.assert_allclose(quarter, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-15)
    body = rj.Inertia.from_principal(*of([1.0, 2.0, 2.5], "kg * cm**2", library))
    np.testing.assert_allclose(body.moments, np.array([1.0, 2.0, 2.5]) * 1e-4)
    sol = rj.simulate(body, rj.Spin([0.01, 0.02, 0.01]), of([0.0, 1.0, 2.0], "min", library))
    np.testing.assert_allclose(sol.ts, [0.0, 60.0, 120.0])
    law = rj.torques.Damping(of([0.1, 0.1, 0.1], "N * cm * s", library))
    np.testing.assert_allclose(law.coefficient, 1e-3)
    read = of(np.ones((2, 3)), "deg / s", library)
    gyro = identify.Gyro(noise=of(0.5, "deg / s", library))
    record = identify.Recording(of([0.0, 10.0], "ms", library), (gyro, read))
    np.testing.assert_allclose(record.t, [0.0, 0.01])
    np.testing.assert_allclose(record.readings[0].values, DEGREE)
    np.testing.assert_allclose(np.ravel(record.readings[0].sensor.noise), 0.5 * DEGREE)


@pytest.mark.usefixtures("unhooked")
@pytest.mark.parametrize("library", LIBRARIES.values(), ids=LIBRARIES)
def test_a_unit_of_another_kind_is_refused(library):
    body = rj.Inertia.from_principal(1.0, 2.0, 2.5)
    wrong = {
        "omega: wanted a unit such as rad/s, got m": lambda m, s: rj.Spin([1.0, 2, 3] * m),
        "omega: wanted a unit such as rad/s": lambda m, s: rj.Attitude([1.0, 0, 0, 0], [1.0 * s, 1 * s, 1 * s]),
        "x: wanted a unit such as m,": lambda m, s: rj.Rigid([1.0, 0, 0] * s, np.zeros(3), [1.0, 0, 0, 0], np.zeros(3)),
        "ts: wanted a unit such as s": lambda m, s: rj.simulate(body, rj.Spin([1.0, 0, 0]), [0.0, 1.0] * m),
        "mass: wanted a unit such as kg": lambda m, s: rj.shapes.sphere(1.0 * m, 1.0),
        "radius: wanted a unit such as m": lambda m, s: rj.shapes.sphere(1.0, 1.0 * s),
        "tensor: wanted a unit such as kg m²": lambda m, s: rj.Inertia(np.eye(3) * m),
        "gravity: wanted a unit such as m/s²": lambda m, s: rj.torques.UniformGravity([0.0, 0, -9.8] * m),
        "angle: wanted a unit such as rad": lambda m, s: rj.quaternion.about_axis([0.0, 0, 1], 1.0 * m),
    }  # fmt: skip
    for words, call in wrong.items():
        with pytest.raises(TypeError, match=words):
            call(library("m") * 1.0, library("s") * 1.0)
    # Angles count as pure numbers, and so a frequency as a rate.
    rates = of([1.0, 2.0, 3.0], "1 / s", library)
    assert rj.Spin(rates).omega.tolist() == [1.0, 2.0, 3.0]
    assert float(rj.quaternion.about_axis([0.0, 0, 1], of(np.pi, "", library))[3]) == 1.0


class Foreign:
    units = "deg/s"

    def __array__(self, dtype=None, copy=None):
        return np.ones(3)


@pytest.mark.usefixtures("unhooked")
@pytest.mark.parametrize("given", [Foreign(), [Foreign()]])
def test_a_unit_that_cannot_be_converted_is_refused(given):
    with pytest.raises(TypeError, match="plain numbers in SI units, got Foreign in deg/s; convert"):
        rj.Spin(given)


def test_plain_numbers_are_as_they_were():
    assert rj.Spin((1, 2.0, 3)).omega.tolist() == [1.0, 2.0, 3.0]
    assert rj.Spin([jnp.asarray(1.0), 2.0, 3.0]).omega.tolist() == [1.0, 2.0, 3.0]
