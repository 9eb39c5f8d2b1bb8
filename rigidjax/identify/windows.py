"""Many short open-loop runs from measured starts: how driven machines are identified.

A record of measured states is cut into windows; from the start of each the model runs on its own,
driven by the recorded inputs, and is compared with what was measured at every step.
"""

from collections.abc import Callable, Mapping
from typing import Any, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float

from rigidjax import _checks
from rigidjax._types import HasAttitude
from rigidjax.body.inertia import Inertia, MassProperties
from rigidjax.identify.levenberg_marquardt import BOLD, Search, Settings, search
from rigidjax.identify.window_starts import eliminated, moved, precisions, with_jacobian
from rigidjax.motion import Attitude, Rigid, Spin
from rigidjax.motion.coupled import Coupled, motion_of, started
from rigidjax.motion.torques.inputs import bind, delays_of, require_inputs
from rigidjax.rotation import quaternion
from rigidjax.rotation.algebra import components
from rigidjax.solve import equations_of_motion
from rigidjax.solve.components import split
from rigidjax.solve.fixed_loop import first_row, step
from rigidjax.solve.steppers import stepper_of
from rigidjax.solve.validation import require_fit

Value = TypeVar("Value")
# Windows side by side: with their tangents they fill the first cache.
_SIDE_BY_SIDE = 8
# A step of so many standard deviations, if errors were as large as `noise`, is the last.
_SETTLED = 1e-5


class Windows(eqx.Module):
    """Short runs of one length. `windows` makes them; `Windows.joined` puts some together.

    **Fields:** `step` s between samples; `starts` N states; `wanted` the L states that follow each
    start, with leading axes (N, L); `inputs` by name (N, before + L, *k), row before + i held
    through step i, where no delay is asked for; `before` how many rows come before the start.
    """

    step: float = eqx.field(static=True)
    starts: Any
    wanted: Any
    inputs: dict[str, Array]
    before: int = eqx.field(static=True, default=0)

    @property
    def count(self) -> int:
        """How many windows."""
        return int(self.starts.omega.shape[0])

    @property
    def length(self) -> int:
        """How many steps each has."""
        return int(self.wanted.omega.shape[1])

    def held(self) -> "Horizons":
        """The errors of a prediction that holds the state at the start: what a model must beat."""
        held = jax.tree.map(
            lambda a, b: jnp.broadcast_to(a[:, None], b.shape), self.starts, self.wanted
        )
        return _by_horizon(_between(held, self.wanted))

    @staticmethod
    def joined(*parts: "Windows") -> "Windows":
        """The windows of several records, of one step and one length.

        **Raises:** `ValueError` for none, or for steps, lengths or inputs that differ.
        """
        if not parts:
            raise ValueError("Windows.joined: wanted at least one Windows")
        kinds = {
            (p.step, p.length, tuple(sorted(p.inputs)), type(p.starts), p.before) for p in parts
        }
        if len(kinds) > 1:
            raise ValueError(
                "Windows.joined: wanted one step, length, kind of state and the same inputs, got "
                + "; ".join(
                    f"{k[0]:g} s, {k[1]}, {k[3].__name__}, {k[2]}, before={k[4]}" for k in kinds
                )
            )
        first, *rest = parts
        if not rest:
            return first
        arrays = jax.tree.map(lambda *a: jnp.concatenate(a), *parts)
        return arrays


def windows(
    t: Float[ArrayLike, " times"] | Any,
    states: Any,
    inputs: Mapping[str, Any] | None = None,
    *,
    length: int,
    stride: int = 1,
    before: int = 0,
) -> Windows:
    """Cut a record of measured states into windows of `length` steps, one every `stride` samples.

    **Arguments:** `t` (T,) s, evenly spaced but for gaps; `states` a `Spin`, `Attitude` or `Rigid`
    with a leading axis (T,); `inputs` by name (T, *k), each held until the next sample, for the
    `rigidjax.torques.Input`s of a law; `before` how many samples of the inputs are kept before each
    start, for a law that delays them (`rigidjax.torques.Delayed`) or has states of its own, as
    `Lagged` has: these begin there, and follow the inputs up to the start while the body is held as
    it was measured at the start. No window, with what is before it, goes across a gap.

    **Raises:** `ValueError` for shapes that do not agree, NaN, times that are uneven, a record
    without a window of this length; `TypeError` for other states.

    >>> t = np.arange(6.0)
    >>> windows(t, Spin(np.ones((6, 3))), length=2, stride=2).count
    2
    """
    times = _checks.on_host(t, "t")
    length, stride = _checks.whole(length, "length", 1), _checks.whole(stride, "stride", 1)
    before = _checks.whole(before, "before", 0)
    if not isinstance(states, Spin | Attitude | Rigid):
        raise TypeError(f"states: wanted Spin, Attitude or Rigid, got {type(states).__name__}")
    if times.ndim != 1 or times.size < length + 1:
        raise ValueError(
            f"t: wanted at least length + 1 = {length + 1} times (T,), got shape {times.shape}"
        )
    if not isinstance(inputs, Mapping | None):
        raise TypeError(f"inputs: wanted arrays by name, got {type(inputs).__name__}")
    rows = {str(k[-1]).lstrip("."): v for k, v in jax.tree.leaves_with_path(states)}
    rows |= {f"inputs[{k!r}]": v for k, v in (inputs or {}).items()}
    for name, value in rows.items():
        if np.shape(value)[:1] != times.shape:
            raise ValueError(
                f"{name}: wanted a row for each of {times.size} times, got shape {np.shape(value)}"
            )
        bad = ~np.isfinite(np.asarray(value, float)).reshape(times.size, -1).all(1)
        if bad.any():
            raise ValueError(
                f"{name}: NaN or infinity in row {int(np.argmax(bad))}; leave such rows out: a "
                "window does not go across the gap"
            )
    gaps = np.diff(times)
    h = float(np.median(gaps))
    even = np.abs(gaps - h) <= 1e-3 * h
    if not np.all(even | (gaps > 1.5 * h)):
        i = int(np.argmin(even | (gaps > 1.5 * h)))
        raise ValueError(
            f"t: wanted even times with or without gaps, got {gaps[i]:.6g} s after row {i} where "
            f"others are {h:.6g} s apart; resample first"
        )
    broken = np.concatenate([[0], np.cumsum(~even)])
    begin = np.arange(before, times.size - length, stride)
    begin = begin[broken[begin + length] == broken[begin - before]]
    if not begin.size:
        raise ValueError(f"windows: no stretch of {before + length} steps without a gap")
    rows_of = begin[:, None] + np.arange(-before, length)
    follow = begin[:, None] + 1 + np.arange(length)
    kind = jnp.result_type(float)
    arrays = jax.tree.map(lambda a: np.asarray(a, kind), states)
    samples = {k: np.asarray(v, kind) for k, v in (inputs or {}).items()}
    return Windows(
        round(h, 12),
        jax.tree.map(lambda a: jnp.asarray(a[begin]), arrays),
        jax.tree.map(lambda a: jnp.asarray(a[follow]), arrays),
        {k: jnp.asarray(v[rows_of]) for k, v in samples.items()},
        before,
    )


class Horizons(NamedTuple):
    """Open-loop errors by horizon, of each kind (`x` m, `v` m/s, `q` rad, `omega` rad/s).

    **Fields:** `steps` (L,) how many steps ahead; `mean_absolute` of a component, and `rms` of the
    vector, each by kind (L,).
    """

    steps: Any
    mean_absolute: dict[str, Any]
    rms: dict[str, Any]


class WindowFit(eqx.Module, Generic[Value]):
    """What `fit_windows` returns.

    **Fields:** `value` the free numbers, of the type of the guess; `deviation` their standard
    deviations, from how the windows differ (sandwich; of windows that overlap they are too small);
    `cost` half the mean square, errors in units of `noise`; `noise` by kind; `steps` taken;
    `converged`; `message` what there is to say.
    """

    value: Value
    deviation: Value
    cost: float
    noise: dict[str, float]
    steps: int
    converged: bool
    message: str
    scene: Callable[[Value], tuple[Any, Any]]

    def predict(self, windows: Windows) -> Horizons:
        """The errors at every horizon, of these windows or of others."""
        return errors_by_horizon(windows, self.scene, self.value)


def fit_windows(
    windows: Windows,
    scene: Callable[[Value], tuple[Any, Any]],
    guess: Value,
    *,
    noise: Mapping[str, float] | None = None,
    starts: Mapping[str, float] | None = None,
    max_steps: int = 50,
) -> WindowFit[Value]:
    """The free numbers with which open-loop runs of all windows come nearest to what was measured.

    **Arguments:** `windows`; `scene` a function of the free numbers → (body, torque), whose torque
    reads the inputs of the windows; `guess` the free numbers to begin with, any tree of arrays;
    `noise` by kind (`x`, `v`, `q`, `omega`) what an error is measured in: by default the rms of a
    prediction that holds the state at the start; `starts` by kind how far the measured starts may
    be off (a standard deviation, beside the `noise` of the readings, which must be given with it;
    `np.inf`: the start is free); `None` takes them as they were measured; `max_steps` of the
    search. Steps of the motion are those of `RungeKutta4`, one a sample.

    Levenberg–Marquardt (`rigidjax.identify.levenberg_marquardt`) on normal equations that are
    summed window by window, so that memory does not grow with their number. Starts that may be off
    are found window by window, and taken out of the normal equations (variable projection).

    **Returns** a `WindowFit`; a fit that ends early returns its best point and says so.

    **Raises:** `ValueError` for inputs that are missing, kinds that there are not, a guess whose
    runs are not finite; `TypeError` where body, states and torque do not fit.

    >>> import rigidjax as rj
    >>> t = np.linspace(0.0, 1.0, 11)
    >>> spin = Spin(np.stack([0 * t, 0 * t, np.exp(-0.5 * t)], 1))
    >>> body = rj.Inertia.from_principal(1.0, 1.0, 1.0)
    >>> scene = lambda k: (body, rj.torques.Damping(k * jnp.ones(3)))
    >>> found = fit_windows(windows(t, spin, length=5), scene, jnp.asarray(0.1))
    >>> round(float(found.value), 6)
    0.5
    """
    max_steps = _checks.whole(max_steps, "max_steps", 1)
    _require_windows(windows)
    _checks.function(scene, "scene", "of the free numbers to (body, torque)")
    leaves, tree = jax.tree.flatten(guess)
    leaves = [_checks.finite(_checks.numbers(leaf, "guess"), "guess") for leaf in leaves]
    x, back = ravel_pytree(jax.tree.unflatten(tree, leaves))
    if not x.size:
        raise ValueError("guess: wanted a tree of floating numbers, at least one")
    guess = back(x)
    made: Any = scene(guess)
    if not isinstance(made, tuple) or len(made) != 2:
        raise TypeError(f"scene: wanted (body, torque), got {type(made).__name__}")
    body, law = made
    start = jax.tree.map(lambda a: a[0], windows.starts)
    require_fit(body, start, law)
    require_inputs(law, windows.inputs)
    _require_delays(windows, law)
    scales = _scales(windows, noise)
    firm = precisions(starts, _kinds(windows.starts), noise)
    settings = Settings(_SETTLED, BOLD, max_steps)
    end = _searched(scene, windows.step, guess, windows, scales, firm, settings)
    if not np.isfinite(end.cost):
        raise ValueError("guess: the runs from it are not finite; is the scene right?")
    value, taken = back(end.point), int(end.taken) - 1
    # Once more where it ended: the last that was tried may have been no better.
    still = Settings(_SETTLED, BOLD, 0)
    there = _searched(scene, windows.step, value, windows, scales, firm, still)
    inverse = np.linalg.pinv(np.asarray(there.gram))
    spread = inverse @ np.asarray(there.found) @ inverse
    deviation = np.sqrt(np.clip(np.diag(spread), 0, None))
    converged = bool(end.converged)
    message = [] if converged else [f"stopped after {taken} steps: its best point"]
    try:
        _require_real(scene(value)[0])
    except ValueError as refused:
        message.append(f"no real body has these numbers: {refused}")
    try:
        _require_delays(windows, scene(value)[1])
    except ValueError as refused:
        message.append(str(refused))
    kinds = {k: float(v) for k, v in scales.items()}
    return WindowFit(
        value,
        back(jnp.asarray(deviation)),
        float(end.cost) / (windows.count * windows.length),
        kinds,
        taken,
        converged,
        "; ".join(message),
        scene,
    )


def _require_windows(windows: Any) -> None:
    _checks.instance(windows, Windows, "windows", wanted="what identify.windows returns")
    for name in ("starts", "wanted"):
        for leaf in jax.tree.leaves(getattr(windows, name)):
            if leaf.ndim != (2 if name == "starts" else 3) or not leaf.shape[0]:
                raise ValueError(
                    f"windows: wanted a row for each of N windows in {name}, got {leaf.shape}"
                )
            _checks.finite(leaf, f"windows: {name}")


def _require_delays(windows: Windows, law: Any) -> None:
    """Raise `ValueError` for a delay beyond the inputs that the windows know."""
    known = windows.before * windows.step
    for name, delay in delays_of(law):
        if float(delay) > known:
            raise ValueError(
                f"inputs[{name!r}]: a delay of {float(delay):.6g} s, and inputs that are known "
                f"{known:.6g} s before a window: cut them with windows(…, before=k)"
            )


def _require_real(body: Any) -> None:
    """Raise `ValueError` for numbers that no body has: inside a trace nobody looked."""
    if isinstance(body, MassProperties):
        MassProperties(body.mass, body.com, body.second_moment)
    else:
        Inertia.from_tensor(body.tensor)


def errors_by_horizon(
    windows: Windows, scene: Callable[[Value], tuple[Any, Any]], value: Value
) -> Horizons:
    """The open-loop errors of a model with these numbers, step by step.

    **Arguments:** as for `fit_windows`, with the free numbers `value`.
    """
    ones = {kind: jnp.ones(()) for kind in _kinds(windows.starts)}
    found = _all_errors(scene, windows.step, value, windows, ones)
    return _by_horizon(found)


def _by_horizon(found: dict[str, Array]) -> Horizons:
    absolute = {k: np.asarray(jnp.mean(jnp.abs(v), (0, 2))) for k, v in found.items()}
    rms = {k: np.asarray(jnp.sqrt(jnp.mean(jnp.sum(v * v, 2), 0))) for k, v in found.items()}
    return Horizons(np.arange(1, found["omega"].shape[1] + 1), absolute, rms)


def _errors(
    scene: Any, h: float, value: Any, start: Any, wanted: Any, inputs: Any, scales: Any
) -> dict[str, Array]:
    """The errors of one window, by kind (L, 3), in units of `scales`."""
    body, law = scene(value)
    size, length = jnp.asarray(h, wanted.omega.dtype), wanted.omega.shape[0]
    before = next(iter(inputs.values())).shape[0] - length if inputs else 0
    start = started(body, start, bind(law, first_row(law, size, inputs)), 0.0)
    stepper = stepper_of(None, equations_of_motion(body, start, law), start)

    def one(y: Any, i: Array) -> tuple[Any, Any]:
        y = step(stepper, size, jnp.zeros_like(size), i, y, inputs or None, before)
        return y, motion_of(stepper.state(y))

    def ahead(y: Any, i: Array) -> tuple[Any, None]:
        # The law's own states follow the inputs; the body stays as it was measured.
        y = step(stepper, size, jnp.zeros_like(size), i, y, inputs, before)
        return split(Coupled(start.motion, stepper.state(y).own)), None

    y0 = stepper.start
    if before and isinstance(start, Coupled):
        y0, _ = lax.scan(ahead, y0, jnp.arange(-before, 0, dtype=jnp.int32))
    _, states = lax.scan(one, y0, jnp.arange(length, dtype=jnp.int32))
    return {k: v / scales[k] for k, v in _between(states, wanted).items()}


def _between(states: Any, wanted: Any) -> dict[str, Array]:
    found = {}
    for kind in _kinds(states):
        a, b = getattr(states, kind), getattr(wanted, kind)
        found[kind] = a - b
        if kind == "q":
            found[kind] = jax.vmap(_turn)(a.reshape(-1, 4), b.reshape(-1, 4)).reshape(
                (*a.shape[:-1], 3)
            )
    return found


def _turn(a: Array, b: Array) -> Array:
    """The rotation from `b` to `a` in body axes, rad, for errors that are small."""
    w, x, y, z = components(quaternion.multiply(quaternion.conjugate(b), a))
    twice = jnp.where(w < 0, -2.0, 2.0).astype(w.dtype)
    return jnp.stack([twice * x, twice * y, twice * z])


def _kinds(states: Any) -> tuple[str, ...]:
    if isinstance(states, Rigid):
        return ("x", "v", "q", "omega")
    return ("q", "omega") if isinstance(states, HasAttitude) else ("omega",)


def _scales(windows: Windows, noise: Mapping[str, float] | None) -> dict[str, Array]:
    kinds = _kinds(windows.starts)
    if noise is not None:
        if not isinstance(noise, Mapping):
            raise TypeError(f"noise: wanted numbers by kind, got {type(noise).__name__}")
        if set(noise) != set(kinds):
            raise ValueError(f"noise: wanted a number for each of {kinds}, got {tuple(noise)}")
        return {k: jnp.asarray(_checks.positive(noise[k], f"noise[{k!r}]")) for k in kinds}
    held = jax.tree.map(
        lambda a, b: jnp.broadcast_to(a[:, None], b.shape), windows.starts, windows.wanted
    )
    rms = {k: jnp.sqrt(jnp.mean(v * v)) for k, v in _between(held, windows.wanted).items()}
    return {k: jnp.where(v > 0, v, 1.0) for k, v in rms.items()}


@eqx.filter_jit
def _all_errors(scene: Any, h: float, value: Any, windows: Windows, scales: Any) -> Any:
    def one(window: Any) -> Any:
        start, wanted, inputs = window
        return _errors(scene, h, value, start, wanted, inputs, scales)

    parts = (windows.starts, windows.wanted, windows.inputs)
    return lax.map(one, parts, batch_size=min(128, windows.count))


@eqx.filter_jit
def _searched(
    scene: Any, h: float, guess: Any, windows: Windows, scales: Any, firm: Any, settings: Settings
) -> Search:
    """The search from `guess`; what it keeps is the spread of the windows' gradients (n, n)."""
    x, back = ravel_pytree(guess)
    parts = (windows.starts, windows.wanted, windows.inputs)

    def of_one(x: Array, window: Any) -> Any:
        start, wanted, inputs = window

        def errors(x: Array, start: Any) -> Array:
            return ravel_pytree(_errors(scene, h, back(x), start, wanted, inputs, scales))[0]

        if firm is not None:
            held = jnp.repeat(jnp.stack([firm[kind] for kind in scales]), 3)
            cost, gram, slope = eliminated(
                lambda x, step: errors(x, moved(start, step, scales)), x, held
            )
            return slope[:, None] * slope[None], cost, gram, slope

        jacobian, flat = with_jacobian(lambda x: errors(x, start), x)
        slope = jacobian.T @ flat
        return slope[:, None] * slope[None], 0.5 * flat @ flat, jacobian.T @ jacobian, slope

    def evaluated(x: Array) -> Any:
        few = min(_SIDE_BY_SIDE, windows.count)
        found = lax.map(lambda window: of_one(x, window), parts, batch_size=few)
        return jax.tree.map(lambda a: jnp.sum(a, 0), found)

    return search(evaluated, x, jnp.zeros_like(x), settings, jnp.zeros((x.size, x.size), x.dtype))
