"""Define names for the arrays that all parts of the library exchange.

Functions return the JAX arrays `Vec3`, `Mat3`, `Quat` and `Scalar`. Their arguments may have the
`…Like` forms: anything of the same shape that JAX takes for an array, such as a NumPy array. A
function takes one body at a time; batch with `jax.vmap`.
"""

import sys
import typing
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, ArrayLike, Float

Scalar = Float[Array, ""]
Vec3 = Float[Array, "3"]
Mat3 = Float[Array, "3 3"]
Quat = Float[Array, "4"]


@runtime_checkable
class Rotation(Protocol):
    """Describe an object like the `Rotation` of SciPy, an active rotation: `as_quat` returns a
    quaternion with the scalar last.
    """

    def as_quat(self) -> Any: ...


ScalarLike = Float[ArrayLike, ""]
# The types in which diffrax passes a real number, such as a time, to a solver.
RealLike = Scalar | np.ndarray | float | int
Vec3Like = Float[ArrayLike, "3"]
Mat3Like = Float[ArrayLike, "3 3"]
QuatLike = Float[ArrayLike, "4"] | Rotation

if not typing.TYPE_CHECKING and sys.version_info >= (3, 12):
    # Each of these types gets a name, which `help` and editors show in the place of a long union of
    # types. (On Python 3.11 beartype does not read a type with a name.)
    ScalarLike = typing.TypeAliasType("ScalarLike", ScalarLike)
    Vec3Like = typing.TypeAliasType("Vec3Like", Vec3Like)
    Mat3Like = typing.TypeAliasType("Mat3Like", Mat3Like)
    QuatLike = typing.TypeAliasType("QuatLike", QuatLike)

# Where an argument may be `Numbers`, it may be a list of numbers, also of nested lists, in the
# place of an array.
Numbers = Sequence[Any]
NumbersLike = ArrayLike | Numbers
Vector = Vec3Like | Numbers
Matrix = Mat3Like | Numbers
Quaternion = QuatLike | Numbers
Vectors = Float[ArrayLike, "*batch 3"] | Numbers
Quaternions = Float[ArrayLike, "*batch 4"] | Rotation | Numbers
Matrices = Float[ArrayLike, "*batch 3 3"] | Numbers
Scalars = Float[ArrayLike, "*batch"] | Numbers | float


@runtime_checkable
class HasSpin(Protocol):
    """Describe a state with a body rate `omega` (rad/s, body frame).

    >>> isinstance(rj.Spin([0.0, 0.0, 1.0]), HasSpin), isinstance(rj.Inertia(jnp.eye(3)), HasSpin)
    (True, False)
    """

    @property
    def omega(self) -> Float[Array, "*batch 3"]: ...


@runtime_checkable
class HasAttitude(HasSpin, Protocol):
    """Describe a state with a body rate and an attitude `q` (w, x, y, z), body → world.

    >>> isinstance(rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1]), HasAttitude)
    True
    """

    @property
    def q(self) -> Float[Array, "*batch 4"]: ...


@runtime_checkable
class HasPose(HasAttitude, Protocol):
    """Describe a state with a body rate, an attitude, and the position `x` (in metres) and velocity
    `v` (in m/s) of the centre of mass, world frame.

    >>> isinstance(rj.Attitude([1.0, 0, 0, 0], [0.0, 0, 1]), HasPose)  # it has no position
    False
    """

    @property
    def x(self) -> Float[Array, "*batch 3"]: ...

    @property
    def v(self) -> Float[Array, "*batch 3"]: ...
