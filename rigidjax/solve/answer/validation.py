"""Check the arguments of `simulate` before anything is integrated."""

import warnings
from typing import Any, NamedTuple

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
from rigidjax.motion import Attitude, Rigid, Spin, Turn
from rigidjax.motion.suspension import AbstractSuspension
from rigidjax.motion.torques import ChangingInertia, GravityGradient
from rigidjax.motion.torques.base import require_state_type
from rigidjax.motion.torques.composite import parts_of
from rigidjax.rotation.validation import rotation_tolerance


class Checked(NamedTuple):
    """Hold the checked arguments of a run."""

    body: Any
    state0: Any
    ts: Array  # (T,), s, in the dtype of the state


def checked_run(body: Any, state0: Any, ts: Any, torque: Any, throw: bool) -> Checked:
    """Return body, start and times of a run in one dtype, after a check of all three.

    Unless `throw`, invalid traced numbers become NaN; known ones raise an error in any case.
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
    require_compatible(body, state0, torque)
    warn_of_relative_inertia(body, torque)
    if body is not None:
        hangs = isinstance(state0, Turn)
        body = require_physical_body(body, throw, allow_zero_moment=hangs)
    return Checked(body, state0, ts)


def require_compatible(body: Any, state0: Any, torque: Any) -> None:
    """Raise `TypeError` unless body, type of the state and torque of a run fit together."""
    if isinstance(state0, Turn) != isinstance(torque, AbstractSuspension):
        raise TypeError(
            "a Turn and a suspension go together: wanted a Turn(angle, rate) and a suspension of "
            f"rigidjax.suspensions, such as Axle(axis, point), got {type(state0).__name__} and "
            f"{_checks.type_name(torque)}; other torques go into the suspension, torque=…"
        )
    if isinstance(torque, AbstractSuspension):
        torque.require_body(body)
        return
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
        laws = _laws_within(torque)
        # In a moving frame the state has the rate relative to it; these laws need the absolute one.
        for law in laws if any(isinstance(law, BodyInFrame) for law in laws) else ():
            if hasattr(law, "internal_momentum") or isinstance(law, ChangingInertia):
                raise TypeError(
                    f"{type(law).__name__} needs the body rate in an inertial frame, got one in a "
                    "moving frame (BodyInFrame, libration); solve in an inertial frame. For a body "
                    "in orbit give the torque GravityGradient(mu, position), where position is a "
                    "function of time"
                )
    if isinstance(state0, Rigid) and not isinstance(body, MassProperties):
        raise TypeError(
            f"Rigid moves as well as turns: wanted MassProperties, got {type(body).__name__}"
            + _advice(body, moves=True)
        )
    if not isinstance(state0, Rigid | Point) and not isinstance(body, Inertia):
        raise TypeError(
            f"{type(state0).__name__} only turns: wanted Inertia, got {type(body).__name__}"
            + ("; pass body.inertia" if isinstance(body, MassProperties) else _advice(body))
        )
    if body is not None:
        _checks.require_unbatched_instance(body, type(body), "body")


def _laws_within(law: Any) -> list[Any]:
    """Return the parts of a law, and the parts of the torques inside them."""
    inner = [p.torque for p in parts_of(law) if isinstance(p, BodyInFrame | ChangingInertia)]
    return [*parts_of(law), *(part for one in inner for part in _laws_within(one))]


def warn_of_relative_inertia(body: Any, torque: Any) -> None:
    """Warn if a torque in N m acts on a body whose inertia is known only up to a factor.

    The gravity gradient without harmonics needs none: it is proportional to the inertia.
    """
    relative = isinstance(body, Inertia) and body.scale is not None
    alike = isinstance(torque, GravityGradient) and not torque.harmonics
    if relative and torque is not None and not alike:
        warnings.warn(
            f"the body has an arbitrary scale, and {type(torque).__name__} gives N m; take "
            "rj.Inertia(size * body.tensor) with the size in kg m²",
            stacklevel=5,
        )


def _advice(numbers: Any, moves: bool = False) -> str:
    """Return how to make a body of bare `numbers` (a `MassProperties` if it `moves`), or ""."""
    if not isinstance(numbers, (list, tuple, np.ndarray, jax.Array)):
        return ""
    if moves:
        return "; rj.MassProperties(mass, com, second_moment) makes one, rj.shapes a solid"
    moments = np.shape(numbers) == (3,)
    return f"; rj.Inertia{'.from_principal(*moments)' if moments else '(tensor)'} makes one of them"


def checked_tolerances(rtol: Any, atol: Any, dtype: Any) -> tuple[Any, Any]:
    """Return the tolerances of a run; `None` gets what suits the dtype.

    Raise `ValueError` unless rtol > 0 and atol ≥ 0 are finite; warn, and return the smallest `rtol`
    that the dtype can reach, if it is below. Traced tolerances are not checked.
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
    """Return the saved times (T,), s, after a check that two or more of them run in one direction.

    Unless `throw`, bad traced times become NaN.
    """
    if isinstance(ts, (Spin, Attitude, Rigid, Turn, Point)):
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
        return _error_or_nan(found, ~ahead.all(), words, throw)
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
    return _error_or_nan(found, ~ahead.all(), f"ts: wanted {kind} times{where}", throw)


def checked_first_step(dt0: Any, times: Array) -> Array:
    """Return the length of the first step, s, in the precision of the `times`.

    Raise `ValueError` if it is known to be zero, not finite, too short, or negative in a run
    forwards.
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
    """Return the state at the start: of one body, finite, with a quaternion of length 1.

    Unless `throw`, a traced quaternion of another length becomes NaN.
    """
    wanted = "Spin, Attitude or Rigid, Turn on a suspension, or Point without a body"
    _checks.require_unbatched_instance(
        state0, (Spin, Attitude, Rigid, Turn, Point), "state0", requirement=wanted
    )
    named, tree = jax.tree.flatten_with_path(state0)
    state0 = tree.unflatten(
        _checks.require_finite(leaf, str(path[-1]).lstrip("."))
        if throw or _checks.is_known(leaf)
        else leaf
        for path, leaf in named
    )
    if isinstance(state0, HasAttitude):
        xp = _checks.array_module(state0.q)
        off = xp.abs(xp.sqrt(xp.sum(xp.square(state0.q))) - 1)
        q = _error_or_nan(
            state0.q,
            off > rotation_tolerance(state0.q.dtype),
            "q: wanted a unit quaternion (w, x, y, z), got one whose length is not 1; normalise it "
            "with rigidjax.quaternion.normalise, and mind that the scalar comes first",
            throw,
        )
        state0 = eqx.tree_at(lambda s: s.q, state0, q)
    return state0


def _error_or_nan(value: Array, bad: Any, message: str, throw: bool) -> Array:
    """Return `value`; if `bad`, raise an error, or return NaN for traced numbers unless `throw`.

    One bad body in a batch must not end the runs of the others.
    """
    if throw or _checks.is_known(bad):
        return _checks.error_if(value, bad, message)
    return jnp.where(bad, jnp.full_like(value, jnp.nan), value)
