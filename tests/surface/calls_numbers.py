"""Good calls: elliptic functions, rotations, bodies."""

import jax
import jax.numpy as jnp
import numpy as np
from surface import public, scenes as s
from surface.calls import leave_out, row
from surface.scenes import SECOND, SYMMETRIC, M, N, P, Q, V, W, Y

import rigidjax as rj

# Elliptic functions.
for name in ("am", "sncndn"):
    row(f"elliptic.{name}", dict(u=0.7, m=0.4, m1=0.6))
for name in ("ellipe", "ellipk"):
    row(f"elliptic.{name}", dict(m=0.4, m1=0.6))
for name in ("ellipeinc", "ellipf"):
    row(f"elliptic.{name}", dict(phi=0.7, m=0.4, m1=0.6))
row("elliptic.ellippi", dict(n=0.3, m=0.4, m1=0.6, n1=0.7))
row("elliptic.ellippiinc", dict(n=0.3, phi=0.7, m=0.4, m1=0.6, n1=0.7))
# Without the complement, which refuses most other values of m.
for name, given in {
    "am": dict(u=0.7, m=0.4),
    "sncndn": dict(u=0.7, m=0.4),
    "ellipe": dict(m=0.4),
    "ellipk": dict(m=0.4),
    "ellipeinc": dict(phi=0.7, m=0.4),
    "ellipf": dict(phi=0.7, m=0.4),
    "ellippi": dict(n=0.3, m=0.4),
    "ellippiinc": dict(n=0.3, phi=0.7, m=0.4),
}.items():
    found = public.functions()[f"elliptic.{name}"]
    row(f"elliptic.{name} (no complement)", given, run=found, transforms=())
row("elliptic.rc", dict(x=0.7, y=1.3))
row("elliptic.rf", dict(x=0.7, y=1.3, z=2.1))
row("elliptic.rd", dict(x=0.7, y=1.3, z=2.1))
row("elliptic.rj_", dict(x=0.7, y=1.3, z=2.1, p=0.9))

# Vectors and matrices.
for name in ("cross", "dot", "align"):
    row(f"rotation.so3.{name}", dict(a=V, b=W))
for name in ("exp", "left_jacobian", "left_jacobian_inverse", "right_jacobian"):
    row(f"rotation.so3.{name}", dict(v=V))
row("rotation.so3.right_jacobian_inverse", dict(v=V))
row("rotation.so3.hat", dict(w=V))
for name in ("vee", "log", "adjoint", "check", "project"):
    row(f"rotation.so3.{name}", dict(matrix=M))
row("rotation.so3.basis", transforms=())
row("rotation.so3.product", dict(a=M, b=N))
row("rotation.so3.distance", dict(a=M, b=N))
row("rotation.so3.determinant", dict(a=M))
for name in ("apply", "solve"):
    row(f"rotation.so3.{name}", dict(a=SYMMETRIC, y=Y))
for name in ("to_world", "to_body"):
    row(f"rotation.so3.{name}", dict(matrix=M, y=Y))
row("rotation.so3.conjugate", dict(turn=N, matrix=M))
row("rotation.so3.rate", dict(matrix=M, omega=W))
for name in ("body_rate", "world_rate"):
    row(f"rotation.so3.{name}", dict(matrix=M, rate=M @ np.cross(np.eye(3), -W)))
row("rotation.so3.about_axis", dict(axis=V, angle=0.7))
row("rotation.so3.interpolate", dict(a=M, b=N, s=0.3))
row("rotation.so3.uniform", lambda: dict(key=jax.random.key(0), dtype="float64"), transforms=())
row("rotation.so3.mean", dict(matrices=np.stack([M, N]), weights=np.array([1.0, 2.0])))
quaternions = np.stack([Q, P])
row("rotation.so3.mean_quaternion", dict(quaternions=quaternions, weights=np.array([1.0, 2.0])))
row(
    "rotation.so3.wahba",
    dict(body=np.stack([V, W, Y]), world=np.stack([V, W, Y]) @ M.T, weights=np.array([1.0, 2, 3])),
)

# Quaternions.
for name in (
    "log",
    "conjugate",
    "to_xyzw",
    "normalise",
    "canonical",
    "angle",
    "to_matrix",
    "check",
):
    row(f"rotation.quaternion.{name}", dict(q=Q))
row("rotation.quaternion.exp", dict(v=V))
row("rotation.quaternion.from_xyzw", dict(xyzw=Q))
row("rotation.quaternion.from_matrix", dict(matrix=M))
row("rotation.quaternion.multiply", dict(p=P, q=Q))
for name in ("rotate", "rotate_inverse"):
    row(f"rotation.quaternion.{name}", dict(q=Q, y=Y))
row("rotation.quaternion.about_axis", dict(axis=V, angle=0.7))
row("rotation.quaternion.advance", dict(q=Q, omega=W, dt=0.3))
row("rotation.quaternion.rate", dict(q=Q, omega=W))
row("rotation.quaternion.interpolate", dict(p=P, q=Q, s=0.3))
row(
    "rotation.quaternion.uniform",
    lambda: dict(key=jax.random.key(0), dtype="float64"),
    transforms=(),
)

# Charts.
for chart, g in (("mrp", "sigma"), ("rodrigues", "g")):
    row(f"rotation.{chart}.from_quaternion", dict(q=Q))
    row(f"rotation.{chart}.from_matrix", dict(matrix=M))
    row(f"rotation.{chart}.to_quaternion", {g: V})
    row(f"rotation.{chart}.to_matrix", {g: V})
    row(f"rotation.{chart}.omega_to_rates", {g: V, "omega": W})
    row(f"rotation.{chart}.rates_to_omega", {g: V, "rates": W})
row("rotation.mrp.shadow", dict(sigma=V))
row("rotation.mrp.switch", dict(sigma=3 * V))
row("rotation.rodrigues.is_singular", dict(q=Q))
for name, given in {
    "to_quaternion": dict(angles=V),
    "to_matrix": dict(angles=V),
    "from_quaternion": dict(q=Q),
    "from_matrix": dict(matrix=M),
    "is_singular": dict(angles=V),
    "rates_to_omega": dict(angles=V, rates=W),
    "omega_to_rates": dict(angles=V, omega=W),
}.items():
    more = dict(frame="world") if name.endswith(("to_omega", "to_rates")) else {}
    row(f"rotation.euler.{name}", dict(given, sequence="ZYX", **more))

# Bodies.
row("Inertia", dict(tensor=SYMMETRIC))
row("MassProperties", dict(mass=2.0, com=V, second_moment=SECOND))
row("Inertia.from_tensor", dict(tensor=SYMMETRIC))
row("Inertia.from_principal", dict(i1=1.1, i2=2.2, i3=2.7), says=("principal moments",))
row("Inertia.from_second_moment", dict(second_moment=SECOND))
row("Inertia.shift", lambda: dict(self=s.inertia(), r=V, mass=1.5))
row("Inertia.rotate", lambda: dict(self=s.inertia(), q=Q))
for name in ("principal", "require_invertible"):
    row(f"Inertia.{name}", lambda: dict(self=s.inertia()), arguments=())
for name in ("check", "require_invertible"):
    row(f"MassProperties.{name}", lambda: dict(self=s.body()), arguments=())
for name in ("inertia_about", "second_moment_about"):
    row(f"MassProperties.{name}", lambda: dict(self=s.body(), point=Y), arguments=("point",))
row("MassProperties.shift", lambda: dict(self=s.body(), r=V), says=("com",))
row("MassProperties.rotate", lambda: dict(self=s.body(), q=Q), arguments=("q",))
row("body.principal", dict(tensor=SYMMETRIC))
row("body.matrix_function", dict(function=jnp.sqrt, tensor=SYMMETRIC))
row("body.sample", lambda: dict(body=s.body(), key=jax.random.key(0), spread=0.05))
leave_out("sample makes it", "body.Draw")
row("body.divergence", lambda: dict(body=s.body(), reference=s.other_body()))
row("body.ellipsoid", lambda: dict(body=s.inertia(), kind="energy", size=1.5))
row(
    "body.ellipsoid (mass)",
    lambda: dict(body=s.body()),
    run=lambda body: rj.body.ellipsoid(body, "mass"),
)
row("body.kinetic_energy_about", lambda: dict(body=s.body(), q=Q, velocity=V, omega=W))
row("body.kinetic_energy_of_matrix_rate", dict(second_moment=SECOND, matrix_rate=N))
row("kinetic_energy", lambda: dict(body=s.body(), state=s.rigid()))
row("angular_momentum", lambda: dict(body=s.inertia(), state=s.spin()))
row("spatial_angular_momentum", lambda: dict(body=s.body(), state=s.rigid()))
row("body.parameters.pack", lambda: dict(body=s.body()))
for name in ("pack_second_moment", "pack_shape"):
    row(f"body.parameters.{name}", dict(second_moment=SECOND))
row(
    "body.parameters.curvature_rows_near_flat_body",
    dict(
        shape=np.array([0.5, 0.45, 0.0, 0.0, 0.0]),
        misfit_gradient=np.array([-0.1, -0.1, 0.0, 0.2, 0.1]),
    ),
)
row(
    "body.parameters.pack_moments", dict(moments=np.array([1.1, 2.2, 2.7])), says=("second moment",)
)
for name, count in {"": 10, "_second_moment": 6, "_shape": 5, "_moments": 3}.items():
    row(
        f"body.parameters.unpack{name}",
        dict(vector=0.1 * np.arange(count) - 0.2),
        says=("mass", "second moment", "com"),
    )

# Solids.
# What is too large for the dtype is named as what overflows.
OVERFLOW = ("second moment", "mass")
SOLIDS = {
    "box": dict(size=np.array([0.3, 0.7, 1.1])),
    "ellipsoid": dict(semi_axes=np.array([0.3, 0.7, 1.1])),
    "sphere": dict(radius=0.7),
    "hollow_sphere": dict(inner=0.3, outer=0.7),
    "cylinder": dict(radius=0.7, height=1.1),
    "hollow_cylinder": dict(inner=0.3, outer=0.7, height=1.1),
    "capsule": dict(radius=0.7, length=1.1),
    "cone": dict(radius=0.7, height=1.1),
    "torus": dict(major=0.7, minor=0.3),
}
for name, given in SOLIDS.items():
    row(f"body.shapes.{name}", dict(mass=1.3, **given), says=OVERFLOW)
    row(f"body.volumes.{name}", given)
row("body.shapes.shell", dict(mass=1.3, radius=0.7), says=OVERFLOW)
row("body.shapes.rod", dict(mass=1.3, length=0.7), says=OVERFLOW)
row("body.shapes.plate", dict(mass=1.3, size=np.array([0.3, 0.7])), says=OVERFLOW)
row(
    "body.shapes.points",
    dict(masses=np.array([1.0, 2.0, 1.5, 0.7]), positions=np.stack([V, W, Y, -V])),
    says=(*OVERFLOW, "com"),
)
row(
    "body.shapes.voxels",
    dict(density=1.0 + np.arange(8.0).reshape(2, 2, 2), spacing=np.abs(V), corner=W),
    says=OVERFLOW,
)
row(
    "body.shapes.quadrature",
    dict(
        density=lambda r: 1.0 + r[0] ** 2, place=lambda u: u * jnp.array([1.0, 2.0, 3.0]), order=3
    ),
    transforms=(),
)
CORNERS = np.array([[0.0, 0, 0], [1, 0.1, 0], [0, 1.2, 0], [0.2, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
row(
    "body.shapes.mesh",
    dict(vertices=CORNERS, faces=FACES, density=6.0),
    traced=("vertices", "density"),
    says=("mass",),
)
leave_out("reads a file: tests/body/test_meshes.py", "body.shapes.mesh_file")
leave_out(
    "a Protocol, for isinstance and type checkers",
    "motion.HasAttitude",
    "motion.HasPose",
    "motion.HasSpin",
)
