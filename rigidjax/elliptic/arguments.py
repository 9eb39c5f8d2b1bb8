"""Check and convert the arguments of elliptic functions."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, ArrayLike, Float, PyTree

from rigidjax import _checks
from rigidjax.rotation.barrier import match_batch_axes

# The arguments and results of all functions are real numbers, of shapes that broadcast.
Real = Float[ArrayLike, "..."]
RealOrArray = Float[Array, "..."]
# The change of an argument in a derivative; a change that is known to be zero is a `SymbolicZero`.
Tangent = ArrayLike | SymbolicZero


def to_common_dtype(**numbers_by_name: Real) -> tuple[RealOrArray, ...]:
    """Convert numbers or arrays to arrays of one dtype and one shape, and return the arrays in the
    order of the arguments.

    The keyword of an argument is the name of the argument in error messages. Python numbers take
    the dtype of the arrays, and the shapes are broadcast. A `TypeError` is raised for half
    precision, a `ValueError` for shapes that do not broadcast.
    """
    arrays = {
        name: _checks.array_of_shape(value, (), name, batched=True)
        for name, value in numbers_by_name.items()
    }
    dtype = jnp.result_type(*arrays.values())
    try:
        shape = jnp.broadcast_shapes(*(array.shape for array in arrays.values()))
    except ValueError as error:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise ValueError(f"shapes do not broadcast together: {shapes}") from error
    return tuple(jnp.broadcast_to(array.astype(dtype), shape) for array in arrays.values())


def number_and_complement(
    name: str, value: Real, complement: Real | None
) -> dict[str, RealOrArray]:
    """Return a number and its complement (1 minus the number), as a dictionary with the keys `name`
    and `name` + "1".

    - `name`: the name of the number, such as "m" for the parameter of an elliptic integral.
    - `value`: the number, or an array.
    - `complement`: 1 − `value`, given by a caller who knows it with more digits; or None, to
      compute it.

    A `ValueError` is raised if `complement` is not 1 − `value` to round-off.
    """
    value = _checks.array_of_shape(value, (), name, batched=True)
    if complement is None:
        return {name: value, name + "1": 1 - value}
    other = _checks.array_of_shape(complement, (), name + "1", batched=True)
    if _checks.is_known((value, other)):
        a, b = np.asarray(value), np.asarray(other)
        eps = max(np.finfo(a.dtype).eps, np.finfo(b.dtype).eps)
        excess = np.abs(a + b - 1)
        if np.any(excess > 16 * eps * np.maximum(1, np.abs(a))):
            raise ValueError(
                f"{name}1: wanted 1 − {name}, but {name} + {name}1 differs from 1 by up to "
                f"{float(np.max(excess)):.3g}; likely a modulus k given for the parameter m = k²"
            )
    return {name: value, name + "1": other}


@jax.custom_jvp
def value_differentiated_by_complement(value: RealOrArray, complement: RealOrArray) -> RealOrArray:
    """Return `value` as a function of its complement alone, where `complement` is 1 − `value`: the
    result is `value` itself, but the derivative of the result with respect to `complement` is −1,
    and the derivative with respect to `value` is 0.
    """
    return match_batch_axes(value, complement)


@value_differentiated_by_complement.defjvp
def _value_differentiated_by_complement_jvp(
    primals: tuple[RealOrArray, RealOrArray], tangents: tuple[PyTree, PyTree]
) -> tuple[RealOrArray, PyTree]:
    """Return two things: a number x as a function of its complement 1 − x alone; and its tangent
    (the change in a derivative), which is −1 times the tangent of the complement. By this rule JAX
    differentiates `value_differentiated_by_complement`.

    - `primals`: the pair of x and 1 − x, two numbers or arrays.
    - `tangents`: the pair of their tangents; the tangent of x is not used.
    """
    return value_differentiated_by_complement(*primals), -tangents[1]
