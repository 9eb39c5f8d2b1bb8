"""Check the arguments of `simulate` before anything is integrated."""

import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from rigidjax import _checks
from rigidjax._types import HasAttitude
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.body.validation import require_physical_body
from rigidjax.frames import AbstractScene, BodyInFrame, MovingFrame, Point
from rigidjax.frames.frame_dynamics import scene_of_force
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.torques import ChangingInertia, GravityGradient
from rigidjax.motion.torques.base import require_state_type
from rigidjax.motion.torques.composite import parts_of
from rigidjax.rotation.validation import rotation_tolerance


def checked_body_state_and_times(
    body: Any, state0: Any, ts: Any, torque: Any, throw: bool
) -> tuple[Any, Any, Array]:
    """Return the body, the state at the start and the times of a run, after a check of all three.

    **Arguments:**

    - `body`, `state0`, `ts`, `torque`: the arguments of `simulate` with these names.
    - `throw`: whether invalid numbers raise an error. With `False` invalid traced numbers become
      NaN instead; known invalid numbers raise an error in any case.

    **Returns** three things: the body; the state at the start; and the times (T,), s, in the same
    dtype as the state.
    """
    ts = checked_times(ts, throw)
    state0 = checked_start(state0, throw)
    dtype = ts.dtype
    for leaf in jax.tree.leaves(state0):
        dtype = jnp.promote_types(dtype, leaf.dtype)
    # Arrays that already have the common dtype `dtype` are not converted: outside of `jit` even a
    # conversion to the same dtype costs as much as a step.
    ts, state0 = jax.tree.map(
        lambda leaf: leaf if leaf.dtype == dtype else leaf.astype(dtype), (ts, state0)
    )
    require_compatible_types(body, state0, torque)
    warn_of_unknown_inertia_scale(body, torque)
    if body is not None:
        body = real_or_nan(body, throw)
    return body, state0, ts


def require_compatible_types(body: Any, state0: Any, torque: Any) -> None:
    """Raise `TypeError` unless the body, the type of the state and the torque fit together.

    The arguments are those of `simulate` with the same names.
    """
    if isinstance(state0, Point) and body is not None:
        raise TypeError(
            "body: wanted None, because a Point is no body and has no inertia; got "
            f"{type(body).__name__}"
        )
    if isinstance(torque, AbstractScene | MovingFrame) and not isinstance(state0, Point):
        raise TypeError(
            f"{type(torque).__name__} moves a Point: wanted Point(x, v), got "
            f"{type(state0).__name__}; frames.BodyInFrame is for a body in a moving frame"
        )
    if isinstance(state0, Point):
        scene_of_force(torque)
    if torque is not None and not isinstance(torque, AbstractScene | MovingFrame):
        require_state_type(torque, state0)
        _refuse_inertial_law_in_moving_frame(torque)
    if isinstance(state0, Rigid) and not isinstance(body, MassProperties):
        raise TypeError(
            f"Rigid moves as well as turns: wanted MassProperties, got {type(body).__name__}"
            + _advice_to_make_body_of_numbers(body, moves=True)
        )
    if not isinstance(state0, Rigid | Point) and not isinstance(body, Inertia):
        raise TypeError(
            f"{type(state0).__name__} only turns: wanted Inertia, got {type(body).__name__}"
            + (
                "; pass body.inertia"
                if isinstance(body, MassProperties)
                else _advice_to_make_body_of_numbers(body)
            )
        )
    if body is not None:
        _checks.require_unbatched_instance(body, type(body), "body")


def _refuse_inertial_law_in_moving_frame(torque: Any) -> None:
    """Raise `TypeError` if a torque needs the absolute body rate but also has a `BodyInFrame`.

    The absolute body rate is the rate relative to an inertial frame. The law `BodyInFrame` is for a
    body in a moving frame, such as that of an orbit, where the state has the body rate relative to
    this frame. A torque may therefore not contain both a `BodyInFrame` and a law that needs the
    absolute body rate. Such a law is a `ChangingInertia`, or a law with an internal momentum.

    - `torque`: the torque law, which may consist of several laws.
    """

    def within(law: Any) -> list[Any]:
        inner = [p.torque for p in parts_of(law) if isinstance(p, BodyInFrame | ChangingInertia)]
        return [*parts_of(law), *(part for one in inner for part in within(one))]

    laws = within(torque)
    for law in laws if any(isinstance(law, BodyInFrame) for law in laws) else ():
        if hasattr(law, "internal_momentum") or isinstance(law, ChangingInertia):
            raise TypeError(
                f"{type(law).__name__} needs the body rate in an inertial frame, got one in a "
                "moving frame (BodyInFrame, libration); solve in an inertial frame. For a body in "
                "orbit give the torque GravityGradient(mu, position), where position is a function "
                "of time"
            )


def common_dtype(tree: Any, name: str) -> Any:
    """Return the dtype that all arrays of a tree have; raise `TypeError` if they have several.

    The message of the error begins with `name`.
    """
    kinds = {jnp.result_type(leaf) for leaf in jax.tree.leaves(tree)}
    if len(kinds) != 1:
        found = ", ".join(sorted(map(str, kinds)))
        raise TypeError(f"{name}: wanted arrays of one dtype, got {found}; convert them to one")
    return kinds.pop()


def warn_of_unknown_inertia_scale(body: Any, torque: Any) -> None:
    """Warn if a torque in N m acts on a body whose inertia is known only up to a factor.

    The gravity gradient without harmonics needs no warning, because it is proportional to the
    inertia. `torque` is the torque law, or `None` for a free body.
    """
    relative = isinstance(body, Inertia) and body.scale is not None
    alike = isinstance(torque, GravityGradient) and not torque.harmonics
    if relative and torque is not None and not alike:
        warnings.warn(
            f"the body has an arbitrary scale, and {type(torque).__name__} gives N m; take "
            "rj.Inertia(size * body.tensor) with the size in kg m²",
            stacklevel=5,
        )


def _advice_to_make_body_of_numbers(numbers: Any, moves: bool = False) -> str:
    """Return the end of an error message, for a user who gave bare numbers in the place of a body.

    The text says how to make a body from the `numbers`. The body is a `MassProperties` if `moves`
    is true (it also moves in space), else an `Inertia`. If `numbers` is not an array, a list or a
    tuple, the text is empty.
    """
    if not isinstance(numbers, (list, tuple, np.ndarray, jax.Array)):
        return ""
    if moves:
        return "; rj.MassProperties(mass, com, second_moment) makes one, rj.shapes a solid"
    moments = np.shape(numbers) == (3,)
    return f"; rj.Inertia{'.from_principal(*moments)' if moments else '(tensor)'} makes one of them"


def real_or_nan(body: Inertia | MassProperties, throw: bool = False) -> Any:
    """Return a body after a check that a real body can have its mass and inertia.

    The numbers of an impossible body become NaN. If `throw` is true, or if the numbers are not
    traced, an impossible body raises an error instead.
    """
    matter = isinstance(body, MassProperties)
    tensor = body.inertia.tensor if matter else body.tensor
    return require_physical_body(body, tensor, body.mass if matter else None, throw)


def checked_tolerances(rtol: Any, atol: Any, dtype: Any) -> tuple[Any, Any]:
    """Return the relative and the absolute tolerance of a run, after a check.

    A tolerance of `None` gets the value that suits the `dtype` of the run. Traced tolerances are
    not checked. Raise `ValueError` if `rtol` is not positive, if `atol` is negative, or if one of
    them is not finite. If `rtol` is smaller than the dtype can reach, warn, and return the smallest
    `rtol` that the dtype can reach.
    """
    double = dtype == jnp.float64
    usual = (1e-9, 1e-12) if double else (2e-5, 1e-7)
    if rtol is None and atol is None:
        return usual
    rtol, atol = (u if g is None else g for u, g in zip(usual, (rtol, atol), strict=True))
    if not _checks.is_known((rtol, atol)):
        return jnp.asarray(rtol, dtype), jnp.asarray(atol, dtype)
    # Known tolerances become Python floats, because NumPy floats would promote a float32 run to
    # float64.
    rtol, atol = _checks.python_float(rtol, "rtol"), _checks.python_float(atol, "atol")
    if not 0 < rtol < np.inf or not 0 <= atol < np.inf:
        raise ValueError(f"simulate: wanted rtol > 0 and atol >= 0, got rtol={rtol}, atol={atol}")
    floor = 100 * float(jnp.finfo(dtype).eps)
    # A relative tolerance below `floor`, which depends on the dtype, cannot be met: the steps would
    # shrink until `max_steps` ends the run.
    if rtol < floor:
        advice = "" if double else "; set jax.config.update('jax_enable_x64', True) for float64"
        warnings.warn(
            f"simulate: {np.dtype(dtype).name} cannot reach rtol={rtol:g}; "
            f"using {floor:.2g}{advice}",
            stacklevel=4,
        )
        rtol = floor
    return rtol, atol


def checked_times(ts: Any, throw: bool) -> Array:
    """Return the saved times of a run as an array (T,), s, after a check.

    The times must increase, or decrease, throughout, and there must be two at least. Other times
    raise an error; if they are traced and `throw` is false, they become NaN instead.
    """
    if isinstance(ts, (Spin, Attitude, Rigid, Point)):
        raise TypeError(f"ts: wanted times, got {type(ts).__name__}; the state comes before them")
    try:
        length = np.shape(ts)
    except ValueError:
        length = ()
    if len(length) != 1 or length[0] < 2:
        raise ValueError(f"ts: wanted at least two times, shape (T,), got shape {length}")
    found = _checks.array_of_shape(ts, length, "ts")
    if throw or _checks.is_known(found):
        found = _checks.require_finite(found, "ts")
    xp = _checks.array_module(found)
    numbers = xp.asarray(found)
    back = numbers[-1] < numbers[0]
    ahead = xp.where(back, numbers[:-1] > numbers[1:], numbers[1:] > numbers[:-1])
    if xp is not np:
        words = "ts: wanted increasing times, or decreasing ones throughout"
        return _error_or_nan_if_bad(found, ~ahead.all(), words, throw)
    where = ""
    if not ahead.all():
        i = int(np.argmin(ahead)) + 1
        where = f"; ts[{i}] is not {'below' if back else 'above'} the one before"
        if _checks.is_known(ts) and (float(ts[i]) - float(ts[i - 1])) * (-1 if back else 1) > 0:
            where += (
                f" in {found.dtype}, which cannot tell {ts[i - 1]!r} from {ts[i]!r}: "
                + _checks.advice_on_times(found.dtype)
            )
    kind = "decreasing" if back else "increasing"
    return _error_or_nan_if_bad(found, ~ahead.all(), f"ts: wanted {kind} times{where}", throw)


def checked_first_step(dt0: Any, times: Array) -> Array:
    """Return the length of the first step that the user gave as `dt0`, s, after a check.

    `times` (T,), s, are the saved times, whose precision the length gets. If the value of `dt0` is
    known, raise `ValueError` if it is zero, not finite, too short for the precision, or negative in
    a run forwards in time.
    """
    step = _checks.array_of_shape(dt0, (), "dt0").astype(times.dtype)
    known = _checks.is_known(times)
    if not _checks.is_known(step):
        return jnp.abs(step)
    back = not known or bool(times[-1] < times[0])
    if not 0 < abs(float(step)) < np.inf or (float(step) < 0 and not back):
        raise ValueError(
            f"dt0: wanted a positive step, s, got {dt0}; to go back in time give decreasing ts"
        )
    if known:
        far = np.abs(np.asarray(times)).max()
        gap = float(np.spacing(far))
        if abs(float(step)) < 8 * gap:
            raise ValueError(
                f"dt0: steps of {dt0} s are too short for {times.dtype}, whose times near "
                f"{float(far):g} s are {gap:.2g} s apart; " + _checks.advice_on_times(times.dtype)
            )
    return abs(step)


def checked_start(state0: Any, throw: bool) -> Any:
    """Return the state at the start of a run after a check.

    The state must be that of one body, with finite numbers; a quaternion must have the length 1. An
    invalid state raises an error. With `throw=False` a traced quaternion whose length is not 1
    becomes NaN instead, and traced numbers that are not finite are left as they are.
    """
    wanted = "Spin, Attitude or Rigid, or Point without a body"
    _checks.require_unbatched_instance(
        state0, (Spin, Attitude, Rigid, Point), "state0", requirement=wanted
    )
    named, tree = jax.tree.flatten_with_path(state0)
    leaves = [
        _checks.require_finite(leaf, str(path[-1]).lstrip("."))
        if throw or _checks.is_known(leaf)
        else leaf
        for path, leaf in named
    ]
    state0 = tree.unflatten(leaves)
    if isinstance(state0, HasAttitude):
        xp = _checks.array_module(state0.q)
        off = xp.abs(xp.sqrt(xp.sum(xp.square(state0.q))) - 1)
        q = _error_or_nan_if_bad(
            state0.q,
            off > rotation_tolerance(state0.q.dtype),
            "q: wanted a unit quaternion (w, x, y, z), got one whose length is not 1; normalise it "
            "with rigidjax.quaternion.normalise, and mind that the scalar comes first",
            throw,
        )
        state0 = eqx.tree_at(lambda s: s.q, state0, q)
    return state0


def _error_or_nan_if_bad(value: Array, bad: Any, message: str, throw: bool) -> Array:
    """Return an array after a check: if it is bad, raise an error, or return NaN in its place.

    **Arguments:**

    - `value`: the array that was checked.
    - `bad`: whether the array is bad, a truth value, which may be traced.
    - `message`: the message of the error.
    - `throw`: whether a bad array raises an error even if `bad` is traced. With `False` and a
      traced `bad`, NaN is returned, because one bad body in a batch must not end the runs of the
      other bodies. If `bad` is not traced, a bad array raises an error in any case.
    """
    if throw or _checks.is_known(bad):
        return _checks.error_if(value, bad, message)
    return jnp.where(bad, jnp.full_like(value, jnp.nan), value)
