"""The first step, and the next one by the error of the last: Hairer, Nørsett and Wanner, II.4."""

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest
from once import once

import rigidjax as rj
from rigidjax.solve.engine.control import StandardController
from rigidjax.solve.engine.loop import starting_step

H, ORDER = 0.25, 8


def lengths(error, dtmax=None):
    """Whether a step from t = 1 s with this error over the tolerance is accepted, and the next."""
    control = StandardController(1e-3, 1e-6, dtmax)
    left, right = jnp.array([1.0, -2.0]), jnp.array([-3.0, 0.5])
    scale = 1e-6 + 1e-3 * jnp.array([3.0, 2.0])
    keep, t0, t1, jumped, state, _ = control.adapt_step_size(
        1.0, 1.0 + H, left, right, None, error * scale, ORDER, ()
    )
    assert t0 == (1.0 + H if keep else 1.0) and not jumped and state == ()
    return bool(keep), float(t1 - t0)


@pytest.mark.parametrize("error", [1e-3, 0.43, 0.9, 0.999, 1.5, 300.0])
def test_the_length_follows_the_error_both_ways(error):
    keep, length = lengths(error)
    assert keep == (error < 1)
    np.testing.assert_allclose(length, 0.9 * H * error ** (-1 / ORDER), rtol=1e-12)
    # An accepted step with a large error is followed by a shorter one.
    assert (length < H) == (error > 0.9**ORDER)


@pytest.mark.parametrize(
    ("error", "accepted", "factor"),
    [(0.0, True, 10.0), (1e-12, True, 10.0), (1e9, False, 0.2), (jnp.inf, False, 0.2),
     (jnp.nan, False, 0.2)],
)  # fmt: skip
def test_the_length_changes_by_a_limited_factor(error, accepted, factor):
    keep, length = lengths(error)
    assert keep is accepted
    np.testing.assert_allclose(length, factor * H, rtol=1e-12)


def test_no_step_is_longer_than_the_longest():
    assert lengths(1e-12, jnp.asarray(0.3)) == (True, pytest.approx(0.3, rel=1e-12))


@pytest.mark.parametrize(
    ("size", "rate"), [(1e9, 3e9), (1e9, 2e6), (0.3, 700.0), (1e4, 1e14), (0.0, 1e12)]
)
def test_the_first_step_is_that_of_an_oscillation(size, rate):
    # A state of zeros is taken to change within 1e-4 s.
    second = rate * max(rate / max(size, 1e-4 * rate), 1.0)
    wanted = min(max(size / rate, 1e-4), (0.01 / second) ** (1 / ORDER))
    found = starting_step(jnp.asarray(size), jnp.asarray(rate), ORDER)
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


def test_the_first_step_from_rest_is_short_and_from_nan_is_none():
    assert float(starting_step(jnp.asarray(1e9), jnp.asarray(0.0), ORDER)) == 1e-4
    for size, rate in ((1e9, jnp.nan), (jnp.nan, 1.0), (1e9, jnp.inf)):
        assert not float(starting_step(jnp.asarray(size), jnp.asarray(rate), ORDER)) > 0


BODY, START = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Attitude([1.0, 0, 0, 0], [0.0, 1.0, 0.1])


@pytest.mark.parametrize("solver", [dfx.Euler(), rj.solvers.Magnus4(), rj.solvers.Splitting4()])
@pytest.mark.parametrize("dt0", [None, 0.1])
def test_a_solver_without_an_estimate_of_its_error_is_told_what_it_needs(solver, dt0):
    law = None if isinstance(solver, rj.solvers.Splitting4) else rj.torques.Damping([0.1, 0.1, 0.1])
    with pytest.raises(ValueError, match=r"estimates the error .*ConstantStepSize"):
        rj.simulate(BODY, START, [0.0, 1.0], law, solver=solver, dt0=dt0)


@pytest.mark.parametrize(
    "ts", [[0.0, 0.5, 2.0], pytest.param([2.0, 0.5, 0.0], marks=pytest.mark.long)]
)
def test_a_solver_that_looks_into_the_field_gets_it_under_tolerances_too(ts):
    by = lambda **how: lambda start: rj.simulate(BODY, start, ts, **how).ys
    steps = once(by(solver=rj.solvers.FreeSolver()))(START)
    exact = once(by())(START)
    np.testing.assert_allclose(steps.omega, exact.omega, atol=1e-13)
    np.testing.assert_allclose(steps.q, exact.q, atol=1e-13)
