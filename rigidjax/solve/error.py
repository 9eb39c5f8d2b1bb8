"""How far a run is from the exact motion of its numbers: a second run and three neighbours say.

The error of the *steps* is the distance to a run at a hundredth of the tolerance, or of equal steps
half as long. Below round-off two runs agree by luck; so the part of *round-off* is how far runs lie
apart whose numbers differ by a unit in the last digit: these round differently at every step, and
what they differ by has grown as a rounding error grows. Nothing about the motion is assumed.
"""

import dataclasses
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rigidjax._types import Scalar
from rigidjax.motion.manifold import dimension, minus, parts
from rigidjax.solve.run import Free, Loop, Setup, solve

# Order 8 makes that 1.8 times the steps.
_CLOSER = 1e-2
# The second run of a few steps would take the same ones: no step grows beyond ten times the last.
_CUTS = 8
# Three deviations of four runs hold half of the true error in all but few of a thousand runs.
_NEIGHBOURS, _DEVIATIONS = 3, 3.0
# Half a radian, or half of the largest rate: errors do not add up any more.
_LOST = 0.5
# The size below which a number does not matter, as the defaults of `rtol` and `atol` have it.
_SMALL = 1e-3
# Where steps leave so many times what rounding adds up to without any growth, at a tolerance so
# far above a rounding, they do so with growth, too: both are local errors that grow alike.
_ABOVE, _COARSE = 300.0, 1e5


class Error(eqx.Module):
    """How far each part of the state is from the exact motion: `Solution.error`.

    **Fields:** `ts` (T,) s; `steps`, `round_off` by name (`q`, `omega`, `x`, `v`, `own.0` …) an
    array (T,): of a quaternion the angle of the turn, rad, of others the length of the difference
    (rad/s, m, m/s). Of `steps` the error is known to some percent; `round_off` is three standard
    deviations, the last digits of body, torque and start included. NaN where the run did not get
    to, inf where nothing closer could be computed. `lost` (T,) whether some part has exceeded 0.5 rad
    (others: half of the largest value) by then.

    >>> import rigidjax as rj
    >>> body, start = rj.Inertia.from_principal(1.0, 2.0, 3.0), rj.Spin([0.0, 1.0, 0.01])
    >>> error = rj.simulate(body, start, [0.0, 1.0, 20.0]).error
    >>> bool(error.total["omega"][-1] < 1e-14), float(error.known_until)
    (True, 20.0)
    """

    ts: Float[Array, " times"]
    steps: dict[str, Float[Array, " times"]]
    round_off: dict[str, Float[Array, " times"]]
    lost: Bool[Array, " times"]

    @property
    def total(self) -> dict[str, Float[Array, " times"]]:
        """Both parts together (T,), by name; inf where the state is `lost`."""
        both = jax.tree.map(jnp.hypot, self.steps, self.round_off)
        return jax.tree.map(lambda a: jnp.where(self.lost, jnp.inf, a), both)

    @property
    def known_until(self) -> Scalar:
        """The last of `ts` at which the state is known, s."""
        return self.ts[jnp.sum(~self.lost) - 1]


@eqx.filter_jit
def error_of_run(setup: Free | Loop | Setup, ts: Array, ys: Any, count: Array) -> Error:
    """The error of the states `ys` that `setup` gave at `ts` in `count` steps."""
    setup, ts, ys, count = lax.stop_gradient((setup, ts, ys, count))
    setup = dataclasses.replace(setup, throw=False)
    start = jax.tree.map(lambda leaf: leaf[0], ys)

    def away(setup: Any, start: Any, ts: Array) -> Array:
        return jax.vmap(minus)(solve(setup, start, ts)[0], ys)

    def lengths(changes: Array) -> dict[str, Array]:
        return {
            name.removeprefix("motion."): jnp.linalg.norm(part, axis=-1)
            for name, part in parts(start, changes).items()
        }

    def size(name: str, leaf: Array) -> Any:
        one = jnp.ones((), leaf.dtype)
        rows = leaf.reshape(ts.size, -1)
        return one if name == "q" else jnp.nanmax(jnp.linalg.norm(rows, axis=-1))

    reached = jnp.isfinite(jnp.sum(jax.vmap(minus)(ys, ys), axis=-1))
    second, rtol, factor = _closer(setup, ts)
    none = lengths(jnp.zeros((ts.size, dimension(start)), ts.dtype))
    named = zip(none, jax.tree.leaves(ys), strict=True)
    sizes = {name: size(name, leaf) for name, leaf in named}
    steps = none
    if second is not None:
        steps = jax.tree.map(lambda a: factor * a, lengths(away(second, start, ts)))
    # What rounding adds up to where nothing grows but the angle turned.
    eps = jnp.finfo(ts.dtype).eps
    plain = _ABOVE * eps * count.astype(ts.dtype) ** 1.5
    clear = [jnp.all((steps[name] > plain * sizes[name])[1:] | ~reached[1:]) for name in none]
    clear = jnp.all(jnp.stack(clear)) & (rtol > _COARSE * eps)
    short = jnp.where(clear, ts[0], ts)

    def neighbour(key: Array) -> Array:
        body, torque, y0 = _nudged((setup.body, setup.torque, start), key)
        moved = {} if isinstance(setup, Free) else {"torque": torque}
        return away(dataclasses.replace(setup, body=body, **moved), y0, short)

    changes = jax.vmap(neighbour)(jax.random.split(jax.random.key(0), _NEIGHBOURS))
    mean = jnp.sum(changes, 0) / (_NEIGHBOURS + 1)
    spread = (jnp.sum((changes - mean) ** 2, 0) + mean**2) / _NEIGHBOURS
    off = lengths(_DEVIATIONS * jnp.sqrt(spread))
    off = {name: jnp.where(clear, plain * sizes[name], off[name]) for name in off}

    def known(part: Array) -> Array:
        """Infinite where a run to compare with got less far."""
        return jnp.where(reached, jnp.where(jnp.isnan(part), jnp.inf, part), jnp.nan)

    steps, off = jax.tree.map(known, (steps, off))
    lost = [jnp.hypot(steps[k], off[k]) > _LOST * jnp.maximum(sizes[k], _SMALL) for k in none]
    return Error(ts, steps, off, lax.associative_scan(jnp.logical_or, jnp.any(jnp.stack(lost), 0)))


def _closer(setup: Any, ts: Array) -> tuple[Any, Any, float]:
    """The set-up of a closer run, the tolerance of the given one, and their distance's factor."""
    eps = float(jnp.finfo(ts.dtype).eps)
    if isinstance(setup, Free):
        return None, jnp.zeros(()), 1.0
    most = None if setup.max_steps is None else 4 * setup.max_steps
    if isinstance(setup, Loop):
        rtol = jnp.asarray(setup.rtol, ts.dtype)
        less = jnp.maximum(_CLOSER * rtol, 4 * eps)
        cuts = ts[0] + (ts[-1] - ts[0]) * jnp.arange(1, _CUTS).astype(ts.dtype) / _CUTS
        atol = setup.atol * (less / rtol)
        new = dict(rtol=less, atol=atol, cuts=cuts, max_steps=most)
        return dataclasses.replace(setup, **new), rtol, 1.0
    found: list[Any] = []

    def tighter(node: Any) -> Any:
        if isinstance(node, dfx.PIDController):
            found.append(node.rtol)
            less = jnp.maximum(_CLOSER * node.rtol, 4 * eps)
            atol = node.atol * (less / node.rtol)
            return eqx.tree_at(lambda c: (c.rtol, c.atol), node, (less, atol))
        return node

    pid = lambda node: isinstance(node, dfx.PIDController)  # noqa: E731
    controller = jax.tree.map(tighter, setup.controller, is_leaf=pid)
    new = dict(controller=controller, max_steps=most)
    if found:
        return dataclasses.replace(setup, **new), jnp.asarray(found[0], ts.dtype), 1.0
    if not isinstance(setup.controller, dfx.ConstantStepSize):
        raise TypeError(
            "error: a second run needs a diffrax.PIDController or ConstantStepSize, got "
            f"{type(setup.controller).__name__}"
        )
    # Of order 2; of a higher one it is a third too much at most.
    return dataclasses.replace(setup, **new, dt0=0.5 * setup.dt0), jnp.zeros(()), 4 / 3


def _nudged(tree: Any, key: Array) -> Any:
    """The numbers, each changed by up to a unit in its last digit; symmetric matrices stay so."""
    leaves, structure = jax.tree.flatten(tree)

    def moved(leaf: Any, key: Array) -> Any:
        if not eqx.is_inexact_array(leaf):
            return leaf
        noise = jax.random.uniform(key, leaf.shape, leaf.dtype, -1.0, 1.0)
        if leaf.ndim > 1 and leaf.shape[-1] == leaf.shape[-2]:
            noise = 0.5 * (noise + jnp.swapaxes(noise, -1, -2))
        return leaf * (1 + jnp.finfo(leaf.dtype).eps * noise)

    keys = jax.random.split(key, len(leaves) + 1)
    return jax.tree.unflatten(structure, list(map(moved, leaves, keys[:-1])))
