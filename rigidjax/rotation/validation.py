"""Check input: refuse matrices and quaternions that are no rotation.

The functions of `quaternion` and `so3` do not check traced values: the checks would make a batch of
1e5 logarithms five times slower. `so3.check` and `quaternion.check` check all values, inside and
outside of `jit`; call these functions on data from outside.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks


def rotation_tolerance(dtype: object) -> float:
    """Return the largest error that checks of a rotation tolerate, of the length of a quaternion or
    of an entry of MᵀM for a matrix M.
    """
    return 1e-6 if dtype == jnp.float64 else 1e-3


def require_direction(v: Float[Array, "n"], name: str) -> Float[Array, "n"]:
    """Return `v`; raise `ValueError` if it is known to be zero, NaN or infinite.

    Entries that are all below the least normal number of the dtype, 2e-308 in float64, count as
    zero, because XLA on some machines takes such numbers for zero.
    """
    if (
        _checks.is_known(v)
        and not (least := float(jnp.finfo(v.dtype).tiny)) <= _largest_entry(v) < np.inf
    ):
        _checks.require_finite(v, name)
        got = (
            "zero" if _largest_entry(v) == 0 else f"less than the least normal number, {least:.2g}"
        )
        raise ValueError(f"{name}: wanted a direction, got {got}")
    return v


def require_turn(v: Float[Array, "*n"], name: str) -> Float[Array, "*n"]:
    """Return the rotation vector or angle `v`, rad, or raise a `ValueError` if it is known and so
    large that no digit of the rotation is correct.
    """
    if _checks.is_known(v) and not _largest_entry(v) <= (
        limit := 1 / float(jnp.finfo(v.dtype).eps)
    ):
        _checks.require_finite(v, name)
        raise ValueError(
            f"{name}: a turn by {_largest_entry(v):.3g} rad; beyond {limit:.2g} rad "
            f"neighbouring {v.dtype} numbers are more than half a radian apart: the attitude is "
            "unknown; leave out whole turns before, or check the unit"
        )
    return v


def _largest_entry(v: Float[Array, "*n"]) -> float:
    """Return the largest absolute value of the entries of a known array."""
    # The result is NaN if an entry is NaN. The function makes one call of NumPy only, because it
    # runs before every conversion that is called outside of `jit`.
    return float(np.abs(np.asarray(v)).max())


def require_rotation(m: Float[Array, "*batch 3 3"], name: str) -> Float[Array, "*batch 3 3"]:
    """Return the matrices, or raise an error, also under `jit`, if any of them is no rotation."""
    m = _checks.require_finite(m, name)
    known = _checks.is_known(m)
    xp, values = (np, np.asarray(m)) if known else (jnp, m)
    rows = [values[..., i, :] for i in range(3)]
    # Entries of 1e200 are refused like other wrong entries, without a warning of NumPy.
    with np.errstate(over="ignore", invalid="ignore"):
        det = (rows[0] * xp.cross(rows[1], rows[2])).sum(-1)
        gram = (values[..., :, :, None] * values[..., :, None, :]).sum(-3)
    got = f", det = {det.min():.4g}" if known else ""
    words = f"left-handed frame{got}; a rotation has det = +1 (an axis flipped or swapped?)"
    m = _checks.error_if(m, (det < 0).any(), f"{name}: {words}")
    error = abs(gram - xp.eye(3, dtype=values.dtype).reshape((1,) * (values.ndim - 2) + (3, 3)))
    limit = rotation_tolerance(values.dtype)
    got = f" is {error.max():.3g}" if known else " is too large"
    words = f"{name}: not orthogonal, the largest entry of |MᵀM − 1|{got} (limit {limit:g}); "
    words += "so3.project gives the nearest rotation"
    return _checks.error_if(m, ~(error.max() <= limit), words)


def require_near_unit(q: Float[Array, "4"], name: str, limit: float) -> Float[Array, "4"]:
    """Return `q`; raise `ValueError` if it is known and ||q| − 1| is above the `limit`."""
    if _checks.is_known(q):
        length = float(np.linalg.norm(np.asarray(q, float)))
        words = f"{name}: wanted a unit quaternion (w, x, y, z), got one of length {length:.6g}"
        words += "; rigidjax.quaternion.normalise makes it one"
        _checks.error_if(q, not abs(length - 1) <= limit, words)
    return q


def require_unit(q: Float[Array, "*batch 4"], name: str) -> Float[Array, "*batch 4"]:
    """Return `q` at length 1; raise an error, also under `jit`, if |q| is far from 1."""
    q = _checks.require_finite(q, name)
    # Known numbers are checked by NumPy: under `jit`, JAX would trace also what is computed from
    # known numbers, and the check could not be made at once.
    xp = _checks.array_module(q)
    with np.errstate(over="ignore"):
        length = xp.sqrt((xp.asarray(q) ** 2).sum(-1, keepdims=True))
    words = f"{name}: zero quaternion; it is no rotation (w, x, y, z)"
    q = _checks.error_if(q, (length == 0).any(), words)
    off = xp.abs(length - 1)
    limit = rotation_tolerance(q.dtype)
    got = f", its length is {length.ravel()[off.argmax()]:.6g}" if xp is np else ""
    words = f"{name}: not a unit quaternion{got} (limit 1 ± {limit:g}); use quaternion.normalise"
    q = _checks.error_if(q, ~(off.max() <= limit), words)
    return q / length
