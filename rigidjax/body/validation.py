"""Check that a real body can have the given mass and inertia; say what is wrong if none can.

Each check returns its argument and refuses numbers that no real body has: known values with a plain
exception that shows the numbers, traced values with `equinox.error_if`, without the numbers. A few
units of round-off are tolerated: plates, rods and points lie on the boundary and pass.
"""

from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from rigidjax import _checks
from rigidjax._types import Quat, Quaternion
from rigidjax.rotation import quaternion
from rigidjax.rotation.validation import require_near_unit, rotation_tolerance

# The tolerance of the checks, in units of round-off of the largest entry of a matrix. A tensor R I
# Rᵀ that a rotation R has turned has an error of about ten such units, and must pass.
_FORGIVEN = 64.0


def require_physical_mass(mass: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return the mass (...), kg. **Raises:** `ValueError` (`equinox` error under `jit`) if it is
    not positive and finite.
    """
    return _checks.require_positive(mass, "mass", "a positive mass (kg)")


def require_physical_inertia(tensor: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """Return the inertia tensor (..., 3, 3), kg m². **Raises:** `ValueError` (`equinox` error under
    `jit`) if it is not finite or not symmetric, or if no real body has its principal moments.
    """
    tensor = _require_symmetric(_checks.require_finite(tensor, "inertia tensor"), "inertia tensor")
    return _require_triangle_inequality(tensor, _eigenvalues(tensor))


def require_physical_moments(moments: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the principal moments (3,), kg m², which may be in any order. **Raises:** `ValueError`
    (`equinox` error under `jit`) if no real body has these moments.
    """
    if not _checks.is_known(moments) and _checks.is_known(plain := lax.stop_gradient(moments)):
        # The numbers are known, and are traced only to be differentiated: check them once by NumPy,
        # instead of by twenty compiled programs.
        require_physical_moments(plain)
        return moments
    moments = _checks.require_finite(moments, "principal moments")
    xp = np if _checks.is_known(moments) else jnp
    return _require_triangle_inequality(moments, xp.sort(_constant_for_checks(moments)))


def require_physical_second_moment(s: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """Return the second moment s = ∫ r rᵀ dm (..., 3, 3), kg m². **Raises:** `ValueError`
    (`equinox` error under `jit`) if it is not symmetric and positive semi-definite.
    """
    s = _require_symmetric(_checks.require_finite(s, "second moment"), "second moment")
    least, largest = (e := _eigenvalues(s))[..., 0], e[..., 2]
    got = (
        f", got principal second moments {_moments_as_text(e)} kg m²" if _checks.is_known(s) else ""
    )
    return _checks.error_if(
        s,
        (least < -_relative_round_off_tolerance(s) * largest).any() | (largest < 0).any(),
        "second moment 𝔖 = ∫ r rᵀ dm: wanted a positive semi-definite matrix (mass is not "
        f"negative){got}; is this an inertia tensor I? then use from_tensor (I = Tr(𝔖) 1 − 𝔖)",
    )


def require_single_body(
    value: object,
    kinds: type | tuple[type, ...],
    name: str,
    *,
    requirement: str = "",
    hint: str = "",
) -> Any:
    """Return `value` if it is one body (not a batch) of one of the classes `kinds`, and if a real
    body can have its mass and inertia.

    Numbers that no real body has raise `ValueError` if they are known, and become NaN if JAX traces
    them. A moment may be zero: a function that divides by the moments calls
    `require_physical_body`. The texts `name` (of the argument), `requirement` (what was wanted) and
    `hint` (a likely cause) are for messages.
    """
    body = _checks.require_unbatched_instance(
        value, kinds, name, requirement=requirement, hint=hint
    )
    has_mass = hasattr(body, "mass")
    tensor = body.inertia.tensor if has_mass else body.tensor
    return require_physical_body(
        body, tensor, body.mass if has_mass else None, throw=False, allow_zero_moment=True
    )


def require_symmetric_or_nan(a: Float[Array, "3 3"], name: str) -> Float[Array, "3 3"]:
    """Return the matrix `a` (3, 3) if it is symmetric to round-off. **Raises:** `ValueError` if it
    is not, unless JAX traces it; a traced matrix that is not symmetric becomes NaN. The text `name`
    names the matrix in the message.
    """
    if _checks.is_known(a):
        return _require_symmetric(a, name)
    return jnp.where(_largest_asymmetry_and_flag(a)[1], jnp.nan, a)


def require_physical_body(
    body: PyTree,
    tensor: Float[Array, "*batch 3 3"],
    mass: Array | None,
    throw: bool,
    *,
    allow_zero_moment: bool = False,
) -> Any:
    """Return `body` if a real body can have the inertia `tensor` and the `mass`, and if no
    principal moment is zero.

    If not, `ValueError` is raised for known numbers. For traced numbers an error of `equinox` is
    raised if `throw` is true; else every number of the body becomes NaN.

    - `body`: any tree of arrays, which is returned
    - `tensor`: (..., 3, 3) kg m², body frame
    - `mass`: (...) kg, or `None`
    - `throw`: whether wrong traced numbers raise an error
    - `allow_zero_moment`: whether a moment may be zero, as that of a rod about its axis
    """
    tensor = _checks.numeric_array(tensor, "inertia tensor")
    is_known = _checks.is_known((tensor, mass))
    if not is_known and _checks.is_known(plain := lax.stop_gradient((tensor, mass))):
        # The numbers are known, and are traced only to be differentiated: check them once by NumPy,
        # instead of by thirty compiled programs.
        faults = _zero_impossible_asymmetric_flags(np, plain[0], allow_zero_moment)
        if not any(f.any() for f in faults) and (mass is None or (np.asarray(plain[1]) > 0).all()):
            return body
    xp = np if is_known else jnp
    light = xp.asarray(False) if mass is None else ~(_constant_for_checks(mass) > 0)
    flat, broken, skew = _zero_impossible_asymmetric_flags(
        xp, tensor if is_known else lax.stop_gradient(tensor), allow_zero_moment
    )
    bad = light | flat | broken | skew
    if is_known:
        if bad.any():
            if mass is not None:
                require_physical_mass(mass)
            require_physical_inertia(tensor)
            _checks.error_if(
                body, True, f"{_FLAT} {_moments_as_text(_eigenvalues(tensor))} kg m²{_THIN}"
            )
        return body
    if not throw:
        nan = lambda a: jnp.where(bad.reshape(bad.shape + (1,) * (a.ndim - bad.ndim)), jnp.nan, a)  # noqa: E731
        return jax.tree.map(nan, body)
    which = jnp.where(skew.any(), 1, jnp.where(broken.any(), 2, 3))
    words = [_MASS, f"inertia tensor{_SKEW}{_CAUSE}", _BROKEN, f"{_FLAT}, or not a number{_THIN}"]
    return eqx.branched_error_if(body, bad.any(), jnp.where(light.any(), 0, which), words)


def index_of_first_impossible_inertia(
    tensors: Float[Array, "n 3 3"],
) -> Array | np.ndarray:
    """Return the index of the first of n matrices that cannot be the inertia tensor of a body, or
    that has a principal moment of zero. The index is a scalar, and −1 if there is no such matrix.

    A matrix with a NaN is skipped, since one such body must not stop a batch: the simulation of the
    batch gives this body the result `nonfinite_input`, and computes the other bodies.

    - `tensors`: (n, 3, 3) inertia tensors, kg m², that are not traced.
    """
    return _checks.first_bad_row(_are_impossible_inertias, tensors)


def _are_impossible_inertias(xp: ModuleType, tensors: Array | np.ndarray) -> Array | np.ndarray:
    """Return booleans (...), one for each matrix: true if the matrix cannot be the inertia tensor
    of a body, or if it has a principal moment of zero; false if it has an entry NaN.

    - `xp`: the module that computes, `numpy` or `jax.numpy`
    - `tensors`: (..., 3, 3) kg m², the matrices
    """
    flat, broken, skew = _zero_impossible_asymmetric_flags(xp, tensors, allow_zero_moment=False)
    return (flat | broken | skew) & ~xp.isnan(xp.asarray(tensors)).any(axis=(-1, -2))


_MASS = "mass: wanted a positive mass (kg), got zero, a negative one or NaN"
_SKEW = ": wanted a symmetric matrix, got A ≠ Aᵀ"
_CAUSE = "; a product of inertia is missing or mistyped; if it is noise, give 0.5 * (A + A.T)"
_BROKEN = (
    "inertia: wanted moments that are not negative and keep the triangle inequality I1 + I2 ≥ I3, "
    "got others: no distribution of mass has such moments. Is this a second moment 𝔖? then use "
    "from_second_moment"
)
_FLAT = "inertia: a principal moment is zero"
_THIN = (
    "; the equations of motion divide by it. A thin rod or a point does not resist turning about "
    "that axis: give it a thickness"
)


def _zero_impossible_asymmetric_flags(
    xp: ModuleType, tensor: Array | np.ndarray, allow_zero_moment: bool
) -> tuple[Any, Any, Any]:
    """Return three booleans (...) for each inertia tensor: whether a principal moment is zero or
    NaN; whether no real body can have its principal moments; and whether the tensor is not
    symmetric.

    The second value comes from the minors (subdeterminants) of the second moment 𝔖 = ½ Tr(I) 1 − I
    divided by the trace of I: a real body has an 𝔖 that is positive semi-definite.

    - `xp`: the module that computes, `numpy` or `jax.numpy`
    - `tensor`: (..., 3, 3) kg m², the inertia tensors
    - `allow_zero_moment`: whether a moment may be zero; if true, the first boolean is always false
    """
    slack = _relative_round_off_tolerance(tensor)
    # The nine entries are split by one operation, because nine slices would take NumPy ten times as
    # long.
    nine = xp.moveaxis(xp.asarray(tensor).reshape(*tensor.shape[:-2], 9), -1, 0)
    xx, xy, xz, yx, yy, yz, zx, zy, zz = np.ascontiguousarray(nine) if xp is np else nine
    trace = xx + yy + zz
    some = trace > 0
    scale = 1 / xp.where(some, trace, 1)
    xx, yy, zz, xy, xz, yz = (a * scale for a in (xx, yy, zz, xy, xz, yz))
    skew = (
        (abs(xy - yx * scale) > slack)
        | (abs(xz - zx * scale) > slack)
        | (abs(yz - zy * scale) > slack)
    )
    sx, sy, sz = 0.5 - xx, 0.5 - yy, 0.5 - zz
    squares = xy * xy, xz * xz, yz * yz
    product = 2 * xy * xz * yz
    minors = (sx * sy - squares[0], sx * sz - squares[1], sy * sz - squares[2])
    whole = sx * minors[2] - sy * squares[1] - sz * squares[0] - product
    broken = trace < 0
    for minor in (sx, sy, sz, *minors, whole):
        # The minors count only if the trace is positive (`some`): for any other trace, also NaN,
        # the entries are not divided by the trace, so that the minors mean nothing.
        broken = broken | (some & (minor < -slack))
    if allow_zero_moment:
        return broken & False, broken, skew
    # The least moment is the determinant divided by the product of the two larger moments. This
    # product is between 1/9 and 1/4 of the squared trace, which is 1 here; 1/8 is taken for every
    # body.
    determinant = xx * (yy * zz - squares[2]) - yy * squares[1] - zz * squares[0] + product
    return ~some | ~(determinant > 0.125 * slack), broken, skew


def is_physical_inertia(tensor: Float[Array, "*batch 3 3"]) -> Bool[Array, "*batch"]:
    """Return whether a real body can have the inertia `tensor` (..., 3, 3), kg m², and none of its
    principal moments is zero.
    """
    flat, broken, skew = _zero_impossible_asymmetric_flags(
        jnp, lax.stop_gradient(tensor), allow_zero_moment=False
    )
    return ~(flat | broken | skew)


def checked_attitude_quaternion(q: Quaternion) -> Quat:
    """Return a unit quaternion (w, x, y, z), scaled to length 1. **Raises:** `ValueError` for a
    quaternion, not traced by JAX, that is not finite or whose length differs from 1 by more than
    1e-6 (float32: 1e-3).
    """
    q = _checks.finite_array(q, (4,), "q", hint="a quaternion is (w, x, y, z)")
    return quaternion.normalise(require_near_unit(q, "q", rotation_tolerance(q.dtype)))


def _require_triangle_inequality(value: Array, moments: Array | np.ndarray) -> Array:
    """Return `value`. **Raises:** `ValueError` (`equinox` error under `jit`) if a principal moment
    is negative, or if the moments break the triangle inequality I1 + I2 ≥ I3.

    - `value`: the array to return: an inertia tensor (..., 3, 3) or principal moments, kg m²
    - `moments`: (..., 3) kg m², its principal moments in ascending order
    """
    m1, m2, m3 = moments[..., 0], moments[..., 1], moments[..., 2]
    moments_text = f" {_moments_as_text(moments)} kg m²" if _checks.is_known(value) else ""
    slack = _relative_round_off_tolerance(value) * abs(m3)
    value = _checks.error_if(
        value,
        (m1 < -slack).any() | (m3 < 0).any(),
        f"inertia: wanted moments that are not negative, got{moments_text or ' a negative one'}; "
        "possible causes: an inside-out mesh, or a product of inertia with the wrong sign",
    )
    short = f" ({float(np.max(m3 - m1 - m2)):.3g} too large)" if _checks.is_known(value) else ""
    return _checks.error_if(
        value,
        (m3 - m1 - m2 > slack).any(),
        f"inertia: the moments{moments_text} break the triangle inequality I1 + I2 ≥ I3: the "
        "largest may "
        f"not exceed the sum of the other two{short}; no distribution of mass has such moments. "
        "Is this a second moment 𝔖? then use from_second_moment",
    )


def _largest_asymmetry_and_flag(a: Array) -> tuple[Any, Any]:
    """Return two things about matrices A = `a` (..., 3, 3), any unit: the largest entry of |A −
    Aᵀ| of each matrix, (...); and one boolean, whether this entry exceeds round-off in any matrix.
    """
    difference = abs(_constant_for_checks(a) - _constant_for_checks(a).swapaxes(-1, -2)).max(
        axis=(-1, -2)
    )
    return difference, (
        difference
        > _relative_round_off_tolerance(a) * abs(_constant_for_checks(a)).max(axis=(-1, -2))
    ).any()


def _require_symmetric(a: Array, name: str) -> Array:
    """Return the matrices `a` (..., 3, 3). **Raises:** `ValueError` (`equinox` error under `jit`)
    if they are not symmetric to round-off; the text `name` names the matrices in the message.
    """
    difference, bad = _largest_asymmetry_and_flag(a)
    difference_text = (
        f" (largest difference {float(difference.max()):.3g})" if _checks.is_known(a) else ""
    )
    return _checks.error_if(
        a,
        bad,
        f"{name}{_SKEW}{difference_text}{_CAUSE}",
    )


def _constant_for_checks(a: Array) -> Array | np.ndarray:
    """Return the array `a` as a constant, whose derivatives are zero: as an array of JAX if JAX
    traces it, else as an array of NumPy, with which a check takes only microseconds.
    """
    return np.asarray(a) if _checks.is_known(a) else lax.stop_gradient(a)


def _eigenvalues(a: Array) -> Array | np.ndarray:
    """Return the eigenvalues (..., 3), ascending, of symmetric matrices `a` (..., 3, 3), as
    constants whose derivatives are zero. NumPy computes them unless JAX traces the matrices.
    """
    if _checks.is_known(a):
        return np.linalg.eigvalsh(np.asarray(a))
    scale = jnp.abs(a).max(axis=(-1, -2), keepdims=True)
    scale = lax.stop_gradient(jnp.where(scale > 0, scale, 1))
    return jnp.linalg.eigvalsh(lax.stop_gradient(a) / scale) * scale[..., 0]


def _relative_round_off_tolerance(a: Array | np.ndarray) -> float:
    """Return the relative error that a check tolerates in an array `a`: 64 times the unit of
    round-off of its dtype.
    """
    return float(_FORGIVEN * jnp.finfo(a.dtype).eps)


def _moments_as_text(moments: Array | np.ndarray) -> str:
    """Return principal moments as a text for messages, such as "(1, 2, 3)".

    - `moments`: (3,) kg m², or (n, 3) for n bodies, of which the first three are shown
    """
    return "; ".join(
        "(" + ", ".join(f"{float(x):.6g}" for x in row) + ")"
        for row in np.asarray(moments).reshape(-1, 3)[:3]
    )
