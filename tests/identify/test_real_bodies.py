"""Fits in charts of a user's own that end at numbers of no body say so."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rigidjax as rj
from rigidjax import identify
from rigidjax.identify.uncertainty.flat_limit import describe_unreal, why_unreal

T = np.linspace(0.0, 3.0, 61)
TORQUE = np.array([0.1, -0.2, 0.15])


class Moments(identify.AbstractBodyChart):
    """Three moments, each by its logarithm: nothing keeps the triangle inequality."""

    size, unit = 3, "kg m²"
    log_names, plain_names = ("A", "B", "C"), ()

    def body(self, vector):
        return rj.Inertia(jnp.diag(jnp.exp(vector)))

    def vector(self, body):
        return self.logs(body)

    def logs(self, body):
        return jnp.log(jnp.diag(body.tensor))

    def plain(self, body):
        return jnp.zeros(0)


class Bare:
    """A body whose numbers nobody looked at."""

    def __init__(self, *moments):
        self.tensor = jnp.diag(jnp.array(moments))


def test_numbers_of_no_body_are_named():
    assert why_unreal(rj.Inertia.from_principal(1.0, 1.0, 1.9)) is None
    wrong = why_unreal(Bare(1.0, 1.0, 3.0))
    assert wrong.startswith("no real body has these numbers: ")
    found = describe_unreal(
        [(" [a]", Moments()), (" [b]", Moments())], [Bare(1.0, 1, 1), Bare(1.0, 1, 3)]
    )
    assert found == [wrong + " [b]"]
    # Every point of a chart of ours is a real body: it is not looked at.
    assert describe_unreal([("", identify.Principal(1.0))], [Bare(1.0, 1.0, 3.0)]) == []


@pytest.mark.parametrize("moments", [(1.0, 1.2, 3.0), (1.0, 1.2, 1.9)])
def test_a_fit_of_readings_that_no_body_makes(moments):
    """Euler's equations by SciPy with moments beyond the triangle inequality, and within."""
    i = np.array(moments)

    def slope(t, w):
        return (np.cross(i * w, w) + TORQUE) / i

    found = solve_ivp(slope, (0.0, 3.0), [0.5, 0.3, -0.4], "DOP853", T, rtol=1e-11, atol=1e-12)
    read = found.y.T + 1e-3 * np.random.default_rng(0).normal(size=(T.size, 3))
    torque = rj.torques.ConstantTorque(TORQUE)
    record = identify.Recording(T, (identify.Gyro(1e-3), read))
    fit = identify.fit(identify.Model(record, Moments(), torque=torque), starts=1)
    np.testing.assert_allclose(jnp.diag(fit.body.tensor), moments, rtol=0.03)
    if moments[2] == 1.9:
        assert fit.ok
    else:
        assert not fit.ok and fit.explanation.reasons[0].startswith(
            "no real body has these numbers"
        )
