"""How far the closed form is from fifty digits, in units of what rounding the inputs does."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np

import rigidjax.exact as exact
from rigidjax.body.inertia import Inertia
from rigidjax.motion import Attitude

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]
import classes
import twin
from once import OPTIONS

PLACES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
Q0 = np.array([0.5, -0.1, 0.7, 0.5]) / np.linalg.norm([0.5, -0.1, 0.7, 0.5])
HEAD, TAIL = slice(0, 4), slice(4, 7)
# What is rounded: the tensor, Ω and t. (q0 only turns the result.)
ROUNDED = (*range(9), 13)
ROUND_OFF = {np.dtype("float64"): 2.0**-53, np.dtype("float32"): 2.0**-24}


def attitude_and_rate(x):
    """(Ixx, Iyy, Izz, Ixy, Ixz, Iyz, Ω, q, t) → (q, Ω) at t."""
    a, b, c, d, e, f = x[:6]
    tensor = jnp.stack([jnp.stack(row) for row in ((a, d, e), (d, b, f), (e, f, c))])
    out = exact.free_body(Inertia(tensor), Attitude(x[9:13], x[6:9]), x[13])
    return jnp.concatenate([out.q, out.omega])


value = jax.jit(jax.vmap(attitude_and_rate))
second_along = jax.jit(
    lambda x, v: _along(lambda y: _along(attitude_and_rate, y, v), x, v),
    compiler_options=OPTIONS,
)
jacobian = jax.jit(jax.vmap(jax.jacfwd(attitude_and_rate)))
# The same for a few rows.
jacobian_once = jax.jit(jax.vmap(jax.jacfwd(attitude_and_rate)), compiler_options=OPTIONS)
reverse_jacobian = jax.jit(jax.vmap(jax.jacrev(attitude_and_rate)))


def _along(function, x, direction):
    return jax.jvp(function, (x,), (direction,))[1]


@jax.jit
@jax.vmap
def gradient_and_curvature(x, direction, cotangent):
    return jax.jvp(jax.grad(lambda y: jnp.dot(attitude_and_rate(y), cotangent)), (x,), (direction,))


def inputs(name, count, ts, seed=0, scale=1.0):
    """Rows for `attitude_and_rate`, bodies in their principal axes. A seam brings its times."""
    u, w, own = classes.bodies(name, count, seed)
    x = np.zeros((count, 14))
    x[:, :3], x[:, 6:9], x[:, 9:13] = u * scale, w, Q0
    x[:, 13] = np.resize(ts, count) if own is None else own
    return x


def rotated(x, seed=0):
    """The same bodies in axes of any direction: a full tensor in each row."""
    r, x = np.random.default_rng(seed), x.copy()
    for row in x:
        axes, _ = np.linalg.qr(r.normal(size=(3, 3)))
        axes = axes * np.linalg.det(axes)
        tensor = axes @ np.diag(row[:3]) @ axes.T
        row[:6] = [0.5 * (tensor[i, j] + tensor[j, i]) for i, j in PLACES]
        row[6:9] = axes @ row[6:9]
    return x


def truth(x):
    x = _exact(x)
    tensor = [[mp.mpf(0)] * 3 for _ in range(3)]
    for (i, j), c in zip(PLACES, x[:6], strict=True):
        tensor[i][j] = tensor[j][i] = c
    length = mp.sqrt(sum(c * c for c in x[9:13]))
    q, omega = twin.free_body(tensor, [c / length for c in x[9:13]], x[6:9], x[13])
    return [*q, *omega]


def true_jacobian(x, columns=range(14), step="1e-15"):
    """Central differences; `step` far below any scale of the motion, digits enough for it."""
    h, x = mp.mpf(step), _exact(x)
    rows = []
    for k in columns:
        up, down = list(x), list(x)
        up[k], down[k] = up[k] + h, down[k] - h
        rows.append([(a - b) / (2 * h) for a, b in zip(truth(up), truth(down), strict=True)])
    return np.array(rows, dtype=object).T


def true_curvature(x, direction, cotangent, step="1e-24", inner="1e-26"):
    """d/ds of cotangentᵀ (Jacobian at x + s direction)."""
    h, x = mp.mpf(step), _exact(x)
    up, down = (
        true_jacobian(
            [a + s * h * mp.mpf(b) for a, b in zip(x, direction, strict=True)], step=inner
        )
        for s in (1, -1)
    )
    return cotangent @ ((up - down) / (2 * h)).astype(float)


def true_second_along(x, direction, step="1e-24"):
    """Second derivative of q and Ω at x + s direction by s, at s = 0."""
    h, x = mp.mpf(step), _exact(x)
    down, here, up = (
        truth([a + s * h * mp.mpf(b) for a, b in zip(x, direction, strict=True)])
        for s in (-1, 0, 1)
    )
    return np.array([(a - 2 * b + c) / h**2 for a, b, c in zip(down, here, up, strict=True)])


def moved(j, row, eps):
    """How far rounding the inputs by one unit moves q and Ω, to first order.

    Each by a unit of itself; the entries of a full tensor and Ω with it by a unit of the largest.
    """
    sizes = np.abs(np.asarray(j, float)[:, ROUNDED]) @ _sizes(row)[[*ROUNDED]]
    return eps * np.linalg.norm(sizes[HEAD]), eps * np.linalg.norm(sizes[TAIL])


def _sizes(row):
    sizes = np.abs(np.asarray(row, float))
    if sizes[3:6].any():
        sizes[:6], sizes[6:9] = sizes[:6].max(), sizes[6:9].max()
    return sizes


def error_in_units(row, got, eps, j=None, ref=None):
    """Error over (what rounding the inputs does + one unit in the result).

    What rounding does is taken from a first derivative or, where that is too much of a straight
    line (within round-off of the separatrix), by rounding the inputs: by k units, for k units.
    """
    ref = truth(row) if ref is None else ref
    if j is None:
        j = np.zeros((7, 14))
        j[:, ROUNDED] = true_jacobian(row, columns=ROUNDED, step="1e-25").astype(float)
    error = np.array([float(b - float(a)) for a, b in zip(got, ref, strict=True)])
    size = np.linalg.norm([float(c) for c in ref[4:]])
    units = _measure(error, *moved(j, row, eps), size, eps)
    for k in (1, 2, 4):
        if units <= 5:
            break
        moves = _by_rounding(row, truth(row), k * eps)
        q, omega = (max(np.linalg.norm(d[part]) for d in moves) for part in (HEAD, TAIL))
        units = min(units, k * max(1.0, _measure(error, q, omega, size, eps)))
    return units


def _measure(error, moved_q, moved_omega, size, eps):
    q = np.linalg.norm(error[HEAD]) / (moved_q + eps)
    return max(q, np.linalg.norm(error[TAIL]) / (moved_omega + eps * size + 1e-300))


def _by_rounding(row, there, eps, count=8):
    """How the result moves when each input is off by up to one rounding.

    Also where that can carry the body across the separatrix, which no random signs would find: on
    the way there the period grows beyond all bounds.
    """
    r, sizes = np.random.default_rng(5), _sizes(row)
    sizes[9:13] = 0.0
    moves = []
    for signs in [*r.choice([-1.0, 1.0], (count, 14)), *_towards_separatrix(row, sizes, eps)]:
        shifts = eps * signs * sizes
        off = [mp.mpf(a) + mp.mpf(b) for a, b in zip(row, shifts, strict=True)]
        moves.append(np.array([float(a - b) for a, b in zip(truth(off), there, strict=True)]))
    return moves


def _towards_separatrix(row, sizes, eps):
    """Roundings, as shares of one, that end a little before and a little beyond the separatrix."""
    if row[3:6].any() or (np.diff(row[:3]) < 0).any():
        return []

    def gap(x):
        (i1, i2, i3), (p1, _, p3) = x[:3], (a * b for a, b in zip(x[:3], x[6:9], strict=True))
        return (1 / i2 - 1 / i3) * p3**2 - (1 / i1 - 1 / i2) * p1**2

    x = _exact(row)
    here, slopes = gap(x), np.zeros(14)
    for k in (0, 1, 2, 6, 8):
        h = mp.mpf("1e-25") * mp.mpf(float(sizes[k]))
        slopes[k] = float(
            (gap([a + h * (i == k) for i, a in enumerate(x)]) - here) / mp.mpf("1e-25")
        )
    reach = np.abs(slopes).sum() * eps
    share = float(here) / reach if reach > 0 else np.inf
    if not abs(share) <= 1:
        return []
    return [-f * share * np.sign(slopes) for f in (0.5, 0.9, 0.99, 0.999, 1.001, 1.01, 1.1)]


def _exact(x):
    return [c if isinstance(c, mp.mpf) else mp.mpf(float(c)) for c in x]
