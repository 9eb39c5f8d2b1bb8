"""The solid in a mesh: closed forms, far from the origin, derivatives, what is refused (D25)."""

import itertools
from fractions import Fraction

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import trimesh

from rigidjax.body import shapes

SIZE = np.array([1.0, 2.0, 3.0])


def cuboid(size=SIZE):
    """Eight corners and twelve outward triangles."""
    corners = np.array(list(itertools.product([-0.5, 0.5], repeat=3))) * size
    faces = []
    for axis, side in itertools.product(range(3), [0, 1]):
        a, b, c, d = (
            sum((1 if bit else 0) << (2 - ax) for ax, bit in ((axis, side), (j, p), (k, q)))
            for (p, q) in [(0, 0), (1, 0), (1, 1), (0, 1)]
            for j, k in [((axis + 1) % 3, (axis + 2) % 3)]
        )
        quad = [a, b, c, d] if side else [d, c, b, a]
        faces += [quad[:3], [quad[0], quad[2], quad[3]]]
    return corners, np.array(faces)


CORNERS, FACES = cuboid()


@pytest.mark.parametrize(
    ("dtype", "offsets", "tolerance"),
    [(jnp.float64, [0.0, 1e2, 1e4, 1e6], 1e-12), (jnp.float32, [0.0, 1e2, 1e3], 1e-4)],
)
def test_a_box_anywhere_is_a_box(dtype, offsets, tolerance):
    box = shapes.box(12.0, SIZE)
    for offset in offsets:
        shift = offset * np.array([1.0, -1.0, 1.0])
        body = shapes.mesh(jnp.asarray(CORNERS + shift, dtype), FACES, jnp.asarray(2.0, dtype))
        np.testing.assert_allclose(body.mass, 12, rtol=tolerance)
        np.testing.assert_allclose(body.com, shift, rtol=tolerance, atol=tolerance)
        size = float(jnp.max(box.second_moment))
        np.testing.assert_allclose(body.second_moment, box.second_moment, atol=tolerance * size)
        assert body.second_moment.dtype == dtype
        body.check()


def exact_mesh(corners, faces):
    """Mass, centre, second moment of unit density in rational arithmetic: no rounding at all."""
    points = [[Fraction(float(x)) for x in row] for row in corners]
    volume, first = Fraction(0), [Fraction(0)] * 3
    second = [[Fraction(0)] * 3 for _ in range(3)]
    for face in faces:
        a, b, c = (points[k] for k in face)
        six = sum(
            a[i] * (b[(i + 1) % 3] * c[(i + 2) % 3] - b[(i + 2) % 3] * c[(i + 1) % 3])
            for i in range(3)
        )
        s = [a[i] + b[i] + c[i] for i in range(3)]
        volume += six / 6
        for i in range(3):
            first[i] += six * s[i] / 24
            for j in range(3):
                own = s[i] * s[j] + a[i] * a[j] + b[i] * b[j] + c[i] * c[j]
                second[i][j] += six * own / 120
    com = [x / volume for x in first]
    about = [[second[i][j] - volume * com[i] * com[j] for j in range(3)] for i in range(3)]
    return float(volume), np.array(com, float), np.array(about, float)


@pytest.mark.parametrize(
    ("dtype", "digits", "offset", "tolerance"),
    [(jnp.float64, 2.0**24, 2.0**20, 1e-12), (jnp.float32, 2.0**12, 2.0**10, 1e-4)],
)
def test_a_crooked_solid_far_away_against_rational_arithmetic(dtype, digits, offset, tolerance):
    turn, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
    corners = CORNERS @ (turn * np.sign(np.linalg.det(turn))).T
    # Coordinates that the dtype holds exactly also when they are far away.
    corners = np.round(corners * digits) / digits + offset * np.array([1.0, -1.0, 1.0])
    volume, com, second = exact_mesh(corners, FACES)
    body = shapes.mesh(jnp.asarray(corners, dtype), FACES, jnp.ones((), dtype))
    np.testing.assert_allclose(body.mass, volume, rtol=tolerance)
    np.testing.assert_allclose(body.com, com, rtol=float(jnp.finfo(dtype).eps))
    np.testing.assert_allclose(body.second_moment, second, atol=tolerance * np.abs(second).max())


def test_ordinary_meshes_agree_with_trimesh():
    solids = [
        trimesh.creation.icosphere(subdivisions=2, radius=1.3),
        trimesh.creation.torus(1.0, 0.3, major_sections=12, minor_sections=8),
        trimesh.creation.capsule(height=1.0, radius=0.4, count=(8, 8)),
        trimesh.creation.cone(radius=0.5, height=1.5, sections=9),
        trimesh.creation.annulus(r_min=0.3, r_max=0.8, height=0.5, sections=10),
    ]
    for solid in solids:
        solid.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]))
        solid.apply_translation([0.3, -0.2, 0.1])
        body = shapes.mesh(solid.vertices.view(np.ndarray), solid.faces.view(np.ndarray), 2.0)
        solid.density = 2.0
        np.testing.assert_allclose(body.mass, solid.mass, rtol=1e-13)
        np.testing.assert_allclose(body.com, solid.center_mass, rtol=1e-12, atol=1e-13)
        moment = solid.moment_inertia
        np.testing.assert_allclose(
            body.inertia.tensor, moment, rtol=1e-11, atol=1e-12 * np.abs(moment).max()
        )


def test_fine_meshes_approach_the_round_solid():
    sphere = trimesh.creation.icosphere(subdivisions=4)
    body = shapes.mesh(sphere.vertices.view(np.ndarray), sphere.faces.view(np.ndarray), 1.0)
    np.testing.assert_allclose(body.inertia.moments / body.mass, 0.4, rtol=3e-3)


def test_a_hole_is_a_mesh_turned_inwards():
    hole, faces = cuboid(SIZE / 2)
    body = shapes.mesh(
        np.concatenate([CORNERS, hole]), np.concatenate([FACES, faces[:, ::-1] + 8]), 1.0
    )
    cut = shapes.box(6.0, SIZE) - shapes.box(0.75, SIZE / 2)
    np.testing.assert_allclose(body.mass, cut.mass, rtol=1e-14)
    np.testing.assert_allclose(body.second_moment, cut.second_moment, rtol=1e-13, atol=1e-14)


def exact_tetrahedron(corners):
    """Mass, centre and second moment of a tetrahedron from barycentric integrals, exactly."""
    a = [mpmath.matrix(list(row)) for row in corners]
    sides = [a[k] - a[0] for k in (1, 2, 3)]
    volume = mpmath.det(mpmath.matrix([list(s) for s in sides])) / 6
    com = (a[0] + a[1] + a[2] + a[3]) / 4
    second = mpmath.zeros(3)
    for p in a:
        second += volume / 20 * (p - com) * (p - com).T
    return [volume, *com, *second]


def test_derivatives_in_the_vertices_agree_with_fifty_digits():
    corners = np.array([[0.1, 0, 0.2], [1, 0.3, 0], [0, 1.2, 0.1], [0.2, 0.1, 0.9]]) + 100.0
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    direction = np.random.default_rng(0).normal(size=(4, 3))

    @jax.jit
    def ours(x):
        body = shapes.mesh(x, faces, 1.0)
        return jnp.concatenate([body.mass[None], body.com, body.second_moment.ravel()])

    with mpmath.workdps(50):
        x, e, h = mpmath.matrix(corners), mpmath.matrix(direction), mpmath.mpf("1e-12")
        plus, here, minus = (
            exact_tetrahedron((x + t * e).tolist()) for t in (h, mpmath.mpf(0), -h)
        )
        value = [float(v) for v in here]
        first = [float((p - m) / (2 * h)) for p, m in zip(plus, minus, strict=True)]
        second = [float((p - 2 * c + m) / h**2) for p, c, m in zip(plus, here, minus, strict=True)]
    corners, direction = jnp.asarray(corners), jnp.asarray(direction)
    np.testing.assert_allclose(ours(corners), value, rtol=1e-12, atol=1e-14)

    def slope(x):
        return jax.jvp(ours, (x,), (direction,))[1]

    np.testing.assert_allclose(slope(corners), first, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(
        jnp.einsum("kij,ij->k", jax.jacrev(ours)(corners), direction), first, rtol=1e-11, atol=1e-13
    )
    bend = jax.jvp(slope, (corners,), (direction,))[1]
    np.testing.assert_allclose(bend, second, rtol=1e-9, atol=1e-11)


def test_faces_without_area_are_harmless():
    corners = np.concatenate([CORNERS, 0.5 * (CORNERS[:1] + CORNERS[1:2])])
    flat = [[0, 8, 1], [1, 8, 0]]
    body = shapes.mesh(corners, np.concatenate([FACES, flat]), 2.0)
    np.testing.assert_allclose(body.second_moment, shapes.box(12.0, SIZE).second_moment, atol=1e-14)


def test_slender_and_flat_solids_are_still_solids_in_single_precision():
    corners, faces = cuboid(np.array([1e-3, 1e-3, 1.0]))
    body = shapes.mesh(jnp.asarray(corners, jnp.float32), faces, jnp.float32(1.0))
    np.testing.assert_allclose(body.mass, 1e-6, rtol=1e-5)


ONE_TURNED = FACES.copy()
ONE_TURNED[3] = ONE_TURNED[3, ::-1]
REPEATED = FACES.copy()
REPEATED[4] = [1, 1, 2]
WRONG = {
    "inverted": (CORNERS, FACES[:, ::-1], r"inside out \(volume -6 m³\).*faces\[:, ::-1\]"),
    "open": (CORNERS, FACES[:-1], r"open: 3 edges belong to one face only, the first is \("),
    "one face turned": (CORNERS, ONE_TURNED, "disagree about which side is outside"),
    "repeated vertex": (CORNERS, REPEATED, r"face 4 is degenerate.*\(1, 1, 2\)"),
    "doubled": (CORNERS, np.concatenate([FACES, FACES[:1]]), "2 times one way"),
    "flat": (CORNERS * [1, 1, 0], FACES, "encloses no volume"),
    "unmerged": (CORNERS[FACES].reshape(-1, 3), np.arange(36).reshape(-1, 3), "merge them first"),
    "from 1": (CORNERS, FACES + 1, "vertex numbers from 0 to 7, got 1 to 8; OBJ"),
    "quads": (CORNERS, np.zeros((6, 4), int), r"shape \(m, 3\), triangles, got \(6, 4\)"),
    "flat list": (CORNERS.ravel(), FACES, r"vertices: wanted shape .*one row"),
    "NaN": (CORNERS * np.nan, FACES, "vertices: contains NaN"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_has_no_inside_is_named(case, unhooked):
    vertices, faces, words = WRONG[case]
    with pytest.raises(ValueError, match=words):
        shapes.mesh(vertices, faces, 1.0)


def test_numbers_of_faces_must_be_integers(unhooked):
    with pytest.raises(TypeError, match="integers"):
        shapes.mesh(CORNERS, FACES.astype(float), 1.0)


def test_an_inverted_mesh_is_named_under_jit():
    run = eqx.filter_jit(lambda x: shapes.mesh(x, FACES, 1.0).mass)
    np.testing.assert_allclose(run(jnp.asarray(CORNERS)), 6.0)
    with pytest.raises(RuntimeError, match="inside out"):
        run(jnp.asarray(CORNERS * [-1.0, 1, 1]))


def test_files_are_read_and_scaled(tmp_path, unhooked):
    path = tmp_path / "box.stl"
    trimesh.Trimesh(CORNERS * 1000, FACES).export(path)
    body = shapes.mesh_file(path, 2.0, scale=1e-3)
    np.testing.assert_allclose(body.second_moment, shapes.box(12.0, SIZE).second_moment, atol=1e-6)
    with pytest.raises(FileNotFoundError, match=r"no file .*missing\.stl"):
        shapes.mesh_file(tmp_path / "missing.stl", 1.0)
    empty = tmp_path / "empty.obj"
    empty.write_text("v 0 0 0\n")
    with pytest.raises(ValueError, match="no triangles"):
        shapes.mesh_file(empty, 1.0)
