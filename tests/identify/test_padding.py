"""Recordings are stacked number by number; what else a law or an input holds is left alone."""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once

import rigidjax as rj
from rigidjax import identify, torques
from rigidjax._types import HasSpin
from rigidjax.identify.data import stacking

BODY = rj.Inertia.from_principal(1.0, 1.7, 2.3)
TS = np.linspace(0.0, 3.0, 31)


class Friction(eqx.Module):
    """A law that holds numbers, a function, a word, a whole number and a switch."""

    strength: jax.Array
    shape: Callable
    gain: float = 2.0
    sign: str = "minus"
    power: int = 1
    on: bool = True
    feels: ClassVar[type] = HasSpin

    def __call__(self, t, state, body):
        # Each is what it was made of: a traced word, number or switch would raise here.
        sign = {"minus": -1.0}[self.sign] if self.on else 0.0
        value = self.gain * self.strength * self.shape(state.omega)
        for _ in range(self.power):
            value = value * sign
        return value


def recording(strength, omega, **inputs):
    law = Friction(jnp.asarray(strength), jnp.tanh)
    read = rj.simulate(BODY, rj.Spin(omega), TS, law).ys.omega
    return identify.Recording(TS, (identify.Gyro(0.01), read), inputs=inputs)


FIRST, SECOND = ([0.9, 0.4, 1.3], [0.3, -1.1, 0.8])
STRENGTH = identify.Free(lambda s: s.torque.strength, "strength", positive=True)


def test_only_numbers_are_stacked():
    laws = [Friction(jnp.asarray(strength), jnp.tanh) for strength in (0.1, 0.3)]
    pair = [
        recording(0.1, start, law=law) for start, law in zip((FIRST, SECOND), laws, strict=True)
    ]
    law = stacking.stack(pair)[0].inputs["law"]
    np.testing.assert_array_equal(law.strength, [0.1, 0.3])
    np.testing.assert_array_equal(law.gain, [2.0, 2.0])
    assert law.shape is jnp.tanh and law.sign == "minus" and law.power == 1 and law.on is True


@pytest.mark.parametrize("many", [1, 2])
def test_a_law_that_holds_a_function_predicts_what_simulate_does(many):
    records = [recording(0.15, FIRST), recording(0.15, SECOND)][:many]
    law = Friction(jnp.asarray(0.15), jnp.tanh)
    problem = identify.Model(records, identify.Known(BODY), torque=law, free=[STRENGTH])
    start = problem.start(None, FIRST) if many == 1 else _at_the_truth(problem)
    errors = once(lambda x: problem.errors(x))(start)
    assert float(jnp.abs(errors[0]).max()) < 1e-6
    assert problem.values(problem.start())["strength"] == pytest.approx(0.15)
    assert problem.torque.shape is jnp.tanh


def _at_the_truth(problem):
    rates = jnp.asarray([FIRST, SECOND]) / problem.reference.rate[:, None]
    return problem.start().at[problem.index.start[:, -3:]].set(rates)


def test_recordings_must_hold_the_same_functions():
    pair = [recording(0.1, FIRST, law=jnp.tanh), recording(0.1, SECOND, law=jnp.arctan)]
    with pytest.raises(ValueError, match="index 1 differs from the first in its sensors or"):
        identify.Model(pair, identify.Known(BODY))


def test_a_potential_given_as_a_function_is_taken():
    law = torques.FromPotential(lambda q: 0.3 * (1 - 2 * (q[1] ** 2 + q[2] ** 2)))
    start = rj.Attitude([1.0, 0, 0, 0], FIRST)
    states = rj.simulate(BODY, start, TS, law).ys
    read = [(identify.Gyro(0.01), states.omega), (identify.AttitudeSensor(0.01), states.q)]
    problem = identify.Model(identify.Recording(TS, *read), identify.Known(BODY), torque=law)
    for errors in once(lambda x: problem.errors(x))(problem.start(None, FIRST)):
        assert float(jnp.abs(errors).max()) < 1e-5
