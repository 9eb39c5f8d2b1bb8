"""The free body in mpmath, to any number of digits, at any time.

The closed form at high precision: one ordering of the axes, one expression each, no reduction by
periods, no choice between equal forms, guard digits for what the doublings lose. It shares its
formula with the code under test, so `test_free_body.py` first holds it against another method, the
Taylor series of the differential equation (tests/systems/free_body_mp.py).
"""

import math
from types import SimpleNamespace

import mpmath as mp

MPMATH = SimpleNamespace(
    number=mp.mpf,
    sqrt=mp.sqrt,
    atan=mp.atan,
    cos=mp.cos,
    sin=mp.sin,
    bits=lambda: mp.mp.prec,
    working=mp.workprec,
)


def mpfr():
    """The same arithmetic from gmpy2, at mpmath's precision: six times sooner."""
    import gmpy2

    return SimpleNamespace(
        number=gmpy2.mpfr,
        sqrt=gmpy2.sqrt,
        atan=gmpy2.atan,
        cos=gmpy2.cos,
        sin=gmpy2.sin,
        bits=lambda: gmpy2.get_context().precision,
        working=lambda bits: gmpy2.context(gmpy2.get_context(), precision=bits),
    )


def principal(moments, q0, omega0, t, arithmetic=MPMATH):
    """q (4) and Ω (3) at t of a body in its principal axes, moments ascending."""
    number = arithmetic.number
    a, omega0 = [1 / number(i) for i in moments], [number(w) for w in omega0]
    momentum = [number(i) * w for i, w in zip(moments, omega0, strict=True)]
    out, turn = _principal_flow(a, momentum, number(t), arithmetic)
    return _times(q0, turn), [k * p for k, p in zip(a, out, strict=True)]


def free_body(inertia, q0, omega0, t):
    """q (4) and Ω (3) at t; inertia 3×3 nested list. Uses the current precision of mpmath."""
    tensor = mp.matrix(inertia)
    moments, axes = _principal(tensor)
    omega0 = list(axes.T * mp.matrix(omega0))
    momentum = [i * w for i, w in zip(moments, omega0, strict=True)]
    out, (w, *turn) = _principal_flow([1 / i for i in moments], momentum, mp.mpf(t), MPMATH)
    omega = list(axes * mp.matrix([p / i for p, i in zip(out, moments, strict=True)]))
    return _times(q0, [w, *(axes * mp.matrix(turn))]), omega


def _principal(tensor):
    if all(tensor[i, j] == 0 for i in range(3) for j in range(3) if i != j):
        moments, axes = [tensor[i, i] for i in range(3)], mp.eye(3)
    else:
        moments, axes = mp.eigsy(tensor)
        moments = list(moments)
    order = sorted(range(3), key=lambda i: moments[i])
    moments = [moments[i] for i in order]
    axes = mp.matrix([[axes[i, j] for j in order] for i in range(3)])
    if mp.det(axes) < 0:
        for i in range(3):
            axes[i, 2] = -axes[i, 2]
    return moments, axes


def _principal_flow(a, momentum, t, x):
    zero, one = x.number(0), x.number(1)
    d12, d13, d23 = a[0] - a[1], a[0] - a[2], a[1] - a[2]
    p1, p2, p3 = momentum
    A1, A3 = d12 * p2**2 + d13 * p3**2, d13 * p1**2 + d23 * p2**2
    h = x.sqrt(p1**2 + p2**2 + p3**2)
    if h == 0:
        return momentum, [one, zero, zero, zero]
    if sum(c != 0 for c in momentum) == 1:
        # A steady spin. (Doubling would ask for as many digits as e^{λt} has about axis 2.)
        angle = h * sum(k for c, k in zip(momentum, a, strict=True) if c != 0) * t / 2
        return momentum, [x.cos(angle), *(x.sin(angle) * c / h for c in momentum)]
    p, q, mu = d23 * A1, d12 * A3, d12 * A1
    turn = d13 * h * mu
    # Small enough that the first neglected term of the series is below round-off.
    size = x.sqrt(max(p, q, mu)) * abs(t)
    n = max(_log2(size), 0) + int(x.bits() / 6) + 2
    # A doubling loses two bits, and beside a saddle as many as |p − q|/max(p, q) is small.
    near = abs(p - q) / max(p, q) if max(p, q) > 0 and p != q else one
    lost = 4 + max(0, -2 * _log2(near))
    with x.working(x.bits() + lost * n + 20):
        u = t / x.number(2) ** (n + 1)
        S = u - (p + q) * u**3 / 6 + (p * p + 14 * p * q + q * q) * u**5 / 120
        C, D = x.sqrt(1 - p * S * S), x.sqrt(1 - q * S * S)
        xi = turn * (u**3 / 3 - (p + q + 3 * mu) * u**5 / 15)
        for k in range(n + 1):
            if k == n:
                half = S, C, D, xi
            s, cc, dd = S * S, C * C, D * D
            den = 1 - p * q * s * s
            xi = 2 * xi + x.atan(2 * turn * s * S * C * D / (den + mu * s * (cc * dd + cc + dd)))
            S, C, D = 2 * S * C * D / den, (cc - p * s * dd) / den, (dd - q * s * cc) / den
    full = S, C, D

    def moved(S, C, D):
        w = 1 - d12 * d23 * p2**2 * S * S
        return [
            (p1 * C - d23 * p2 * p3 * S * D) / w,
            (p2 * C * D + d13 * p1 * p3 * S) / w,
            (p3 * D - d12 * p1 * p2 * S * C) / w,
        ]

    S, C, D, xi = half
    k = moved(S, C, D)
    b = [C, zero, -d12 * S * k[1] * C, -d13 * S * k[2]]
    length = x.sqrt(sum(c * c for c in b))
    angle = a[0] * h * t / 2 - xi
    e = [x.cos(angle), *(x.sin(angle) * c / h for c in momentum)]
    return moved(*full), _times(e, [c / length for c in b])


def _log2(x):
    """Rounded down; 0 as if it were the smallest float."""
    return math.frexp(max(float(x), 1e-300))[1] - 1


def _times(p, q):
    a, b, c, d = p
    w, x, y, z = q
    return [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
