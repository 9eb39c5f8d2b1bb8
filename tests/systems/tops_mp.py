"""Lagrange's top and the pendulum in mpmath: elliptic functions and quadrature, to any number of digits."""

import mpmath as mp


def _lagrange(i1, i3, mgl, theta, rates):
    """u(s) = cos θ, and the constants a = pψ/I1, b = pφ/I1, speed and quarter period of u."""
    i1, i3, mgl, theta = (mp.mpf(x) for x in (i1, i3, mgl, theta))
    dphi, dtheta, dpsi = (mp.mpf(x) for x in rates)
    u0, s0 = mp.cos(theta), mp.sin(theta)
    a = i3 * (dpsi + dphi * u0) / i1
    b = dphi * s0**2 + a * u0
    beta = 2 * mgl / i1
    alpha = dtheta**2 + (dphi * s0) ** 2 + beta * u0
    u1, u2, u3 = _cubic(-(alpha + a**2) / beta, (2 * a * b - beta) / beta, (alpha - b**2) / beta)
    m = (u2 - u1) / (u3 - u1)
    speed = mp.sqrt(beta * (u3 - u1)) / 2
    part = min(max((u0 - u1) / (u2 - u1), mp.mpf(0)), mp.mpf(1))
    start = mp.ellipf(mp.asin(mp.sqrt(part)), m)
    start = start if -s0 * dtheta >= 0 else -start

    def u(s):
        return u1 + (u2 - u1) * mp.ellipfun("sn", start + speed * s, m=m) ** 2

    return u, a, b, mp.ellipk(m) / speed


def _cubic(p, q, r):
    """The three real roots of x³ + p x² + q x + r, ascending (Viète)."""
    with mp.extradps(mp.mp.dps + 10):
        slope, value = q - p**2 / 3, 2 * p**3 / 27 - p * q / 3 + r
        size = 2 * mp.sqrt(-slope / 3)
        cosine = min(max(3 * value / (slope * size), mp.mpf(-1)), mp.mpf(1))
        turn = mp.acos(cosine) / 3
        return sorted(size * mp.cos(turn - 2 * mp.pi * k / 3) - p / 3 for k in range(3))


def lagrange_cosine(i1, i3, mgl, theta, rates, t, *, digits=30):
    """cos θ at t of Lagrange's top; arguments as for `lagrange_top`."""
    with mp.workdps(digits):
        return _lagrange(i1, i3, mgl, theta, rates)[0](mp.mpf(t))


def lagrange_top(i1, i3, mgl, theta, rates, t, *, digits=30):
    """3-1-3 Euler angles (φ, θ, ψ) at t, from φ = ψ = 0, θ = theta and rates (φ', θ', ψ').

    Moments i1 = i2, i3 about the fixed point; mgl the weight times the distance to the centre of
    mass, along the third axis; gravity down the world's third axis. u = cos θ obeys u'² = cubic(u).
    Source: Whittaker, Analytical Dynamics, §71; Goldstein, Poole and Safko, §5.7.
    """
    with mp.workdps(digits):
        u, a, b, quarter = _lagrange(i1, i3, mgl, theta, rates)
        ratio, t = mp.mpf(i1) / mp.mpf(i3), mp.mpf(t)

        def phi_rate(s):
            return (b - a * u(s)) / (1 - u(s) ** 2)

        def psi_rate(s):
            return ratio * a - u(s) * phi_rate(s)

        pieces = mp.linspace(0, t, 2 * int(mp.ceil(t / quarter)) + 1)
        return mp.quad(phi_rate, pieces), mp.acos(u(t)), mp.quad(psi_rate, pieces)


def pendulum(rate2, angle, t, *, digits=30):
    """Angle of x'' = −rate2 sin x at t, from rest at `angle` (0 < angle < π)."""
    with mp.workdps(digits):
        k = mp.sin(mp.mpf(angle) / 2)
        u = mp.ellipk(k**2) - mp.sqrt(mp.mpf(rate2)) * mp.mpf(t)
        return 2 * mp.asin(k * mp.ellipfun("sn", u, m=k**2))


def derivative(function, x, *, step="1e-8", digits=30):
    """Derivative of a real function of one number, by a central difference in many digits."""
    with mp.workdps(digits):
        x, h = mp.mpf(x), mp.mpf(step)
        return (function(x + h) - function(x - h)) / (2 * h)
