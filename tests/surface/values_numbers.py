"""A second way for elliptic functions and rotations: mpmath, matrices for quaternions and back."""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
from surface import values as v
from surface.values import between, direction, fixed, leave_out, one_of, scale, way

from rigidjax import elliptic as ell, euler, mrp, quaternion as q4, rodrigues, so3

# Elliptic functions: the parameter by its complement m1 = 1 − m, near 1, at 0, negative, above 1.
M1 = one_of(between(0.05, 1.0), scale(-20, -1), fixed(1.0), scale(0, 8), between(0.9, 1.1))
PHI = one_of(between(-1.5, 1.5), scale(-20, -1), between(-50, 50), fixed(np.pi / 2, 0.0))
# The characteristic by n1 = 1 − n.
N1 = one_of(between(0.05, 1.0), scale(-8, -1), scale(0, 8), fixed(1.0))
POSITIVE = one_of(scale(-20, 20), between(0.1, 3.0), fixed(1.0))


def real(f):
    return lambda *a: mp.re(f(*a))


def f_of(phi, m1):
    return mp.re(mp.ellipf(phi, 1 - m1))


def amplitude(u, m1):
    m = 1 - m1
    if m > 1:
        return mp.asin(mp.re(mp.ellipfun("sn", u, m)))
    k = mp.re(mp.ellipk(m)) if m != 1 else mp.inf
    turns = mp.nint(u / (2 * k))
    return mp.pi * turns + mp.asin(mp.re(mp.ellipfun("sn", u - 2 * k * turns, m)))


def jacobi(u, m1):
    return [mp.re(mp.ellipfun(name, u, 1 - m1)) for name in ("sn", "cn", "dn")]


# Of m above 1, which has to be given by m itself.
U = one_of(between(-2.0, 2.0), scale(-20, -1), between(-60, 60))
way("elliptic.sncndn", lambda u, m1: ell.sncndn(u, 1 - m1, m1), (U, M1), jacobi)
way(
    "elliptic.sncndn (m > 1)", lambda u, m: ell.sncndn(u, m), (U, between(1.01, 30)),
    lambda u, m: jacobi(u, 1 - m), ulps=32,
)  # fmt: skip
way("elliptic.am", lambda u, m1: ell.am(u, 1 - m1, m1), (U, M1), amplitude)
way(
    "elliptic.am (m > 1)", lambda u, m: ell.am(u, m), (U, between(1.01, 30)),
    lambda u, m: amplitude(u, 1 - m), ulps=32,
)  # fmt: skip
way("elliptic.ellipk", lambda m1: ell.ellipk(1 - m1, m1), M1, lambda m1: mp.ellipk(1 - m1))
way("elliptic.ellipe", lambda m1: ell.ellipe(1 - m1, m1), M1, lambda m1: mp.ellipe(1 - m1))
way("elliptic.ellipf", lambda p, m1: ell.ellipf(p, 1 - m1, m1), (PHI, M1), f_of)
way(
    "elliptic.ellipeinc", lambda p, m1: ell.ellipeinc(p, 1 - m1, m1), (PHI, M1),
    real(lambda p, m1: mp.ellipe(p, 1 - m1)),
)  # fmt: skip
way(
    "elliptic.ellippi", lambda n1, m1: ell.ellippi(1 - n1, 1 - m1, m1, n1), (N1, M1),
    real(lambda n1, m1: mp.ellippi(1 - n1, 1 - m1)),
)  # fmt: skip
way(
    "elliptic.ellippiinc",
    lambda n1, p, m1: ell.ellippiinc(1 - n1, p, 1 - m1, m1, n1), (N1, PHI, M1),
    real(lambda n1, p, m1: mp.ellippi(1 - n1, p, 1 - m1)),
)  # fmt: skip
way(
    "elliptic.rc", ell.rc, (POSITIVE, one_of(POSITIVE, between(-3.0, -0.1))),
    real(lambda x, y: mp.elliprc(x, y)),
)  # fmt: skip
for name in ("rf", "rd"):
    way(
        f"elliptic.{name}", getattr(ell, name), (POSITIVE,) * 3,
        real(getattr(mp, f"ellip{name}")),
    )  # fmt: skip
way("elliptic.rj_", ell.rj_, (POSITIVE,) * 4, real(mp.elliprj))

# Vectors and matrices.
ANY = one_of(v.normal(3, 3), v.normal(3, 3, low=-20, high=20))
way("rotation.so3.cross rotation.so3.dot", lambda a, b: (so3.cross(a, b), so3.dot(a, b)),
    (v.vector, v.vector), lambda a, b: (np.cross(a, b), v.dot(a, b)))  # fmt: skip
way("rotation.so3.hat", so3.hat, v.vector, v.hat)
way("rotation.so3.vee", so3.vee, ANY, v.vee)
way("rotation.so3.basis", lambda _: so3.basis(), fixed(0.0), lambda _: [
    np.stack([v.hat(e) for e in v.eye()])])  # fmt: skip
way(
    "rotation.so3.product rotation.so3.apply rotation.so3.determinant",
    lambda a, b, y: (so3.product(a, b), so3.apply(a, y), so3.determinant(a)), (ANY, ANY, v.vector),
    lambda a, b, y: (a @ b, a @ y, v.determinant(a)),
)  # fmt: skip
way("rotation.so3.solve", so3.solve, (one_of(ANY, v.inertia), v.vector), v.solve, norm=True)
way(
    "rotation.so3.adjoint rotation.so3.to_world rotation.so3.to_body rotation.so3.rate "
    "rotation.so3.conjugate rotation.so3.body_rate rotation.so3.world_rate rotation.so3.check",
    lambda m, n, y, r: (
        so3.adjoint(m), so3.to_world(m, y), so3.to_body(m, y), so3.rate(m, y),
        so3.conjugate(n, m), so3.body_rate(m, r), so3.world_rate(m, r), so3.check(m),
    ),
    (v.matrix, v.matrix, v.vector, ANY),
    lambda m, n, y, r: (
        m, m @ y, m.T @ y, m @ v.hat(y), m @ n @ m.T, v.vee(m.T @ r), v.vee(r @ m.T), m,
    ),
)  # fmt: skip


def series(x, first):
    """Σ hat(x)ᵏ/(k + first)!, by halving and Taylor: the exponential, or the left Jacobian."""
    size = v.norm(x)
    n = max(0, int(mp.ceil(mp.log(size, 2))) + 2) if size > 0 else 0
    a, term = v.hat(x) / 2**n, v.eye()
    e, j = v.eye(), v.eye()
    for k in range(1, 40):
        term = term @ a / k
        e, j = e + term, j + term / (k + 1)
    for _ in range(n):
        # J(2x) = ½(1 + e^x) J(x).
        e, j = e @ e, (v.eye() + e) @ j / 2
    return j if first else e


# The series, by doubling: another formula than Rodrigues'.
way("rotation.so3.exp", so3.exp, v.turn, lambda x: series(x, 0))
way("rotation.quaternion.exp", q4.exp, v.turn, v.quaternion_of)
way(
    "rotation.so3.left_jacobian rotation.so3.right_jacobian",
    lambda x: (so3.left_jacobian(x), so3.right_jacobian(x)), v.turn,
    lambda x: (series(x, 1), series(-x, 1)),
)  # fmt: skip
way(
    "rotation.so3.left_jacobian_inverse rotation.so3.right_jacobian_inverse",
    lambda x: (so3.left_jacobian_inverse(x), so3.right_jacobian_inverse(x)),
    one_of(v.short_turn, v.rotated_by(between(3.2, 6.2)), v.rotated_by(
        lambda rng, i: 2 * np.pi - 10.0 ** rng.uniform(-6, -1))),
    lambda x: (v.solve(series(x, 1), v.eye()), v.solve(series(-x, 1), v.eye())),
)  # fmt: skip


def nearest(m):
    """The quaternion of the rotation nearest to a matrix, w ≥ 0, by Davenport's 4 × 4 matrix."""
    k = np.empty((4, 4), object)
    k[0, 0] = np.trace(m)
    k[0, 1:] = k[1:, 0] = 2 * v.vee(m)
    k[1:, 1:] = m + m.T - np.trace(m) * v.eye()
    q = v.eigen(k)[1][:, 3]
    lead = next(x for x in q if abs(x) > mp.mpf(10) ** -15)
    return q * mp.sign(lead)


way("rotation.so3.log", so3.log, v.matrix, lambda m: v.turn_of(nearest(m)), norm=True)
way("rotation.quaternion.from_matrix", q4.from_matrix, v.matrix, nearest, norm=True)
way(
    "rotation.so3.project",
    so3.project, lambda rng, i: v.matrix(rng, i) + 10.0 ** rng.uniform(-8, -0.7) * rng.normal(
        size=(3, 3)) * 0.5,
    lambda m: v.matrix_of(nearest(m)), norm=True,
)  # fmt: skip


def angle_of(q):
    return 2 * mp.atan2(v.norm(q[1:]), abs(q[0]))


way("rotation.so3.distance", so3.distance, (v.matrix, v.matrix),
    lambda a, b: angle_of(nearest(a.T @ b)), norm=True)  # fmt: skip
AXIS = one_of(v.normal(3, low=-20, high=20), direction, v.vector)
ANGLE = one_of(between(-3, 3), scale(-20, -1), fixed(np.pi, -np.pi, 0.0), scale(0, 6))


def about(axis, angle):
    return v.quaternion_of(axis / v.norm(axis) * angle) if angle != 0 else v.number(
        np.array([1.0, 0, 0, 0]))  # fmt: skip


# By the angle itself: beyond a turn the quaternion is that of the angle, not of its remainder.
way(
    "rotation.quaternion.about_axis rotation.so3.about_axis",
    lambda a, t: (q4.about_axis(a, t), so3.about_axis(a, t)), (AXIS, ANGLE),
    lambda a, t: (about(a, t), v.matrix_of(about(a, t))),
)  # fmt: skip


def between_two(a, b, s):
    return a @ v.rotation(s * v.turn_of(nearest(a.T @ b)))


S = one_of(between(0, 1), fixed(0.0, 1.0), between(-2, 3))
way("rotation.so3.interpolate", so3.interpolate, (
    v.matrix, lambda rng, i: v.matrix(rng, 0), S), between_two, norm=True)  # fmt: skip
way(
    "rotation.quaternion.interpolate", lambda p, q, s: so3.product(
        q4.to_matrix(p).T, q4.to_matrix(q4.interpolate(p, q, s))),
    (v.quaternion, lambda rng, i: v.quaternion(rng, 0), S),
    lambda p, q, s: v.rotation(s * v.turn_of(v.times([p[0], *(-p[1:])], q))), norm=True,
)  # fmt: skip


def aligned(a, b):
    """From a to b about a × b: reflections in b and in their bisector, one after the other."""
    a, b = a / v.norm(a), b / v.norm(b)
    h = a + b
    mirror = lambda n: 2 * np.outer(n, n) / v.dot(n, n) - v.eye()
    return mirror(h) @ mirror(a)


way("rotation.so3.align", so3.align, (AXIS, lambda rng, i: AXIS(rng, i)), aligned, norm=True)


def best(body, world, weights):
    """Wahba's problem by Davenport's method: the largest eigenvector."""
    rows = zip(weights, body, world, strict=True)
    return v.matrix_of(nearest(sum(w * np.outer(y, x) for w, x, y in rows)))


def weights(count, width):
    return lambda rng, i: 10.0 ** rng.uniform(-width, width, count)


way(
    "rotation.so3.wahba", so3.wahba,
    (v.normal(4, 3, low=-20, high=20), v.normal(4, 3, low=-20, high=20), weights(4, 1)), best,
    norm=True,
)  # fmt: skip


def karcher(qs, ws):
    """The mean as what no step of the steepest descent moves."""
    q = qs[0]
    for _ in range(50):
        apart = [v.turn_of(v.times([q[0], *(-q[1:])], each)) for each in qs]
        step = sum(w * x for w, x in zip(ws, apart, strict=True)) / sum(ws)
        q = v.times(q, v.quaternion_of(step))
        if v.norm(step) < mp.mpf(10) ** -30:
            break
    return q * mp.sign(q[0])


def cluster(rng, i):
    """Quaternions within some distance of one, of either sign."""
    with mp.workdps(20):
        width, q = (0.3, 1e-7, 0.0)[i % 3], v.number(v.quaternion(rng, i))
        near = [v.times(q, v.quaternion_of(v.number(width * direction(rng, 1)))) for _ in range(3)]
        return np.array(near).astype(float) * rng.choice([-1.0, 1.0], (3, 1))


way(
    "rotation.so3.mean_quaternion rotation.so3.mean",
    lambda qs, ws: (
        q4.to_matrix(so3.mean_quaternion(qs, ws)), so3.mean(jax.vmap(q4.to_matrix)(qs), ws)
    ),
    (cluster, weights(3, 2)), lambda qs, ws: (v.matrix_of(karcher(qs, ws)),) * 2, cost=2,
)  # fmt: skip

# Quaternions.
LONG = lambda rng, i: v.quaternion(rng, i) * 10.0 ** rng.uniform(-20, 20)


def positive(q):
    return q * mp.sign(next(x for x in q if x != 0))


way(
    "rotation.quaternion.log rotation.quaternion.angle rotation.quaternion.normalise "
    "rotation.quaternion.canonical rotation.quaternion.conjugate rotation.quaternion.to_xyzw "
    "rotation.quaternion.from_xyzw",
    lambda q: (
        q4.log(q), q4.angle(q), q4.normalise(q), q4.canonical(q), q4.conjugate(q), q4.to_xyzw(q),
        q4.from_xyzw(q),
    ),
    LONG,
    lambda q: (
        v.turn_of(q), angle_of(q), q / v.norm(q), positive(q), np.array([q[0], *(-q[1:])]),
        q[[1, 2, 3, 0]], q[[3, 0, 1, 2]],
    ),
)  # fmt: skip
way("rotation.quaternion.multiply", q4.multiply, (LONG, LONG), v.times)
way("rotation.quaternion.check", q4.check, v.quaternion, lambda q: q / v.norm(q))
way(
    "rotation.quaternion.to_matrix rotation.quaternion.rotate rotation.quaternion.rotate_inverse "
    "rotation.quaternion.rate",
    lambda q, y: (q4.to_matrix(q), q4.rotate(q, y), q4.rotate_inverse(q, y), q4.rate(q, y)),
    (v.quaternion, v.vector),
    lambda q, y: (
        v.matrix_of(q), v.matrix_of(q) @ y, v.matrix_of(q).T @ y, v.times(q, [0, *(y / 2)]),
    ),
)  # fmt: skip
way(
    "rotation.quaternion.advance", q4.advance, (v.quaternion, v.turn, scale(-3, 0)),
    lambda q, w, dt: v.times(q, v.quaternion_of(w * dt)),
)  # fmt: skip
leave_out(
    "random: tests/rotation look at how its draws are distributed",
    "rotation.so3.uniform", "rotation.quaternion.uniform",
)  # fmt: skip


# Charts: by the rotation vector, and rates by differentiation of a motion at 40 digits.
def mrp_of(q):
    x = v.turn_of(q)
    return mp.tan(v.norm(x) / 4) * x / v.norm(x) if v.norm(x) else x


def rodrigues_of(q):
    return q[1:] / q[0]


def derivative(f):
    """Of an array by a number, at 0: central differences of order 8, to 28 digits of 40."""
    with mp.extradps(40):
        h = mp.mpf(10) ** -8
        terms = ((1, 4, 5), (2, -1, 5), (3, 4, 105), (4, -1, 280))
        return sum(mp.mpf(a) / b * (f(k * h) - f(-k * h)) for k, a, b in terms) / h


def chart_rates(of, quaternion):
    """Of a chart's parameters: (rate from omega, omega from rate), both (3, 3)."""

    def both(x, y):
        size = max(v.norm(x), 1)
        moved = lambda e: derivative(
            lambda h: of(v.times(quaternion(x), v.quaternion_of(h * e / size))) * size
        )
        slope = np.stack([moved(e) for e in v.eye()], 1)
        return slope @ y, v.solve(slope, y)

    return both


def from_mrp(s):
    return np.concatenate([[1 - v.dot(s, s)], 2 * s]) / (1 + v.dot(s, s))


def from_rodrigues(g):
    return np.concatenate([[mp.mpf(1)], g]) / mp.sqrt(1 + v.dot(g, g))


INSIDE = one_of(v.normal(3, low=-20, high=-1), v.rotated_by(between(0.0, 0.99)), fixed([0.0] * 3))
OUTSIDE = one_of(INSIDE, v.normal(3, low=0, high=6))
for chart, name, of, back, draw in (
    (mrp, "mrp", lambda q: q[1:] / (v.norm(q) + q[0]), from_mrp, OUTSIDE),
    (rodrigues, "rodrigues", rodrigues_of, from_rodrigues, OUTSIDE),
):
    way(
        f"rotation.{name}.to_quaternion rotation.{name}.to_matrix",
        lambda x, c=chart: (c.to_quaternion(x), c.to_matrix(x)), draw,
        lambda x, b=back: (b(x), v.matrix_of(b(x))),
    )  # fmt: skip
    way(
        f"rotation.{name}.omega_to_rates rotation.{name}.rates_to_omega",
        lambda x, y, c=chart: (c.omega_to_rates(x, y), c.rates_to_omega(x, y)),
        (draw, v.vector), chart_rates(of, back), norm=True,
    )  # fmt: skip
way("rotation.mrp.from_quaternion", mrp.from_quaternion, v.quaternion, mrp_of)
way("rotation.mrp.from_matrix", mrp.from_matrix, v.matrix, lambda m: mrp_of(nearest(m)), norm=True)
way(
    "rotation.mrp.shadow rotation.mrp.switch", lambda s: (mrp.shadow(s), mrp.switch(s)),
    one_of(v.normal(3, low=-20, high=20), v.rotated_by(between(0.5, 2.0))),
    lambda s: (-s / v.dot(s, s), s if v.dot(s, s) <= 1 else -s / v.dot(s, s)),
)  # fmt: skip
HALF = lambda rng, i: np.array([10.0 ** rng.uniform(-12, 0), *direction(rng, i)])
way("rotation.rodrigues.from_quaternion", rodrigues.from_quaternion,
    HALF, rodrigues_of)  # fmt: skip
way(
    "rotation.rodrigues.from_matrix", lambda x: rodrigues.from_matrix(so3.exp(x)),
    v.rotated_by(one_of(between(0.1, 3.0), scale(-10, -1))), lambda x: mp.tan(v.norm(x) / 2)
    / v.norm(x) * x, norm=True,
)  # fmt: skip
way(
    "rotation.rodrigues.is_singular rotation.euler.is_singular",
    lambda d: (
        rodrigues.is_singular(q4.exp(jnp.array([jnp.pi - d, 0, 0]))),
        euler.is_singular(jnp.array([0.3, jnp.pi - d, 0.1]), "ZXZ"),
        euler.is_singular(jnp.array([0.3, 0.5 * jnp.pi - d, 0.1]), "ZYX"),
    ),
    fixed(0.0, 1e-7, 1e-2), lambda d: (mp.mpf(d == 0),) * 3,
)  # fmt: skip

# Euler angles: products of turns about axes; back by arctangents of the matrix.
EULER = ("ZXZ", "ZYX", "xyz", "YXY", "xzx", "YZX")


def euler_matrix(angles, sequence):
    turns = [
        v.rotation(a * v.eye()["xyz".index(s.lower())])
        for a, s in zip(angles, sequence, strict=True)
    ]
    a, b, c = turns if sequence.isupper() else turns[::-1]
    return a @ b @ c


def euler_angles(m, sequence):
    letters = sequence if sequence.isupper() else sequence[::-1]
    i, j, k = ("XYZ".index(s) for s in letters.upper())
    proper = i == k
    if proper:
        k = 3 - i - j
    e = 1 if (j - i) % 3 == 1 else -1
    if proper:
        across = mp.sqrt(m[i, j] ** 2 + m[i, k] ** 2)
        found = [
            mp.atan2(m[j, i], -e * m[k, i]), mp.atan2(across, m[i, i]),
            mp.atan2(m[i, j], e * m[i, k]),
        ]  # fmt: skip
    else:
        across = mp.sqrt(m[i, i] ** 2 + m[i, j] ** 2)
        found = [
            mp.atan2(-e * m[j, k], m[k, k]), mp.atan2(e * m[i, k], across),
            mp.atan2(-e * m[i, j], m[i, i]),
        ]  # fmt: skip
    return np.array(found if sequence.isupper() else found[::-1])


def euler_rates(angles, y, sequence):
    """Of (angles, y): y as rates → body and world rate; y as body and world rate → rates."""
    m = euler_matrix(angles, sequence)
    columns = [derivative(lambda h, e=e: euler_matrix(angles + h * e, sequence)) for e in v.eye()]
    body = np.stack([v.vee(m.T @ c) for c in columns], 1)
    return body @ y, m @ body @ y, v.solve(body, y), v.solve(m @ body, y)


def tilted(sequence):
    """Angles whose middle one is not singular, or nearly."""
    proper = sequence[0] == sequence[2]
    middle = one_of(
        between(0.2, 1.4),
        lambda rng, i: 10.0 ** rng.uniform(-6, -2) + (0 if proper else -np.pi / 2),
    )
    return lambda rng, i: np.array([rng.uniform(-3, 3), middle(rng, i), rng.uniform(-3, 3)])


for sequence in EULER:
    name = f"({sequence})"
    way(
        f"rotation.euler.to_quaternion rotation.euler.to_matrix {name}",
        lambda a, s=sequence: (q4.to_matrix(euler.to_quaternion(a, s)), euler.to_matrix(a, s)),
        one_of(tilted(sequence), between(-10, 10, 3), v.normal(3, low=-20, high=0)),
        lambda a, s=sequence: (euler_matrix(a, s),) * 2,
    )  # fmt: skip
    way(
        f"rotation.euler.from_quaternion rotation.euler.from_matrix {name}",
        lambda q, m, s=sequence: (
            euler.from_quaternion(q, s), euler.to_matrix(euler.from_quaternion(q, s), s),
            euler.to_matrix(euler.from_matrix(m, s), s),
        ),
        (lambda rng, i: v.quaternion(rng, 0) * 10.0 ** rng.uniform(-20, 20), v.matrix),
        lambda q, m, s=sequence: (euler_angles(v.matrix_of(q), s), v.matrix_of(q), m), norm=True,
    )  # fmt: skip
    way(
        f"rotation.euler.rates_to_omega rotation.euler.omega_to_rates {name}",
        lambda a, y, s=sequence: (
            *(euler.rates_to_omega(a, y, s, frame=f) for f in ("body", "world")),
            *(euler.omega_to_rates(a, y, s, frame=f) for f in ("body", "world")),
        ),
        (tilted(sequence), v.vector), lambda a, y, s=sequence: euler_rates(a, y, s), norm=True,
    )  # fmt: skip
