"""The fit of a model to many short open-loop runs: Gauss and Newton over windows."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from rigidjax import _checks
from rigidjax.identify import flat_limit
from rigidjax.identify.flat_limit import unreal
from rigidjax.identify.levenberg_marquardt import BOLD, Search, Settings, search
from rigidjax.identify.normal import Normal
from rigidjax.identify.quantities import carried
from rigidjax.identify.terms import with_jacobian
from rigidjax.identify.uncertainty import inverted
from rigidjax.identify.windows import Horizons, Windows, by_horizon, held_errors
from rigidjax.motion.coupled import Coupled, motion_of, started
from rigidjax.motion.manifold import minus_small, names, plus
from rigidjax.motion.torques.inputs import bind, delays_of, require_inputs
from rigidjax.solve import equations_of_motion
from rigidjax.solve.components import split
from rigidjax.solve.equal_steps import in_a_loop
from rigidjax.solve.fixed_loop import first_row, first_rows, step
from rigidjax.solve.steppers import cheapest, stepper_of
from rigidjax.solve.validation import require_fit


def open_loop_errors(
    scene: Any, value: Any, window: Windows, steps: Any = None
) -> Float[Array, "steps n"]:
    """The errors of one window, as changes from the measured states; zero beyond `steps`."""
    body, law = scene(value)
    wanted, inputs = window.wanted, window.inputs
    size, length = jnp.asarray(window.step, wanted.omega.dtype), wanted.omega.shape[0]
    before = window.before if inputs else 0
    start = started(body, window.starts, bind(law, first_row(law, size, inputs)), 0.0)
    field = equations_of_motion(body, start, law)
    stepper = stepper_of(in_a_loop(cheapest(field)), field, start)

    def one(y: Any, i: Array) -> tuple[Any, Any]:
        y = step(stepper, size, jnp.zeros_like(size), i, y, inputs or None, before)
        return y, motion_of(stepper.state(y))

    def ahead(y: Any, i: Array) -> tuple[Any, None]:
        # The torque's own states follow the inputs; the body keeps its measured state.
        y, _ = one(y, i)
        return split(Coupled(start.motion, stepper.state(y).own)), None

    y0 = stepper.start
    if before and isinstance(start, Coupled):
        y0, _ = lax.scan(ahead, y0, jnp.arange(-before, 0, dtype=jnp.int32))
    states = first_rows(length if steps is None else steps, one, y0, wanted)
    return jax.vmap(minus_small)(states, wanted)


@eqx.filter_jit
def all_errors(windows: Windows, scene: Any, value: Any) -> Float[Array, "windows steps n"]:
    """The errors of a model with these numbers."""
    of = partial(open_loop_errors, scene, value)
    return lax.map(of, windows, batch_size=min(128, windows.count))


# Steps of Gauss and Newton's for each start; residuals of a short run are nearly linear in it.
_STEPS = 3


def _by_kind(given: Any, kinds: tuple[str, ...], name: str, check: Any) -> np.ndarray:
    """The checked numbers of a mapping with these keys, one for each component (m,)."""
    _checks.instance(given, Mapping, name, wanted="numbers by kind")
    if set(given) != set(kinds):
        raise ValueError(f"{name}: wanted a number for each of {kinds}, got {tuple(given)}")
    return np.repeat([check(given[kind], f"{name}[{kind!r}]") for kind in kinds], 3)


def _deviation(value: Any, name: str) -> float:
    found = _checks.number(value, name)
    if not found > 0:
        raise ValueError(
            f"{name}: wanted a positive deviation, or infinity for a start that is free, got "
            f"{found}"
        )
    return found


def eliminated(
    residual: Callable[[Array, Array], Array], x: Array, firm: Float[Array, " m"]
) -> tuple[Array, Array, Array]:
    """Cost `½ |r|² + ½ Σ firm step²`, normal matrix and gradient of one window, the best start put
    in (variable projection: Golub and Pereyra 2003, doi:10.1088/0266-5611/19/2/201).
    """
    number = x.size

    def better(_: Any, step: Array) -> Array:
        jacobian, found = with_jacobian(lambda s: residual(x, s), step)
        normal = jacobian.T @ jacobian + jnp.diag(firm)
        return step - jnp.linalg.solve(normal, jacobian.T @ found + firm * step)

    step = lax.fori_loop(0, _STEPS, better, jnp.zeros_like(firm))
    both = jnp.concatenate([x, step])
    jacobian, found = with_jacobian(lambda z: residual(z[:number], z[number:]), both)
    gram, slope = jacobian.T @ jacobian, jacobian.T @ found
    beside = gram[number:, number:] + jnp.diag(firm)
    # The part of each number's effect that the start absorbs, and the remaining gradient.
    sides = jnp.c_[gram[number:, :number], slope[number:] + firm * step]
    taken = gram[:number, number:] @ jnp.linalg.solve(beside, sides)
    cost = 0.5 * (found @ found + jnp.sum(firm * step * step))
    return cost, gram[:number, :number] - taken[:, :number], slope[:number] - taken[:, number]


Value = TypeVar("Value")
# Windows in one batch: with their tangents they fill the first cache.
_SIDE_BY_SIDE = 8
# The last step has so many standard deviations, for errors as large as `noise`.
_SETTLED = 1e-5
# The last step gains less than this part of the gain of a fit from noise alone: about 0.05 standard
# deviations from the least cost. The first searches need not come so near.
_LEVEL, _ROUGH = 0.05**2, 1.0
# A number of order one with a larger deviation than this is unknown.
VAGUE = 100.0
# A number hangs on one stretch, of so many at least, if that makes this part of its variance.
HANGS, FEWEST = 0.85, 6
# The search first uses a ninth and a third of the windows, if these have so many steps.
_PARTS, _SHORTEST, _FEW = (9, 3), 5, 10


class WindowFit(eqx.Module, Generic[Value]):
    """The result of `fit_windows`.

    **Fields:** `value` the free numbers, of the type of the guess; `deviation` their standard
    deviations, by leaving out one stretch of the windows after the other (jackknife: the errors of
    neighbours may be alike), infinite for a number that no window or only one stretch shows, NaN
    if windows are too few; `stretches` their number; `cost` half the mean square, errors in units
    of `noise`; `noise` by kind; `steps` taken over the whole windows; `converged`; `message`
    remarks; `scene` as given.

    >>> t = np.linspace(0.0, 1.0, 11)
    >>> spin = rj.Spin(np.stack([0 * t, 0 * t, np.exp(-0.5 * t)], 1))
    >>> body = rj.Inertia.from_principal(1.0, 1.0, 1.0)
    >>> scene = lambda k: (body, rj.torques.Damping(k * jnp.ones(3)))
    >>> found = fit_windows(rj.identify.windows(t, spin, length=5), scene, jnp.asarray(0.1))
    >>> bool(found.converged), bool(found.cost < 1e-9)
    (True, True)
    """

    value: Value
    deviation: Value
    stretches: int
    cost: float
    noise: dict[str, float]
    steps: int
    converged: bool
    message: str
    scene: Callable[[Value], tuple[Any, Any]]

    def interval(self, level: float = 0.95) -> tuple[Value, Value]:
        """Low and high of each free number: Student's of one degree of freedom less than there are
        stretches. **Raises** `ValueError` for a `level` outside (0, 1).
        """
        from scipy.special import stdtrit

        level = _checks.fraction(level, "level")
        reach = float(stdtrit(max(self.stretches - 1, 1), 0.5 + 0.5 * level))
        low, high = (
            jax.tree.map(
                lambda x, d, s=s: x + s * reach * d if eqx.is_array(x) else x,
                self.value,
                self.deviation,
            )
            for s in (-1.0, 1.0)
        )
        return low, high

    def predict(self, windows: Windows) -> Horizons:
        """The errors at every horizon, of these windows or of others: `mean_absolute`, `rms`."""
        return by_horizon(windows.starts, all_errors(windows, self.scene, self.value))


def fit_windows(
    windows: Windows,
    scene: Callable[[Value], tuple[Any, Any]],
    guess: Value,
    *,
    noise: Mapping[str, float] | None = None,
    starts: Mapping[str, float] | None = None,
    stretches: int = 12,
    max_steps: int = 50,
) -> WindowFit[Value]:
    """The free numbers with the least errors of open-loop runs over all windows.

    **Arguments:** `windows`; `scene` a function of the free numbers → (body, torque), whose torque
    reads the inputs of the windows; `guess` the initial free numbers, any tree of arrays (or a
    network, whose functions are left alone); `noise` by kind (`x`, `v`, `q`, `omega`) the unit of
    an error: by default the rms of a prediction that holds the state at the start; `starts` by kind
    the standard deviation of the measured starts (the `noise` of the readings must be given with
    it; `np.inf`: the start is free); `None` takes the starts as measured; `stretches` of windows in
    a row for the deviations: a stretch should be longer than the errors of the model last;
    `max_steps` of the search. The motion is computed by `RungeKutta4`, one step a sample.

    Levenberg–Marquardt on normal equations that are summed window by window. Uncertain starts are
    found window by window, and eliminated (variable projection). The search first uses a ninth and
    a third of long windows, since a long run from a poor guess diverges, and ends when a step gains
    less than 0.05² of the gain of a fit from noise alone: about 0.05 standard deviations.

    **Returns** a `WindowFit`; a fit that ends early returns its best point and says so. **Raises:**
    `ValueError` for missing inputs, unknown kinds, and a guess with runs that are not finite;
    `TypeError` if body, states and torque do not fit together.

    >>> t = np.linspace(0.0, 1.0, 11)
    >>> spin = rj.Spin(np.stack([0 * t, 0 * t, np.exp(-0.5 * t)], 1))
    >>> body = rj.Inertia.from_principal(1.0, 1.0, 1.0)
    >>> scene = lambda k: (body, rj.torques.Damping(k * jnp.ones(3)))
    >>> found = fit_windows(rj.identify.windows(t, spin, length=5), scene, jnp.asarray(0.1))
    >>> round(float(found.value), 6)
    0.5
    """
    max_steps = _checks.whole(max_steps, "max_steps", 1)
    stretches = _checks.whole(stretches, "stretches", 2)
    _require_windows(windows)
    x, back = _numbers(guess, windows.starts.omega.dtype)
    guess, whole = back(x), windows.length
    _require_scene(scene, guess, windows)
    scales, firm = _scales(windows, whole, noise), None
    if starts is not None:
        wide = _by_kind(starts, names(windows.starts), "starts", _deviation)
        if noise is None:
            raise ValueError(
                "starts: deviations of the starts need the noise of the readings: give noise={…}, "
                "too"
            )
        # The precision of each number of the starts.
        firm = jnp.asarray((np.asarray(scales) / wide) ** 2)
    padded, count = _padded(windows), np.asarray(windows.count, np.int32)
    own = min(stretches, windows.count)

    def searched(value: Any, settings: Settings, steps: int) -> Search:
        units = scales if steps == whole else _scales(windows, steps, noise)
        return _searched(scene, value, padded, count, units, firm, settings, np.int32(steps), own)

    evaluated = Settings(_SETTLED, BOLD, 0)
    last = Settings(_SETTLED, BOLD, max_steps, level=_LEVEL)
    begin = guess
    for part in _PARTS:
        if whole // part >= _SHORTEST:
            end = searched(begin, Settings(_SETTLED, BOLD, _FEW, level=_ROUGH), whole // part)
            begin = back(end.point) if np.isfinite(end.cost) else begin
    end = searched(begin, last, whole)
    if begin is not guess and not end.cost <= searched(guess, evaluated, whole).cost:
        end = searched(guess, last, whole)
    if not np.isfinite(end.cost):
        raise ValueError("guess: the runs from it are not finite; is the scene right?")
    value, taken = back(end.point), int(end.taken) - 1
    # Evaluated once more at the best point, if the last trial was no better.
    there = end if end.here else searched(value, evaluated, whole)
    converged = bool(end.converged)
    message = [] if converged else [f"stopped after {taken} steps: its best point"]
    deviation, words = _deviations(there, np.asarray(end.point), windows.count)
    message += [*words, *_remarks(scene, value, windows)]
    return WindowFit(
        value,
        back(jnp.asarray(deviation)),
        own,
        float(end.cost) / (windows.count * windows.length),
        {kind: float(s) for kind, s in zip(names(windows.starts), scales[::3], strict=True)},
        taken,
        converged,
        "; ".join(message),
        scene,
    )


def _remarks(scene: Any, value: Any, windows: Windows) -> list[str]:
    try:
        body, law = scene(value)
    except ValueError as wrong:
        # A long fit returns its best point.
        return [f"at the best point the scene raises: {wrong}"]
    found = (unreal(body) or flat_limit.in_words(body), _too_late(windows, law))
    return [remark for remark in found if remark]


def _deviations(there: Search, point: np.ndarray, count: int) -> tuple[np.ndarray, list[str]]:
    """Standard deviations (n,) by leaving out one stretch after the other, and remarks.

    One step of Gauss and Newton's from the best point each: Miller 1974, doi:10.1093/biomet/61.1.1;
    of neighbours in one block: Künsch 1989, doi:10.1214/aos/1176347265.
    """
    grams, slopes = (np.asarray(a) for a in there.found)
    gram, many, message = grams.sum(0), len(grams), []
    nulls = [inverted(gram)[1]]
    if len(nulls[0]):
        message.append("some combination of the free numbers changes nothing in the windows")
    if many == 1:
        message.append("deviations come from the differences between windows, and there is one")
        return np.full(point.size, np.nan), message
    steps = np.zeros_like(slopes)
    for k in range(many):
        half, null = inverted(np.delete(grams, k, 0).sum(0))
        steps[k] = half @ (half.T @ slopes[k])
        nulls.append(null)
    square = (many - 1) / many * steps.T @ steps
    deviation = carried(np.eye(point.size), square, np.concatenate(nulls))
    vague = deviation > VAGUE * np.maximum(1.0, np.abs(point))
    if vague.any():
        listed = ", ".join(f"number {k} (± {deviation[k]:.3g})" for k in np.flatnonzero(vague))
        message.append(f"these of the flattened free numbers are not determined: {listed}")
    # Most of a deviation comes from one stretch.
    most = np.abs(steps).argmax(0)
    far = np.max(steps**2, 0) > HANGS * np.sum(steps**2, 0)
    edges = -(-np.arange(many + 1) * count // many)
    listed = [
        f"number {k} (without windows {edges[at]} … {edges[at + 1] - 1} it is "
        f"{point[k] + steps[at, k]:.3g})"
        for k, at in enumerate(most)
        if far[k] and many >= FEWEST and np.isfinite(deviation[k]) and not vague[k]
    ]
    if listed:
        message.append(
            f"these of the flattened free numbers hang on one stretch: {', '.join(listed)}"
        )
    return deviation, message


def _require_windows(windows: Any) -> None:
    _checks.instance(windows, Windows, "windows", wanted="what identify.windows returns")
    for name, wanted in (("starts", 2), ("wanted", 3)):
        for leaf in jax.tree.leaves(getattr(windows, name)):
            if leaf.ndim != wanted or not leaf.shape[0]:
                raise ValueError(
                    f"windows: wanted a row for each of N windows in {name}, got {leaf.shape}"
                )
            _checks.finite(leaf, f"windows: {name}")


def _require_scene(scene: Any, guess: Any, windows: Windows) -> None:
    _checks.function(scene, "scene", "of the free numbers to (body, torque)")
    made = scene(guess)
    if not isinstance(made, tuple) or len(made) != 2:
        raise TypeError(f"scene: wanted (body, torque), got {type(made).__name__}")
    require_fit(made[0], jax.tree.map(lambda a: a[0], windows.starts), made[1])
    require_inputs(made[1], windows.inputs)
    if wrong := _too_late(windows, made[1]):
        raise ValueError(wrong)


def _numbers(guess: Any, kind: Any) -> tuple[Float[Array, " n"], Callable[[Array], Any]]:
    """The free numbers in one vector, and a function that puts them back."""

    def number(leaf: Any) -> Any:
        # The weights of a network stand beside its functions.
        if callable(leaf):
            return leaf
        return _checks.finite(_checks.numbers(leaf, "guess"), "guess").astype(kind)

    x, back = _in_a_row(jax.tree.map(number, guess))
    if not x.size:
        raise ValueError("guess: wanted a tree of floating numbers, at least one")
    return x, back


def _in_a_row(guess: Any) -> tuple[Float[Array, " n"], Callable[[Array], Any]]:
    """The arrays of a tree in one vector, and a function that puts them back."""
    arrays, rest = eqx.partition(guess, eqx.is_array)
    x, back = ravel_pytree(arrays)
    return x, lambda x: eqx.combine(back(x), rest)


def _too_late(windows: Windows, law: Any) -> str | None:
    """The error if a delay goes beyond the inputs of the windows."""
    known, length = windows.before * windows.step, windows.length * windows.step
    for name, delay in delays_of(law):
        late = f"inputs[{name!r}]: a delay of {float(delay):.6g} s"
        if -float(delay) > length:
            return f"{late} reaches beyond the end of windows of {length:.6g} s; is it in seconds?"
        if float(delay) > known:
            return (
                f"{late}, and inputs that are known {known:.6g} s before a window: cut them with "
                "windows(…, before=k)"
            )
    return None


def _scales(windows: Windows, steps: int, noise: Mapping[str, float] | None) -> Float[Array, " m"]:
    """The unit of each number of an error, for windows of so many steps."""
    kinds = names(windows.starts)
    if noise is not None:
        return jnp.asarray(_by_kind(noise, kinds, "noise", _checks.positive))
    wanted = jax.tree.map(lambda a: a[:, :steps], windows.wanted)
    squares = np.mean(np.asarray(held_errors(windows.starts, wanted)) ** 2, (0, 1))
    each = np.sqrt(np.mean(squares.reshape(len(kinds), 3), 1))
    return jnp.asarray(np.repeat(np.where(each == 0, 1.0, each), 3))


def _padded(windows: Windows) -> Windows:
    """The windows, the last repeated to full batches: a rest needs a program more."""
    batches = -(-windows.count // _SIDE_BY_SIDE)
    order = np.minimum(np.arange(batches * _SIDE_BY_SIDE), windows.count - 1)
    return jax.tree.map(lambda a: jnp.asarray(np.asarray(a)[order]), windows)


@eqx.filter_jit
def _searched(
    scene: Any,
    guess: Any,
    windows: Windows,
    count: Any,
    scales: Any,
    firm: Any,
    settings: Settings,
    steps: Any,
    stretches: int,
) -> Search:
    """The search from `guess` over the first `steps` of the first `count` windows; it keeps normal
    matrix and gradient of each stretch of them, (C, n, n) and (C, n).
    """
    x, back = _in_a_row(guess)

    def of_one(x: Array, window: Windows) -> tuple[Array, Array, Array]:
        def errors(x: Array, start: Any) -> Array:
            begun = eqx.tree_at(lambda w: w.starts, window, start)
            found = open_loop_errors(scene, back(x), begun, steps)
            return (found / scales[None]).reshape(-1)

        if firm is None:
            jacobian, flat = with_jacobian(lambda x: errors(x, window.starts), x)
            return 0.5 * flat @ flat, jacobian.T @ jacobian, jacobian.T @ flat
        return eliminated(lambda x, step: errors(x, plus(window.starts, scales * step)), x, firm)

    def evaluated(x: Array) -> Any:
        def side_by_side(i: Array, total: Any) -> Any:
            rows = i * _SIDE_BY_SIDE + jnp.arange(_SIDE_BY_SIDE, dtype=jnp.int32)
            some = jax.tree.map(
                lambda a: lax.dynamic_slice_in_dim(a, rows[0], _SIDE_BY_SIDE), windows
            )
            found = jax.vmap(lambda window: of_one(x, window))(some)
            # Beyond the last window there is no stretch.
            stretch = jnp.where(rows < count, rows * stretches // count, stretches)

            def add(sum_: Array, part: Array) -> Array:
                return sum_.at[stretch].add(part, mode="drop")

            return jax.tree.map(add, total, found)

        square, line = nothing
        rounds = (count + _SIDE_BY_SIDE - 1) // _SIDE_BY_SIDE
        start = (line[:, 0], square, line)
        cost, grams, slopes = lax.fori_loop(0, rounds, side_by_side, start)
        return (grams, slopes), jnp.sum(cost), Normal(jnp.sum(grams, 0)), jnp.sum(slopes, 0)

    nothing = (
        jnp.zeros((stretches, x.size, x.size), x.dtype),
        jnp.zeros((stretches, x.size), x.dtype),
    )
    return search(evaluated, x, jnp.zeros_like(x), settings, nothing, by_noise=_by_noise)


def _by_noise(parts: tuple[Array, Array], normal: Normal) -> Array:
    """½ tr(K G⁻¹), the mean excess of the cost at the true numbers, K of the gradients of the
    stretches: Takeuchi 1976; Burnham and Anderson 2002, doi:10.1007/b97636, section 7.2.
    """
    spread = parts[1].T @ parts[1]
    felt = normal.diagonal
    root = jnp.sqrt(jnp.maximum(felt, 1e-12 * jnp.max(felt)))
    firm = normal.scaled(1.0 / root).plus(jnp.full_like(root, 1e-12))
    return 0.5 * jnp.trace(firm.solve(spread / (root[:, None] * root[None, :])))
