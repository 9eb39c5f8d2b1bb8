"""Checks at public boundaries: what was wanted, what came, and the likely cause (floor 0)."""

import functools
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float


def floating(
    value: Any, shape: tuple[int, ...], name: str, *, hint: str = "", batched: bool = False
) -> Array:
    """Return `value` as a float32 or float64 array of exactly `shape`, or say what is wrong.

    **Arguments:** `value` anything array-like; integers become the default float type. `shape` the
    shape wanted; with `batched` any leading axes may stand before it. `name` how the message calls
    the argument. `hint` a likely cause, added to a shape message.

    **Raises:** `TypeError` for what is not a real number array, or is half precision (its 3 digits
    cannot hold a rotation); `ValueError` for a wrong shape.
    """
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"{name}: wanted an array of numbers, got {type(value).__name__}"
        ) from error
    if isinstance(value, np.ndarray) and value.dtype == np.float64 and array.dtype != np.float64:
        _warn_of_lost_digits()
    if jnp.issubdtype(array.dtype, jnp.integer):
        array = array.astype(jnp.result_type(float))
    if array.dtype not in (jnp.float32, jnp.float64):
        reason = " (half precision cannot hold a rotation)" if array.dtype.itemsize == 2 else ""
        raise TypeError(f"{name}: wanted float32 or float64, got {array.dtype}{reason}")
    found = array.shape[array.ndim - len(shape) :] if batched else array.shape
    if found != shape:
        advice = hint or (
            "functions take one body; batch with jax.vmap"
            if array.ndim > len(shape) and array.shape[array.ndim - len(shape) :] == shape
            else ""
        )
        raise ValueError(
            f"{name}: wanted shape {shape}, got {array.shape}" + (f"; {advice}" if advice else "")
        )
    return array


def same_batch(**arrays: tuple[Array, int]) -> None:
    """Refuse arrays whose leading axes, before the last `n` of each, differ.

    **Arguments:** `name=(array, n)`, for each part of one container. A container of many bodies has
    the same leading axes everywhere; one body has none.

    **Raises:** `ValueError`.
    """
    leading = {name: a.shape[: a.ndim - n] for name, (a, n) in arrays.items()}
    if len(set(leading.values())) > 1:
        found = ", ".join(f"{name} {a.shape}" for name, (a, _) in arrays.items())
        wanted = ", ".join(f"{name} {a.shape[a.ndim - n :]}" for name, (a, n) in arrays.items())
        raise ValueError(
            f"{', '.join(arrays)}: wanted one of each, {wanted}, or the same leading axes before "
            f"all of them, got shapes {found}"
        )


@functools.cache
def _warn_of_lost_digits() -> None:
    # Cached: once in a process.
    warnings.warn(
        "rigidjax: float64 numbers become float32, seven digits, because JAX's 64 bits are off; "
        "set jax.config.update('jax_enable_x64', True), or pass float32 if that is meant",
        stacklevel=4,
    )


def known(value: Any) -> bool:
    """Whether `value` is an array of known numbers, not one that is being traced."""
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value))


def namespace(value: Any) -> Any:
    """NumPy where `value` is known, else `jax.numpy`.

    A check of known numbers is done by NumPy on the host: a JAX operation outside `jit` costs some
    30 µs, ten of them more than a whole short simulation.
    """
    return np if known(value) else jnp


def refuse(value: Any, bad: Bool[ArrayLike, "..."], message: str) -> Any:
    """Return `value` unless `bad`; then raise with `message`, the same under `jit` and `vmap`.

    Outside a trace this is a `ValueError` with the bare text. Inside one it is
    `equinox.error_if`; the result must be used, or the check is dropped.
    """
    if known(bad):
        if bool(np.any(np.asarray(bad))):
            raise ValueError(message)
        return value
    return eqx.error_if(value, bad, message)


def finite(value: Float[Array, "..."], name: str) -> Float[Array, "..."]:
    """Return `value` unless it holds a NaN or an infinity."""
    xp = namespace(value)
    bad = ~xp.isfinite(value)
    where = ""
    if xp is np and bad.any():
        where = f" at index {tuple(int(i) for i in np.argwhere(bad)[0])}"
    return refuse(value, bad.any(), f"{name}: contains NaN or infinity{where}")
