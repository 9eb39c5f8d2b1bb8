"""Hold the result of a run, and compute its drift, error and growth of errors on demand."""

import dataclasses
import warnings
from typing import Any, Generic, TypeVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rigidjax import _checks, _show
from rigidjax._types import ScalarLike
from rigidjax.frames import Point
from rigidjax.motion import Attitude, Rigid, Spin, Turn
from rigidjax.motion.conserved import drift
from rigidjax.motion.coupled import Coupled, motion_of
from rigidjax.motion.manifold import (
    dimension,
    leaf_names,
    minus_small,
    parts_by_name,
    plus,
    rotation_slices,
)
from rigidjax.motion.torques.states import require_no_own_states
from rigidjax.solve.answer.error import Error, estimate_error_of_run, largest_length_in_run
from rigidjax.solve.answer.run import AnyRun, solve

_drift: Any = eqx.filter_jit(drift)
State = TypeVar("State", Spin, Attitude, Rigid, Turn, Point)


class Solution(eqx.Module, Generic[State]):
    """Hold the result of `simulate`.

    **Fields:**

    - `ts` (T,): the given times, s.
    - `ys`: the states at `ts`, of the type of `state0`, with a leading time axis; NaN at times that
      the run did not reach.
    - `stats`: a dict with `num_steps`, `num_accepted_steps` and `num_rejected_steps`; for a `Point`
      also with `drift`, the relative drift of each conserved quantity of its scene.
    - `result`: a `diffrax.RESULTS`: `successful`, or why the run ended early, such as
      `max_steps_reached`, `nonfinite`, `nonfinite_input` (no body has these numbers),
      `dt_min_reached` or `event_occurred`.
    - `event_time`, s, and `event_state`: the time and the state at the event. Both are NaN if the
      event did not occur, and `None` if no event was given. The state has the type of `state0`;
      under a law with states of its own it is a `Coupled`.
    - `own`: a tuple with the states of each law that has states of its own, with a leading time
      axis; `None` if no law has any. The order is that of the laws; a law inside another law comes
      before the outer law.

    >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 0.0, 1.0])
    >>> sol = rj.simulate(body, start, [0.0, 1.0, 2.0])
    >>> sol.ys.omega.shape, sol.event_time
    ((3, 3), None)
    """

    ts: Float[Array, " times"]
    ys: State
    stats: dict[str, Any]
    result: dfx.RESULTS
    _arrays: Any
    # `_rest` is the set-up of the run without its arrays, which are in `_arrays`. It is a tree and
    # not a `PyTreeDef`. A `PyTreeDef` would hold the object with which Equinox marks a part that is
    # left out, and after `pickle` this is another object, which Equinox does not recognise.
    _rest: Any = eqx.field(static=True)
    event_time: Float[Array, ""] | None = None
    event_state: Any = None
    own: Any = None
    _error: Error | None = None

    def __repr__(self) -> str:
        if not _checks.is_known((self.ts, self.stats, self.result)) or np.ndim(self.ts) != 1:
            return eqx.tree_pformat(self)
        count, t = self.ts.shape[0], np.asarray(self.ts)
        ends = (
            " … ".join(_show.time_as_text(end, abs(t[-1] - t[0])) for end in (t[0], t[-1])) + " s"
        )
        steps = "".join(
            f", {int(self.stats[name])} {words}"
            for name, words in (("num_steps", "steps"), ("num_rejected_steps", "rejected"))
            if name in self.stats
        )
        word = dfx.RESULTS[self.result] or "successful"
        return f"Solution({type(self.ys).__name__} at {count} times {ends}{steps}; {word})"

    def to_xarray(self) -> Any:
        """Return the states of this run as a `Dataset` of xarray, with the times as `t`, s.

        Vectors have the components `axis` x, y, z, and quaternions the components `part` w, x, y,
        z. **Raises** `ModuleNotFoundError` without xarray, and `ValueError` for a batch of runs.
        """
        xarray = _checks.import_library("xarray", "frames", "to_xarray")
        if np.ndim(self.ts) != 1:
            raise ValueError(f"to_xarray: wanted one run, got times of shape {np.shape(self.ts)}")
        named = {3: ("axis", list("xyz")), 4: ("part", list("wxyz"))}
        variables, places = {}, {"t": np.asarray(self.ts)}
        for name, leaf in zip(leaf_names(self.ys), jax.tree.leaves(self.ys), strict=True):
            kinds = [named[size] for size in leaf.shape[1:]]
            places |= dict(kinds)
            variables[name] = (["t", *dict(kinds)], np.asarray(leaf))
        return xarray.Dataset(variables, coords=places)

    @property
    def drift(self) -> dict[str, Array]:
        """Return the drift of each quantity that the motion conserves, relative to its size.

        See `rigidjax.drift`. The quantities may be the energy, the angular momentum in the world
        frame, or the component of the angular momentum along gravity. Which of them the motion
        conserves depends on the body and the torque or, for a `Point`, on its scene. A drift of
        zero is best.
        """
        if "drift" in self.stats:
            return self.stats["drift"]
        return _drift(self.ts, self._states, self._setup.body, self._setup.torque)

    @property
    def growth(self) -> Float[Array, " times"]:
        """Return the growth of a small error at the start, ‖∂y(t)/∂y(t₀)‖, at each time t of `ts`.

        The growth is computed when it is read, by forward mode, which takes about as many runs as
        the state y has numbers. The growth has no unit, because each of q, Ω, x and v is divided by
        its largest size in the run. The norm ‖…‖ is the largest singular value.

        The errors of the solver grow by the same factor. If `growth * rtol` exceeds 1, the states
        have no correct digit, and gradients through these states mean nothing: a `UserWarning`
        names the first such time. In this case end the run earlier, or fit shorter recordings.

        Source: the largest finite-time Lyapunov exponent is the logarithm of the growth, divided by
        t − t₀ (Eckmann and Ruelle 1985, doi:10.1103/RevModPhys.57.617).
        """
        found = _growth(self._setup, self.ts, self._states)
        rtol = self._setup.rtol
        if rtol is None:
            rtol = 100 * float(jnp.finfo(self.ts.dtype).eps)
        if _checks.is_known((found, rtol, self.ts)):
            lost = np.flatnonzero(np.asarray(found) * float(rtol) > 1)
            if lost.size:
                i = lost[0]
                warnings.warn(
                    f"growth: errors at the start have grown {float(found[i]):.1e} times at t = "
                    f"{float(self.ts[i]):g} s; at a tolerance of {float(rtol):.0e} the states from "
                    "there on are not known, and gradients through them mean nothing",
                    stacklevel=2,
                )
        return found

    @property
    def error(self) -> Error:
        """Return how far the states are from the exact motion of the given numbers, as an `Error`.

        The error is computed when it is read, by a second run with a fiftieth of the tolerances
        (for fixed steps, with half of the step). If round-off may matter, three more runs are done
        with changed last digits of body, torque and start (in closed form, also of the times). A
        `UserWarning` names the time after which nothing is known, as in chaos.

        A torque that depends on the time is also sampled, because both runs might pass over a short
        pulse of the torque. In each of 32 parts of the run it is sampled at 512 times, always at
        one saved state of this part. If the samples show a pulse, an adaptive step of the second
        run ends at the pulse. Three kinds of pulses are not seen: a pulse between two samples; a
        pulse that the torque has at other states only; and, under fixed steps, a pulse between the
        stages of the steps.

        >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 0.5, 1.0])
        >>> law = rj.torques.Damping([0.1, 0.1, 0.1])
        >>> rj.simulate(body, start, [0.0, 5.0], law).error.total["omega"] < 1e-9
        Array([ True,  True], dtype=bool)
        """
        if self._error is not None:
            return self._error
        found = estimate_error_of_run(self._setup, self.ts, self._states, self.stats["num_steps"])
        _warn_of_error(found, 0.5, "error: nothing is known of the states")
        return found

    def transition_matrix(self) -> Float[Array, "times n n"]:
        """Return ∂ state(t) / ∂ state(t₀) at each of `ts`, on the tangent spaces of the states.

        Row i is the change of number i of the state at the time t, and column j is a small change
        of number j at the start t₀. These numbers are Ω for a `Spin` (n = 3); δθ, Ω for an
        `Attitude` (n = 6); x, v, δθ, Ω for a `Rigid` (n = 12); γ, dγ/dt for a `Turn` (n = 2); and
        x, v for a `Point` (n = 6). The three numbers δθ, rad, are a small turn in body axes, which
        changes q to q ⊗ exp(½δθ). The columns are forward-mode derivatives, NaN at times that the
        run did not reach. If an event ended the run, the derivatives are those of the run without
        the event.

        >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 0.0, 1.0])
        >>> rj.simulate(body, start, [0.0, 2.0]).transition_matrix()[1, 2].tolist()
        [0.0, 0.0, 1.0]
        """
        require_no_own_states(self._setup.torque, "transition_matrix")
        return _transition_matrix(self._setup, self.ts, self.ys)

    def evaluate(self, t: ScalarLike) -> State:
        """Return the state at any time `t`, s, between the first and the last of `ts`.

        The motion is computed again from the last saved state before `t`, with steps of its own.

        **Raises:** `ValueError` (`EquinoxRuntimeError` under `jit`) if `t` is outside of `ts`.
        """
        t = _checks.array_of_shape(t, (), "t").astype(self.ts.dtype)
        way = jnp.sign(self.ts[-1] - self.ts[0])
        along, since = way * self.ts, way * t
        outside = ~((since >= along[0]) & (since <= along[-1]))
        t = _checks.error_if(t, outside, "evaluate: t lies outside the times that were simulated")
        index = jnp.searchsorted(along, since, side="right") - 1
        index = jnp.clip(index, 0, self.ts.shape[0] - 1)
        start = jax.tree.map(lambda leaf: leaf[index], self._states)
        ys, _, _ = solve(self._setup, start, jnp.stack([self.ts[index], t]))
        return motion_of(jax.tree.map(lambda leaf: leaf[-1], ys))

    @property
    def _setup(self) -> AnyRun:
        return eqx.combine(self._arrays, self._rest)

    @property
    def _states(self) -> Any:
        """Return the saved states, `Coupled` with the torque's own states if it has any."""
        return self.ys if self.own is None else Coupled(self.ys, self.own)


def with_error(sol: Solution, error: Error, accuracy: Any) -> Solution:
    """Return the solution with its `error` stored; warn if it exceeds the accuracy."""
    _warn_of_error(error, accuracy, "simulate: the accuracy cannot be had")
    return dataclasses.replace(sol, _error=error)


def _warn_of_error(error: Error, limit: Any, message_start: str) -> None:
    """Warn if the error of a run exceeds a limit, and name the first time at which it does."""
    if not _checks.is_known((error, limit)) or not np.any(np.asarray(error.relative) > limit):
        return
    i = int(np.argmax(np.asarray(error.relative) > limit))
    steps, off = (
        max(float(part[name][i] / error.sizes[name]) for name in part)
        for part in (error.steps, error.round_off)
    )
    single = "" if error.ts.dtype == jnp.float64 else ", or take float64"
    warnings.warn(
        f"{message_start} from t = {float(error.ts[i]):g} s on: the steps leave {steps:.1e}, "
        f"round-off {off:.1e} (rad, or relative); end the run earlier{single}",
        stacklevel=6,
    )


@eqx.filter_jit
def _transition_matrix(setup: AnyRun, ts: Array, ys: Any) -> Float[Array, "times n n"]:
    """Return the derivatives (T, n, n) of the states by the first, as changes by `plus`."""
    setup = setup.forward()
    start = jax.tree.map(lambda leaf: leaf[0], ys)

    def changes(change: Array) -> Array:
        return jax.vmap(minus_small)(solve(setup, plus(start, change), ts)[0], ys)

    return jax.jacfwd(changes)(jnp.zeros(dimension(start), ts.dtype))


@eqx.filter_jit
def _growth(setup: AnyRun, ts: Array, ys: Any) -> Float[Array, " times"]:
    """Return the factors (T,) by which a small error at the start grows, as `Solution.growth`."""
    start = jax.tree.map(lambda leaf: leaf[0], ys)
    each = parts_by_name(start, jnp.ones(dimension(start), ts.dtype)).values()
    both = zip(each, jax.tree.leaves(ys), strict=True)
    sizes = jnp.concatenate([a.reshape(-1) * largest_length_in_run(b) for a, b in both])
    sizes = jnp.where(sizes > 0, sizes, 1)
    # A turn by the rotation vector δθ changes q by half of δθ. The size of δθ is therefore twice
    # that of q.
    for turned in rotation_slices(start):
        sizes = sizes.at[turned].multiply(2)
    change = _transition_matrix(setup, ts, ys) * (sizes[None] / sizes[:, None])[None]
    return jnp.linalg.norm(change, ord=2, axis=(1, 2))
