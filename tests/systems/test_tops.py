"""Heavy tops through the front door: published figures, quadrature, sleeping, and over the pole."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import tops_mp

import rigidjax as rj
from rigidjax import lagrangian, torques
from rigidjax.motion.conserved import drift, energy

DOWN = np.array([0.0, 0.0, -9.81])


def spin(body, start, top, ts):
    """All through one compiled program: same shapes, same tolerances."""
    return rj.simulate(body, start, jnp.asarray(ts), top, rtol=1e-12, atol=1e-13)


def cosine(q):
    return 1 - 2 * (q[..., 1] ** 2 + q[..., 2] ** 2)


def test_bruels_cardona():
    # Géradin & Cardona 2001; Brüls, Cardona, Arnold 2012, Mech. Mach. Theory 48:121, at t = 1.
    com = np.array([0.0, 1.0, 0.0])
    body = rj.Inertia.from_principal(0.234375, 0.46875, 0.234375).shift(com, 15.0)
    start = rj.Attitude([1.0, 0, 0, 0], [0.0, 150.0, -4.61538])
    top = torques.HeavyTop(15.0, com, DOWN)
    out = spin(body, start, top, [0.0, 0.5, 1.0])
    found = rj.quaternion.rotate(out.ys.q[-1], jnp.asarray(com)) - com
    published = [0.173343964098205, -0.359911407929772, -0.748490791133914]
    np.testing.assert_allclose(found, published, atol=1e-10)
    for value in drift(out.ts, out.ys, body, top).values():
        assert float(value) < 1e-10


def test_simo_wong():
    # Simo & Wong 1991, Int. J. Numer. Methods Eng. 31:19: M g l = 20, spin 50, tilt 0.05.
    body = rj.Inertia.from_principal(5.0, 5.0, 1.0)
    top = torques.HeavyTop(20.0, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0])
    q = rj.quaternion.exp(jnp.array([0.05, 0.0, 0.0]))
    start = rj.Attitude(q, [0.0, 0.0, 50.0])
    # The figure in print is 1.7e-10 above 1250 + 20 cos 0.05.
    np.testing.assert_allclose(energy(body, start, top), 1269.97500520807, atol=2e-10)
    np.testing.assert_allclose(energy(body, start, top), 1250 + 20 * np.cos(0.05), rtol=1e-15)
    out = spin(body, start, top, [0.0, 5.0, 10.0])
    end = jax.tree.map(lambda leaf: leaf[-1], out.ys)
    np.testing.assert_allclose(energy(body, end, top), 1269.97500520807, rtol=1e-11)
    exact = tops_mp.lagrange_cosine(5, 1, 20, "0.05", (0, 0, 50), 10)
    np.testing.assert_allclose(cosine(end.q), float(exact), atol=1e-10)


I1, I3, WEIGHT = 1.3, 0.9, 9.81
BODY = rj.Inertia.from_principal(I1, I1, I3)
TOP = torques.HeavyTop(2.0, [0.0, 0.0, 0.5], DOWN)


@pytest.mark.parametrize("speed", [3.0, 12.0], ids=["falls", "sleeps"])
def test_the_sleeping_top(speed):
    """Upright it stays; a hair off it grows as the linear theory says, or does not grow."""
    upright = rj.Attitude([1.0, 0, 0, 0], [0.0, 0.0, speed])
    out = spin(BODY, upright, TOP, [0.0, 1.0, 2.0])
    np.testing.assert_allclose(cosine(out.ys.q), np.ones(3), atol=1e-15)
    np.testing.assert_allclose(out.ys.omega[-1], [0.0, 0.0, speed], rtol=1e-13)
    off = 1e-6
    tilted = rj.Attitude(rj.quaternion.exp(jnp.array([off, 0.0, 0.0])), [0.0, 0.0, speed])
    ends = spin(BODY, tilted, TOP, [0.0, 1.0, 2.0]).ys.q[-1]
    tilt = 2 * float(jnp.sqrt(ends[1] ** 2 + ends[2] ** 2))
    # z'' − i a z' − k z = 0 for the tilt z, from z' = 0 (a = I3 s/I1, k = weight/I1).
    a, k = I3 * speed / I1, WEIGHT / I1
    p, m = (1j * a + np.array([1, -1]) * np.sqrt(4 * k - a**2 + 0j)) / 2
    start = np.array([off, 0.0])
    c = np.linalg.solve(np.array([[1, 1], [p, m]]), start)
    np.testing.assert_allclose(tilt, abs(c @ np.exp(2.0 * np.array([p, m]))), rtol=1e-6)
    assert (tilt > 10 * off) == (a**2 < 4 * k)


def _over_the_pole(gap):
    """Angles and rates of a top thrown over the upright; with gap = 0 it passes exactly through."""
    theta, a = 0.9, 1.2
    b = a + gap
    phi = (b - a * np.cos(theta)) / np.sin(theta) ** 2
    return theta, (phi, -4.0, a * I1 / I3 - phi * np.cos(theta))


def test_over_the_pole_costs_nothing_extra():
    """p_φ = p_ψ: the axis passes through the vertical, where Euler angles break down."""
    steps = {}
    for gap in (0.0, 0.3):
        theta, rates = _over_the_pole(gap)
        start = lagrangian.to_attitude(lagrangian.Coordinates([0.0, theta, 0.0], rates))
        out = spin(BODY, start, TOP, [0.0, 0.4, 2.0])
        steps[gap] = int(out.stats["num_steps"])
        for t, q in zip((0.4, 2.0), out.ys.q[1:], strict=True):
            exact = tops_mp.lagrange_cosine(I1, I3, WEIGHT, theta, rates, t)
            np.testing.assert_allclose(cosine(q), float(exact), atol=1e-10)
    assert 0.8 < steps[0.0] / steps[0.3] < 1.25
    # And it did pass: near the pole the exact u touches 1.
    theta, rates = _over_the_pole(0.0)
    us = [tops_mp.lagrange_cosine(I1, I3, WEIGHT, theta, rates, t) for t in np.linspace(0, 2, 201)]
    assert float(max(us)) > 0.999


def test_starting_on_the_pole():
    start = rj.Attitude([1.0, 0, 0, 0], [1.0, 0.0, 3.0])
    out = spin(BODY, start, TOP, [0.0, 1.0, 2.0])
    # θ = 0 with a rate: u from the cubic with a = b.
    exact = tops_mp.lagrange_cosine(I1, I3, WEIGHT, "1e-14", (0, 1, 3), 2)
    np.testing.assert_allclose(cosine(out.ys.q[-1]), float(exact), atol=1e-10)
    assert bool(jnp.all(jnp.isfinite(out.ys.omega)))
