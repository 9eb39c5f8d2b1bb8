"""Check that a real body can have the given mass and inertia; say what is wrong if none can.

Each check returns its argument and refuses numbers that no real body has: known values with a plain
exception that shows the numbers, traced values with `equinox.error_if`, without the numbers. A few
units of round-off are tolerated: plates, rods and points lie on the boundary and pass.
"""

from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from rigidjax import _checks
from rigidjax._types import Quat, Quaternion
from rigidjax.rotation import quaternion
from rigidjax.rotation.validation import require_near_unit, rotation_tolerance

# The tolerance of the checks, in units of round-off of the largest entry of a matrix. A tensor R I
# Rᵀ that a rotation R has turned has an error of about ten such units, and must pass.
_FORGIVEN = 64.0


def require_physical_mass(mass: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return the mass, or raise an error if it is not positive and finite."""
    return _checks.require_positive(mass, "mass", "a positive mass (kg)")


def require_physical_inertia(tensor: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """Return the inertia tensor, kg m², or raise an error if it is not finite or symmetric, or if
    no real body has its principal moments.
    """
    tensor = _require_symmetric(_checks.require_finite(tensor, "inertia tensor"), "inertia tensor")
    return _require_triangle(tensor, _eigenvalues(tensor))


def require_physical_moments(moments: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return principal moments, kg m², in any order; raise an error if no body has them."""
    if not _checks.is_known(moments) and _checks.is_known(plain := lax.stop_gradient(moments)):
        # The numbers are known, and are traced only to be differentiated: check them once by NumPy,
        # instead of by twenty compiled programs.
        require_physical_moments(plain)
        return moments
    moments = _checks.require_finite(moments, "principal moments")
    xp = np if _checks.is_known(moments) else jnp
    return _require_triangle(moments, xp.sort(_constant(moments)))


def require_second_moment(s: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """Return the second moment ∫ r rᵀ dm, kg m², if symmetric and positive semi-definite."""
    s = _require_symmetric(_checks.require_finite(s, "second moment"), "second moment")
    least, largest = (e := _eigenvalues(s))[..., 0], e[..., 2]
    got = f", got principal second moments {_text(e)} kg m²" if _checks.is_known(s) else ""
    return _checks.error_if(
        s,
        (least < -_relative_tolerance(s) * largest).any() | (largest < 0).any(),
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
    """Return `value` if it is a single body of one of the classes `kinds`, and a possible one.

    Impossible numbers raise an error if they are known, and become NaN if they are traced. A moment
    may be zero: a function that divides by the moments calls `require_physical_body`. The other
    texts are for messages.
    """
    body = _checks.require_unbatched_instance(
        value, kinds, name, requirement=requirement, hint=hint
    )
    return require_physical_body(body, throw=False, allow_zero_moment=True)


def require_symmetric_or_nan(a: Float[Array, "3 3"], name: str) -> Float[Array, "3 3"]:
    """Return the matrix if it is symmetric to round-off; else raise an error if it is known, and
    return NaN if it is traced.
    """
    if _checks.is_known(a):
        return _require_symmetric(a, name)
    return jnp.where(_asymmetry(a)[1], jnp.nan, a)


def require_physical_body(body: Any, throw: bool, *, allow_zero_moment: bool = False) -> Any:
    """Return an `Inertia` or `MassProperties` if a real body can have its inertia and mass, and if
    no principal moment is zero or zero is allowed.

    If not, an error is raised for known numbers, and for traced ones if `throw` is true; else every
    number of the body becomes NaN.
    """
    mass = getattr(body, "mass", None)
    tensor = body.tensor if mass is None else body.inertia.tensor
    tensor = _checks.numeric_array(tensor, "inertia tensor")
    is_known = _checks.is_known((tensor, mass))
    if not is_known and _checks.is_known(plain := lax.stop_gradient((tensor, mass))):
        # The numbers are known, and are traced only to be differentiated: check them once by NumPy,
        # instead of by thirty compiled programs.
        faults = _faults(np, plain[0], allow_zero_moment)
        if not any(f.any() for f in faults) and (mass is None or (np.asarray(plain[1]) > 0).all()):
            return body
    xp = np if is_known else jnp
    light = xp.asarray(False) if mass is None else ~(_constant(mass) > 0)
    flat, broken, skew = _faults(
        xp, tensor if is_known else lax.stop_gradient(tensor), allow_zero_moment
    )
    bad = light | flat | broken | skew
    if is_known:
        if bad.any():
            if mass is not None:
                require_physical_mass(mass)
            require_physical_inertia(tensor)
            _checks.error_if(body, True, f"{_FLAT} {_text(_eigenvalues(tensor))} kg m²{_THIN}")
        return body
    if not throw:
        nan = lambda a: jnp.where(bad.reshape(bad.shape + (1,) * (a.ndim - bad.ndim)), jnp.nan, a)  # noqa: E731
        return jax.tree.map(nan, body)
    which = jnp.where(skew.any(), 1, jnp.where(broken.any(), 2, 3))
    words = [_MASS, f"inertia tensor{_SKEW}{_CAUSE}", _BROKEN, f"{_FLAT}, or not a number{_THIN}"]
    return eqx.branched_error_if(body, bad.any(), jnp.where(light.any(), 0, which), words)


def first_impossible_inertia(
    tensors: Float[Array, "n 3 3"],
) -> Array | np.ndarray:
    """Return the index of the first of n known inertia tensors that no body can have, or that has a
    moment of zero; −1 if there is none.

    A matrix with a NaN is skipped, since one such body must not stop a batch: the simulation of the
    batch gives this body the result `nonfinite_input`, and computes the other bodies.
    """

    def impossible(xp: ModuleType, tensors: Array | np.ndarray) -> Array | np.ndarray:
        flat, broken, skew = _faults(xp, tensors, allow_zero_moment=False)
        return (flat | broken | skew) & ~xp.isnan(xp.asarray(tensors)).any(axis=(-1, -2))

    return _checks.first_bad_row(impossible, tensors)


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


class Faults(NamedTuple):
    """Hold, for each of some inertia tensors, whether it has one of three faults."""

    flat: Any  # a principal moment is zero or NaN
    broken: Any  # no real body can have the principal moments
    skew: Any  # the tensor is not symmetric


def _faults(xp: ModuleType, tensor: Array | np.ndarray, allow_zero_moment: bool) -> Faults:
    """Return the faults of inertia tensors; none is flat if `allow_zero_moment` is true.

    Moments that no body can have show in the minors (subdeterminants) of the second moment 𝔖 = ½
    Tr(I) 1 − I divided by the trace of I: a real body has an 𝔖 that is positive semi-definite.
    """
    slack = _relative_tolerance(tensor)
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
        return Faults(broken & False, broken, skew)
    # The least moment is the determinant divided by the product of the two larger moments. This
    # product is between 1/9 and 1/4 of the squared trace, which is 1 here; 1/8 is taken for every
    # body.
    determinant = xx * (yy * zz - squares[2]) - yy * squares[1] - zz * squares[0] + product
    return Faults(~some | ~(determinant > 0.125 * slack), broken, skew)


def is_physical_inertia(tensor: Float[Array, "*batch 3 3"]) -> Bool[Array, "*batch"]:
    """Return whether a body can have the inertia tensor, kg m², and no moment is zero."""
    flat, broken, skew = _faults(jnp, lax.stop_gradient(tensor), allow_zero_moment=False)
    return ~(flat | broken | skew)


def unit_attitude(q: Quaternion) -> Quat:
    """Return a quaternion at length 1; raise an error if it is known and not of unit length."""
    q = _checks.finite_array(q, (4,), "q", hint="a quaternion is (w, x, y, z)")
    return quaternion.normalise(require_near_unit(q, "q", rotation_tolerance(q.dtype)))


def _require_triangle(value: Array, moments: Array | np.ndarray) -> Array:
    """Return `value`, or raise an error if its ascending principal moments, kg m², are negative or
    break the triangle inequality.
    """
    m1, m2, m3 = moments[..., 0], moments[..., 1], moments[..., 2]
    moments_text = f" {_text(moments)} kg m²" if _checks.is_known(value) else ""
    slack = _relative_tolerance(value) * abs(m3)
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


def _asymmetry(a: Array) -> tuple[Any, Any]:
    """Return the largest entry of |A − Aᵀ| of each matrix, and whether any exceeds round-off."""
    fixed = _constant(a)
    difference = abs(fixed - fixed.swapaxes(-1, -2)).max(axis=(-1, -2))
    largest = abs(fixed).max(axis=(-1, -2))
    return difference, (difference > _relative_tolerance(a) * largest).any()


def _require_symmetric(a: Array, name: str) -> Array:
    """Return the matrices, or raise an error if they are not symmetric to round-off."""
    difference, bad = _asymmetry(a)
    known = _checks.is_known(a)
    text = f" (largest difference {float(difference.max()):.3g})" if known else ""
    return _checks.error_if(a, bad, f"{name}{_SKEW}{text}{_CAUSE}")


def _constant(a: Array) -> Array | np.ndarray:
    """Return an array as a constant, of NumPy if it is known: a check then takes microseconds."""
    return np.asarray(a) if _checks.is_known(a) else lax.stop_gradient(a)


def _eigenvalues(a: Array) -> Array | np.ndarray:
    """Return ascending eigenvalues of symmetric matrices as constants, of NumPy if known."""
    if _checks.is_known(a):
        return np.linalg.eigvalsh(np.asarray(a))
    scale = jnp.abs(a).max(axis=(-1, -2), keepdims=True)
    scale = lax.stop_gradient(jnp.where(scale > 0, scale, 1))
    return jnp.linalg.eigvalsh(lax.stop_gradient(a) / scale) * scale[..., 0]


def _relative_tolerance(a: Array | np.ndarray) -> float:
    """Return the relative error that a check tolerates in an array."""
    return float(_FORGIVEN * jnp.finfo(a.dtype).eps)


def _text(moments: Array | np.ndarray) -> str:
    """Return principal moments, of at most three bodies, as a text such as "(1, 2, 3)"."""
    return "; ".join(
        "(" + ", ".join(f"{float(x):.6g}" for x in row) + ")"
        for row in np.asarray(moments).reshape(-1, 3)[:3]
    )
