"""Brightness of ellipsoids and convex meshes; the oracle is the integral over the surface itself.

That is Gauss–Legendre points on the lune of normals that are lit and seen, with the area of the
ellipsoid over that of its image on the sphere of normals, `det E/(n·En)²`: another parametrisation
than the code's, which maps the surface to a sphere.
"""

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from once import once
from scipy.spatial import ConvexHull

from rigidjax.tumblers import brightness

AXES = np.array([2.0, 1.3, 0.8])
LAWS = {
    "geometric": (brightness.Geometric(), lambda i, e: e),
    "lommel": (brightness.LommelSeeliger(), lambda i, e: 2 * i * e / (i + e)),
    "lambert": (brightness.Lambert(), lambda i, e: 1.5 * i * e),
}


def unit(v):
    return np.asarray(v, float) / np.linalg.norm(v)


def surface(law, shape, sun, observer, points=60, panels=1):
    s, o = unit(sun), unit(observer)
    pole = np.cross(s, o - s)
    angle = np.arctan2(np.linalg.norm(pole), s @ o)
    if angle < 1e-12:
        pole = np.cross(s, np.eye(3)[np.argmin(np.abs(s))])
    pole = unit(pole)
    x, w = np.polynomial.legendre.leggauss(points)
    # A shape of 30 : 1 has a peak of width 1/30, so narrow panels.
    x = (np.arange(panels)[:, None] + 0.5 * (x + 1)).ravel() * 2 / panels - 1
    w = np.tile(w, panels) / panels
    half = 0.5 * (np.pi - angle)
    # Of Lommel and Seeliger's law edges as narrow as the phase: points crowd there.
    phi, psi = 0.5 * angle + half * np.sin(0.5 * np.pi * x), 0.5 * np.pi * x
    flat = np.cos(phi)[:, None] * s + np.sin(phi)[:, None] * np.cross(pole, s)
    c, d = np.cos(psi), np.sin(psi)
    weight = 0.25 * np.pi**2 * half * np.outer(w * np.cos(0.5 * np.pi * x), w * c)
    # Of normals n = cos ψ flat + sin ψ pole, n·En and both cosines.
    cross = np.outer(2 * (flat @ shape @ pole), c * d) + (pole @ shape @ pole) * d**2
    squared = np.outer(np.sum(flat @ shape * flat, axis=1), c**2) + cross
    area = np.linalg.det(shape) / squared**2
    return np.sum(weight * area * law(np.outer(flat @ s, c), np.outer(flat @ o, c)))


@pytest.fixture(scope="module")
def directions():
    rng = np.random.default_rng(0)
    return rng.normal(size=(40, 2, 3))


@pytest.mark.parametrize("name", LAWS)
def test_an_ellipsoid_is_the_integral_over_its_surface(name, directions):
    law, per_area = LAWS[name]
    many = once(jax.vmap(lambda d: brightness.ellipsoid(AXES, d[0], d[1], law)))
    found = many(jnp.asarray(directions))
    wanted = [surface(per_area, np.diag(AXES**2), s, o) for s, o in directions]
    np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-11)


SHAPES = np.array(
    [
        *([1.5, 1, 1], [3, 1, 1], [10, 1, 1], [30, 1, 1], [5, 5, 1], [20, 20, 1], [30, 30, 1]),
        *([30, 5, 1], [30, 29, 1], [4, 2, 1], [1, 1, 1], [1, 1 + 1e-9, 1], [1, 0.9, 0.95]),
    ]
)


def seen_from(phases, rng):
    """Random directions (n, 2, 3) of the sun and the observer with these phases, degrees."""
    sun = rng.normal(size=(len(phases), 3))
    across = np.cross(sun, rng.normal(size=sun.shape))
    sun, across = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (sun, across))
    angle = np.radians(phases)[:, None]
    return np.stack([sun, np.cos(angle) * sun + np.sin(angle) * across], axis=1)


@pytest.mark.parametrize("name", LAWS)
def test_long_and_flat_ellipsoids_at_all_phases(name):
    law, per_area = LAWS[name]
    phases = [0.0, 1e-6, 0.01, 1.0, 20.0, 60.0, 89.9, 120.0, 150.0, 170.0]
    rng = np.random.default_rng(8)
    given = [(a, s, o) for a in SHAPES for s, o in seen_from(phases, rng)]
    a, s, o = (jnp.asarray(np.array(v)) for v in zip(*given, strict=True))
    found = once(jax.vmap(lambda a, s, o: brightness.ellipsoid(a, s, o, law)))(a, s, o)
    wanted = [surface(per_area, np.diag(a**2), s, o, 20, 44) for a, s, o in given]
    np.testing.assert_allclose(found, wanted, rtol=1e-9)


def test_along_the_axes_at_zero_phase_lambert_is_an_integral_of_one_variable():
    # 3π ∫₀¹ u²/√(u² + A²(1 − u²)) du along the first axis of A : 1 : 1, by mpmath.
    law = brightness.Lambert()
    for a in (1.5, 2, 3, 4, 6, 10, 30, 1 / 30):
        with mp.workdps(30):
            whole = mp.quad(lambda u, a=a: u**2 / mp.sqrt(u**2 + a**2 * (1 - u**2)), [0, 0.1, 1])
        found = brightness.ellipsoid([a, 1.0, 1.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], law)
        np.testing.assert_allclose(float(found), 3 * np.pi * float(whole), rtol=1e-11)


@pytest.mark.parametrize("name", LAWS)
def test_first_and_second_derivatives_of_long_and_flat_ellipsoids(name):
    law, per_area = LAWS[name]
    rng = np.random.default_rng(9)
    axes = SHAPES[[3, 6, 7, 9, 10, 3, 6, 10]]
    sides = seen_from([20.0, 60.0, 100.0, 150.0, 70.0, 0.0, 0.0, 0.0], rng)
    given = np.concatenate([np.log(axes)[:, None], sides], axis=1)
    step = rng.normal(size=given.shape)

    def both(v, dv):
        def value(h):
            moved = v + h * dv
            return brightness.ellipsoid(jnp.exp(moved[0]), moved[1], moved[2], law)

        one = jnp.ones(())
        return jax.jvp(lambda h: jax.jvp(value, (h,), (one,))[1], (0.0 * one,), (one,))

    found = np.array(once(jax.vmap(both))(jnp.asarray(given), jnp.asarray(step)))
    # Central differences of eighth order of the integral over the surface.
    k = np.arange(-4, 5)
    slopes = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280])
    half = [-1 / 560, 8 / 315, -1 / 5, 8 / 5]
    bends = np.array([*half, -205 / 72, *half[::-1]])
    for row, (v, dv) in enumerate(zip(given, step, strict=True)):
        # At zero phase the third derivative jumps, and Lommel and Seeliger's second is infinite.
        smooth = row < 5 or name == "geometric"
        h = 2e-3 if smooth else 1e-4
        moved = [v + j * h * dv for j in k]
        values = [surface(per_area, np.diag(np.exp(2 * m[0])), *m[1:], 20, 48) for m in moved]
        first, second = slopes @ values / h, bends @ values / h**2
        near = 1e-8 if smooth else 1e-5
        np.testing.assert_allclose(found[0][row], first, rtol=near, atol=near * values[4])
        if smooth or name == "lambert":
            near = (1e-5 if name == "geometric" else 1e-6) if smooth else 3e-3
            np.testing.assert_allclose(found[1][row], second, rtol=near, atol=near * values[4])


@pytest.mark.parametrize("name", LAWS)
def test_a_sphere_has_its_known_phase_function(name):
    a = np.array([0.0, 1e-9, 1e-4, 0.1, 1.0, 2.0, 3.0, np.pi - 1e-3, np.pi])
    with np.errstate(divide="ignore", invalid="ignore"):
        logarithm = np.where(a > 0, np.log(np.tan(a / 4)), 0.0)
        # At opposition to zero phase the closed form is 0 · ∞.
        lommel = 1 + np.sin(a / 2) * np.tan(a / 2) * logarithm
    lommel[-1] = 0.0
    known = {
        "geometric": 0.5 * (1 + np.cos(a)),
        "lommel": lommel,
        "lambert": (np.sin(a) + (np.pi - a) * np.cos(a)) / np.pi,
    }[name]
    sun = jnp.asarray(np.stack([np.sin(a), np.zeros_like(a), np.cos(a)], axis=1))
    law = LAWS[name][0]

    def seen(s):
        return brightness.ellipsoid([3.0, 3.0, 3.0], s, [0.0, 0.0, 1.0], law)

    found = once(jax.vmap(seen))(sun)
    atol = 1e-6 if name == "lambert" else 1e-13
    np.testing.assert_allclose(found / (9 * np.pi), known, atol=atol)


@pytest.mark.parametrize("name", LAWS)
def test_derivatives_by_axes_and_directions(name):
    law, per_area = LAWS[name]
    places = {
        "phase": [AXES, [0.3, 0.5, 0.8], [-0.5, 0.6, 0.4]],
        "zero phase": [AXES, [0.3, 0.5, 0.8], [0.3, 0.5, 0.8]],
        "sphere": [np.ones(3), [0.3, 0.5, 0.8], [-0.5, 0.6, 0.4]],
        "sphere at zero phase": [np.ones(3), [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]],
        "along an axis": [AXES, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
    }
    given = jnp.asarray(np.array(list(places.values())))

    def seen(v):
        return brightness.ellipsoid(v[0], v[1], v[2], law)

    slope = np.asarray(once(jax.vmap(jax.grad(seen)))(given))
    h = 1e-6
    for row, where in enumerate(given):
        for index in np.ndindex(3, 3):
            step = np.zeros((3, 3))
            step[index] = h
            # Central differences of the surface integral.
            up, down = (
                surface(per_area, np.diag(v[0] ** 2), v[1], v[2])
                for v in (np.asarray(where) + step, np.asarray(where) - step)
            )
            np.testing.assert_allclose(slope[row][index], (up - down) / (2 * h), atol=1e-4)


def icosphere(times):
    g = (1 + 5**0.5) / 2
    corners = [[-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0], [0, -1, g], [0, 1, g]]
    corners += [[0, -1, -g], [0, 1, -g], [g, 0, -1], [g, 0, 1], [-g, 0, -1], [-g, 0, 1]]
    faces = [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4]]
    faces += [[11, 10, 2], [10, 7, 6], [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8]]
    faces += [[3, 8, 9], [4, 9, 5], [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1]]
    corners = [unit(c) for c in corners]
    for _ in range(times):
        middle, finer = {}, []

        def half(i, j, middle=middle):
            key = min(i, j), max(i, j)
            if key not in middle:
                middle[key] = len(corners)
                corners.append(unit(corners[i] + corners[j]))
            return middle[key]

        for a, b, c in faces:
            ab, bc, ca = half(a, b), half(b, c), half(c, a)
            finer += [[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]
        faces = finer
    return np.array(corners), np.array(faces)


@pytest.mark.parametrize("name", LAWS)
def test_finer_and_finer_faces_become_the_ellipsoid(name):
    law, s, o = LAWS[name][0], [0.3, 0.5, 0.8], [-0.5, 0.6, 0.4]
    whole, off = float(brightness.ellipsoid(AXES, s, o, law)), []
    for times in (1, 3):
        corners, faces = icosphere(times)
        off.append(abs(float(brightness.mesh(corners * AXES, faces, s, o, law)) / whole - 1))
    # Of second order in the size of a face, but for the terminator's teeth under the first law.
    assert off[1] < (0.3 if name == "geometric" else 0.1) * off[0] and off[1] < 1e-2


@pytest.mark.parametrize("name", LAWS)
def test_a_polyhedron_is_the_sum_over_its_faces(name):
    # Normals and areas by Qhull and Heron; at zero phase the first law is the area of the shadow.
    law, per_area = LAWS[name]
    rng = np.random.default_rng(5)
    corners = rng.normal(size=(60, 3)) * [30.0, 5.0, 1.0]
    hull = ConvexHull(corners)
    normals, faces = hull.equations[:, :3], hull.simplices.copy()
    a, b, c = (corners[faces[:, k]] for k in range(3))
    inward = np.sum(np.cross(b - a, c - a) * normals, axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    sides = np.sort([np.linalg.norm(u - v, axis=1) for u, v in ((a, b), (b, c), (c, a))], axis=0)
    z, y, x = sides
    area = 0.25 * np.sqrt((x + y + z) * (z - x + y) * (z + x - y) * (x + y - z))
    for s, o in seen_from([0.0, 30.0, 90.0, 170.0], rng):
        both = (normals @ s > 0) & (normals @ o > 0)
        wanted = np.sum((area * per_area(normals @ s, normals @ o))[both])
        found = brightness.mesh(corners, faces, s, o, law)
        np.testing.assert_allclose(found, wanted, rtol=1e-11)
        if name == "geometric":
            flat = corners @ np.linalg.svd(np.eye(3) - np.outer(s, s))[0][:, :2]
            shadow = brightness.mesh(corners, faces, s, s, law)
            np.testing.assert_allclose(shadow, ConvexHull(flat).volume, rtol=1e-12)


def test_a_mesh_in_its_vertices():
    corners, faces = icosphere(0)
    s, o = [0.3, 0.5, 0.8], [-0.5, 0.6, 0.4]

    def seen(v):
        return brightness.mesh(v, faces, s, o)

    v = jnp.asarray(corners * AXES)
    slope = once(jax.grad(seen))(v)
    step = np.random.default_rng(1).normal(size=v.shape)
    h = 1e-6
    difference = (seen(v + h * step) - seen(v - h * step)) / (2 * h)
    np.testing.assert_allclose(np.sum(np.asarray(slope) * step), difference, rtol=1e-7)


def test_a_plate_edge_on_is_dark_and_its_derivatives_are_numbers():
    plate = np.array([1.0, 1.0, 1e-200])
    for name in ("geometric", "lommel"):
        law = LAWS[name][0]
        value, slope = jax.value_and_grad(
            lambda s, law=law: brightness.ellipsoid(plate, s, [1.0, 0.0, 0.0], law)
        )(jnp.array([0.0, 1.0, 0.0]))
        assert float(value) == 0.0 and np.isfinite(np.asarray(slope)).all()


def test_float32():
    for name, (law, _) in LAWS.items():
        given = [np.float32(v) for v in (AXES, [0.3, 0.5, 0.8], [0.3001, 0.5, 0.8])]
        found = brightness.ellipsoid(*map(jnp.asarray, given), law)
        assert found.dtype == jnp.float32
        wide = brightness.ellipsoid(*(jnp.asarray(v, float) for v in given), law)
        np.testing.assert_allclose(found, wide, rtol=1e-5, err_msg=name)
        long, *sides = (jnp.asarray(v, jnp.float32) for v in ([30.0, 3.0, 1.0], *given[1:]))
        found, wide = (
            brightness.ellipsoid(long.astype(d), *(v.astype(d) for v in sides), law)
            for d in (jnp.float32, jnp.float64)
        )
        np.testing.assert_allclose(found, wide, rtol=1e-5, err_msg=name)


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        ((AXES, [0, 0, 0.0], [0, 0, 1.0]), ValueError, "sun: wanted a direction, got a vector of"),
        ((AXES, [0, 0, 1.0], [0, 0, np.nan]), ValueError, "observer: contains NaN"),
        (([1.0, -1.0, 1.0], [0, 0, 1.0], [0, 0, 1.0]), ValueError, "semi_axes: wanted three posit"),
        (([1.0, 1.0], [0, 0, 1.0], [0, 0, 1.0]), ValueError, r"semi_axes: wanted shape \(3,\)"),
    ],
)
def test_what_is_refused(given, error, words):
    with pytest.raises(error, match=words):
        brightness.ellipsoid(*given)
