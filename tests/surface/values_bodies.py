"""A second way for bodies: integrals over slices and surfaces, eigenvalues in mpmath."""

import jax.numpy as jnp
import mpmath as mp
import numpy as np
from surface import values as v
from surface.values import between, fixed, leave_out, one_of, scale, way

import rigidjax as rj
from rigidjax import body as bodies, parameters, quaternion as q4, shapes, so3, tumblers, volumes

MASS = scale(-20, 20)
# LAPACK's eigenvalues are those of a matrix some dozen units off: p(n) ε, its guide says.
EIGEN = 32


def tensor_of(s):
    """I of 𝔖."""
    return np.trace(s) * v.eye(len(s)) - s


def second_of(i):
    """𝔖 of I."""
    return np.trace(i) / 2 * v.eye() - i


def props(m, c, s):
    return rj.MassProperties(m, c, s)


# Inertia and mass properties. A second moment that is near a plate's says what digits I has lost.
way(
    "Inertia Inertia.second_moment Inertia.from_tensor Inertia.from_second_moment "
    "Inertia.require_invertible Inertia.rotate Inertia.shift",
    lambda i, s, q, r, m: (
        rj.Inertia(i), rj.Inertia(i).second_moment, rj.Inertia.from_tensor(i),
        rj.Inertia.from_second_moment(s), rj.Inertia(i).require_invertible(), rj.Inertia(i).rotate(q),
        rj.Inertia(i).shift(r, m),
    ),
    (v.inertia, v.second_moment, v.quaternion, v.vector, MASS),
    lambda i, s, q, r, m: (
        i, second_of(i), i, tensor_of(s), i, v.matrix_of(q) @ i @ v.matrix_of(q).T,
        i - m * v.hat(r) @ v.hat(r),
    ),
    norm=True,
)  # fmt: skip
way("Inertia.from_principal", rj.Inertia.from_principal,
    (between(1.0, 2.0), between(1.5, 2.0), between(1.0, 2.0)),
    lambda a, b, c: np.diag([a, b, c]) + 0 * v.eye())  # fmt: skip


def rebuilt(values, q):
    r = q4.to_matrix(q)
    return values, so3.product(so3.product(r, jnp.diag(values)), r.T)


way(
    "Inertia.principal Inertia.moments body.principal",
    lambda i: (rebuilt(*rj.Inertia(i).principal()), rj.Inertia(i).moments, rebuilt(
        *bodies.principal(i))),
    v.inertia, lambda i: (v.eigen(i)[0], i, v.eigen(i)[0], v.eigen(i)[0], i), norm=True,
    ulps=EIGEN,
)  # fmt: skip


def function_of(f):
    def found(a):
        values, axes = v.eigen(a)
        return axes @ np.diag([f(x) for x in values]) @ axes.T

    return found


way("body.matrix_function", lambda a: bodies.matrix_function(jnp.sqrt, a), v.inertia,
    function_of(mp.sqrt), norm=True, ulps=EIGEN)  # fmt: skip
way("body.matrix_function (exp)", lambda a: bodies.matrix_function(jnp.exp, a),
    one_of(lambda rng, i: v.second_moment(rng, i % 5)), function_of(mp.exp),
    norm=True, ulps=EIGEN)  # fmt: skip
BODY = (MASS, v.vector, v.second_moment)
way(
    "MassProperties MassProperties.inertia MassProperties.check MassProperties.require_invertible "
    "MassProperties.rotate MassProperties.shift MassProperties.inertia_about "
    "MassProperties.second_moment_about",
    lambda m, c, s, q, r: (
        props(m, c, s), props(m, c, s).inertia, props(m, c, s).check(),
        props(m, c, s).require_invertible(), props(m, c, s).rotate(q), props(m, c, s).shift(r),
        props(m, c, s).inertia_about(r), props(m, c, s).second_moment_about(r),
    ),
    (*BODY, v.quaternion, v.vector),
    lambda m, c, s, q, r: (
        (m, c, s), tensor_of(s), (m, c, s), (m, c, s),
        (m, v.matrix_of(q) @ c, v.matrix_of(q) @ s @ v.matrix_of(q).T), (m, c + r, s),
        tensor_of(s) - m * v.hat(c - r) @ v.hat(c - r), s + m * np.outer(c - r, c - r),
    ),
    norm=True,
)  # fmt: skip


# Sums of two bodies, as of points.
def joined(m, c, s, n, d, u):
    mass = m + n
    middle = (m * c + n * d) / mass
    out = lambda x: np.outer(x - middle, x - middle)
    return mass, middle, s + u + m * out(c) + n * out(d)


way(
    "MassProperties (sum)", lambda m, c, s, n, d, u: props(m, c, s) + props(n, d, u),
    (scale(-3, 3), v.vector, v.second_moment) * 2, joined, norm=True,
)  # fmt: skip


def pseudo(m, c, s):
    j = np.zeros((4, 4), object)
    j[:3, :3], j[:3, 3], j[3, :3], j[3, 3] = s + m * np.outer(c, c), m * c, m * c, m
    return j


def divergence(m, c, s, n, d, u):
    k = v.solve(pseudo(n, d, u), pseudo(m, c, s))
    return np.trace(k) - mp.log(v.determinant(k)) - 4


def alike(rng, i):
    return v.second_moment(rng, i % 5)


# Known to round-off of the trace, from which 4 is taken.
way(
    "body.divergence",
    lambda m, c, s, n, d, u: bodies.divergence(props(m, c, s), props(n, d, u)) + 4.0,
    (scale(-2, 2), v.ordinary, alike) * 2, lambda *a: divergence(*a) + 4, norm=True,
)  # fmt: skip
way(
    "body.divergence (near)",
    lambda m, c, s, e: bodies.divergence(props(m, c, s), props(m * (1 + e), c, s)) + 4.0,
    (scale(-2, 2), v.ordinary, alike, fixed(0.0, 2.0**-3, 2.0**-20)),
    lambda m, c, s, e: divergence(m, c, s, m * (1 + e), c, s) + 4, norm=True,
)  # fmt: skip
way(
    "body.ellipsoid (of rates)",
    lambda i, x: (
        rebuilt(*bodies.ellipsoid(rj.Inertia(i), "energy", x)),
        rebuilt(*bodies.ellipsoid(rj.Inertia(i), "momentum", x)),
    ),
    (v.inertia, scale(-20, 20)),
    lambda i, x: (
        [mp.sqrt(2 * x / k) for k in v.eigen(i)[0]] * np.ones(3), function_of(
            lambda k: mp.sqrt(2 * x / k))(i),
        [x / k for k in v.eigen(i)[0]] * np.ones(3), function_of(lambda k: x / k)(i),
    ),
    norm=True, ulps=EIGEN,
)  # fmt: skip


def ellipsoid_of(m, c, s):
    f = lambda k: mp.sqrt(abs(5 * k / m))
    return [f(k) for k in v.eigen(s)[0]] * np.ones(3), function_of(f)(s)


# The root of a small eigenvalue: as good as the eigenvalue is.
way(
    "body.ellipsoid (of mass)", lambda m, c, s: rebuilt(*bodies.ellipsoid(props(m, c, s), "mass")), BODY,
    ellipsoid_of, norm=True, ulps=EIGEN,
)  # fmt: skip


# Energies and momenta: by adding up what six points of a body have.
def points(m, c, s):
    """Six points of the same mass, centre and second moment: ± √(3 λ/m) along the axes."""
    values, axes = v.eigen(s)
    out = [mp.sqrt(abs(3 * k / m)) * axes[:, n] for n, k in enumerate(values)]
    return [c + sign * e for e in out for sign in (1, -1)], m / 6


def moved_points(m, c, s, x, vel, q, w):
    """Places and velocities in the world; x, vel of the centre of mass."""
    r, (rows, each) = v.matrix_of(q), points(m, 0 * c, s)
    return [(x + r @ p, vel + r @ np.cross(w, p)) for p in rows], each


def mechanics(m, c, s, x, vel, q, w):
    rows, each = moved_points(m, c, s, x, vel, q, w)
    energy = sum(v.dot(u, u) for _, u in rows) * each / 2
    spatial = sum(np.cross(p, u) for p, u in rows) * each
    body = tensor_of(s) @ w
    r = v.matrix_of(q)
    return energy, body, spatial, v.dot(body, w) / 2, r @ body


STATE = (v.vector, v.vector, v.quaternion, v.vector)
way(
    "kinetic_energy angular_momentum spatial_angular_momentum",
    lambda m, c, s, x, u, q, w: (
        rj.kinetic_energy(props(m, c, s), rj.Rigid(x, u, q, w)),
        rj.angular_momentum(props(m, c, s), rj.Spin(w)),
        rj.spatial_angular_momentum(props(m, c, s), rj.Rigid(x, u, q, w)),
        rj.kinetic_energy(props(m, c, s).inertia, w),
        rj.spatial_angular_momentum(props(m, c, s).inertia, rj.Attitude(q, w)),
    ),
    (*BODY, *STATE), mechanics, norm=True,
)  # fmt: skip


def about(m, c, s, q, vel, w):
    r = v.matrix_of(q)
    rows, each = points(m, c, s)
    return sum(v.dot(u, u) for u in (vel + r @ np.cross(w, p) for p in rows)) * each / 2


way(
    "body.kinetic_energy_about",
    lambda m, c, s, q, u, w: bodies.kinetic_energy_about(props(m, c, s), q, u, w),
    (*BODY, v.quaternion, v.vector, v.vector), about, norm=True,
)  # fmt: skip
way(
    "body.kinetic_energy_of_matrix_rate",
    lambda s, w, m: (
        bodies.kinetic_energy_of_matrix_rate(s, so3.hat(w)),
        bodies.kinetic_energy_of_matrix_rate(s, so3.product(m, so3.hat(w))),
    ),
    (v.second_moment, v.vector, v.matrix),
    lambda s, w, m: (v.dot(w, tensor_of(s) @ w) / 2, v.dot(w, tensor_of(s) @ w) / 2),
    norm=True,
)  # fmt: skip


# Unconstrained parameters: the root by eigenvalues.
def pack_second(s):
    values, axes = v.eigen(s)
    a = axes @ np.diag([mp.sqrt(max(x, mp.mpf(0))) for x in values]) @ axes.T
    a = 3 * a / np.trace(a)
    return np.array([
        mp.log(np.trace(s) / 3) / 2, a[0, 0] - 1, a[1, 1] - 1, a[0, 1], a[1, 2], a[0, 2]
    ])  # fmt: skip


def unpack_second(x):
    return 3 * mp.exp(2 * x[0]) * unpack_shape(x[1:])


def unpack_shape(x):
    a = np.array([
        [1 + x[0], x[2], x[4]], [x[2], 1 + x[1], x[3]], [x[4], x[3], 1 - x[0] - x[1]]
    ])  # fmt: skip
    return a @ a / np.trace(a @ a)


def pack(m, c, s):
    return np.concatenate([[mp.log(m) / 2], pack_second(s / m), c])


def unpack(x):
    m = mp.exp(2 * x[0])
    return m, x[7:], m * unpack_second(x[1:7])


def pack_moments(i):
    a = v.sqrt(LAMBDA(i))
    return np.array([mp.log(sum(LAMBDA(i)) / 3) / 2, *(3 * a[:2] / sum(a) - 1)])


def unpack_moments(x):
    s = np.array([1 + x[1], 1 + x[2], 1 - x[1] - x[2]]) ** 2
    s = 3 * mp.exp(2 * x[0]) * s / sum(s)
    return sum(s) - s


LAMBDA = lambda i: (sum(i) - 2 * i) / 2
way("body.parameters.pack", lambda m, c, s: parameters.pack(props(m, c, s)), BODY, pack, norm=True)
way(
    "body.parameters.pack_second_moment body.parameters.pack_shape",
    lambda s: (parameters.pack_second_moment(s), parameters.pack_shape(s)),
    v.second_moment, lambda s: (pack_second(s), pack_second(s)[1:]), norm=True,
)  # fmt: skip
way(
    "body.parameters.pack_moments", parameters.pack_moments,
    lambda rng, i: np.trace(np.diag(x := v.moments(rng, i))) - x,
    pack_moments, norm=True,
)  # fmt: skip
NUMBERS = lambda n: one_of(between(-2, 2, n), between(-20, 20, n), fixed(np.zeros(n)))
way("body.parameters.unpack", parameters.unpack, NUMBERS(10), unpack)
way("body.parameters.unpack_second_moment", parameters.unpack_second_moment, NUMBERS(6),
    unpack_second)  # fmt: skip
way("body.parameters.unpack_shape", parameters.unpack_shape, NUMBERS(5), unpack_shape)
way("body.parameters.unpack_moments", parameters.unpack_moments, NUMBERS(3), unpack_moments)


# Solids: slices along z, each a disc, a ring, a rectangle or an ellipse; Gauss's points along z.
def _gauss(n):
    """Points and weights on (−1, 1), by the secant method from Tricomi's estimate."""

    def legendre(x):
        return mp.legendre(n, x)

    guesses = [mp.cos(mp.pi * (k + mp.mpf(3) / 4) / (n + mp.mpf(1) / 2)) for k in range(n)]
    points = [mp.findroot(legendre, (x, x + mp.mpf(10) ** -6)) for x in guesses]
    return [(x, 2 / ((1 - x * x) * mp.diff(legendre, x) ** 2)) for x in points]


with mp.workdps(v.DIGITS + 10):
    NODES = _gauss(12)


def along(slices, low, high):
    """(V, λ) of unit density; `slices(z)` the area and its second moments about x and y = 0."""
    half, total = (high - low) / 2, 0
    for x, weight in NODES:
        z = low + half * (1 + x)
        area, xx, yy = slices(z)
        total = total + half * weight * np.array([area, xx, yy, z * area, z * z * area])
    volume, xx, yy, first, zz = total
    return volume, np.array([xx, yy, zz - first**2 / volume if volume else zz])


def disc(r2):
    return mp.pi * r2, mp.pi * r2**2 / 4, mp.pi * r2**2 / 4


def less(outer, inner):
    return tuple(a - b for a, b in zip(outer, inner, strict=True))


def torus(major, minor):
    """Slices at z = r sin θ, with dz: polynomials of the cosine, by the trapezoidal rule."""
    n = 24
    total = 0
    for k in range(n):
        t = 2 * mp.pi * (k + mp.mpf(1) / 2) / n
        z, x = minor * mp.sin(t), minor * mp.cos(t)
        # Half of the way round has x > 0: there the ring reaches from major − x to major + x.
        area = 4 * mp.pi * major * x
        fourth = mp.pi / 4 * 8 * major * x * (major**2 + x**2)
        total = total + np.array([area, fourth, fourth, z * z * area]) * x / 2
    volume, xx, yy, zz = total * 2 * mp.pi / n
    return volume, np.array([xx, yy, zz])


def capsule(r, h):
    end, first = along(lambda z: disc(r * r - z * z), 0 * r, r)
    # Half balls beyond ±h/2: their z² from their own centre, and the shift.
    mid, inner = along(lambda z: disc(r * r), -h / 2, h / 2)
    zz = 0
    for x, weight in NODES:
        z = r * (1 + x) / 2
        zz = zz + r / 2 * weight * mp.pi * (r * r - z * z) * (z + h / 2) ** 2
    return mid + 2 * end, inner + 2 * np.array([first[0], first[1], zz])


SOLIDS = {
    "box": (one_of(between(0.1, 2, 3), v.normal(3, low=-20, high=20)), lambda s: along(
        lambda z: (s[0] * s[1], s[0] ** 3 * s[1] / 12, s[0] * s[1] ** 3 / 12), -s[2] / 2, s[2] / 2)),
    "ellipsoid": (one_of(between(0.1, 2, 3), v.normal(3, low=-20, high=20)), lambda s: along(
        lambda z: ellipse(s[0], s[1], 1 - z * z / s[2] ** 2), -s[2], s[2])),
    "sphere": (scale(), lambda r: along(lambda z: disc(r * r - z * z), -r, r)),
    "hollow_sphere": (scale(-3, 0), one_of(between(1, 3), scale(0, 10)), lambda a, b: tuple(
        x - y for x, y in zip(along_all(lambda z: disc(b * b - z * z), b),
                              along_all(lambda z: disc(a * a - z * z), a), strict=True))),
    "cylinder": (scale(), scale(), lambda r, h: along(lambda z: disc(r * r), -h / 2, h / 2)),
    "hollow_cylinder": (scale(-3, 0), one_of(between(1, 3), scale(0, 10)), scale(), lambda a, b, h:
        along(lambda z: less(disc(b * b), disc(a * a)), -h / 2, h / 2)),
    "capsule": (scale(), scale(-3, 3), capsule),
    "cone": (scale(), scale(), lambda r, h: along(lambda z: disc((r * (1 - z / h)) ** 2), 0 * h, h)),
    "torus": (one_of(between(1, 3), scale(0, 20)), one_of(between(0, 1), scale(-20, 0)), torus),
}  # fmt: skip


def ellipse(a, b, part):
    area = mp.pi * a * b * part
    return area, area * a * a * part / 4, area * b * b * part / 4


def along_all(slices, r):
    return along(slices, -r, r)


def solid(integrals):
    def found(m, *sizes):
        volume, moments = integrals(*sizes)
        return m, 0 * v.eye()[0], np.diag(m * moments / volume) + 0 * v.eye(), volume

    return found


for name, (*sizes, integrals) in SOLIDS.items():
    shape, volume = getattr(shapes, name), getattr(volumes, name)
    sizes = [lambda rng, i, s=s: np.abs(s(rng, i)) for s in sizes]
    way(
        f"body.shapes.{name} body.volumes.{name}",
        lambda m, *a, shape=shape, volume=volume: (shape(m, *a), volume(*a)),
        (MASS, *sizes), solid(integrals),
    )  # fmt: skip


def thin(m, x, y):
    """A shell, a rod, a plate: balls, bars and boxes without their thickness."""
    zero = 0 * v.eye()
    rod = m * y * y / 12
    return (
        (m, zero[0], m * x * x / 3 * v.eye()), (m, zero[0], np.diag([0, 0, rod]) + zero),
        (m, zero[0], np.diag([m * x * x / 12, rod, 0]) + zero),
    )  # fmt: skip


way(
    "body.shapes.shell body.shapes.rod body.shapes.plate",
    lambda m, x, y: (
        shapes.shell(m, x), shapes.rod(m, y), shapes.plate(m, jnp.stack([x, y])),
    ),
    (MASS, scale(), scale()), thin,
)  # fmt: skip


def gathered(ms, rs):
    m = sum(ms)
    c = sum(a * r for a, r in zip(ms, rs, strict=True)) / m
    return m, c, sum(a * np.outer(r - c, r - c) for a, r in zip(ms, rs, strict=True))


way(
    "body.shapes.points", shapes.points,
    (lambda rng, i: 10.0 ** rng.uniform(-3, 3, 5),
     lambda rng, i: rng.normal(size=(5, 3)) * 10.0 ** rng.uniform(-6, 6) + 10.0 ** (i % 4) * (i % 4)),
    gathered, norm=True,
)  # fmt: skip


def cells(density, h, corner):
    each = [
        (density[i, j, k] * h.prod(), corner + h * (np.array([i, j, k]) + mp.mpf(1) / 2))
        for i in range(2) for j in range(3) for k in range(2)
    ]  # fmt: skip
    m, c, s = gathered(*zip(*each, strict=True))
    return m, c, s + m / 12 * np.diag(h * h)


way(
    "body.shapes.voxels", shapes.voxels,
    (between(0.1, 2.0, 2, 3, 2), lambda rng, i: 10.0 ** rng.uniform(-3, 3, 3),
     one_of(v.ordinary, v.normal(3, low=0, high=4))), cells, norm=True,
)  # fmt: skip


# A box of density 1 + a x², whose integrals are powers.
def weighted(a, size):
    power = lambda n, k: size[k] ** (n + 1) / (n + 1)
    whole = lambda i, j, k: (
        power(i, 0) * power(j, 1) * power(k, 2) + a * (power(i + 2, 0) * power(j, 1) * power(k, 2))
    )
    e = np.eye(3, dtype=int)
    m = whole(0, 0, 0)
    c = np.array([whole(*e[k]) / m for k in range(3)])
    return m, c, np.array([[whole(*(e[i] + e[j])) for j in range(3)] for i in range(3)]) - (
        m * np.outer(c, c))  # fmt: skip


way(
    "body.shapes.quadrature",
    lambda a, size: shapes.quadrature(lambda r: 1.0 + a * r[0] ** 2, lambda u: u * size, 4),
    (between(0, 3), between(0.1, 3.0, 3)), weighted, ulps=32, norm=True,
)  # fmt: skip

# A closed mesh, an octahedron pushed out of shape: integrals over its faces (Gauss's theorem).
OCTAHEDRON = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
FACES = np.array([
    [0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]
])  # fmt: skip


def corners(rng, i):
    size, far = 10.0 ** rng.uniform(-6, 6), (0.0, 0.0, 10.0, 1e3)[i % 4]
    r = v.matrix(rng, 0)
    return size * ((OCTAHEDRON * [1, 0.6, 1.7] + 0.2 * rng.uniform(-1, 1, (6, 3))) @ r.T + far)


def surface(rows, density):
    """∫ r rᵀ dV = ⅕ ∮ r rᵀ (r·n) dA; on a face r·n is one number, and the rest a quadratic."""
    # From a corner, so that the sums are of the body's own size.
    start = rows[0]
    rows = rows - start
    m, first, second = 0, 0, 0
    for face in FACES:
        a, b, c = (rows[k] for k in face)
        flux = v.dot(a, np.cross(b, c)) / 2
        # Exact for quadratics: the middles of the sides.
        middles = [(a + b) / 2, (b + c) / 2, (c + a) / 2]
        m = m + flux / 3
        first = first + flux / 4 * sum(middles) / 3
        second = second + flux / 5 * sum(np.outer(r, r) for r in middles) / 3
    c = first / m
    return density * m, start + c, density * (second - m * np.outer(c, c))


way(
    "body.shapes.mesh", lambda rows, d: shapes.mesh(rows, FACES, d), (corners, scale(-6, 6)),
    surface, norm=True,
)  # fmt: skip
leave_out(
    "files: tests/body read what other programs wrote, and the numbers back",
    "body.shapes.mesh_file", "body.read_inertials", "body.write_inertials",
)  # fmt: skip
leave_out(
    "random: tests/body/test_draws.py, tests/identify/test_drawn_bodies.py",
    "body.Draw", "body.sample", "identify.Fit.bodies",
)  # fmt: skip
leave_out(
    "tables of other libraries: tests/identify/test_tables.py",
    "identify.Fit.to_frame", "solve.Solution.to_xarray",
)  # fmt: skip
leave_out("a Protocol: no numbers", "motion.HasAttitude", "motion.HasPose", "motion.HasSpin", "motion.HasAttitude.q",
          "motion.HasPose.x", "motion.HasPose.v", "motion.HasSpin.omega")  # fmt: skip

# Brightness: a sum over the ellipsoid's directions, by the sphere it is an image of.
leave_out("being mended for long shapes (issue 33, 1): its test holds it by a quadrature",
          "tumblers.brightness.Lambert", "tumblers.brightness.Lambert.of_ellipsoid")  # fmt: skip
leave_out("abstract", "tumblers.brightness.AbstractScattering")
LAWS = (tumblers.brightness.Geometric(), tumblers.brightness.LommelSeeliger())


def of_lune(axes, sun, observer):
    """r = A u: along the lune the integrands are cos β, across it one integral is left."""
    p, q = (x / v.norm(x) / axes for x in (sun, observer))
    angle = mp.atan2(v.norm(np.cross(p, q)), v.dot(p, q))
    p, q = v.norm(p), v.norm(q)
    lit, seen = lambda x: p * mp.cos(x), lambda x: q * mp.cos(x - angle)
    low, high = angle - mp.pi / 2, mp.pi / 2
    laws = (seen, lambda x: 2 * lit(x) * seen(x) / (lit(x) + seen(x)))
    half, found = (high - low) / 2, []
    for law in laws:
        # Tanh-sinh points: the ends are where both cosines may vanish.
        with mp.extradps(10):
            found.append(mp.quad(lambda x, law=law: law(low + half * (1 + x)), [-1, 0, 1]) * half)
    return [axes.prod() * mp.pi / 2 * x for x in found]


AXES = one_of(between(0.5, 2.0, 3), lambda rng, i: 10.0 ** rng.uniform(-1, 1, 3), lambda rng, i:
              10.0 ** rng.uniform(-20, 20) * rng.uniform(0.5, 2.0, 3))  # fmt: skip
LIGHT = (AXES, v.vector, one_of(v.ordinary, v.direction))
way(
    "tumblers.brightness.ellipsoid tumblers.brightness.Geometric tumblers.brightness.Geometric.of_ellipsoid "
    "tumblers.brightness.LommelSeeliger tumblers.brightness.LommelSeeliger.of_ellipsoid",
    lambda *a: [tumblers.brightness.ellipsoid(*a, law) for law in LAWS], LIGHT, of_lune, cost=2,
)  # fmt: skip
way(
    "tumblers.brightness.ellipsoid (small phase)",
    lambda a, s, e: [tumblers.brightness.ellipsoid(a, s, s + e * jnp.roll(s, 1), law) for law in LAWS],
    (AXES, v.ordinary, one_of(scale(-16, -1), fixed(0.0))),
    lambda a, s, e: of_lune(a, s, s + e * np.roll(s, 1)), cost=2,
)  # fmt: skip


def of_faces(rows, sun, observer):
    sun, observer = (x / v.norm(x) for x in (sun, observer))
    found = [0 * sun[0]] * 3
    for face in FACES:
        a, b, c = (rows[k] for k in face)
        area = np.cross(b - a, c - a) / 2
        size = v.norm(area)
        lit, seen = v.dot(area, sun) / size, v.dot(area, observer) / size
        if lit > 0 and seen > 0:
            each = (seen, 2 * lit * seen / (lit + seen), 3 * lit * seen / 2)
            found = [x + size * y for x, y in zip(found, each, strict=True)]
    return found


way(
    "tumblers.brightness.mesh tumblers.brightness.Geometric.per_area "
    "tumblers.brightness.LommelSeeliger.per_area tumblers.brightness.Lambert.per_area",
    lambda rows, s, o: [
        tumblers.brightness.mesh(rows, FACES, s, o, law)
        for law in (*LAWS, tumblers.brightness.Lambert())
    ],
    (corners, v.vector, v.ordinary), of_faces, norm=True,
)  # fmt: skip
