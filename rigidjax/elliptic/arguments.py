"""Check and convert the arguments of elliptic functions."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from rigidjax import _checks
from rigidjax.rotation.barrier import batch_as

# The arguments and results of all functions are real numbers, of shapes that broadcast.
Real = Float[ArrayLike, "..."]
RealOrArray = Float[Array, "..."]


def to_common_dtype(**named: Real) -> tuple[RealOrArray, ...]:
    """Convert the arguments to arrays of one dtype and shape; Python numbers take the dtype of the
    arrays.
    """
    arrays = {
        name: _checks.array_of_shape(value, (), name, batched=True) for name, value in named.items()
    }
    dtype = jnp.result_type(*arrays.values())
    try:
        shape = jnp.broadcast_shapes(*(array.shape for array in arrays.values()))
    except ValueError as error:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise ValueError(f"shapes do not broadcast together: {shapes}") from error
    return tuple(jnp.broadcast_to(array.astype(dtype), shape) for array in arrays.values())


def complement_pair(name: str, value: Real, complement: Real | None) -> dict[str, Any]:
    """Return `value` and 1 − `value` as a dictionary with the keys `name` and `name` + "1".

    If a `complement` is given it is the second number, and an error is raised unless it is 1 −
    `value`.
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
def exact_complement(value: Result, complement: Result) -> Any:
    """Return `value` as a function of its `complement` (1 − `value`) alone.

    The derivative with respect to `complement` is −1, and the derivative with respect to `value` is
    0.
    """
    return batch_as(value, complement)


@exact_complement.defjvp
def _exact_complement_jvp(
    primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]
) -> tuple[Any, Any]:
    return exact_complement(*primals), -tangents[1]
