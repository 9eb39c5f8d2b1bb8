"""Rows D17, D18 in single precision, and how near is too near; in double: tests/systems/test_tops.py
(over the pole), tests/orbits (Arenstorf's orbit, collisions).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import tops_mp

import rigidjax as rj

SINGLE = jnp.float32


def single(tree):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, SINGLE), tree)


def test_d17_a_top_through_the_pole():
    """Thrown over the upright, p_φ = p_ψ: cos θ to 1e-4 in float32, no step lost at the pole."""
    i1, i3, weight, theta, a = 1.3, 0.9, 9.81, 0.9, 1.2
    steps = {}
    for gap in (0.0, 0.3):
        phi = (a + gap - a * np.cos(theta)) / np.sin(theta) ** 2
        rates = (phi, -4.0, a * i1 / i3 - phi * np.cos(theta))
        q = rj.euler.to_quaternion(jnp.array([0.0, theta, 0.0]), "ZXZ")
        omega = rj.euler.rates_to_omega(jnp.array([0.0, theta, 0.0]), jnp.array(rates), "ZXZ")
        out = rj.simulate(
            single(rj.Inertia.from_principal(i1, i1, i3)), single(rj.Attitude(q, omega)),
            jnp.array([0.0, 0.4, 2.0], SINGLE),
            rj.torques.HeavyTop(2.0, [0.0, 0.0, 0.5], [0.0, 0.0, -weight]),
        )  # fmt: skip
        assert out.ys.q.dtype == SINGLE
        steps[gap] = int(out.stats["num_steps"])
        last = np.asarray(out.ys.q[-1], float)
        found = 1 - 2 * (last[1] ** 2 + last[2] ** 2)
        wanted = float(tops_mp.lagrange_cosine(i1, i3, weight, theta, rates, 2))
        print(f"D17 float32 gap {gap}: {found - wanted:.1e}, {steps[gap]} steps")
        assert abs(found - wanted) < 1e-4
    assert 0.8 < steps[0.0] / steps[0.3] < 1.25


def test_d18_arenstorf_in_single_precision():
    """Closure of the place 1e-2 (peers: 0.1); the velocity is lost at the last fall on the Moon."""
    scene = rj.orbits.cr3bp(0.012277471)
    start = rj.Point([0.994, 0.0, 0.0], [0.0, -2.00158510637908252, 0.0])
    ts = jnp.array([0.0, 8.0, 17.0652165601579625], SINGLE)
    out = rj.simulate(None, single(start), ts, scene, throw=False)
    assert out.ys.x.dtype == SINGLE
    assert np.isfinite(out.ys.x).all()
    off = float(jnp.abs(out.ys.x[-1] - single(start).x).max())
    drift = float(out.stats["drift"]["jacobi"])
    print(f"D18 float32 closure {off:.1e}, drift {drift:.1e}")
    assert off < 1e-2 and drift < 1e3 * 2e-5


@pytest.mark.parametrize("miss", [1e-1, 1e-2, 1e-3])
def test_d18_a_close_pass_keeps_the_integral(miss):
    """Past the heavy body at a distance: the Jacobi constant to 1e3 tolerances of its size there."""
    scene = rj.orbits.cr3bp(1e-3)
    # On a parabola about the heavy body whose nearest point is `miss` away.
    r, p = 0.4, 2 * miss
    speed, around = np.sqrt(2 / r), np.sqrt(p) / r
    inward = -np.sqrt(max(speed**2 - around**2, 0.0))
    start = rj.Point([r - 1e-3, 0.0, 0.0], [inward, around - r, 0.0])
    out = rj.simulate(None, start, [0.0, 0.3], scene, rtol=1e-10, atol=1e-13)
    drift = float(out.stats["drift"]["jacobi"])
    print(f"D18 miss {miss}: drift {drift:.1e}, {int(out.stats['num_steps'])} steps")
    # Kinetic and potential energy cancel there, each of them 1/miss.
    assert drift < 1e3 * 1e-10 / miss
