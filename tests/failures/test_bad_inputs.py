"""Section 3 of failures.md, as far as `simulate` meets it: what is read on a mistake."""

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest
from systems.tumble import BODY, OMEGA, TOP, Q

import rigidjax as rj

EQUAL = dfx.ConstantStepSize()
BAD = [
    (dict(ts=[0.0, np.nan, 1.0]), ValueError, r"ts: contains NaN or infinity at index \(1,\)"),
    (dict(ts=[0.0, np.inf]), ValueError, r"ts: contains NaN or infinity at index \(1,\)"),
    (dict(ts=[2.0, 1.0, 1.5]), ValueError, r"wanted decreasing times; ts\[2\] is not below"),
    (dict(ts=[0.0, 1.0, 1.0]), ValueError, r"wanted increasing times; ts\[2\]"),
    (dict(ts=np.zeros((2, 2))), ValueError, r"at least two times, shape \(T,\), got shape \(2, 2\)"),
    (dict(ts=[[0.0], [1.0, 2.0]]), ValueError, "at least two times"),
    (dict(ts=np.array([0.0, 1.0], np.float16)), TypeError, "float16.*half precision"),
    (dict(ts=jnp.array([0.0, 1.0], jnp.bfloat16)), TypeError, "bfloat16.*half precision"),
    (dict(rtol=0.0), ValueError, "wanted rtol > 0 and atol >= 0, got rtol=0.0"),
    (dict(rtol=-1e-6), ValueError, "wanted rtol > 0"),
    (dict(rtol=np.nan), ValueError, "wanted rtol > 0"),
    (dict(rtol=np.inf), ValueError, "wanted rtol > 0"),
    (dict(atol=-1.0), ValueError, "atol >= 0"),
    (dict(dt0=0.0), ValueError, "dt0: wanted a positive step"),
    (dict(dt0=-0.1), ValueError, "dt0: wanted a positive step, s, got -0.1"),
    (dict(dt0=np.nan), ValueError, "dt0: wanted a positive step"),
    (dict(stepsize_controller=EQUAL), ValueError, "please pass a value for `dt0`"),
    (dict(state0=rj.Attitude(Q, [0.0, np.nan, 0.0])), ValueError, r"omega: contains NaN .*\(1,\)"),
    (dict(state0=rj.Attitude(np.nan * Q, OMEGA)), ValueError, "q: contains NaN"),
    (dict(state0=rj.Attitude(0 * Q, OMEGA)), ValueError, "unit quaternion"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "error", "words"), BAD)
@pytest.mark.usefixtures("unhooked")
def test_mistakes_are_named(change, error, words):
    given = dict(body=BODY, state0=rj.Attitude(Q, OMEGA), ts=[0.0, 1.0], torque=TOP) | change
    with pytest.raises(error, match=words):
        rj.simulate(**given)


@pytest.mark.parametrize("dtype", [np.float16, jnp.bfloat16])
@pytest.mark.usefixtures("unhooked")
def test_half_precision_is_refused(dtype):
    with pytest.raises(TypeError, match="half precision cannot hold a rotation"):
        rj.Attitude(jnp.asarray(Q, dtype), jnp.asarray(OMEGA, dtype))


@pytest.mark.usefixtures("unhooked")
def test_whole_numbers_are_numbers():
    body, start = rj.Inertia.from_principal(1, 2, 3), rj.Attitude([1, 0, 0, 0], [0, 1, 2])
    whole = rj.simulate(body, start, [0, 1, 2])
    other = rj.simulate(body, start, np.array([0.0, 1.0, 2.0]))
    np.testing.assert_array_equal(whole.ys.q, other.ys.q)
    assert whole.ys.omega.dtype == jnp.float64
