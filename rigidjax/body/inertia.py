"""Hold the inertia of a body, and its mass, centre of mass and second moment.

The second moment `𝔖 = ∫ r rᵀ dm` (notes, eq 60) and the inertia tensor `I = Tr(𝔖) 1 − 𝔖` (eqs
76–78) have the same information. A matrix is the 𝔖 of a real body exactly if it is positive
semi-definite; for the principal moments of I this condition is the triangle inequality I1 + I2 ≥
I3.
"""

from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rigidjax import _checks, _show
from rigidjax._types import (
    Mat3,
    Matrices,
    Matrix,
    Quat,
    Quaternion,
    ScalarLike,
    Scalars,
    Vec3,
    Vector,
    Vectors,
)
from rigidjax.body import validation
from rigidjax.body.principal_axes import eigensystem, principal
from rigidjax.body.symmetric3 import (
    apply as apply,
    inverse as inverse,
    outer,
    product,
    to_inertia,
    to_second_moment,
)
from rigidjax.rotation import quaternion


class Inertia(eqx.Module):
    """Hold the inertia tensor I of a body about the point that the body turns about.

    **Arguments:** `tensor` (3, 3), kg m², body frame. The constructor checks shape and dtype only;
    `from_tensor`, `from_principal`, `from_second_moment`, and every function that takes a body,
    check that some distribution of mass has this inertia. `scale` is `None`, or "arbitrary" if only
    the ratios of the components are known, as after a fit of free motion: `simulate` then warns if
    a torque in N m acts, which needs an inertia in kg m²; and `shift` raises `ValueError`.

    The object stores I, not 𝔖: `from_tensor` changes no digit, and the small moment of a rod keeps
    all its digits. Source: notes, eqs 76–78.

    >>> Inertia.from_principal(1.0, 2.0, 2.5).moments
    Array([1. , 2. , 2.5], dtype=float64)
    """

    tensor: Float[Array, "*batch 3 3"]
    scale: str | None = eqx.field(static=True)

    __repr__ = _show.fields_as_text

    def __init__(self, tensor: Matrices, scale: str | None = None):
        hint = "Inertia.from_principal takes principal moments"
        self.tensor = _checks.array_of_shape(
            tensor, (3, 3), "tensor", batched=True, hint=hint, unit="kg m²"
        )
        self.scale = (
            None if scale is None else _checks.require_option(scale, ("arbitrary",), "scale")
        )

    @staticmethod
    def from_tensor(tensor: Matrix) -> "Inertia":
        """Return the body with a given inertia tensor.

        **Arguments:** `tensor` (3, 3), kg m², body frame, about the point that the body turns
        about. Plates, rods and points, for which principal second moments are zero, are allowed.
        **Raises:** `ValueError` (`equinox` error under `jit`) if the tensor is not symmetric to a
        few units of round-off, or if its principal moments I1 ≤ I2 ≤ I3 are negative or break the
        triangle inequality `I1 + I2 ≥ I3`.

        >>> Inertia.from_tensor([[2.0, 0.1, 0], [0.1, 2, 0], [0, 0, 3]]).tensor.shape
        (3, 3)
        """
        a = _checks.array_of_shape(tensor, (3, 3), "inertia tensor")
        return Inertia(validation.require_physical_inertia(a))

    @staticmethod
    def from_principal(i1: ScalarLike, i2: ScalarLike, i3: ScalarLike) -> "Inertia":
        """Return the body with moments `i1`, `i2`, `i3`, kg m², about the body axes. **Raises:** as
        `from_tensor`.

        >>> Inertia.from_principal(1.0, 2.0, 3.0).tensor[2, 2]
        Array(3., dtype=float64)
        """
        moments = validation.require_physical_moments(
            jnp.stack(_checks.scalars(i1=i1, i2=i2, i3=i3))
        )
        return Inertia(jnp.diag(moments))

    @staticmethod
    def from_second_moment(second_moment: Matrix) -> "Inertia":
        """Return the body with this second moment: `I = Tr(𝔖) 1 − 𝔖` (notes, eqs 60, 76–78).

        **Arguments:** `second_moment` (3, 3) 𝔖 = ∫ r rᵀ dm, kg m², body frame, about the point that
        the body turns about. **Raises:** `ValueError` (`equinox` error under `jit`) if the matrix
        is not symmetric and positive semi-definite to a few units of round-off.

        >>> Inertia.from_second_moment(jnp.diag(jnp.array([2.0, 1.0, 0.0]))).moments
        Array([1., 2., 3.], dtype=float64)
        """
        s = _checks.array_of_shape(second_moment, (3, 3), "second moment", unit="kg m²")
        return Inertia(to_inertia(validation.require_second_moment(s)))

    @property
    def second_moment(self) -> Float[Array, "*batch 3 3"]:
        """Return the second moment 𝔖 = ∫ r rᵀ dm of this body, (3, 3), kg m², body frame, from its
        inertia tensor I: 𝔖 = ½ Tr(I) 1 − I (notes, eqs 76–78 solved).
        """
        return to_second_moment(self.tensor)

    @property
    def moments(self) -> Vec3:
        """Return the principal moments I1 ≤ I2 ≤ I3 of this inertia, (3,), kg m²."""
        return eigensystem(validation.require_symmetric_or_nan(self.tensor, "inertia tensor"))[0]

    def principal(self) -> tuple[Vec3, Quat]:
        """Return the principal moments, ascending, and the rotation principal axes → body axes.

        **Returns** `(moments, q)`, (3,) kg m² and (4,), with `I = R(q) diag(moments) R(q)ᵀ`.
        Derivatives are finite for any body; `rigidjax.body.principal` says what they mean at equal
        moments.

        >>> Inertia.from_principal(3.0, 2.0, 2.5).principal()[0]
        Array([2. , 2.5, 3. ], dtype=float64)
        """
        return principal(self.tensor)

    def shift(self, r: Vector, mass: ScalarLike) -> "Inertia":
        """Return the inertia about a point away from the centre of mass: `I + m (|r|² 1 − r rᵀ)`.

        **Arguments:** `self`, the inertia I about the centre of mass; `r` (3,) the vector between
        the centre of mass and the new point, in either direction, in metres, body frame; `mass` m,
        kg; a negative mass undoes a shift. Source: Steiner; Landau and Lifshitz, eq 32.12.

        >>> Inertia.from_principal(1.0, 1.0, 1.0).shift([0.0, 0.0, 2.0], 3.0).moments
        Array([ 1., 13., 13.], dtype=float64)
        """
        r = _checks.array_of_shape(r, (3,), "r", unit="m")
        m = _checks.array_of_shape(mass, (), "mass")
        if self.scale is not None:
            raise ValueError("shift: wanted an inertia in kg m², got one of arbitrary scale")
        return Inertia(self.tensor + to_inertia(m * outer(r, r)))

    def rotate(self, q: Quaternion) -> "Inertia":
        """Return the inertia of the turned body, or of the body in other axes: `R(q) I R(q)ᵀ`.

        **Arguments:** `q` (4,) unit quaternion (w, x, y, z), active: the mass at `r` moves to `R(q)
        r`. With q body → world the result is the inertia in world axes.

        >>> half = 0.5**0.5
        >>> Inertia.from_principal(1.0, 2.0, 2.5).rotate([half, 0, 0, half]).tensor[0, 0]
        Array(2., dtype=float64)
        """
        m = quaternion.to_matrix(validation.unit_attitude(q))
        return Inertia(product(m, product(self.tensor, m.T)), self.scale)

    def require_invertible(self) -> "Inertia":
        """Return `self` unchanged. **Raises:** `ValueError` (`equinox` error under `jit`) if a
        principal moment is zero: Euler's equations divide by the moments.
        """
        return validation.require_physical_body(self, throw=True)

    def __add__(self, other: "Inertia") -> "Inertia":
        """Return the inertia of two bodies that are joined into one; both inertias are about the
        same point, in the same axes.
        """
        return Inertia(self.tensor + other.tensor)

    def __sub__(self, other: "Inertia") -> "Inertia":
        """Return the inertia of the body after the part `other` is taken away; both inertias are
        about the same point, in the same axes.
        """
        return Inertia(self.tensor - other.tensor)


class MassProperties(eqx.Module):
    """Hold the mass, centre of mass and second moment of a body.

    **Arguments:** `mass` m, kg; `com` (3,) centre of mass c, in metres, body frame (from the body's
    origin); `second_moment` (3, 3) 𝔖 **about the centre of mass**, kg m², body axes (notes, eq 60).
    Known values are checked; for traced values call `check`.

    **Raises:** `ValueError` for a mass that is not positive, a centre of mass that is not finite, a
    second moment that is not symmetric and positive semi-definite.

    >>> MassProperties(2.0, [0.0, 0, 0], [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]).inertia.moments
    Array([2., 2., 2.], dtype=float64)
    """

    mass: Float[Array, "*batch"]
    com: Float[Array, "*batch 3"]
    second_moment: Float[Array, "*batch 3 3"]

    __repr__ = _show.fields_as_text

    def __init__(self, mass: Scalars, com: Vectors, second_moment: Matrices):
        mass = _checks.array_of_shape(mass, (), "mass", batched=True)
        com = _checks.array_of_shape(com, (3,), "com", batched=True)
        if isinstance(second_moment, Inertia):
            words = "second_moment: wanted 𝔖 about the centre of mass, got an Inertia"
            raise TypeError(f"{words}; give its .second_moment")
        s = _checks.array_of_shape(
            second_moment, (3, 3), "second_moment", batched=True, unit="kg m²"
        )
        _checks.require_same_batch(mass=(mass, 0), com=(com, 1), second_moment=(s, 2))
        dtype = jnp.result_type(mass, com, s)
        mass = _checks.check_if_known(validation.require_physical_mass, mass.astype(dtype))
        # A traced mass that is not positive makes the body NaN; the method `check` raises an error
        # instead.
        self.mass = mass if _checks.is_known(mass) else jnp.where(mass > 0, mass, jnp.nan)
        self.com = _checks.check_if_known(_checks.require_finite, com.astype(dtype), "com")
        self.second_moment = _checks.check_if_known(
            validation.require_second_moment, s.astype(dtype)
        )

    @property
    def inertia(self) -> Inertia:
        """Return the inertia of this body about its centre of mass, in body axes."""
        return Inertia(to_inertia(self.second_moment))

    def check(self) -> "MassProperties":
        """Return an equal body whose mass, centre of mass and second moment are checked, also under
        `jit`. **Raises:** `ValueError` (`equinox` error under `jit`) in the cases in which the
        constructor of `MassProperties` raises it.
        """
        return MassProperties(
            validation.require_physical_mass(self.mass),
            _checks.require_finite(self.com, "com"),
            validation.require_second_moment(self.second_moment),
        )

    def require_invertible(self) -> "MassProperties":
        """Return `self` unchanged. **Raises:** `ValueError` (`equinox` error under `jit`) if a
        principal moment about the centre of mass is zero: Euler's equations divide by the moments.
        """
        return validation.require_physical_body(self, throw=True)

    def second_moment_about(self, point: Vector) -> Mat3:
        """Return the second moment about another point, (3, 3), kg m², body axes: `𝔖 + m d dᵀ`,
        with the second moment 𝔖 about the centre of mass c, the mass m, and `d = c − point`.

        **Arguments:** `point` (3,), in metres, body frame. Source: eq 60 of the notes with `r −
        point = (r − c) + d`; the cross terms vanish.

        >>> body = MassProperties(2.0, [1.0, 0, 0], [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> body.second_moment_about([0.0, 0, 0])[0, 0]
        Array(3., dtype=float64)
        """
        d = self.com - _checks.array_of_shape(point, (3,), "point")
        return self.second_moment + self.mass * outer(d, d)

    def inertia_about(self, point: Vector) -> Inertia:
        """Return the inertia about another `point` (3,) of the body, m, body frame, such as a
        pivot.

        >>> body = MassProperties(2.0, [1.0, 0, 0], [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> body.inertia_about([0.0, 0, 0]).moments
        Array([2., 4., 4.], dtype=float64)
        """
        return Inertia(to_inertia(self.second_moment_about(point)))

    def shift(self, r: Vector) -> "MassProperties":
        """Return the body shifted by `r` (3,), m, in its own axes: only its centre of mass changes.

        >>> body = MassProperties(2.0, [1.0, 0, 0], [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> body.shift([0.0, 1.0, 0.0]).com
        Array([1., 1., 0.], dtype=float64)
        """
        com = self.com + _checks.array_of_shape(r, (3,), "r")
        return MassProperties(self.mass, com, self.second_moment)

    def rotate(self, q: Quaternion) -> "MassProperties":
        """Return the body turned about its origin by `q` (4,), unit, active. The centre of mass c
        becomes `R c`, and the second moment 𝔖 becomes `R 𝔖 Rᵀ`, with the rotation matrix R of `q`.

        >>> body = MassProperties(2.0, [1.0, 0, 0], [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> body.rotate([0.0, 0, 0, 1]).com
        Array([-1.,  0.,  0.], dtype=float64)
        """
        m = quaternion.to_matrix(validation.unit_attitude(q))
        second_moment = product(m, product(self.second_moment, m.T))
        return MassProperties(self.mass, apply(m, self.com), second_moment)

    def __add__(self, other: "MassProperties") -> "MassProperties":
        """Return two bodies joined into one; both are given in the same frame. The second moment is
        `𝔖 = 𝔖a + 𝔖b + (ma mb / m) d dᵀ`, with the two masses ma and mb, their sum m, and the vector
        `d = cb − ca` from the first centre of mass to the second.

        >>> part = MassProperties(1.0, [0.0, 0, 0], [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> (part + part.shift([2.0, 0, 0])).second_moment[0, 0]
        Array(4., dtype=float64)
        """
        if not isinstance(other, MassProperties):
            return NotImplemented
        return _add_mass(self, other.mass, other.com, other.second_moment)

    def __radd__(self, other: int) -> "MassProperties":
        """Return `self` if `other` is 0: Python's `sum(parts)` begins with 0 and adds the parts to
        it.
        """
        return self if isinstance(other, int) and other == 0 else NotImplemented

    def __sub__(self, other: "MassProperties") -> "MassProperties":
        """Return the body after the part `other` is taken away; both are given in the same frame.

        **Raises:** `ValueError` if the part has more mass than the body.

        >>> part = MassProperties(1.0, [0.0, 0, 0], [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> ((part + part.shift([2.0, 0, 0])) - part).com
        Array([2., 0., 0.], dtype=float64)
        """
        if not isinstance(other, MassProperties):
            return NotImplemented
        return _add_mass(self, -other.mass, other.com, -other.second_moment)


# A body that turns is given by its inertia alone, or by its mass, centre of mass and second moment.
Body = Inertia | MassProperties


def tensor_of(body: Body) -> Float[Array, "*batch 3 3"]:
    """Return the inertia tensor (3, 3), kg m², of a body, an `Inertia` or `MassProperties`; for
    `MassProperties` the tensor is about the centre of mass.
    """
    return body.tensor if isinstance(body, Inertia) else body.inertia.tensor


OneBody = TypeVar("OneBody", bound=Body)


def with_tensor(body: OneBody, tensor: Mat3) -> OneBody:
    """Return a copy of `body`, an `Inertia` or `MassProperties`, with another inertia tensor. The
    tensor is not checked: what is left of an inertia when that of the wheels is subtracted, for
    example, need not be the inertia of a real body.

    - `tensor`: (3, 3), kg m², body frame; of `MassProperties`, about the centre of mass
    """
    if isinstance(body, Inertia):
        return Inertia(tensor)  # pyright: ignore[reportReturnType]
    return eqx.tree_at(lambda b: b.second_moment, body, to_second_moment(tensor))


def _add_mass(
    body: MassProperties, mass: Array, com: Array, second_moment: Array
) -> MassProperties:
    """Return the body with an added mass, whose second moment is about its own centre of mass; a
    negative mass and second moment take mass away.
    """
    total = body.mass + mass
    d = com - body.com
    # The centre of mass of the sum is computed from that of the heavier part: a light and distant
    # part moves it little, so that no digit is lost.
    heavy = body.mass >= mass
    moved = jnp.where(heavy, mass, -body.mass) / total * d
    both = body.second_moment + second_moment + (body.mass * (mass / total)) * outer(d, d)
    return MassProperties(total, jnp.where(heavy, body.com, com) + moved, both)
