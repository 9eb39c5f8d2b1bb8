"""Rows D19 to D24: large steps, what is not offered, long runs, fast tops, rods.

- D19, splittings with large steps: documented limit; the stable spin of the row, tilt below 3×.
- D20, the Moser–Veselov map: not offered. On one smooth forced trajectory it lost to explicit
  Runge–Kutta methods at every error, and past h |Ω| ≈ 1 its equation has no solution.
- D21, implicit midpoint: not offered either; diffrax's implicit methods pass through `simulate`,
  and where their equations are not solved the result says so.
- D22, a million steps: tests/solve/steps/test_splitting.py, slow.
- D23, fast tops: the free flow is exact in a splitting, whatever the spin.
- D24, a rod has no Euler's equations: refused, in words.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import tops_mp

import rigidjax as rj

EQUAL = dfx.ConstantStepSize()


@pytest.mark.parametrize("moments", [(1.0, 1.8, 2.5), (1.0, 2.0, 3.0), (2.5, 1.8, 1.0)])
def test_d19_a_stable_spin_stays_at_large_steps(moments):
    """Where the row's three-rotation splitting breaks (hΩ = 1.78, 1.93, 5): ours has no such h."""
    for h in (0.3, 1.0, 1.9, 5.3):
        assert float(tilt(jnp.array(moments), jnp.asarray(h))) < 3e-3


@jax.jit
def tilt(moments, h):
    """How far the axis of a spin has gone from it, at the worst of four times."""
    body = rj.Inertia(jnp.diag(moments))
    start = rj.Attitude([1.0, 0, 0, 0], [1e-3, 0.0, 1.0])
    law = rj.torques.HeavyTop(1.0, [0.0, 0.0, 0.0], [0.0, 0.0, -1.0])

    ts = h * jnp.array([0.0, 100.0, 200.0, 300.0, 400.0])
    ys = rj.simulate(
        body, start, ts, law, solver=rj.solvers.Splitting2(), dt0=h, throw=False,
        stepsize_controller=EQUAL,
    ).ys  # fmt: skip
    return jnp.abs(ys.omega[:, :2]).max()


def test_d21_an_equation_that_is_not_solved_is_a_status():
    start = rj.Spin([30.0, -11.0, 40.0])
    out = rj.simulate(
        rj.Inertia.from_principal(1.0, 2.0, 2.9), start, [0.0, 10.0], rj.torques.Damping([1.0] * 3),
        solver=dfx.ImplicitEuler(root_finder=dfx.VeryChord(rtol=1e-8, atol=1e-10)),
        dt0=0.5, stepsize_controller=EQUAL, throw=False,
    )  # fmt: skip
    assert out.result != dfx.RESULTS.successful
    assert np.isnan(out.ys.omega[-1]).all()


def test_d23_accuracy_does_not_depend_on_the_spin():
    """A symmetric top spun up to 10 000 rad/s: a thousand steps, the tilt by quadrature."""
    body = rj.Inertia.from_principal(1.0, 1.0, 0.6)
    law = rj.torques.HeavyTop(1.0, [0.0, 0.0, 0.5], [0.0, 0.0, -9.81])
    q = rj.quaternion.exp(jnp.array([0.6, 0.0, 0.0]))

    @jax.jit
    def height(speed):
        start = rj.Attitude(q, jnp.stack([0.0 * speed, 0.0 * speed, speed]))
        out = rj.simulate(
            body, start, jnp.array([0.0, 5.0, 10.0]), law, solver=rj.solvers.Splitting4(),
            dt0=0.01, throw=False, stepsize_controller=EQUAL,
        )  # fmt: skip
        last = out.ys.q[-1]
        return 1 - 2 * (last[1] ** 2 + last[2] ** 2), out.stats["num_steps"]

    for speed in (30, 1000, 10_000):
        found, steps = height(jnp.asarray(float(speed)))
        wanted = tops_mp.lagrange_cosine(1, 0.6, 9.81 / 2, "0.6", (0, 0, speed), 10)
        print(f"D23 {speed}: {float(found) - float(wanted):.1e}")
        assert abs(float(found) - float(wanted)) < 2e-6
        assert int(steps) == 1000


@pytest.mark.usefixtures("unhooked")
def test_d24_a_rod_is_refused_and_so_is_nearly_one():
    start = rj.Spin([0.1, 0.2, 0.3])
    for least in (0.0, 1e-17):
        rod = rj.Inertia.from_principal(1.0, 1.0, least)
        with pytest.raises(ValueError, match=r"a principal moment is zero.*give it a thickness"):
            rj.simulate(rod, start, [0.0, 1.0], rj.torques.Damping([1.0, 1.0, 1.0]))
    plate = rj.simulate(rj.Inertia.from_principal(1.0, 2.0, 3.0), start, [0.0, 1.0])
    assert np.isfinite(plate.ys.omega).all()
