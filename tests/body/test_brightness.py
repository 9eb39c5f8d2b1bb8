"""Brightness of ellipsoids and convex meshes; the oracle is the integral over the surface itself.

That is Gauss–Legendre points on the lune of normals that are lit and seen, with the area of the
ellipsoid over that of its image on the sphere of normals, `det E/(n·En)²`: another parametrisation
than the code's, which maps the surface to a sphere.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once

from rigidjax.body import brightness

AXES = np.array([2.0, 1.3, 0.8])
LAWS = {
    "geometric": (brightness.Geometric(), lambda i, e: e),
    "lommel": (brightness.LommelSeeliger(), lambda i, e: 2 * i * e / (i + e)),
    "lambert": (brightness.Lambert(), lambda i, e: 1.5 * i * e),
}


def unit(v):
    return np.asarray(v, float) / np.linalg.norm(v)


def surface(law, shape, sun, observer, points=60):
    s, o = unit(sun), unit(observer)
    pole = np.cross(s, o)
    if np.linalg.norm(pole) < 1e-12:
        pole = np.cross(s, np.eye(3)[np.argmin(np.abs(s))])
    pole = unit(pole)
    angle = np.arctan2(np.linalg.norm(np.cross(s, o)), s @ o)
    x, w = np.polynomial.legendre.leggauss(points)
    half = 0.5 * (np.pi - angle)
    phi, psi = 0.5 * angle + half * x, 0.5 * np.pi * x
    flat = np.cos(phi)[:, None] * s + np.sin(phi)[:, None] * np.cross(pole, s)
    n = np.cos(psi)[None, :, None] * flat[:, None] + np.sin(psi)[None, :, None] * pole
    weight = half * w[:, None] * 0.5 * np.pi * (w * np.cos(psi))[None, :]
    area = np.linalg.det(shape) / np.einsum("abi,ij,abj->ab", n, shape, n) ** 2
    return np.sum(weight * area * law(n @ s, n @ o))


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
    tolerance = 1e-7 if name == "lambert" else 1e-11
    np.testing.assert_allclose(found, wanted, rtol=tolerance, atol=tolerance)


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


@pytest.mark.parametrize(
    "name", ["geometric", "lommel", pytest.param("lambert", marks=pytest.mark.long)]
)
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
