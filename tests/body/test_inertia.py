"""I, 𝔖, parallel axis, rotation, joining and cutting; what a body may not be (R7, D24, I9)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from once import once

import rigidjax as rj
from rigidjax.body import shapes
from rigidjax.body.inertia import Inertia, MassProperties, inverse
from rigidjax.rotation import quaternion

ORIGIN = [0.0, 0.0, 0.0]


def many_bodies(seed, n=50):
    """Bodies of all shapes: second moments with eigenvalues over eight decades."""
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(n, 3, 3)) * 10.0 ** rng.uniform(-4, 0, size=(n, 1, 3))
    return MassProperties(
        10.0 ** rng.uniform(-1, 1, n), rng.normal(size=(n, 3)), half @ half.transpose(0, 2, 1)
    )


def turns(seed, n=50):
    q = np.random.default_rng(seed).normal(size=(n, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def same(a, b, tolerance=1e-13):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance * float(jnp.abs(y).max()))


def test_second_moment_and_inertia_are_each_others_inverse():
    s = many_bodies(0).second_moment
    inertia = jax.vmap(Inertia.from_second_moment)(s)
    trace = np.trace(s, axis1=1, axis2=2)[:, None, None]
    same(inertia.tensor, trace * np.eye(3) - s, 1e-15)
    same(inertia.second_moment, s, 1e-15)
    assert np.array_equal(jax.vmap(Inertia.from_tensor)(inertia.tensor).tensor, inertia.tensor)
    # Eqs 76–78: I1 = λ2 + λ3, …; hence the triangle inequality.
    second = np.linalg.eigvalsh(s)
    want = second[:, [0, 0, 1]] + second[:, [1, 2, 2]]
    moments = np.asarray(jax.vmap(lambda a: Inertia(a).moments)(inertia.tensor))
    assert (np.abs(moments - want) <= 4e-15 * want[:, 2:]).all()
    assert (moments[:, 0] + moments[:, 1] > moments[:, 2] * (1 - 1e-14)).all()


def test_eigenvalues_of_a_second_moment_count_its_dimensions():
    """Eqs 66–70 print 'definite'; a plate, a rod and a point have one, two, three zeros."""
    for positions, zeros in (
        ([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], 1),
        ([[0.0, 0, 2], [0, 0, -2]], 2),
        ([[2.0, 1, 0]], 3),
    ):
        s = shapes.points(np.ones(len(positions)), positions).second_moment
        assert (np.abs(np.linalg.eigvalsh(s)) < 1e-15).sum() == zeros


def test_second_moment_turns_as_a_tensor_and_shifts_by_a_square():
    body, q = many_bodies(1), turns(2)
    r = jnp.asarray(np.random.default_rng(3).normal(size=(50, 3)))
    m = np.asarray(once(jax.vmap(quaternion.to_matrix))(jnp.asarray(q)))

    @jax.jit
    @jax.vmap
    def ours(body, q, r):
        return (
            body.rotate(q),
            body.inertia.rotate(q),
            body.second_moment_about(r),
            body.inertia_about(r),
            body.inertia.shift(body.com - r, body.mass),
            body.inertia.shift(r, body.mass).shift(r, -body.mass),
        )

    turned, inertia, about, inertia_about, shifted, back = ours(body, jnp.asarray(q), r)
    mass, s = np.asarray(body.mass)[:, None, None], np.asarray(body.second_moment)
    same(turned.com, np.einsum("nij,nj->ni", m, body.com))
    same(turned.second_moment, m @ s @ m.transpose(0, 2, 1))
    same(inertia.tensor, m @ np.asarray(body.inertia.tensor) @ m.transpose(0, 2, 1))
    d = np.asarray(body.com - r)
    square = d[:, :, None] * d[:, None, :]
    same(about, s + mass * square)
    steiner = mass * ((d * d).sum(axis=1)[:, None, None] * np.eye(3) - square)
    same(inertia_about.tensor, np.asarray(body.inertia.tensor) + steiner)
    same(shifted, inertia_about)
    same(back, body.inertia)


def test_joining_is_associative_commutative_and_undone_by_cutting():
    @jax.jit
    @jax.vmap
    def ours(a, b, c, q):
        whole = (a + b).inertia_about(jnp.zeros(3))
        parts = a.inertia_about(jnp.zeros(3)) + b.inertia_about(jnp.zeros(3))
        return (
            ((a + b) + c, a + (b + c)),
            (a + b, b + a),
            ((a + b).rotate(q), a.rotate(q) + b.rotate(q)),
            ((a + b) - b, a),
            (whole, parts),
            (whole - b.inertia_about(jnp.zeros(3)), a.inertia_about(jnp.zeros(3))),
        )

    for left, right in ours(many_bodies(4), many_bodies(5), many_bodies(6), jnp.asarray(turns(7))):
        same(left, right, 1e-12)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_inverse_from_grains_to_planets(dtype):
    turned = Inertia.from_principal(0.3, 1.0, 1.2).rotate([0.8, 0.1, 0.5, 0.1**0.5]).tensor
    want = np.linalg.inv(np.asarray(turned, dtype).astype(np.float64))
    for scale in (1e-20, 1e-10, 1.0, 1e20, 1e37):
        a = (turned * scale).astype(dtype)
        got = np.asarray(inverse(a), np.float64) * scale
        np.testing.assert_allclose(got, want, rtol=0, atol=20 * jnp.finfo(dtype).eps)
        assert got.dtype == np.float64 and inverse(a).dtype == dtype


def test_a_light_body_far_away_keeps_the_digits_of_the_centre():
    ball = shapes.sphere(1.0, 1.0)
    grain = shapes.sphere(2.0**-40, 1e-3).shift(jnp.array([2.0**30, 1.0, 0.0]))
    exact = np.array([2.0**30, 1.0, 0.0]) / (1 + 2.0**40)
    for whole in (ball + grain, grain + ball):
        np.testing.assert_allclose(whole.com, exact, rtol=4e-16)


def test_derivative_of_the_inverse_at_a_sphere():
    e = jnp.asarray([[0.1, 0.3, 0.2], [0.3, -0.2, 0.4], [0.2, 0.4, 0.5]])
    moved = jax.jvp(inverse, (2.0 * jnp.eye(3),), (e,))[1]
    np.testing.assert_allclose(moved, -e / 4, atol=1e-15)
    second = jax.jvp(lambda a: jax.jvp(inverse, (a,), (e,))[1], (2.0 * jnp.eye(3),), (e,))[1]
    np.testing.assert_allclose(second, 2 * e @ e / 8, atol=1e-15)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_plates_rods_and_points_are_bodies_also_turned(dtype):
    q = jnp.asarray([0.5, 0.5, -0.5, 0.5], dtype)
    for second in ([1.0, 2.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]):
        s = jnp.diag(jnp.asarray(second, dtype))
        body = MassProperties(jnp.ones((), dtype), jnp.zeros(3, dtype), s).rotate(q).check()
        for scale in (1e-20, 1.0, 1e30):
            tensor = body.inertia.tensor * jnp.asarray(scale, dtype)
            assert Inertia.from_tensor(tensor).tensor.dtype == dtype
            Inertia.from_tensor(0.5 * (tensor + tensor.T))
    assert Inertia.from_principal(1.0, 2.0, 3.0).moments[2] == 3.0


def test_rod_keeps_its_small_moment():
    rod = Inertia.from_principal(1e-14, 1.0, 1.0)
    assert float(rod.tensor[0, 0]) == 1e-14
    np.testing.assert_allclose(rod.moments[0], 1e-14, rtol=1e-14)
    np.testing.assert_allclose(inverse(rod.tensor)[0, 0], 1e14, rtol=1e-14)


GOOD = np.diag([1.0, 2.0, 2.5])
REFUSED = {
    "asymmetric": (lambda: Inertia.from_tensor(GOOD + np.eye(3, k=1)), "A ≠ Aᵀ"),
    "asymmetric, by how much": (
        lambda: Inertia.from_tensor(GOOD + 0.25 * np.eye(3, k=1)),
        "difference 0.25",
    ),
    "negative": (lambda: Inertia.from_principal(-1.0, 1.0, 1.0), r"not negative, got \(-1, 1, 1\)"),
    "triangle": (
        lambda: Inertia.from_principal(3.2, 1.0, 2.0),
        r"moments \(1, 2, 3.2\) kg m² break the triangle inequality.*0.2 too large",
    ),
    "just broken": (lambda: Inertia.from_principal(1.0, 1.0, 2.0 + 1e-12), "triangle"),
    "triangle in a full tensor": (
        lambda: Inertia.from_tensor(Inertia.from_second_moment(GOOD).second_moment * 1.0 - 0.9),
        "inertia: ",
    ),
    "NaN": (lambda: Inertia.from_tensor(GOOD * np.nan), "NaN"),
    "infinity": (lambda: Inertia.from_principal(1.0, np.inf, 1.0), "infinity"),
    "𝔖 not semi-definite": (
        lambda: Inertia.from_second_moment(np.diag([1.0, 1.0, -0.1])),
        "positive semi-definite",
    ),
    "no mass": (lambda: MassProperties(0.0, ORIGIN, GOOD), "positive mass.*got 0.0"),
    "negative mass": (lambda: MassProperties(-2.0, ORIGIN, GOOD), "positive mass.*got -2.0"),
    "𝔖 of MassProperties": (lambda: MassProperties(1.0, ORIGIN, -GOOD), "semi-definite"),
    "more cut than there is": (
        lambda: MassProperties(1.0, ORIGIN, GOOD) - MassProperties(2.0, ORIGIN, GOOD),
        "positive mass",
    ),
    "rod in the equations": (
        lambda: Inertia.from_principal(0.0, 1.0, 1.0).require_invertible(),
        r"principal moment is zero \(0, 1, 1\).*thin rod",
    ),
    "a tensor of NaN in the equations": (
        lambda: Inertia(GOOD * np.nan).require_invertible(),
        r"inertia tensor: contains NaN or infinity at index \(0, 0\)",
    ),
    "a centre of mass of NaN": (
        lambda: MassProperties(1.0, [0.0, np.nan, 0.0], GOOD),
        r"com: contains NaN or infinity at index \(1,\)",
    ),
    "a mass for each axis": (
        lambda: MassProperties([1.0, 2.0, 4.0], ORIGIN, GOOD),
        r"wanted one of each, mass \(\), com \(3,\), second_moment \(3, 3\), or the same "
        r"leading axes.*mass \(3,\), com",
    ),
    "no number for the mass": (
        lambda: MassProperties([], ORIGIN, GOOD),
        r"mass, com, second_moment: wanted one of each.*mass \(0,\)",
    ),
    "two masses": (lambda: MassProperties([1.0, 2.0], ORIGIN, GOOD), r"mass \(2,\), com \(3,\)"),
    "two centres": (
        lambda: MassProperties(1.0, np.zeros((2, 3)), GOOD),
        r"com \(2, 3\), second_moment \(3, 3\);",
    ),
    "two masses, three tensors": (
        lambda: MassProperties(np.ones(2), np.zeros((2, 3)), np.stack([GOOD] * 3)),
        r"mass \(2,\), com \(2, 3\), second_moment \(3, 3, 3\);",
    ),
    "shape": (lambda: Inertia.from_tensor(np.ones(3)), r"wanted shape \(3, 3\), got \(3,\)"),
    "batch": (lambda: Inertia.from_tensor(np.ones((5, 3, 3))), "jax.vmap"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_body_is_refused_in_words(case, unhooked):
    call, words = REFUSED[case]
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize("kind", ["half", "text"])
def test_what_is_no_number_is_refused(kind, unhooked):
    value = np.ones((3, 3), np.float16) if kind == "half" else "inertia"
    with pytest.raises(TypeError, match="wanted"):
        Inertia.from_tensor(value)


def test_refusals_under_jit_say_the_same():
    good, broken = jnp.diag(jnp.array([1.0, 2, 2.5])), jnp.diag(jnp.array([1.0, 1, 5]))
    cases = [
        (lambda a: Inertia.from_tensor(a), broken, "triangle"),
        (lambda a: Inertia.from_tensor(a), good.at[0, 1].set(1.0), "symmetric"),
        (lambda a: Inertia.from_second_moment(a), -good, "semi-definite"),
        (lambda a: Inertia(a).require_invertible(), jnp.diag(jnp.array([0.0, 1, 1])), "thin rod"),
        (lambda a: Inertia(a).require_invertible(), good.at[1, 1].set(jnp.nan), "not a number"),
        (lambda a: MassProperties(a[0, 0], a[0], a).check(), -good, "positive mass"),
    ]
    for make, value, words in cases:
        run = eqx.filter_jit(make)
        run(good)
        with pytest.raises(RuntimeError, match=words):
            run(value)
    with pytest.raises(RuntimeError, match="triangle"):
        eqx.filter_jit(jax.vmap(lambda a: Inertia.from_tensor(a).tensor))(jnp.stack([good, broken]))


def test_checks_let_derivatives_through():
    a = jnp.diag(jnp.array([1.0, 1.0, 1.0]))

    def f(x):
        return Inertia.from_tensor(x).tensor.sum() + Inertia.from_second_moment(x).tensor.sum()

    want = jax.grad(lambda x: x.sum() + (3 * jnp.trace(x) - x.sum()))(a)
    np.testing.assert_array_equal(jax.grad(f)(a), want)
    np.testing.assert_array_equal(eqx.filter_jit(jax.grad(f))(a), want)


def test_integers_and_lists_become_the_default_float(unhooked):
    body = MassProperties(2, [0, 0, 1], [[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert {x.dtype for x in jax.tree.leaves(body)} == {np.dtype("float64")}
    assert not any(x.weak_type for x in jax.tree.leaves(body))
    assert not Inertia.from_principal(1.0, 2.0, 2.5).tensor.weak_type


def test_single_precision_stays_single_with_python_numbers():
    single = MassProperties(2.0, jnp.zeros(3, jnp.float32), jnp.eye(3, dtype=jnp.float32))
    results = (
        single + single.shift(jnp.ones(3, jnp.float32)),
        single.inertia.shift(jnp.ones(3, jnp.float32), 2.0),
        single.inertia.principal(),
        Inertia.from_principal(np.float32(1), np.float32(2), np.float32(2.5)),
    )
    assert {x.dtype for x in jax.tree.leaves(results)} == {np.dtype("float32")}


def test_containers_carry_a_batch():
    many = jax.vmap(Inertia.from_principal)(jnp.ones(4), 2 * jnp.ones(4), 2.5 * jnp.ones(4))
    assert many.tensor.shape == (4, 3, 3) and many.second_moment.shape == (4, 3, 3)
    assert Inertia(many.tensor).tensor.shape == (4, 3, 3)
    bodies = MassProperties(np.ones(4), np.zeros((4, 3)), many.second_moment)
    assert bodies.inertia.tensor.shape == (4, 3, 3)
    np.testing.assert_allclose(bodies.inertia.tensor, many.tensor, atol=1e-15)
    moments = many.second_moment
    made = jax.vmap(lambda m, s: MassProperties(m, jnp.zeros(3), s))(jnp.arange(1.0, 5), moments)
    assert [leaf.shape[0] for leaf in jax.tree.leaves(made)] == [4, 4, 4]
    none = MassProperties(np.ones(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    assert none.mass.shape == (0,)


@pytest.mark.usefixtures("unhooked")
def test_an_inertia_in_place_of_its_second_moment_is_named():
    with pytest.raises(TypeError, match=r"got an Inertia; give its \.second_moment"):
        MassProperties(1.0, ORIGIN, Inertia.from_principal(1.0, 1.6, 2.2))


def test_a_body_of_arbitrary_scale_says_so():
    body = Inertia(np.diag([0.5, 0.7, 0.8]), "arbitrary")
    assert "scale='arbitrary'" in repr(body) and "scale" not in repr(Inertia(body.tensor))
    assert jax.jit(lambda b: b.rotate([1.0, 0, 0, 0]))(body).scale == "arbitrary"
    with pytest.raises(ValueError, match="in kg m², got one of arbitrary scale"):
        body.shift([0.0, 0, 1], 1.0)
    with pytest.raises(ValueError, match="scale: wanted one of arbitrary, got 'g'"):
        Inertia(body.tensor, "g")
    spin, attitude = rj.Spin([1.0, 0, 0]), rj.Attitude([1.0, 0, 0, 0], [1.0, 0, 0])
    far = rj.torques.GravityGradient(1.0, [3.0, 0, 0])
    rj.simulate(body, spin, [0.0, 1.0])
    rj.simulate(body, attitude, [0.0, 1.0], far)
    top = rj.torques.HeavyTop(1.0, [0.0, 0, 1], [0.0, 0, -9.81])
    with pytest.warns(UserWarning, match="arbitrary scale, and HeavyTop gives N m"):
        rj.simulate(body, attitude, [0.0, 1.0], top)
    many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), attitude)
    with pytest.warns(UserWarning, match="arbitrary scale, and HeavyTop gives N m"):
        rj.batch.simulate(body, many, [0.0, 1.0], top)
