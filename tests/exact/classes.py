"""Bodies of every class in which closed forms are known to fail, and their seams."""

import numpy as np


def bodies(name: str, count: int, seed: int = 0):
    """Principal moments (count, 3) and body rates (count, 3), float64."""
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
    return u, w


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
)
