"""Bodies of every class in which closed forms are known to fail, and their seams."""

import numpy as np
from scipy.special import ellipk, ellipkinc


def bodies(name: str, count: int, seed: int = 0):
    """Principal moments (count, 3), body rates (count, 3) and, for a seam, times; float64."""
    r = np.random.default_rng(seed + sum(map(ord, name)))
    u = np.sort(r.uniform(0.3, 1.0, (count, 3)), axis=1)
    u[:, 2] = np.minimum(u[:, 2], 0.999 * (u[:, 0] + u[:, 1]))
    w = r.normal(size=(count, 3))
    tiny = 10.0 ** r.uniform(-16, -1, count)
    ones = np.ones(count)
    if name == "oblate":
        u = np.stack([u[:, 0], u[:, 0], 1.5 * u[:, 0]], 1)
    elif name == "prolate":
        u = np.stack([0.4 * u[:, 1], u[:, 1], u[:, 1]], 1)
    elif name == "sphere":
        u = np.stack([u[:, 0]] * 3, 1)
    elif name == "rod":
        u = np.stack([1e-6 * u[:, 0], u[:, 1], u[:, 1] * (1 + 1e-7)], 1)
    elif name == "plate":
        u = np.stack([u[:, 0], u[:, 1], u[:, 0] + u[:, 1]], 1)
    elif name == "nearly equal":
        u = np.stack([ones, 1 + tiny, 1 + tiny + tiny * r.uniform(0, 1, count)], 1)
    elif name == "nearly symmetric":
        u = np.stack([u[:, 0], u[:, 0] * (1 + tiny), 1.4 * u[:, 0]], 1)
    elif name.startswith("axis"):
        w = np.zeros((count, 3))
        w[:, int(name[-1]) - 1] = r.uniform(-2, 2, count)
    elif name.startswith("near axis"):
        k = int(name[-1]) - 1
        w = tiny[:, None] * w
        w[:, k] = r.uniform(0.3, 2, count)
    elif "separatrix" in name:
        # E₂ = |Π|²/I₂: d₁₂Π₁² = d₂₃Π₃²; then to one side or the other of it.
        i1, i2, i3 = u.T
        side = {"on": 0, "below": -1, "above": 1}[name.split()[0]]
        p1 = np.abs(w[:, 0]) + 0.1
        p3 = p1 * np.sqrt((i2 - i1) * i3 / ((i3 - i2) * i1)) * (1 + side * tiny)
        w = np.stack([p1 / i1, w[:, 1], p3 / i3], 1)
    elif name == "any order":
        u = r.permuted(u, axis=1)
    elif name == "rest":
        w = np.zeros((count, 3))
    elif name == "slow":
        w = w * 10.0 ** r.uniform(-20, -6, count)[:, None]
    elif name == "seam of the labels":
        w = _between_labels(u, w, r)
    t = None
    if name == "seam of the reduction":
        # An odd number of quarter turns: where the whole half periods go up by one.
        big, m = _modulus(u, w)
        t = 2 * ellipk(m) / big * (2 * r.integers(0, 1000, count) + 1)
    elif name == "seam of the doubling":
        # max(p, q) S² = ½ in the last doublings.
        big, m = _modulus(u, w)
        t = ellipkinc(np.pi / 4, m) / big * 2.0 ** r.integers(-1, 2, count)
    if t is not None:
        t = t * (1 + 2.0**-52 * r.integers(-4, 5, count))
    return u, w, t


def _modulus(u, w):
    """√max(p, q) and m of the motion: what Jacobi's functions want."""
    a, x = 1 / u.T, (u * w).T ** 2
    p = (a[1] - a[2]) * ((a[0] - a[1]) * x[1] + (a[0] - a[2]) * x[2])
    q = (a[0] - a[1]) * ((a[0] - a[2]) * x[0] + (a[1] - a[2]) * x[1])
    big = np.maximum(p, q)
    return np.sqrt(big), np.minimum(p, q) / big


def off_separatrix(u, w):
    """|p − q|/max(p, q), p − q computed without subtracting them; moments in order."""
    a, x = 1 / u.T, (u * w).T ** 2
    d12, d13, d23 = a[0] - a[1], a[0] - a[2], a[1] - a[2]
    p = d23 * (d12 * x[1] + d13 * x[2])
    big = np.maximum(p, d12 * (d13 * x[0] + d23 * x[1]))
    return np.abs(d13 * (d23 * x[2] - d12 * x[0])) / np.where(big > 0, big, 1.0)


def _between_labels(u, w, r):
    """Rates with d₁₂A₁ = d₂₃A₃ within a few units of round-off, on both sides."""
    a, x = 1 / u.T, (u * w).T ** 2
    d12, d13, d23 = a[0] - a[1], a[0] - a[2], a[1] - a[2]
    x1 = ((d12 + d23) * (d12 - d23) * x[1] + d12 * d13 * x[2]) / (d23 * d13)
    x3 = ((d12 + d23) * (d23 - d12) * x[1] + d23 * d13 * x[0]) / (d12 * d13)
    first = x1 > 0
    nudge = 1 + 2.0**-52 * r.integers(-4, 5, len(u))
    p1 = np.where(first, np.sqrt(np.where(first, x1, 1.0)) * nudge, u[:, 0] * w[:, 0])
    p3 = np.where(first, u[:, 2] * w[:, 2], np.sqrt(np.where(first, 1.0, x3)) * nudge)
    return np.stack([p1 / u[:, 0], w[:, 1], p3 / u[:, 2]], 1)


NAMES = (
    "triaxial",
    "oblate",
    "prolate",
    "sphere",
    "rod",
    "plate",
    "nearly equal",
    "nearly symmetric",
    "axis 1",
    "axis 2",
    "axis 3",
    "near axis 1",
    "near axis 2",
    "near axis 3",
    "on separatrix",
    "below separatrix",
    "above separatrix",
    "any order",
    "rest",
    "slow",
    "seam of the labels",
    "seam of the reduction",
    "seam of the doubling",
)
# Where a disturbance grows as e^{λt} for good: at long times no digit of the input suffices.
UNSTABLE = ("axis 2", "near axis 2", "on separatrix", "below separatrix", "above separatrix")


def times(name: str):
    return (1.0, 3.0, 10.0, 20.0, 1e3, 1e6) if name in UNSTABLE else (1.0, 30.0, 1e3, 1e6)
