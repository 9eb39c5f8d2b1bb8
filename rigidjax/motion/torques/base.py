"""Define the base classes of torques and forces, and evaluate them in a vector field."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float, PyTree

from rigidjax import _checks, _show
from rigidjax._types import (
    HasAttitude,
    HasPose,
    HasSpin,
    NumbersLike,
    Scalar,
    ScalarLike,
    Vec3,
    Vector,
)
from rigidjax.body.inertia import Body, Inertia, MassProperties, tensor_of as tensor_of
from rigidjax.motion.torques.states import FrozenLaw, has_own_states


class Wrench(eqx.Module):
    """Hold a force on the centre of mass and a torque about the centre of mass: the value that a
    force model returns.

    **Arguments:** `force` (3,) N, **world** frame; `torque` (3,) N m, **body** frame, about the
    centre of mass; zero by default.

    >>> Wrench([0.0, 0.0, -9.81]).torque
    Array([0., 0., 0.], dtype=float64)
    """

    force: Vec3
    torque: Vec3

    __repr__ = _show.fields_as_text

    def __init__(self, force: Vector, torque: Vector | None = None):
        self.force = _checks.array_of_shape(force, (3,), "force", hint="world-frame N")
        torque = jnp.zeros_like(self.force) if torque is None else torque
        self.torque = _checks.array_of_shape(torque, (3,), "torque", hint="body-frame N m")


class AbstractTorque(eqx.Module):
    """Define a torque on a body: a function of time, state and body, in N m, body axes.

    Subclass it, or give any callable with the arguments `(t, state, body)` in its place, best an
    `equinox.Module`. `feels` is the smallest state with the parts that the torque reads: `HasSpin`
    (`.omega`), `HasAttitude` (also `.q`) or `HasPose` (also `.x`, `.v`); a torque with `feels =
    HasPose` may return a `Wrench`, a force as well as a torque. A torque gets the `body` that was
    given to `simulate`: an `Inertia`, or `MassProperties` for `Rigid`.

    Optional members:

    - `rate_free`: true if the torque does not depend on the body rate; the splitting methods of
      `rigidjax.solvers`, such as `Splitting4`, can then be used.
    - `jump_times` (n,), s: the times at which the torque jumps or has a kink; `simulate` ends a
      step at each of these times.
    - `energy(t, state, body)`, J, a method of a torque with a potential. This member and the next
      three are for `rigidjax.conserved`.
    - `steady`: true if the torque does not depend on time.
    - `axis` (3,), world frame: a vector along which the torque has no component.
    - `internal_momentum(t)` (3,), N m s, body frame, a method that returns the momentum of parts
      inside the body, such as wheels. A torque with this method is not an external torque.

    **States of its own** (such as the speed of a motor, or a bias that drifts): give the torque two
    more members. `state0` is a tree of arrays with the initial values of these states, or a method
    `(t, state, body)` that returns such a tree; the method `rate(t, own, state, body)` returns the
    derivatives with respect to time of the states, whose values are in `own`. The torque is then
    called as `(t, state, body, own)`. `simulate` (which returns the states as `sol.own`),
    `batch.rollout`, `batch.simulate` and `identify.fit` integrate the states of the torque with the
    body's state. A function of time inside a torque, such as the delayed response `Lagged` of a
    motor, may have states, too; it is called as `(t, own)`. No base class is needed:

    >>> import equinox as eqx
    >>> class Fading(eqx.Module):
    ...     state0: jnp.ndarray
    ...     def rate(self, t, own, state, body):
    ...         return -own
    ...     def __call__(self, t, state, body, own):
    ...         return jnp.stack([0.0, 0.0, 1.0]) * own
    >>> body, start = rj.Inertia.from_principal(1.0, 1.0, 1.0), rj.Spin([0.0, 0.0, 0.0])
    >>> rj.simulate(body, start, [0.0, 1.0], Fading(jnp.asarray(1.0))).ys.omega[-1, 2]  # 1 − 1/e
    Array(0.63212056, dtype=float64)
    """

    feels: eqx.AbstractVar[type]

    __repr__ = _show.fields_as_text

    @abc.abstractmethod
    def __call__(self, t: ScalarLike, state: PyTree, body: Body) -> Vec3:
        """Return the torque (3,), N m, body frame, at the time `t`, s, on a `body` (an `Inertia` or
        `MassProperties`) in the state of motion `state`.
        """


class AbstractForce(eqx.Module):
    """Define a force on a body with a mass and a `Rigid` state: like `AbstractTorque`, but the
    value is a `Wrench`.
    """

    feels: eqx.AbstractVar[type]

    __repr__ = _show.fields_as_text

    @abc.abstractmethod
    def __call__(self, t: ScalarLike, state: PyTree, body: MassProperties) -> Wrench:
        """Return the force, N, world frame, and the torque about the centre of mass, N m, body
        frame, at the time `t`, s.
        """


class AbstractTimeTorque(AbstractTorque):
    """Define a torque with vectors as fields, such as a magnetic field, each constant or a function
    of time.
    """

    @property
    def steady(self) -> bool:
        """Return whether no field of the torque is a function of time."""
        return not any(callable(part) for part in vars(self).values())

    @property
    def jump_times(self) -> Float[Array, " n"]:
        """Return the times, s, ascending, at which a field of the torque jumps or has a kink."""
        return field_jumps(self)


# An argument with this type takes any callable `(t, state, body)` as a torque: the class of a
# user's own torque need not be a subclass of `AbstractTorque`.
Torque = AbstractTorque | AbstractForce | Callable[[Any, Any, Any], Any]

# This is the type of the attribute `feels` of a torque, which is a class: the smallest state of
# motion that the torque can read.
StateType = type
# This is the type of the attribute `axis` of a torque: a vector (3,), world frame, along which the
# torque has no component.
AxisWithoutTorque = Vec3
# These are the classes of states that a torque may declare in `feels`: with the body rate, also
# with the attitude, also with position and velocity. A later class has all parts of an earlier one.
STATE_TYPES_BY_SIZE = (HasSpin, HasAttitude, HasPose)
# The message about a wrong vector of gravity ends with this advice.
GRAVITY_HINT = "a vector in world axes, such as [0, 0, -9.81]"


def require_torque(torque: object, name: str = "torque") -> None:
    """Raise `TypeError` unless `torque` can be called with the arguments `(t, state, body)`."""
    if isinstance(torque, type):
        made = f"{torque.__name__}(...)"
        raise TypeError(f"{name}: wanted an object, got the class {torque.__name__}; make {made}")
    if not callable(torque):
        advice = ""
        if isinstance(torque, list | tuple) and any(callable(part) for part in torque):
            advice = "; several go in a Sum: Sum(a, b)"
        elif isinstance(torque, list | tuple | np.ndarray | jax.Array):
            advice = "; a constant one is ConstantTorque([x, y, z])"
        raise TypeError(
            f"{name}: wanted a torque or force of rigidjax.torques, or a callable (t, state, "
            f"body), got {type(torque).__name__}{advice}"
        )
    # Only the arguments of a plain function are checked. The arguments of a Module are not: if it
    # has states of its own, it is called with these states as a fourth argument.
    if not isinstance(torque, eqx.Module):
        _checks.require_function(torque, name, "(t, state, body) → torque (3,), N m, body frame")


def may_read_attitude(torque: Torque | None) -> bool:
    """Return whether a torque, or any torque in a `Sum`, may read the attitude: unless it is `None`
    or declares `feels = HasSpin`.
    """
    if hasattr(torque, "parts"):
        return any(may_read_attitude(part) for part in torque.parts)  # pyright: ignore
    return torque is not None and getattr(torque, "feels", None) is not HasSpin


def may_read_rate(torque: Torque | None) -> bool:
    """Return whether a torque may read the body rate: not if it declares `rate_free = True`."""
    return torque is not None and not getattr(torque, "rate_free", False)


def require_state_type(torque: Torque, state: object) -> None:
    """Raise `TypeError` unless `state` has the parts that `torque` declares in `feels`."""
    require_torque(torque)
    feels = getattr(torque, "feels", None)
    if feels is not None and not isinstance(state, feels):
        raise TypeError(
            f"{type(torque).__name__} needs a state with {feels.__name__}, got "
            f"{type(state).__name__}; take Attitude, or Rigid for a torque that reads the position"
        )


def require_compatible(torque: Torque | None, state: object, body: object) -> None:
    """Raise an error unless `torque` can be evaluated for one state of motion and one body; states
    of its own must be inserted.
    """
    _checks.require_unbatched_instance(
        state, HasSpin, "state", requirement="a Spin, an Attitude or a Rigid"
    )
    if torque is not None:
        require_state_type(torque, state)
        if has_own_states(torque):
            words = "has states of its own (state0, rate): simulate, batch.rollout, batch.simulate "
            words += "and identify.fit integrate them; elsewhere call it with its states last"
            raise TypeError(f"{type(torque).__name__} {words}: torque(t, state, body, own)")
        require_single(torque.law if isinstance(torque, FrozenLaw) else torque)
    _checks.require_unbatched_instance(body, (Inertia, MassProperties), "body")


def evaluate_torque(
    torque: Torque, t: ScalarLike, state: HasSpin, body: Inertia | MassProperties
) -> Vec3:
    """Return a torque, N m, body frame; raise `TypeError` if a model returns a force, too."""
    force, value = force_and_torque(torque, t, state, body)
    if force is not None:
        raise TypeError(
            f"{type(torque).__name__} returns a force (a Wrench): wanted a Rigid state, got "
            f"{type(state).__name__}, which has no position"
        )
    return value


def force_and_torque(
    model: Torque, t: ScalarLike, state: HasSpin, body: Inertia | MassProperties
) -> tuple[Vec3 | None, Vec3]:
    """Return the force on the centre of mass, N, world frame (`None` for a pure torque), and the
    torque about it, N m, body frame, in the precision of the state.
    """
    require_compatible(model, state, body)
    dtype = state.omega.dtype
    t = _checks.array_of_shape(t, (), "t").astype(dtype)
    name = f"torque {getattr(model, 'law_name', type(model).__name__)}"
    # All arrays of the torque and of the body are converted to the precision of the state: a
    # float64 table in a torque must not turn a float32 solve into a float64 solve, nor raise an
    # error under JAX's strict promotion of dtypes.
    try:
        with _checks.explain_tracing("torque", model):
            result = in_precision(model, dtype)(t, state, in_precision(body, dtype))
    except AttributeError as error:
        message = missing_part(name, error)
        if message is None:
            raise
        raise TypeError(
            f"{message}; a subclass of AbstractTorque declares the state that it reads by feels, "
            "such as feels = HasAttitude"
        ) from error
    # A model that returns a force is recognised by the field `force` of its value, not by the class
    # of the value: the modules of moving frames do not import this module, and have a class of
    # their own for a force and a torque.
    if hasattr(result, "force"):
        return result.force.astype(dtype), result.torque.astype(dtype)
    value = _checks.array_of_shape(result, (3,), name, hint="body-frame N m")
    return None, value.astype(dtype)


# For each field that a state of motion may lack, this table has two texts for messages: the name of
# the quantity, and a class of states that has it.
_QUANTITY_AND_STATE_OF_FIELD = {
    "q": ("attitude", "Attitude(q, omega)"),
    "x": ("position", "Rigid(x, v, q, omega)"),
    "v": ("velocity", "Rigid(x, v, q, omega)"),
}


def missing_part(caller: str, error: AttributeError) -> str | None:
    """Return the message for a user's function that reads a part which its state lacks, such as the
    attitude of a `Spin`; `None` for another error.
    """
    if error.name not in _QUANTITY_AND_STATE_OF_FIELD or not isinstance(error.obj, HasSpin):
        return None
    quantity, state_with_field = _QUANTITY_AND_STATE_OF_FIELD[error.name]
    has_none = f"the {quantity}, and {type(error.obj).__name__} has none"
    return f"{caller} looks at state.{error.name}, {has_none}: start from {state_with_field}"


def require_single(torque: PyTree) -> None:
    """Raise `ValueError` if a field has the shape of many torques, as in a batch by `jax.vmap`. A
    user's own torque may have fields of any shape.
    """
    if not type(torque).__module__.startswith(("rigidjax.motion.torques", "rigidjax.suspensions")):
        return
    for field in dataclasses.fields(torque):  # pyright: ignore[reportArgumentType]
        value, kind = getattr(torque, field.name), field.type
        if eqx.is_array(value) and not isinstance(value, kind):  # pyright: ignore[reportArgumentType]
            raise ValueError(
                f"torque {type(torque).__name__}: {field.name} has the shape {value.shape}, which "
                "is not that of one torque; for one torque per body use jax.vmap, or torque_axes=0 "
                "in rigidjax.batch"
            )


def in_precision(tree: PyTree, dtype: DTypeLike) -> PyTree:
    """Return a pytree with every floating-point array converted to `dtype`; all else stays."""
    kind = lambda a: getattr(a, "dtype", bool) if eqx.is_array_like(a) else bool  # noqa: E731
    floating = lambda a: jnp.issubdtype(kind(a), jnp.floating)  # noqa: E731
    return jax.tree.map(lambda leaf: leaf.astype(dtype) if floating(leaf) else leaf, tree)


def vector_at(source: PyTree, t: ScalarLike, name: str, size: int = 3) -> Float[Array, " size"]:
    """Return a vector at the time `t`, s, of a source that is constant or a function of time."""
    return _checks.array_of_shape(source(t), (size,), f"{name}(t)") if callable(source) else source


def vector_converter(name: str, *, hint: str = "") -> Callable[[Any], Array]:
    """Return a converter for `equinox.field` that makes three finite numbers of a value."""
    return lambda value: _checks.finite_array(value, (3,), name, hint=hint)


def number_converter(name: str) -> Callable[[Any], Array]:
    """Return a converter for `equinox.field` that makes one finite number of a value."""
    return lambda value: _checks.finite_array(value, (), name)


def positive_converter(
    name: str, requirement: str = "a positive number", *, allow_zero: bool = False
) -> Callable[[Any], Array]:
    """Return a converter for `equinox.field` that makes one positive number of a value."""

    def convert(value: Any) -> Array:
        number, check = _checks.array_of_shape(value, (), name), _checks.require_positive
        return _checks.check_if_known(check, number, name, requirement, allow_zero=allow_zero)

    return convert


def source_converter(name: str) -> Callable[[Any], Any]:
    """Return a converter for `equinox.field` to a finite vector, or a function of time."""
    return lambda value: checked_source(value, name)


def checked_source(source: object, name: str, size: int = 3) -> Any:
    """Return a function of time unchanged, anything else as a vector of finite numbers."""
    if callable(source):
        return _checks.require_function(source, name, f"of time to ({size},)")
    return _checks.finite_array(source, (size,), name)


def jump_times_of(source: object) -> Float[Array, " n"]:
    """Return the times, s, at which a torque or function of time declares jumps or kinks."""
    times = getattr(source, "jump_times", None)
    return jnp.zeros(0) if times is None else times


def sorted_jumps(*sources: object) -> Float[Array, " n"]:
    """Return the ascending times, s, of jumps and kinks of torques or functions of time."""
    times = [jumps for source in sources if (jumps := jump_times_of(source)).shape[0]]
    if len(times) < 2:
        return times[0] if times else jnp.zeros(0)
    dtype = jnp.result_type(*times)
    return jnp.sort(jnp.concatenate([jumps.astype(dtype) for jumps in times]))


def field_jumps(torque: object) -> Float[Array, " n"]:
    """Return the times, s, ascending, at which any field of `torque` jumps or has a kink."""
    return sorted_jumps(*vars(torque).values())


def unit_rows(value: NumbersLike, name: str, count: int) -> Float[Array, "n 3"]:
    """Return unit vectors in rows; raise `ValueError` for a known row of another length."""
    rows = _checks.finite_array(value, (count, 3), name)
    if _checks.is_known(rows):
        lengths = np.linalg.norm(np.asarray(rows, float), axis=1)
        if abs(lengths - 1).max() > 1e-6:
            raise ValueError(f"{name}: wanted unit vectors, got lengths {lengths}")
    return rows


def row_count(value: NumbersLike, name: str, item: str) -> int:
    """Return the number R of rows of an array (R, 3); raise `ValueError` for another shape."""
    shape = _checks.numeric_array(value, name).shape
    if len(shape) != 2 or shape[1] != 3 or not shape[0]:
        raise ValueError(f"{name}: wanted (R, 3), one row for each {item}, got shape {shape}")
    return shape[0]


def one_or_each(value: NumbersLike, count: int, name: str) -> Array:
    """Return one number that holds for all items (wheels, rotors), or an array of one for each."""
    return _checks.finite_array(
        value, (count,) if _checks.numeric_array(value, name).ndim else (), name
    )


def length_or_zero(v: Vec3) -> Scalar:
    """Return the length of a vector, with the derivative 0 at v = 0, where it has none: the first
    derivative of a product such as |v| v is then right.
    """
    v = _checks.array_of_shape(v, (3,), "v")
    square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
