"""One deliberate mistake after another: each is named, none goes on as a silent NaN."""

import jax.numpy as jnp
import numpy as np
import pytest

from rigidjax import orbits
from rigidjax.frames import AboutAxis, BodyInFrame, Force, MovingFrame, Point, Uniform, scenes
from rigidjax.frames.frame_dynamics import InFrame

NAN = float("nan")
FRAME = MovingFrame(Uniform([0.0, 0.0, 1.0]))
MOON = orbits.cr3bp(0.0121505856)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: orbits.cr3bp("moon"), TypeError, "mu: wanted an array of numbers, got str"),
        (lambda: orbits.cr3bp([0.1, 0.2]), ValueError, "mu: wanted shape .* jax.vmap"),
        (lambda: orbits.cr3bp(0.1, [NAN, 0.0]), ValueError, "radii: wanted two numbers ≥ 0"),
        (lambda: scenes.foucault(48.9, 10.0), ValueError, "were these degrees"),
        (lambda: scenes.foucault(0.5, np.inf), ValueError, "length: wanted a positive number"),
        (lambda: scenes.earth(0.5, np.inf), ValueError, "gravity: wanted a positive number"),
        (lambda: scenes.earth(0.5, rate=NAN), ValueError, "rate: wanted a finite number"),
        (lambda: scenes.earth(0.5).eastward_deflection(-3.0), ValueError, "height: wanted metres"),
        (lambda: scenes.turntable(NAN), ValueError, "rate: contains NaN"),
        (lambda: scenes.turntable([0.0, 0, 1]), ValueError, r"rate: wanted shape \(\)"),
        (lambda: scenes.hoop(1.0, NAN), ValueError, "rate: contains NaN"),
        (lambda: scenes.hoop(1.0, 1.0, NAN), ValueError, "gravity: contains NaN"),
        (lambda: scenes.libration(NAN), ValueError, "rate: contains NaN"),
        (lambda: orbits.hill(NAN), ValueError, "radius: wanted a number ≥ 0"),
        (lambda: Uniform([NAN, 0, 1]), ValueError, r"omega: contains NaN or infinity at index"),
        (lambda: Uniform(2.0), ValueError, r"omega: wanted shape \(3,\)"),
        (lambda: AboutAxis([NAN, 0, 0], lambda t: t), ValueError, "axis: contains NaN"),
        (lambda: AboutAxis([1.0, 0, 0], 2.0), TypeError, "angle: wanted a function of time"),
        (lambda: MovingFrame(lambda t: np.zeros(4)).matrix(0.0), ValueError, "unit quaternion"),
        (lambda: MovingFrame(lambda t: NAN * np.ones(4)).matrix(0.0), ValueError, "unit quat"),
        (lambda: MovingFrame(lambda t: NAN * np.eye(3)).matrix(0.0), ValueError, "rotation: contains NaN"),
        (lambda: MovingFrame(Uniform(np.ones(3)), rate=[1.0]), TypeError, "rate: wanted a functi"),
        (lambda: MovingFrame(Uniform(np.ones(3)), lambda t: jnp.zeros(2)).at(0.0), ValueError, "origin: wanted shape"),
        (lambda: FRAME.at([0.0, 1.0]), ValueError, r"t: wanted shape \(\)"),
        (lambda: FRAME.compose(np.eye(3)), TypeError, "inner: wanted a MovingFrame, got ndarray"),
        (lambda: FRAME.centrifugal([1.0, 2.0], 0.0), ValueError, r"x: wanted shape \(3,\)"),
        (lambda: InFrame(Uniform([0.0, 0, 1])), TypeError, "InFrame: wanted a MovingFrame, got Un"),
        (lambda: BodyInFrame(np.eye(3)), TypeError, "BodyInFrame: wanted a MovingFrame"),
        (lambda: Force(3.0), TypeError, "force: wanted a function"),
        (lambda: orbits.PeriodicOrbit([1.0, 2, 3], 1.0), TypeError, "state: wanted a Point"),
        (lambda: MOON.transition([1.0, 2, 3], 1.0), TypeError, "state: wanted a Point"),
        (lambda: MOON.transition(Point([0.5, 0, 0], [0.0, 1, 0]), NAN), ValueError, "t: contains"),
        (lambda: MOON.lyapunov_guess(1, NAN), ValueError, "amplitude: contains NaN"),
        (lambda: MOON.zero_velocity(np.ones((2, 2)), np.ones((2, 2))), ValueError, "not a mesh"),
    ],
)  # fmt: skip
@pytest.mark.usefixtures("unhooked")
def test_mistakes_are_named(call, error, words):
    with pytest.raises(error, match=words):
        call()
