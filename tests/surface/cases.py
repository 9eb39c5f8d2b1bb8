"""What the sweep of derivatives goes through: functions of one vector, ordinary and degenerate points."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from surface import scenes as s
from surface.scenes import DOWN, SECOND, SYMMETRIC, TS, P, Q, V, W, Y
from surface.sweep import Case

import rigidjax as rj
from rigidjax.frames.frame_dynamics import InFrame
from rigidjax.motion.equations import AttitudeEquations, EulerEquations, NewtonEuler
from rigidjax.motion.torques.base import force_and_torque

q4, so3, mrp, rodrigues, euler = rj.quaternion, rj.so3, rj.mrp, rj.rodrigues, rj.euler
ell = rj.elliptic
HALF = np.array([0.0, 1.0, 0.0, 0.0])
ONE = np.array([1.0, 0.0, 0.0, 0.0])
AXIS = np.array([0.6, 0.0, 0.8])


def generator(w: Any) -> Any:
    """hat w, written down here."""
    x, y, z = w
    zero = jnp.zeros_like(x)
    return jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


def cayley(x: Any) -> Any:
    """A rotation near 1, (1 + ½ hat x)(1 − ½ hat x)⁻¹ multiplied out: neither series nor root."""
    h = generator(x)
    return jnp.eye(3) + (4 / (4 + jnp.sum(x * x))) * (h + 0.5 * h @ h)


def matrix_at(start: np.ndarray) -> Callable[[Any], Any]:
    """Rotations near `start`."""
    return lambda x: jnp.asarray(start) @ cayley(x)


def symmetric(x: Any) -> Any:
    """A symmetric matrix of six numbers: the diagonal, then xy, xz, yz."""
    a, b, c, d, e, f = x
    return jnp.stack([a, d, e, d, b, f, e, f, c]).reshape(3, 3)


def six(a: Any) -> np.ndarray:
    a = np.asarray(a, float)
    return np.array([a[0, 0], a[1, 1], a[2, 2], a[0, 1], a[0, 2], a[1, 2]])


def unit(x: Any) -> Any:
    """q/|q|, written down here."""
    return x / jnp.sqrt(jnp.sum(x * x))


def join(*parts: Any) -> np.ndarray:
    return np.concatenate([np.atleast_1d(np.asarray(p, float)).reshape(-1) for p in parts])


def split(*sizes: int) -> Callable[[Any], Any]:
    edges = np.cumsum(sizes)[:-1]
    return lambda x: [
        p[0] if n == 1 else p for p, n in zip(jnp.split(x, edges), sizes, strict=True)
    ]


VECTORS = {
    "ordinary": V,
    "zero": np.zeros(3),
    "1e-9": 1e-9 * AXIS,
    "a half turn": np.pi * AXIS,
    "near a turn": 6.2 * AXIS,
    "many turns": np.array([7.0, -9.0, 4.0]),
}
SHORT = {k: v for k, v in VECTORS.items() if k not in ("near a turn", "many turns")}
QUATERNIONS = {
    "ordinary": Q,
    "identity": ONE,
    "minus identity": -ONE,
    "near": join(1.0, 1e-9, 0, 0),
}
# The branch of the logarithm is at a half turn itself: differences stay on one side of it.
BEFORE = {"before a half turn": join(0.1, 0.99, 0.05, -0.08)}
LENGTHS = {"ordinary": np.array([0.3, 0.7, 1.1]), "a plate": np.array([0.3, 0.0, 1.1])}


def rotations() -> list[Case]:
    no = np.zeros(3)
    found = [
        Case("so3.exp", so3.exp, VECTORS),
        Case("quaternion.exp", q4.exp, VECTORS),
        Case("so3.left_jacobian", so3.left_jacobian, VECTORS),
        Case("so3.right_jacobian", so3.right_jacobian, VECTORS),
        Case("so3.left_jacobian_inverse", so3.left_jacobian_inverse, SHORT),
        Case("so3.right_jacobian_inverse", so3.right_jacobian_inverse, SHORT),
        Case("so3.hat", so3.hat, {"zero": no}),
        Case("so3.vee", lambda x: so3.vee(x.reshape(3, 3)), {"ordinary": join(SYMMETRIC, )}),
        Case("quaternion.log", q4.log, QUATERNIONS | BEFORE),
        Case("quaternion.log of lengths", lambda x: q4.log(3.0 * x), QUATERNIONS),
        Case("quaternion.angle", q4.angle, {"ordinary": Q} | BEFORE, step=0.01),
        Case("quaternion.to_matrix", q4.to_matrix, QUATERNIONS),
        Case("quaternion.normalise", q4.normalise, QUATERNIONS),
        Case("quaternion.canonical", q4.canonical, {"ordinary": Q}),
        Case("quaternion.conjugate", q4.conjugate, QUATERNIONS),
        Case("quaternion.to_xyzw", lambda x: (q4.to_xyzw(x), q4.from_xyzw(x)), QUATERNIONS),
        Case("quaternion.check", q4.check, {"ordinary": Q}, step=1e-7, rtol=1e-6, first=True),
        Case(
            "quaternion.multiply",
            lambda x: (q4.multiply(x[:4], x[4:]), q4.interpolate(unit(x[:4]), unit(x[4:]), 0.3)),
            {"ordinary": join(Q, P), "the same": join(Q, Q), "opposite signs": join(Q, -Q)},
            covers=("quaternion.interpolate",),
        ),
        Case(
            "quaternion.rotate",
            lambda x: (
                q4.rotate(x[:4], x[4:]), q4.rotate_inverse(x[:4], x[4:]), q4.rate(x[:4], x[4:]),
                q4.advance(x[:4], x[4:], 0.3),
            ),
            {"ordinary": join(Q, W), "identity, at rest": join(ONE, no)},
            covers=("quaternion.rotate_inverse", "quaternion.rate", "quaternion.advance"),
        ),
        Case(
            "quaternion.about_axis",
            lambda x: (q4.about_axis(x[:3], x[3]), so3.about_axis(x[:3], x[3])),
            {"ordinary": join(V, 0.7), "no angle": join(V, 0.0), "a half turn": join(V, np.pi)},
            step=0.01,
            covers=("so3.about_axis",),
        ),
    ]  # fmt: skip
    for name, start in {
        "identity": np.eye(3),
        "ordinary": s.M,
        "a half turn": np.diag([1.0, -1, -1]),
    }.items():
        at = matrix_at(start)
        zero = {"here": no, "near": 1e-9 * AXIS}
        found.append(
            Case(
                f"so3.project at {name}",
                lambda x, at=at: (so3.project(at(x[:3]) + symmetric(x[3:])),),
                {"here": np.zeros(9), "stretched": join(no, 0.1 * six(SYMMETRIC))},
                rtol=1e-8, rtol2=1e-7,
                covers=("so3.project",),
            )
        )  # fmt: skip
        found.append(
            Case(
                f"matrices at {name}",
                lambda x, at=at, name=name: (
                    mrp.from_matrix(at(x)) if name != "a half turn" else (),
                    rodrigues.from_matrix(at(x)) if name != "a half turn" else (),
                    so3.adjoint(at(x)), so3.conjugate(at(x), s.N), so3.rate(at(x), W),
                    so3.to_world(at(x), Y), so3.to_body(at(x), Y),
                    so3.body_rate(at(x), s.N), so3.world_rate(at(x), s.N), so3.check(at(x)),
                ),
                zero, step=0.01,
                covers=(
                    "mrp.from_matrix", "rodrigues.from_matrix", "so3.adjoint", "so3.conjugate",
                    "so3.rate", "so3.to_world", "so3.to_body", "so3.body_rate", "so3.world_rate",
                    "so3.check",
                ),
            )
        )  # fmt: skip
        if name != "a half turn":
            found.append(
                Case(
                    f"so3.log at {name}",
                    lambda x, at=at: (so3.log(at(x)), q4.from_matrix(at(x))),
                    zero, step=0.01,
                    covers=("so3.log", "quaternion.from_matrix"),
                )
            )  # fmt: skip
    found += [
        Case(
            "so3.products",
            lambda x: (
                so3.cross(x[:3], x[3:6]), so3.dot(x[:3], x[3:6]),
                so3.product(x[6:15].reshape(3, 3), x[15:].reshape(3, 3)),
                so3.apply(x[6:15].reshape(3, 3), x[:3]), so3.solve(x[6:15].reshape(3, 3), x[:3]),
                so3.determinant(x[6:15].reshape(3, 3)),
            ),
            {"ordinary": join(V, W, SYMMETRIC, s.M), "zero vectors": join(no, no, SYMMETRIC, s.M)},
            covers=tuple(f"so3.{n}" for n in ("cross", "dot", "product", "apply", "solve", "determinant")),
        ),
        Case(
            "so3.align",
            lambda x: so3.align(x[:3], x[3:]),
            {"ordinary": join(V, W), "the same": join(V, V), "parallel": join(V, 2 * V)},
            step=0.01,
        ),
        Case(
            "so3.wahba",
            lambda x: so3.wahba(x[:9].reshape(3, 3), x[9:18].reshape(3, 3), x[18:]),
            {
                "exact": join(V, W, Y, np.stack([V, W, Y]) @ s.M.T, [1.0, 2.0, 3.0]),
                "noisy": join(V, W, Y, np.stack([V, W, Y]) @ s.M.T + 0.1 * s.N, [1.0, 2.0, 3.0]),
            },
            step=0.01, rtol=1e-8, rtol2=1e-6,
        ),
        Case(
            "so3.mean",
            lambda x: (
                so3.mean(jnp.stack([cayley(x[:3]), cayley(x[3:6])]), x[6:]),
                so3.mean_quaternion(jnp.stack([q4.exp(x[:3]), q4.exp(x[3:6])]), x[6:]),
            ),
            {"ordinary": join(V, W, 1.0, 2.0), "the same": join(V, V, 1.0, 2.0), "identity": join(no, no, 1, 1)},
            step=0.01, rtol=1e-8, rtol2=1e-6,
            covers=("so3.mean_quaternion",),
        ),
        Case(
            "so3.interpolate",
            lambda x: so3.interpolate(cayley(x[:3]), cayley(x[3:6]), x[6]),
            {"ordinary": join(V, W, 0.3), "the same": join(V, V, 0.3), "at the start": join(V, W, 0.0)},
            step=0.01,
        ),
        Case(
            "so3.distance",
            lambda x: so3.distance(cayley(x[:3]), cayley(x[3:])),
            {"ordinary": join(V, W)},
            step=0.01,
        ),
    ]  # fmt: skip
    for chart, name in ((mrp, "mrp"), (rodrigues, "rodrigues")):
        found.append(
            Case(
                f"{name} of vectors",
                lambda x, chart=chart: (
                    chart.to_quaternion(x[:3]), chart.to_matrix(x[:3]),
                    chart.omega_to_rates(x[:3], x[3:]), chart.rates_to_omega(x[:3], x[3:]),
                ),
                {"ordinary": join(V, W), "identity, at rest": join(no, no), "a half turn": join(AXIS, W)},
                covers=tuple(
                    f"{name}.{n}" for n in ("to_quaternion", "to_matrix", "omega_to_rates", "rates_to_omega")
                ),
            )
        )  # fmt: skip
        found.append(
            Case(
                f"{name}.from_quaternion",
                lambda x, c=chart: c.from_quaternion(unit(x)),
                QUATERNIONS,
            )
        )
    found += [
        Case("mrp.shadow", mrp.shadow, {"ordinary": V, "unit": AXIS}, step=0.005),
        Case("mrp.switch", mrp.switch, {"ordinary": V, "zero": no, "outside": 3 * V}),
    ]
    for sequence in ("ZXZ", "ZYX", "xyz"):
        angles = {"ordinary": join(V, W), "large": join([3.0, 1.2, -2.0], W)}
        found.append(
            Case(
                f"euler {sequence}",
                lambda x, sequence=sequence: (
                    euler.to_quaternion(x[:3], sequence), euler.to_matrix(x[:3], sequence),
                    euler.rates_to_omega(x[:3], x[3:], sequence),
                    euler.rates_to_omega(x[:3], x[3:], sequence, frame="world"),
                ),
                angles | {"singular": join(0.3, 0.0 if sequence == "ZXZ" else np.pi / 2, 0.2, W)},
                covers=tuple(f"euler.{n}" for n in ("to_quaternion", "to_matrix", "rates_to_omega")),
            )
        )  # fmt: skip
        found.append(
            Case(
                f"euler {sequence}, back",
                lambda x, sequence=sequence: (
                    euler.from_quaternion(unit(x[:4]), sequence),
                    euler.from_matrix(cayley(x[:3]), sequence),
                    euler.omega_to_rates(x[:3] + 1.0, x[4:], sequence, frame="world"),
                ),
                {"ordinary": join(Q, W)}, step=0.005,
                covers=tuple(f"euler.{n}" for n in ("from_quaternion", "from_matrix", "omega_to_rates")),
            )
        )  # fmt: skip
    return found


def numbers() -> list[Case]:
    m = {
        "ordinary": np.array([0.7, 0.4]),
        "m = 0": np.array([0.7, 0.0]),
        "m < 0": np.array([0.7, -1.3]),
        "u = 0": np.array([0.0, 0.4]),
    }
    m1 = {
        "ordinary": np.array([0.7, 0.3]),
        "m near 1": np.array([0.7, 0.02]),
        "long": np.array([5.0, 0.1]),
    }
    return [
        Case("elliptic.sncndn", lambda x: ell.sncndn(x[0], x[1]), m | {"m > 1": np.array([0.7, 1.6])}),
        Case("elliptic.am", lambda x: ell.am(x[0], x[1]), m | {"m > 1": np.array([0.7, 1.6])}),
        Case(
            "elliptic by m1",
            lambda x: (
                ell.sncndn(x[0], 1 - x[1], x[1]), ell.am(x[0], 1 - x[1], x[1]),
                ell.ellipf(x[0], 1 - x[1], x[1]), ell.ellipeinc(x[0], 1 - x[1], x[1]),
                ell.ellipk(1 - x[1], x[1]), ell.ellipe(1 - x[1], x[1]),
            ),
            m1, step=5e-4, rtol2=1e-6,
            covers=("elliptic.sncndn", "elliptic.am", "elliptic.ellipf", "elliptic.ellipeinc"),
        ),
        Case("elliptic.ellipf", lambda x: (ell.ellipf(x[0], x[1]), ell.ellipeinc(x[0], x[1])), m, covers=("elliptic.ellipeinc",)),
        Case("elliptic.ellipk", lambda x: (ell.ellipk(x[0]), ell.ellipe(x[0])), {"ordinary": [0.4], "0": [0.0], "negative": [-1.3]}, covers=("elliptic.ellipe",)),
        Case("elliptic.ellippi", lambda x: ell.ellippi(x[0], x[1]), {"ordinary": [0.3, 0.4], "n = 0": [0.0, 0.4], "n = m": [0.4, 0.4], "both 0": [0.0, 0.0], "n < 0": [-1.0, 0.4]}),
        Case("elliptic.ellippiinc", lambda x: ell.ellippiinc(x[0], x[1], x[2]), {"ordinary": [0.3, 0.7, 0.4], "n = 0": [0.0, 0.7, 0.4], "n = m": [0.4, 0.7, 0.4], "φ = 0": [0.3, 0.0, 0.4], "all 0": [0.0, 0.0, 0.0]}),
        Case("elliptic.rf", lambda x: ell.rf(x[0], x[1], x[2]), {"ordinary": [0.7, 1.3, 2.1], "equal": [1.0, 1.0, 1.0], "two equal": [1.0, 1.0, 2.0], "small": [0.15, 1.3, 2.1]}, step=0.004, rtol2=1e-7),
        Case("elliptic.rd", lambda x: ell.rd(x[0], x[1], x[2]), {"ordinary": [0.7, 1.3, 2.1], "equal": [1.0, 1.0, 1.0], "two equal": [1.0, 1.0, 2.0], "small": [0.15, 1.3, 2.1]}, step=0.004, rtol2=1e-7),
        Case("elliptic.rc", lambda x: ell.rc(x[0], x[1]), {"ordinary": [0.7, 1.3], "equal": [1.0, 1.0], "y < 0": [0.7, -1.3]}, step=0.01),
        Case("elliptic.rj_", lambda x: ell.rj_(x[0], x[1], x[2], x[3]), {"ordinary": [0.7, 1.3, 2.1, 0.9], "equal": [1.0, 1.0, 1.0, 1.0], "p = z": [0.7, 1.3, 2.1, 2.1]}, step=0.01, rtol2=1e-7),
    ]  # fmt: skip


SPHERE, PROLATE = six(2.0 * np.eye(3)), six(np.diag([1.0, 2.0, 2.0]))
OBLATE, NEAR_PLATE = six(np.diag([2.0, 2.0, 3.0])), six(np.diag([1.0, 2.0, 2.999]))
GENERAL = six(SYMMETRIC)
TENSORS = {
    "ordinary": GENERAL,
    "sphere": SPHERE,
    "prolate": PROLATE,
    "oblate": OBLATE,
    "near a plate": NEAR_PLATE,
}


def body_of(x: Any) -> rj.MassProperties:
    """Ten numbers: mass, com, 𝔖."""
    return rj.MassProperties(x[0], x[1:4], symmetric(x[4:10]))


TEN = join(2.0, 0.1, -0.2, 0.3, six(SECOND))
TEN_BALL = join(2.0, 0.0, 0.0, 0.0, six(np.eye(3)))


def bodies() -> list[Case]:
    ball = rj.shapes.sphere(2.0, 1.3)
    found = [
        Case("body.matrix_function", lambda x: rj.body.matrix_function(jnp.sqrt, symmetric(x)), TENSORS, step=0.01),
        Case("Inertia.moments", lambda x: rj.Inertia(symmetric(x)).moments, {"ordinary": GENERAL}, step=0.01, covers=("Inertia",)),
        Case(
            "body.principal",
            lambda x: so3.product(
                q4.to_matrix(rj.body.principal(symmetric(x))[1]),
                jnp.diag(rj.body.principal(symmetric(x))[0]),
            ),
            {"ordinary": GENERAL}, step=0.01, covers=("Inertia.principal",),
        ),
        Case(
            "body.ellipsoid",
            lambda x: (
                rj.body.ellipsoid(rj.Inertia(symmetric(x[:6])), "energy", x[6])[0],
                rj.body.ellipsoid(rj.Inertia(symmetric(x[:6])), "momentum", x[6])[0],
            ),
            {"ordinary": join(GENERAL, 1.5)}, step=0.01,
        ),
        Case("body.ellipsoid of mass", lambda x: rj.body.ellipsoid(body_of(x), "mass")[0], {"ordinary": TEN}, step=0.01),
        Case(
            "Inertia.shift",
            lambda x: (
                rj.Inertia(symmetric(x[:6])).shift(x[6:9], x[9]), rj.Inertia(symmetric(x[:6])).rotate(unit(x[10:])),
                rj.Inertia(symmetric(x[:6])).second_moment,
                rj.Inertia.from_tensor(symmetric(x[:6])).tensor,
                rj.Inertia.from_second_moment(symmetric(x[:6])).tensor,
            ),
            # No further than what is left to a plate.
            {k: join(t, V, 1.5, Q) for k, t in TENSORS.items()}, step=2e-4,
            covers=("Inertia.rotate", "Inertia.from_tensor", "Inertia.from_second_moment"),
        ),
        # The last moment is as large as a body's may be at 0, and less on both sides.
        Case("Inertia.from_principal", lambda x: rj.Inertia.from_principal(x[0], x[1], x[0] + x[1] - x[2] * x[2]), {"ordinary": [1.0, 2.0, 0.7], "plate": [1.0, 2.0, 0.0]}, step=0.01),
        Case(
            "MassProperties",
            lambda x: (
                body_of(x[:10]).shift(x[10:13]), body_of(x[:10]).rotate(unit(x[13:])),
                body_of(x[:10]).inertia_about(x[10:13]), body_of(x[:10]) + body_of(x[:10]).shift(x[10:13]),
            ),
            {"ordinary": join(TEN, V, Q), "ball": join(TEN_BALL, np.zeros(3), ONE)}, step=0.01,
            covers=("MassProperties.shift", "MassProperties.rotate", "MassProperties.inertia_about"),
        ),
        Case(
            "energies and momenta",
            lambda x: (
                rj.kinetic_energy(body_of(x), state_of(x[10:])), rj.angular_momentum(body_of(x), state_of(x[10:])),
                rj.spatial_angular_momentum(body_of(x), state_of(x[10:])),
                rj.body.kinetic_energy_about(body_of(x), unit(x[16:20]), x[13:16], x[20:23]),
                rj.body.kinetic_energy_of_matrix_rate(symmetric(x[4:10]), generator(x[20:23])),
            ),
            {"ordinary": join(TEN, Y, V, Q, W), "at rest": join(TEN_BALL, np.zeros(6), ONE, np.zeros(3))},
            covers=(
                "kinetic_energy", "angular_momentum", "spatial_angular_momentum", "body.kinetic_energy_about",
                "body.kinetic_energy_of_matrix_rate",
            ),
        ),
        Case("body.divergence", lambda x: rj.body.divergence(body_of(x[:10]), body_of(x[10:])), {"ordinary": join(TEN, TEN_BALL), "the same": join(TEN, TEN), "balls": join(TEN_BALL, TEN_BALL)}, step=0.01, atol=1e-11),
        Case("body.parameters.pack", lambda x: rj.parameters.pack(body_of(x)), {"ordinary": TEN, "ball": TEN_BALL}, step=0.01),
        Case("body.parameters.unpack", rj.parameters.unpack, {"ordinary": 0.1 * np.arange(10) - 0.2, "zero": np.zeros(10)}),
        Case("body.parameters.pack_second_moment", lambda x: (rj.parameters.pack_second_moment(symmetric(x)), rj.parameters.pack_shape(symmetric(x))), {"ordinary": six(SECOND), "ball": six(np.eye(3))}, step=0.01, covers=("body.parameters.pack_shape",)),
        Case("body.parameters.unpack_second_moment", rj.parameters.unpack_second_moment, {"ordinary": 0.1 * np.arange(6) - 0.2, "zero": np.zeros(6)}),
        Case("body.parameters.unpack_shape", rj.parameters.unpack_shape, {"ordinary": 0.1 * np.arange(5) - 0.2, "zero": np.zeros(5)}),
        Case("body.parameters.pack_moments", rj.parameters.pack_moments, {"ordinary": [1.1, 2.2, 2.7], "equal": [2.0, 2.0, 2.0]}, step=0.01),
        Case("body.parameters.unpack_moments", rj.parameters.unpack_moments, {"ordinary": [0.3, -0.2, 0.1], "zero": np.zeros(3)}),
        Case("body.shapes.points", lambda x: rj.shapes.points(x[:4], x[4:].reshape(4, 3)), {"ordinary": join([1.0, 2.0, 1.5, 0.7], V, W, Y, -V), "a line": join([1.0, 2.0, 1.5, 0.7], V, 2 * V, 3 * V, -V), "one place": join([1.0, 2.0, 1.5, 0.7], V, V, V, V)}),
        Case("body.shapes.voxels", lambda x: rj.shapes.voxels(x[:8].reshape(2, 2, 2), x[8:11], x[11:]), {"ordinary": join(1 + np.arange(8.0), np.abs(V), W)}),
        Case("body.shapes.mesh", lambda x: rj.shapes.mesh(x[:12].reshape(4, 3), MESH, x[12]), {"ordinary": join([[0.0, 0, 0], [1, 0.1, 0], [0, 1.2, 0], [0.2, 0, 1]], 6.0)}),
        Case("body.shapes.quadrature", lambda x: rj.shapes.quadrature(lambda r: 1.0 + x[0] * r[0] ** 2, lambda u: u * x[1:], 3), {"ordinary": [0.3, 1.0, 2.0, 3.0]}),
    ]  # fmt: skip
    solids = {
        "box": 3, "ellipsoid": 3, "sphere": 1, "hollow_sphere": 2, "cylinder": 2, "hollow_cylinder": 3,
        "capsule": 2, "cone": 2, "torus": 2,
    }  # fmt: skip
    ordinary = {
        "box": [0.3, 0.7, 1.1], "ellipsoid": [0.3, 0.7, 1.1], "sphere": [0.7], "hollow_sphere": [0.3, 0.7],
        "cylinder": [0.7, 1.1], "hollow_cylinder": [0.3, 0.7, 1.1], "capsule": [0.7, 1.1], "cone": [0.7, 1.1],
        "torus": [0.7, 0.3],
    }  # fmt: skip
    degenerate = {
        "box": [0.3, 0.0, 1.1], "ellipsoid": [0.0, 0.7, 0.0], "sphere": [0.0], "hollow_sphere": [0.7, 0.7],
        "cylinder": [0.7, 0.0], "hollow_cylinder": [0.7, 0.7, 0.0], "capsule": [0.7, 0.0], "cone": [0.0, 1.1],
        "torus": [0.7, 0.0],
    }  # fmt: skip
    for name, count in solids.items():
        shape, volume = getattr(rj.shapes, name), getattr(rj.volumes, name)
        several = count == 3 and name in ("box", "ellipsoid")

        def both(x: Any, shape: Any = shape, volume: Any = volume, several: bool = several) -> Any:
            sizes = (x[1:],) if several else tuple(x[1:])
            return shape(x[0], *sizes), volume(*sizes)

        points = {"ordinary": join(1.3, ordinary[name]), "degenerate": join(1.3, degenerate[name])}
        found.append(Case(f"body.shapes.{name}", both, points, covers=(f"body.volumes.{name}",)))
    found.append(Case("body.shapes.shell", lambda x: (rj.shapes.shell(x[0], x[1]), rj.shapes.rod(x[0], x[1]), rj.shapes.plate(x[0], x[1:])), {"ordinary": [1.3, 0.7, 0.3], "no size": [1.3, 0.0, 0.0]}, covers=("body.shapes.rod", "body.shapes.plate")))  # fmt: skip
    del ball
    return found


MESH = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def state_of(x: Any) -> rj.Rigid:
    """Thirteen numbers."""
    return rj.Rigid(x[:3], x[3:6], unit(x[6:10]), x[10:13])


def attitude_of(x: Any) -> rj.Attitude:
    """Seven."""
    return rj.Attitude(unit(x[:4]), x[4:7])


RIGID = join(Y, V, Q, W)
RESTING = join(Y, np.zeros(3), ONE, np.zeros(3))


def laws() -> list[Case]:
    t = rj.torques
    body = s.body()

    def law(name: str, make: Callable[[Any], Any], given: Any, **more: Any) -> Case:
        size = np.atleast_1d(np.asarray(given, float)).size

        def value(x: Any) -> Any:
            found = force_and_torque(make(x[:size]), 0.3, state_of(x[size:]), body)
            return [part for part in found if part is not None]

        points = {"ordinary": join(given, RIGID), "at rest, identity": join(given, RESTING)}
        return Case(f"torques.{name}", value, points, **more)

    tables = np.stack([V, W, Y, V])
    return [
        law("ConstantTorque", lambda x: t.ConstantTorque(x), V),
        law("InSpace", lambda x: t.InSpace(x), V),
        law("Damping", lambda x: t.Damping(x), np.abs(V)),
        law("QuadraticDamping", lambda x: t.QuadraticDamping(x), np.abs(V), once=("at rest, identity",), rtol=1e-6, atol=1e-6, step=1e-6, first=True),
        law("Flywheel", lambda x: t.Flywheel(x), V),
        law("UniformGravity", lambda x: t.UniformGravity(x), DOWN),
        law("CentralGravity", lambda x: t.CentralGravity(x[0]), [3.1], step=0.01, rtol2=1e-7),
        law("Drag", lambda x: t.Drag(x[0], x[1:4], x[4:7]), join(0.2, V, np.zeros(3)), once=("at rest, identity",), rtol=1e-6, atol=1e-6, step=1e-6, first=True),
        law("GravityGradient", lambda x: t.GravityGradient(x[0], x[1:]), join(3.1, Y), step=0.01, rtol2=1e-7),
        law("MagneticDipole", lambda x: t.MagneticDipole(x[:3], x[3:]), join(V, W)),
        law("FromPotential", lambda x: t.FromPotential(s.Spring(x[0])), [2.0]),
        Case(
            "torques.HeavyTop",
            lambda x: (
                t.HeavyTop(x[0], x[1:4], x[4:7])(0.0, attitude_of(x[7:]), s.inertia()),
                rj.energy(s.inertia(), attitude_of(x[7:]), t.HeavyTop(x[0], x[1:4], x[4:7])),
                rj.conserved(s.inertia(), attitude_of(x[7:]), t.HeavyTop(x[0], x[1:4], x[4:7])),
            ),
            {"ordinary": join(2.0, V, DOWN, Q, W), "hanging": join(2.0, 0, 0, 1, DOWN, ONE, np.zeros(3))},
            covers=("energy", "conserved"),
        ),
        # In time and in the table; knots are where a derivative is that of one side.
        Case("torques.Linear", lambda x: t.Linear(jnp.asarray(TS), x[:12].reshape(4, 3))(x[12]), {"between": join(tables, 0.6), "before": join(tables, -1.0)}),
        Case("torques.Tabulated", lambda x: t.Tabulated(jnp.asarray(TS), x[:12].reshape(4, 3))(x[12], s.spin(), None), {"between": join(tables, 0.6), "after": join(tables, 2.0)}),
        Case("torques.Pulses", lambda x: t.Pulses(jnp.asarray(TS), x[:9].reshape(3, 3))(x[9], s.spin(), None), {"between": join(V, W, Y, 0.6), "after": join(V, W, Y, 2.0)}),
        Case("torques.Series", lambda x: t.Series(np.arange(5.0), np.cos(np.arange(15.0)).reshape(5, 3))(x[0]), {"between": [1.5], "before": [-1.0]}, covers=("torques.Wheel",)),
        Case("torques.Series at a sample", lambda x: t.Series(np.arange(5.0), np.cos(np.arange(15.0)).reshape(5, 3))(x[0]), {"a sample": [2.0]}, step=1e-4, rtol=1e-7, first=True),
        Case("torques.Sum", lambda x: t.Sum(t.Damping(x[:3]), t.InSpace(x[3:6]))(0.0, attitude_of(x[6:]), s.inertia()), {"ordinary": join(V, W, Q, W)}),
    ]  # fmt: skip


def equations() -> list[Case]:
    lagrangian = rj.lagrangian
    return [
        Case(
            "equations of motion",
            lambda x: (
                AttitudeEquations(rj.Inertia(symmetric(x[:6])), s.top())(0.0, attitude_of(x[6:]), None),
                EulerEquations(rj.Inertia(symmetric(x[:6])))(0.0, rj.Spin(x[10:13]), None),
            ),
            {k: join(v, Q, W) for k, v in TENSORS.items()} | {"at rest": join(GENERAL, ONE, np.zeros(3))},
            step=0.01,
            covers=("motion.AttitudeEquations", "motion.EulerEquations", "equations_of_motion"),
        ),
        Case("motion.NewtonEuler", lambda x: NewtonEuler(body_of(x[:10]), rj.torques.UniformGravity(DOWN))(0.0, state_of(x[10:]), None), {"ordinary": join(TEN, RIGID), "at rest": join(TEN_BALL, RESTING)}, step=0.01),
        Case(
            "lagrangian",
            lambda x: (
                lagrangian.equations_of_motion(lagrangian.EulerAngleTop(s.inertia(), s.top()))(0.0, lagrangian.Coordinates(x[:3], x[3:6])),
                lagrangian.to_attitude(lagrangian.Coordinates(x[:3], x[3:6])),
                lagrangian.from_attitude(rj.Attitude(q4.exp(x[:3]), x[3:6])),
                lagrangian.lie_poisson(lagrangian.RotationalHamiltonian(s.inertia()))(0.0, lagrangian.Momentum(x[3:6])),
                lagrangian.lie_poisson_with_direction(lagrangian.HeavyTopHamiltonian(s.inertia(), s.top()))(0.0, lagrangian.MomentumAndDirection(x[3:6], x[:3])),
            ),
            {"ordinary": join([0.3, 0.7, 0.2], W), "at rest": join([0.3, 0.7, 0.2], np.zeros(3))},
            step=0.01, rtol2=1e-7,
            covers=tuple(
                f"lagrangian.{n}" for n in (
                    "equations_of_motion", "to_attitude", "from_attitude", "lie_poisson",
                    "lie_poisson_with_direction", "EulerAngleTop", "RotationalHamiltonian", "HeavyTopHamiltonian",
                )
            ),
        ),
    ]  # fmt: skip


def frames() -> list[Case]:
    def moving(x: Any) -> rj.frames.MovingFrame:
        return rj.frames.MovingFrame(rj.frames.AboutAxis(x[:3], s.Quadratic(x[3])), s.Place(x[4:7]))

    def seen(x: Any) -> Any:
        frame, t, state = moving(x), x[7], state_of(x[8:21])
        return (
            frame.to_inertial(state, t), frame.from_inertial(state, t), frame.acceleration(x[8:11], x[11:14], t),
            frame.acceleration_to_inertial(x[8:11], x[11:14], x[18:21], t), frame.jacobi_integral(state, t),
            frame.compose(frame).matrix(t), frame.inverse().place(t),
            rj.frames.BodyInFrame(frame)(t, state, s.body()).torque,
            InFrame(frame, potential=lambda y: jnp.sum(y**4)).acceleration(t, state),
        )  # fmt: skip

    place = join(AXIS, 3.0, V)
    found = [
        Case(
            "frames.MovingFrame",
            seen,
            {"ordinary": join(place, 0.3, RIGID), "t = 0": join(place, 0.0, RIGID), "at rest": join(place, 0.3, RESTING)},
            step=0.005, rtol=1e-8, rtol2=1e-6,
            covers=("frames.AboutAxis", "frames.BodyInFrame", "frames.InFrame", "frames.Instant"),
        ),
        Case(
            "frames.Uniform",
            lambda x: rj.frames.MovingFrame(rj.frames.Uniform(x[:3])).acceleration(x[4:7], x[7:10], x[3]),
            {"ordinary": join(W, 0.3, Y, V), "no turn": join(np.zeros(3), 0.3, Y, V), "t = 0": join(W, 0.0, Y, V)},
        ),
        Case(
            "scenes.libration",
            lambda x: (
                rj.scenes.libration(x[0])(0.0, attitude_of(x[1:]), s.inertia()),
                rj.scenes.libration_integral(attitude_of(x[1:]), s.inertia(), x[0]),
            ),
            {"ordinary": join(0.3, Q, W), "equilibrium": join(0.3, ONE, np.zeros(3))},
            covers=("frames.scenes.libration_integral",),
        ),
    ]  # fmt: skip
    scenes = {
        "orbits.cr3bp": (lambda x: rj.orbits.cr3bp(x[0]), [0.3]),
        "orbits.hill": (lambda x: rj.orbits.hill(0.0 * x[0]), [0.3]),
        "frames.scenes.earth": (lambda x: rj.scenes.earth(x[0], x[1], x[2]), [0.7, 9.8, 0.1]),
        "frames.scenes.foucault": (
            lambda x: rj.scenes.foucault(x[0], x[1], x[2], x[3]),
            [0.7, 10.0, 9.8, 0.1],
        ),
        "frames.scenes.hoop": (lambda x: rj.scenes.hoop(x[0], x[1], x[2]), [1.0, 5.0, 9.8]),
        "frames.scenes.turntable": (lambda x: rj.scenes.turntable(x[0], x[1]), [0.7, 0.2]),
    }
    for name, (make, given) in scenes.items():
        size = len(given)

        def field(x: Any, make: Any = make, size: int = size) -> Any:
            scene, state = make(x[:size]), rj.Point(x[size : size + 3], x[size + 3 :])
            return scene.acceleration(0.3, state), scene.conserved(0.3, state)

        points = {"ordinary": join(given, Y, V), "at rest": join(given, Y, np.zeros(3))}
        found.append(Case(name, field, points, step=0.005, rtol2=1e-6))
    found.append(
        Case(
            "frames.scenes.small_swing",
            lambda x: rj.scenes.foucault(x[0], x[1]).small_swing(rj.Point(x[3:6], x[6:9]), x[2]),
            {"ordinary": join(0.7, 10.0, 0.3, Y, V), "t = 0": join(0.7, 10.0, 0.0, Y, V)},
        )
    )
    return found


def closed_form() -> list[Case]:
    def flow(x: Any) -> Any:
        return rj.exact.free_body(rj.Inertia(symmetric(x[:6])), attitude_of(x[6:13]), x[13])

    first, middle, last = np.eye(3)
    unlike = six(np.diag([1.0, 2.0, 2.7]))
    # On the separatrix of (1, 2, 2.7): |L|² = 2 E I₂.
    ratio = np.sqrt(2.7 * 0.7 / (1.0 * 1.0))
    points = {
        "ordinary": join(GENERAL, Q, W, 0.7),
        "t = 0": join(GENERAL, Q, W, 0.0),
        "backwards": join(GENERAL, Q, W, -1.3),
        "at rest": join(GENERAL, Q, np.zeros(3), 0.7),
        "sphere": join(SPHERE, Q, W, 0.7),
        "prolate": join(PROLATE, Q, W, 0.7),
        "oblate": join(OBLATE, Q, W, 0.7),
        "near a plate": join(NEAR_PLATE, Q, W, 0.7),
        "first axis": join(unlike, ONE, first, 0.7),
        "middle axis": join(unlike, ONE, middle, 0.7),
        "last axis": join(unlike, ONE, last, 0.7),
        "separatrix": join(unlike, ONE, [ratio, 0.5, 1.0], 0.7),
        "sphere at rest, t = 0": join(SPHERE, ONE, np.zeros(3), 0.0),
    }
    periods = {
        k: join(p[:6], p[10:13])
        for k, p in points.items()
        if k in ("ordinary", "prolate", "oblate", "near a plate", "first axis", "last axis")
    }
    return [
        Case(
            "exact.free_body", flow, points, step=0.01, rtol=1e-8,
            without_second="tests/exact compares it with fifty digits in every class of body",
            covers=("exact.FreeBody", "simulate (free)"),
        ),
        Case(
            "exact.body_period",
            lambda x: (rj.exact.body_period(rj.Inertia(symmetric(x[:6])), x[6:]), rj.exact.precession_period(rj.Inertia(symmetric(x[:6])), x[6:])),
            periods, step=2e-4, rtol=1e-8, covers=("exact.precession_period",),
            without_second="tests/exact compares one with differences; all of them take minutes to compile",
        ),
    ]  # fmt: skip


def solved() -> list[Case]:
    def free(x: Any) -> Any:
        out = rj.simulate(rj.Inertia(symmetric(x[:6])), attitude_of(x[6:13]), jnp.asarray(TS), None)
        return out.ys.omega, out.ys.q

    def rolled(x: Any) -> Any:
        states = rj.Attitude(jnp.stack([unit(x[6:10])] * 2), jnp.stack([x[10:13], 0.5 * x[10:13]]))
        return rj.batch.rollout(rj.Inertia(symmetric(x[:6])), states, 0.1, 4, s.top())

    points = {"ordinary": join(GENERAL, Q, W), "sphere at rest": join(SPHERE, ONE, np.zeros(3))}
    return [
        Case(
            "simulate, free",
            free,
            points,
            step=0.01,
            rtol=1e-8,
            covers=("simulate",),
            without_second="the closed form's, which tests/exact compares with fifty digits",
        ),
        Case("batch.rollout", rolled, points, step=0.01, rtol=1e-8, first=True),
    ]


def fits() -> list[Case]:
    identify = rj.identify
    motion = s.motion()
    ts, omega, q = (np.asarray(a) for a in (motion.ts, motion.ys.omega, motion.ys.q))
    gyro, star = identify.Gyro(0.01, bias=0.01 * V), identify.AttitudeSensor(0.01, mounting=0.1 * V)
    # Not so long that an error of the attitude comes near half a turn, where its logarithm jumps.
    whole = identify.Recording(ts[:9], (gyro, omega[:9]), (star, q[:9]))
    # A shorter one beside it: its last time is repeated, its last readings masked.
    short = identify.Recording(ts[:6], (gyro, omega[:6]), (star, q[:6]))
    found = []
    for name, recordings, torque in (
        ("free", [whole], None),
        ("free, repeated reads", [whole, short], None),
        ("forced, repeated reads", [whole, short], s.damping()),
    ):
        model = identify.Model(
            recordings, identify.Ratios() if torque is None else identify.Tensor(2.0), torque=torque,
            integrator=None if torque is None else identify.FixedSteps(2),
        )  # fmt: skip
        start = np.asarray(model.start(s.inertia()))
        found.append(
            Case(
                f"identify.Model.errors, {name}",
                lambda x, model=model: model.errors(x),
                {"start": start, "elsewhere": start + 0.05 * np.cos(np.arange(start.size))},
                step=0.01, rtol=1e-7,
                without_second="a fit takes the first only; the closed form's is in tests/exact",
                covers=("identify.Model.errors", "identify.Model.motion"),
            )
        )  # fmt: skip
    states = {"ordinary": join(Q, W), "identity, at rest": join(ONE, np.zeros(3))}
    sensors = {
        "Gyro": (identify.Gyro(0.1, bias=V, scale=1 + 0.1 * V, mounting=0.1 * W), W),
        "Accelerometer": (identify.Accelerometer(0.1, place=Y, gravity=DOWN, mounting=0.1 * W), W),
        "Magnetometer": (identify.Magnetometer(0.1, field=Y, mounting=0.1 * W), W),
        "AttitudeSensor": (identify.AttitudeSensor(0.1, mounting=0.1 * V), P),
        "Direction": (
            identify.Direction(Y, 0.1, mounting=0.1 * V),
            np.asarray(unit(jnp.asarray(W))),
        ),
        "Marker": (identify.Marker(Y, 0.1, origin=V), W),
    }
    moving = {
        "Position": (identify.Position(0.1, bias=V), W),
        "Velocity": (identify.Velocity(0.1, place=Y, mounting=0.1 * W), V),
        "Range": (identify.Range(2.0 * Y, 0.1, place=V), 1.3),
    }

    def no_field(t: Any, state: Any, args: Any = None) -> Any:
        raise AssertionError("these sensors feel no acceleration")

    for name, (sensor, reading) in moving.items():

        def missed(x: Any, sensor: Any = sensor, reading: Any = reading) -> Any:
            state = rj.Rigid(x[:3], x[3:6], unit(x[6:10]), x[10:13])
            moment = identify.SensorInput(jnp.asarray(0.0), state, s.body(), no_field)
            return sensor.error(moment, jnp.asarray(reading))

        both = {"ordinary": RIGID, "identity, at rest": RESTING}
        found.append(Case(f"identify.{name}", missed, both, step=0.01, rtol2=1e-7))
    for name, (sensor, reading) in sensors.items():

        def error(x: Any, sensor: Any = sensor, reading: Any = reading) -> Any:
            state = attitude_of(x)
            field = AttitudeEquations(s.inertia(), s.top())
            moment = identify.SensorInput(jnp.asarray(0.0), state, s.inertia(), field)
            return sensor.error(moment, jnp.asarray(reading))

        found.append(Case(f"identify.{name}", error, states, step=0.01, rtol2=1e-7))
    exact = identify.AttitudeSensor(0.1)
    found.append(
        Case(
            "identify.AttitudeSensor, no error",
            lambda x: exact.error(
                identify.SensorInput(jnp.asarray(0.0), attitude_of(x), None, no_field),
                jnp.asarray(Q),
            ),
            {"read as it is": join(Q, W)},
        )
    )
    for loss in (identify.Huber(3.0), identify.SoftL1(3.0)):
        found.append(
            Case(
                f"identify.{type(loss).__name__}",
                lambda x, loss=loss: (loss.shrink(x), loss.weight(x)),
                {"small": V, "zero": np.zeros(3), "large": 10 * W},
            )
        )
    entropic = identify.Entropic(s.body(), 2.0)
    found.append(
        Case(
            "identify.Entropic",
            lambda x: entropic.residuals(body_of(x)),
            {"the guess": TEN, "elsewhere": TEN_BALL},
            step=0.005, rtol=1e-8, rtol2=1e-6,
        )
    )  # fmt: skip
    for chart in (
        identify.Ratios(),
        identify.PrincipalRatios(),
        identify.Tensor(2.0),
        identify.Principal(2.0),
        identify.Mass(s.body()),
    ):
        found.append(
            Case(
                f"identify.{type(chart).__name__}",
                lambda x, chart=chart: chart.body(x),
                {"zero": np.zeros(chart.size), "ordinary": 0.1 * np.arange(chart.size) - 0.2},
            )
        )
    return found


# Made before anything is traced: what they keep must not be tracers.
for made in (s.inertia, s.body, s.other_body, s.spin, s.attitude, s.top, s.damping):
    made()

GROUPS = dict(
    rotations=rotations, numbers=numbers, bodies=bodies, laws=laws, equations=equations, frames=frames,
    closed_form=closed_form, solved=solved, fits=fits,
)  # fmt: skip
