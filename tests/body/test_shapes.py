"""Closed forms against textbook moments, quadrature and 50-digit derivatives."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import rigidjax as rj
from rigidjax.body import shapes, volumes

R, r, h, L = 1.3, 0.4, 2.2, 0.7

# Moments about the centre of mass per unit mass, as tables of moments of inertia print them
# (CRC Handbook; Beyer, Standard Mathematical Tables), about x, y, z.
TEXTBOOK = {
    "box": (
        (R, h, L),
        lambda a, b, c: ((b**2 + c**2) / 12, (a**2 + c**2) / 12, (a**2 + b**2) / 12),
    ),
    "ellipsoid": (
        (R, h, L),
        lambda a, b, c: ((b**2 + c**2) / 5, (a**2 + c**2) / 5, (a**2 + b**2) / 5),
    ),
    "sphere": ((R,), lambda a: (2 * a**2 / 5,) * 3),
    "shell": ((R,), lambda a: (2 * a**2 / 3,) * 3),
    "hollow_sphere": (
        (r, R),
        lambda a, b: (2 * (b**5 - a**5) / (5 * (b**3 - a**3)),) * 3,
    ),
    "cylinder": (
        (R, h),
        lambda a, b: ((3 * a**2 + b**2) / 12, (3 * a**2 + b**2) / 12, a**2 / 2),
    ),
    "hollow_cylinder": (
        (r, R, h),
        lambda a, b, c: (
            (3 * (a**2 + b**2) + c**2) / 12,
            (3 * (a**2 + b**2) + c**2) / 12,
            (a**2 + b**2) / 2,
        ),
    ),
    "cone": (
        (R, h),
        lambda a, b: (
            3 * a**2 / 20 + 3 * b**2 / 80,
            3 * a**2 / 20 + 3 * b**2 / 80,
            3 * a**2 / 10,
        ),
    ),
    "torus": (
        (R, r),
        lambda a, b: (
            (4 * a**2 + 5 * b**2) / 8,
            (4 * a**2 + 5 * b**2) / 8,
            (4 * a**2 + 3 * b**2) / 4,
        ),
    ),
    "rod": ((L,), lambda a: (a**2 / 12, a**2 / 12, 0)),
    "plate": ((R, L), lambda a, b: (b**2 / 12, a**2 / 12, (a**2 + b**2) / 12)),
}
GROUPED = {"box", "ellipsoid", "plate"}  # take their sizes as one array


def build(name, mass, dims):
    make = getattr(shapes, name)
    return make(mass, dims) if name in GROUPED else make(mass, *dims)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("name", TEXTBOOK)
def test_moments_and_their_derivatives_are_the_textbooks(name, dtype):
    dims, book = TEXTBOOK[name]

    def diagonal(mass, x):
        return jnp.diagonal(build(name, mass, x).inertia.tensor)

    x, mass = jnp.asarray(dims, dtype), jnp.asarray(3.0, dtype)
    eps = float(jnp.finfo(dtype).eps)
    exact = [mpmath.mpf(float(v)) for v in x]
    body = build(name, mass, x)
    assert body.mass.dtype == body.com.dtype == body.second_moment.dtype == dtype
    want = 3 * np.array([float(v) for v in book(*exact)])
    np.testing.assert_allclose(diagonal(mass, x), want, rtol=8 * eps, atol=0)
    np.testing.assert_array_equal(body.com, 0)
    by_mass, by_size = jax.jit(jax.jacrev(diagonal, argnums=(0, 1)))(mass, x)
    np.testing.assert_allclose(by_mass, want / 3, rtol=8 * eps, atol=0)
    with mpmath.workdps(50):
        for k in range(len(dims)):
            for axis in range(3):

                def moment(t, k=k, axis=axis):
                    return book(*[t if i == k else v for i, v in enumerate(exact)])[axis]

                slope = 3 * float(mpmath.diff(moment, exact[k]))
                np.testing.assert_allclose(by_size[axis, k], slope, rtol=64 * eps, atol=8 * eps)


# From the unit cube onto each solid: (u, v, w) → (x, y, z).
def ball(u):
    radius, theta, phi = u[0], jnp.pi * u[1], 2 * jnp.pi * u[2]
    return radius * jnp.stack(
        [jnp.sin(theta) * jnp.cos(phi), jnp.sin(theta) * jnp.sin(phi), jnp.cos(theta)]
    )


def round_solid(radius_at, low, high):
    def place(u):
        z = low + (high - low) * u[2]
        a, phi = radius_at(z) * u[0], 2 * jnp.pi * u[1]
        return jnp.stack([a * jnp.cos(phi), a * jnp.sin(phi), z])

    return place


def ring(u):
    a, theta, phi = r * u[0], 2 * jnp.pi * u[1], 2 * jnp.pi * u[2]
    across = R + a * jnp.cos(theta)
    return jnp.stack([across * jnp.cos(phi), across * jnp.sin(phi), a * jnp.sin(theta)])


def cap_angle(sign):
    def place(u):
        # A half ball on the end of a cylinder of length h.
        p = ball(jnp.stack([u[0], 0.5 * u[1], u[2]]))
        return jnp.stack([R * p[0], R * p[1], sign * (h / 2 + R * p[2])])

    return place


PLACED = {
    "box": ([lambda u: (u - 0.5) * jnp.array([R, h, L])], (jnp.array([R, h, L]),)),
    "ellipsoid": ([lambda u: ball(u) * jnp.array([R, h, L])], (jnp.array([R, h, L]),)),
    "sphere": ([lambda u: R * ball(u)], (R,)),
    "hollow_sphere": ([lambda u: ball(u.at[0].set(r + (R - r) * u[0]))], (r, R)),
    "cylinder": ([round_solid(lambda z: R, -h / 2, h / 2)], (R, h)),
    "hollow_cylinder": (
        [lambda u: round_solid(lambda z: R, -h / 2, h / 2)(u.at[0].set((r + (R - r) * u[0]) / R))],
        (r, R, h),
    ),
    "cone": ([round_solid(lambda z: R * (0.75 - z / h), -h / 4, 3 * h / 4)], (R, h)),
    "torus": ([ring], (R, r)),
    "capsule": (
        [round_solid(lambda z: R, -h / 2, h / 2), cap_angle(1.0), cap_angle(-1.0)],
        (R, h),
    ),
}


@pytest.mark.parametrize("name", PLACED)
def test_solids_equal_quadrature_over_their_volume(name):
    places, dims = PLACED[name]
    parts = [shapes.quadrature(lambda p: jnp.full((), 2.5), place, 20) for place in places]
    summed = parts[0]
    for part in parts[1:]:
        summed = summed + part
    body = getattr(shapes, name)(2.5 * getattr(volumes, name)(*dims), *dims)
    np.testing.assert_allclose(summed.mass, body.mass, rtol=1e-12)
    np.testing.assert_allclose(summed.com, body.com, atol=1e-12)
    np.testing.assert_allclose(summed.second_moment, body.second_moment, rtol=1e-12, atol=1e-11)


def test_joining_and_cutting_simple_solids_gives_the_hollow_and_joined_ones():
    def solid(radius, height):
        return shapes.cylinder(volumes.cylinder(radius, height), radius, height)

    tube = shapes.hollow_cylinder(volumes.hollow_cylinder(r, R, h), r, R, h)
    cut = solid(R, h) - solid(r, h)
    np.testing.assert_allclose(cut.second_moment, tube.second_moment, rtol=1e-13)
    np.testing.assert_allclose(cut.mass, tube.mass, rtol=1e-14)
    np.testing.assert_allclose(sum([cut, solid(r, h)]).mass, solid(R, h).mass, rtol=1e-14)
    with pytest.raises(TypeError, match="unsupported operand"):
        cut + 1
    stacked = solid(R, h) + solid(R, L).shift([0.0, 0.0, (h + L) / 2])
    np.testing.assert_allclose(stacked.second_moment, solid(R, h + L).second_moment, rtol=1e-13)
    np.testing.assert_allclose(stacked.com, [0, 0, L / 2], rtol=1e-13)


def test_limits_are_the_thin_bodies():
    pairs = [
        (shapes.hollow_sphere(1.0, R, R), shapes.shell(1.0, R)),
        (shapes.cylinder(1.0, 0.0, L), shapes.rod(1.0, L)),
        (shapes.capsule(1.0, 0.0, L), shapes.rod(1.0, L)),
        (shapes.capsule(1.0, R, 0.0), shapes.sphere(1.0, R)),
        (shapes.box(1.0, [R, L, 0.0]), shapes.plate(1.0, [R, L])),
        (shapes.torus(1.0, R, 0.0), shapes.hollow_cylinder(1.0, R, R, 0.0)),
        (shapes.hollow_cylinder(1.0, 0.0, R, h), shapes.cylinder(1.0, R, h)),
    ]
    for a, b in pairs:
        np.testing.assert_allclose(a.second_moment, b.second_moment, rtol=1e-15)


def test_density_and_sizes_carry_derivatives():
    def mass_of(density, radius):
        return shapes.sphere(density * volumes.sphere(radius), radius).inertia.moments[1]

    by_density, by_radius = jax.grad(mass_of, argnums=(0, 1))(2.0, R)
    moment = 2 / 5 * 4 / 3 * np.pi * R**5
    np.testing.assert_allclose(by_density, moment, rtol=1e-14)
    np.testing.assert_allclose(by_radius, 2 * 5 * moment / R, rtol=1e-14)


WRONG = {
    "negative length": (lambda: shapes.box(1.0, [1.0, -2.0, 3.0]), "size: wanted lengths ≥ 0"),
    "no mass": (lambda: shapes.sphere(0.0, 1.0), "positive mass"),
    "inside out": (lambda: shapes.hollow_sphere(1.0, 2.0, 1.0), "inner ≤ outer, got 2.0 and 1.0"),
    "spindle": (lambda: shapes.torus(1.0, 1.0, 2.0), "minor ≤ major"),
    "NaN": (lambda: shapes.cylinder(1.0, np.nan, 1.0), "radius: contains NaN"),
    "three numbers": (lambda: shapes.box(1.0, [1.0, 2.0]), r"size: wanted shape \(3,\)"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_sizes_are_named(case, unhooked):
    call, words = WRONG[case]
    with pytest.raises(ValueError, match=words):
        call()


def test_the_public_name():
    assert rj.body.shapes is shapes
