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
# The tangent of an argument; one that is known to be zero is a `SymbolicZero`.
Tangent = ArrayLike | SymbolicZero


def common_arrays(**numbers_by_name: Real) -> tuple[RealOrArray, ...]:
    """Convert numbers or arrays to arrays of one dtype and one shape, in the order of the
    arguments, whose keywords name them in errors.

    Python numbers take the dtype of the arrays; half precision is refused.
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


def with_complement(name: str, value: Real, complement: Real | None) -> dict[str, RealOrArray]:
    """Return a number and its complement to 1 by the keys `name` and `name` + "1".

    The `complement` is given by a caller who knows it with more digits than 1 − `value`; a
    `ValueError` is raised if the two differ by more than round-off.
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
def by_complement(value: RealOrArray, complement: RealOrArray) -> RealOrArray:
    """Return `value` as a function of `complement` = 1 − `value` alone: the derivative by
    `complement` is −1, and that by `value` is 0.
    """
    return match_batch_axes(value, complement)


@by_complement.defjvp
def _by_complement_jvp(
    primals: tuple[RealOrArray, RealOrArray], tangents: tuple[PyTree, PyTree]
) -> tuple[RealOrArray, PyTree]:
    """Return the value and its tangent, minus the tangent of the complement."""
    return by_complement(*primals), -tangents[1]
