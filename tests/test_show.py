"""What `print` shows: the numbers of states, torques, scenes, sensors and orbits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rigidjax as rj
from rigidjax import identify, torques

SERIES = torques.Series(np.arange(4.0), [1.0, 2.5, 3.0, 4.0])


@pytest.mark.parametrize(
    ("thing", "text"),
    [
        (torques.Damping([0.05, 0.1, 0.2]), "Damping(coefficient=[0.05, 0.1, 0.2])"),
        (
            torques.Sum(torques.ConstantTorque([1.0, 2, 3]), torques.UniformGravity([0, 0, -9.81])),
            "Sum(parts=(ConstantTorque(torque=[1, 2, 3]), UniformGravity(gravity=[0, 0, -9.81])))",
        ),
        (torques.Delayed(SERIES, 0.25), "values=[1, 2.5, 3, 4]"),
        (torques.Held([0.0, 1.0], [4.5, 5.5]), "Held(times=[0, 1], values=[4.5, 5.5])"),
        (torques.Wheel(1e-6, [0.0, 0, 1], SERIES), "Wheel(inertia=1e-06, axis=[0, 0, 1]"),
        (torques.Wrench([0.0, 0, 3.5]), "Wrench(force=[0, 0, 3.5], torque=[0, 0, 0])"),
        (rj.scenes.earth(0.75), "latitude=0.75"),
        (rj.scenes.turntable(1.25), "rate=1.25"),
        (identify.Gyro(0.01, bias=[0.5, 0, 0]), "bias=[0.5, 0, 0])"),
        (
            rj.orbits.PeriodicOrbit(rj.Point([0.8, 0, 0], [0, 0.2, 0]), 2.5),
            "PeriodicOrbit(state=Point(x=[0.8, 0, 0], v=[0, 0.2, 0]), period=2.5)",
        ),
    ],
    ids=lambda one: type(one).__name__,
)
def test_numbers_are_shown(thing, text):
    shown = str(thing)
    assert text in shown
    assert "f64[" not in shown and "class" not in shown


def test_traced_numbers_are_shown_by_their_shape():
    words = []
    jax.jit(lambda a: words.append(str(torques.Damping(a))))(jnp.ones(3))
    assert words == ["Damping(coefficient=f64[3])"]
