"""Find the parameters of a scene: which leaf of the scene each number changes, and how."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from rigidjax import _checks
from rigidjax._types import NumbersLike
from rigidjax.identify.model.scene import Scene
from rigidjax.identify.sensors.base import extras


class Free(eqx.Module):
    """Define a parameter, which a fit moves: a number or an array in the torque or in the sensors
    of a `Scene` (the body, torques, sensors and initial state of a recording).

    **Arguments:**

    - `where`: a function that picks the number from a `Scene`, such as
      `lambda s: s.sensors[0].bias` or `lambda s: s.torque.coefficient`, or entries of an array,
      such as `lambda s: s.torque.coefficient[0]`. The value in the scene is the starting value. The
      numbers of the body are those of the model's chart. Or the starting value itself, of a number
      or an array that belongs to no scene, such as a length: a `Measured` reads
      `point.values[name]`.
    - `name`: the name of the number in reports.
    - `scale`: the natural size of the number, in the unit of the number; inside the fit the number
      is in units of this size.
    - `each`: `False` for one value for all recordings; `True` for a value for each recording;
      `"body"` for a value for each body; or a sequence of labels, one for each recording:
      recordings with the same label share a value.
    - `positive`: whether the fit moves the logarithm of the number, so that its sign is kept.
    - `prior`: the standard deviation of a normal prior about the starting value. It is in the unit
      of the number, or relative to the number if `positive` is true. With `None` it is the standard
      deviation that the sensor's `Tolerance` (the size of its constant errors) states for this
      number; there is no prior if the sensor states none.
    - `spread`: if the value of each recording deviates from the shared value, the standard
      deviation of these deviations; `None` for no deviations. It is in the unit of the number, or
      relative to the number if `positive` is true. With `"estimated"` the fit estimates it from
      three recordings or more, and `scale` is the first guess.
    - `unit`: the unit of the number in reports. With `None` the unit is found for a bias, delay,
      clock offset, mounting, tilt or place; other numbers have no unit.

    **Raises** `ValueError` for a scale, prior or spread that is not positive, and for a spread
    together with `each=True`.

    >>> Free(lambda s: s.sensors[0].bias, "gyro bias", scale=0.01, spread=0.02).name
    'gyro bias'
    """

    where: Callable[[Scene], Any] | Array
    name: str
    scale: float
    each: bool | str | tuple[Any, ...]
    positive: bool
    prior: float | None
    spread: float | str | None
    unit: str | None

    def __init__(
        self,
        where: Callable[[Scene], Any] | NumbersLike,
        name: str,
        *,
        scale: float = 1.0,
        each: bool | str | Sequence[Any] = False,
        positive: bool = False,
        prior: float | None = None,
        spread: float | str | None = None,
        unit: str | None = None,
    ):
        _checks.require_instance(name, str, "name")
        self.name, here = name, f"Free {name!r}"
        if not callable(where):
            where = _checks.require_finite(_checks.numeric_array(where, here), here)
        self.where = where
        self.unit = None if unit is None else _checks.require_instance(unit, str, f"{here}: unit")
        self.scale = _checks.positive_float(scale, f"{here}: scale")
        self.each = checked_labels(each, f"{here}: each")
        self.positive = positive
        self.prior = None if prior is None else _checks.positive_float(prior, f"{here}: prior")
        if spread is not None and spread != "estimated":
            wanted = 'a positive number or "estimated"'
            spread = _checks.positive_float(spread, f"{here}: spread", wanted)
        self.spread = spread
        if each is True and spread is not None:
            raise ValueError(
                f"{here}: wanted no spread with each=True, which has no shared value to deviate "
                "from; give a prior, or each=False"
            )


def checked_labels(each: object, name: str) -> bool | str | tuple[Any, ...]:
    """Return the argument `each` of a `Free` after checks, a sequence of labels as a tuple.

    `name` is the argument's name in an error.
    """
    if isinstance(each, bool):
        return each
    if isinstance(each, str):
        return _checks.require_option(each, ("body",), name)
    wanted = 'True, False, "body", or a sequence of labels, one for each recording'
    return tuple(_checks.require_instance(each, Sequence, name, requirement=wanted))


class Slot(eqx.Module):
    """Hold a `Free` together with the place of its leaf in a `Scene`.

    It contains no function: a new `where` in a second model would force a new compilation. A *step*
    is the change of the leaf (of its logarithm, if `positive`) in units of `scale`.
    """

    path: tuple[Any, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    # Whether each recording has a value of its own.
    each: bool = eqx.field(static=True)
    positive: bool = eqx.field(static=True)
    # The shape of a step, which is the shape of the leaf or broadcasts to it.
    shape: tuple[int, ...] = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)
    # The group of each recording; `None` if all share one value, or each has its own.
    groups: Int[Array, " records"] | None
    scale: Float[Array, ""]
    # These are standard deviations in units of `scale`.
    prior: Float[Array, ""] | None
    spread: Float[Array, ""] | None
    # Whether the fit estimates the spread.
    estimated: bool = eqx.field(static=True, default=False)
    # The first column of the step in the row of a recording.
    column: int = eqx.field(static=True, default=0)
    # The places in x of the steps that recordings share, or `None`.
    shared: Int[Array, "groups *shape"] | None = None
    # The places in x of the steps that each recording has alone, or `None`: steps of its own value,
    # or deviations from the shared step.
    own: Int[Array, "records *shape"] | None = None

    @property
    def columns(self) -> slice:
        """Return a slice that picks the step of this slot from the row of a recording."""
        return slice(self.column, self.column + int(np.prod(self.shape, dtype=int)))

    def moved(self, start: Array, step: Array) -> Array:
        """Return the value of the leaf after a `step` from its value `start`."""
        if self.positive:
            return start * jnp.exp(step * self.scale)
        return start + step * self.scale

    def step(self, start: Array, value: Array) -> Array:
        """Return the step from the value `start` to `value`; it inverts `moved`."""
        if self.positive:
            return jnp.log(value / start) / self.scale
        return (value - start) / self.scale


class Groups(NamedTuple):
    """Hold the groups of recordings that share the value of a parameter."""

    # The index of the group of each recording among the labels.
    indices: Int[Array, " records"]
    labels: tuple[str, ...]


def group_recordings(each: str | tuple[Any, ...], body_names: Sequence[str], name: str) -> Groups:
    """Return the groups of recordings with the same label, or of the same body for `"body"`.

    `name` stands in errors for the object with the labels.
    """
    row = list(body_names) if isinstance(each, str) else list(each)
    if len(row) != len(body_names):
        raise ValueError(
            f"{name}: wanted one label for each of {len(body_names)} recordings, got {len(row)}"
        )
    labels = list(dict.fromkeys(map(str, row)))
    rows = [labels.index(str(label)) for label in row]
    return Groups(jnp.asarray(rows, jnp.int32), tuple(labels))


# This maps the name of a number in the scene to its unit. A bias is not in this dict: its unit is
# the unit of its sensor.
_UNITS = {"offset": "s", "delay": "s", "mounting": "rad", "tilt": "rad", "place": "m"}
# This maps the name of a member of a sensor to the name of the tolerance from a data sheet that
# limits this member.
TOLERANCES = {"scale": "scale", "skew": "cross_axis", "bias": "bias", "offset": "clock"}


def added_slots(
    free: Sequence[Free], scene: Scene, body_names: Sequence[str], taken: Sequence[Slot] = ()
) -> list[Slot]:
    """Return the slots in `taken`, and for each `Free` one more `Slot`, without places in x yet.

    An error is raised if a `Free` picks no numbers, or the numbers or the name of another one.
    """
    slots, beside = list(taken), 0
    for item in free:
        _checks.require_instance(item, Free, "free", requirement="Free(where, name)")
        here, where = f"Free {item.name!r}", item.where
        if not callable(where):
            where, beside = (lambda s, k=beside: s.beside[k]), beside + 1
        path, value = leaf_at(where, scene, here, "it")
        if any(overlap(slot.path, path) for slot in slots):
            raise ValueError(
                f"{here}: another Free already frees the same numbers; give each array one Free"
            )
        if any(slot.name == item.name for slot in slots):
            raise ValueError(f"{here}: another Free has this name; give each Free its own name")
        if item.positive and not (np.asarray(value) > 0).all():
            raise ValueError(f"{here}: wanted a positive starting value, got {value}")
        estimated = isinstance(item.spread, str)
        if estimated and len(body_names) < 3:
            raise ValueError(
                f"{here}: wanted three recordings or more to estimate a spread, got "
                f"{len(body_names)}; give the spread as a number"
            )
        spread = item.scale if isinstance(item.spread, str) else item.spread
        way, prior = split_path(path).leaf, item.prior
        if prior is None and len(way) == 3 and getattr(way[0], "name", "") == "sensors":
            # What the sensor's data sheet states for the number is its prior.
            tolerance = extras(scene.sensors[way[1].idx]).tolerance
            prior = getattr(tolerance, TOLERANCES.get(way[2].name, ""), None)
        prior, spread = (
            None if x is None else jnp.asarray(x / item.scale) for x in (prior, spread)
        )
        groups, labels = None, ()
        if not isinstance(item.each, bool):
            groups, labels = group_recordings(item.each, body_names, here)
        unit = item.unit
        if unit is None:
            name = getattr(way[-1], "name", "")
            unit = _UNITS.get(name, "")
            if name == "bias":
                holder: Any = scene
                for key in way[:-1]:
                    holder = getattr(holder, key.name) if hasattr(key, "name") else holder[key.idx]
                unit = getattr(holder, "unit", "")
        slots.append(
            Slot(
                path,
                item.name,
                unit,
                item.each is True,
                item.positive,
                tuple(np.shape(value)),
                labels,
                groups,
                jnp.asarray(item.scale),
                prior,
                spread,
                estimated,
            )
        )
    return slots


class Entries(NamedTuple):
    """Hold the last key of a path that leads to some entries of an array."""

    # The places of the entries in the flat array.
    places: tuple[int, ...]
    # The shape in which they were picked.
    shape: tuple[int, ...]


class Leaf(NamedTuple):
    """Hold the path of the numbers that a function picks, and the numbers."""

    # The path of a leaf; if only some entries of the leaf are picked, an `Entries` follows.
    path: tuple[Any, ...]
    value: Any


class SplitPath(NamedTuple):
    """Hold a path without its `Entries`, and these entries: `None` for the whole leaf."""

    leaf: tuple[Any, ...]
    entries: Entries | None


class _Picked:
    """Hold the place of a leaf of a pytree, or of entries of it, for a function that picks one.

    Entries are picked as in an array; any arithmetic fails, since its result is no place.
    """

    def __init__(self, leaf: int, places: np.ndarray):
        self.leaf, self.places = leaf, places

    def __getitem__(self, index: Any) -> "_Picked":
        return _Picked(self.leaf, np.asarray(self.places[index]))


class _NotHere:
    """Raise an error, which says why, if a number of this part of a scene is picked."""

    def __init__(self, why: str):
        self.why = why

    def __getattr__(self, name: str) -> Any:
        raise ValueError(self.why)

    __getitem__ = __getattr__


_ELSEWHERE = {
    "body": "the numbers of the body are those of the model's chart; instead of Known(body) take "
    'a chart of what is free, such as Ratios(), Tensor() or Mass(guess, ["inertia"])',
    "start": "the initial state needs no Free: it is free in every recording",
}


def leaf_at(where: Callable[[Any], Any], tree: PyTree, name: str, role: str) -> Leaf:
    """Return the path and the value of the numbers that `where` picks from a pytree.

    In errors, `name` stands for the object with this `where`, and `role` for the object that needs
    a starting value. `ValueError` is raised if `where` does not pick one array of numbers.
    """
    pairs, structure = jax.tree.flatten_with_path(tree)
    paths, leaves = [path for path, _ in pairs], [leaf for _, leaf in pairs]
    places = [np.arange(np.size(leaf)).reshape(np.shape(leaf)) for leaf in leaves]
    marked = jax.tree.unflatten(structure, list(map(_Picked, range(len(leaves)), places)))
    if isinstance(tree, Scene):
        for part in (part for part in _ELSEWHERE if getattr(tree, part) is None):
            object.__setattr__(marked, part, _NotHere(f"{name}: {_ELSEWHERE[part]}"))
    try:
        picked = where(marked)
    except (AttributeError, IndexError, TypeError) as error:
        if "'NoneType' object is not subscriptable" not in str(error):
            nothing = "wanted numbers at the place that `where` picks, but nothing is there"
            if "_Picked" in str(error):
                nothing = (
                    "`where` picks numbers of the scene as they stand, or entries of them, such as "
                    "s.torque.coefficient[0]; a function of them is no place"
                )
            words = f"{name}: {nothing} ({error})".replace("_Picked", "array")
            raise ValueError(words) from None
        picked = None
    if picked is None:
        raise ValueError(
            f"{name}: wanted numbers at the place that `where` picks, but None is there; give "
            f"{role} a starting value, such as Gyro(bias=[0.0, 0.0, 0.0])"
        )
    if isinstance(picked, _NotHere):
        raise ValueError(picked.why)
    if not isinstance(picked, _Picked):
        kind = name.split()[0]
        raise ValueError(
            f"{name}: wanted one array, got {type(picked).__name__}; give one {kind} for each array"
        )
    leaf = leaves[picked.leaf]
    # This is not `equinox.is_inexact_array_like`, which raises an error for a leaf that JAX traces,
    # because this leaf has a `__jax_array__` of `None`.
    if not (eqx.is_inexact_array(leaf) or isinstance(leaf, float)):
        raise ValueError(f"{name}: wanted numbers, got {type(leaf).__name__}")
    if np.array_equal(picked.places, places[picked.leaf]):
        return Leaf(paths[picked.leaf], leaf)
    flat = picked.places.ravel().tolist()
    if not flat or len(set(flat)) < len(flat):
        raise ValueError(f"{name}: wanted entries of an array, each once, got {flat}")
    path = (*paths[picked.leaf], Entries(tuple(flat), picked.places.shape))
    return Leaf(path, entries_at(leaf, path))


def split_path(path: tuple[Any, ...]) -> SplitPath:
    return (
        SplitPath(path[:-1], path[-1]) if isinstance(path[-1], Entries) else SplitPath(path, None)
    )


def overlap(one: tuple[Any, ...], other: tuple[Any, ...]) -> bool:
    """Return whether two paths lead to the same leaf and have an entry of it in common."""
    (leaf, mine), (same, theirs) = split_path(one), split_path(other)
    apart = mine is not None and theirs is not None and not set(mine.places) & set(theirs.places)
    return leaf == same and not apart


def entries_at(leaf: Any, path: tuple[Any, ...], axes: int = 0) -> Array:
    """Return the numbers at the `path` in a `leaf`, whose first `axes` count recordings."""
    leaf, (_, some) = jnp.asarray(leaf), split_path(path)
    if some is None:
        return leaf
    rows = leaf.shape[:axes]
    return leaf.reshape(*rows, -1)[..., np.array(some.places)].reshape(*rows, *some.shape)


def leaves_at(scene: Scene, paths: Sequence[tuple[Any, ...]]) -> tuple[Array, ...]:
    """Return the numbers of a `scene` at the `paths` as JAX arrays."""
    leaves = dict(jax.tree.leaves_with_path(scene))
    return tuple(entries_at(leaves[split_path(path).leaf], path) for path in paths)


def with_leaves(scene: Scene, paths: Sequence[tuple[Any, ...]], values: Sequence[Array]) -> Scene:
    """Return the `scene` with other numbers at the `paths`."""
    pairs, structure = jax.tree.flatten_with_path(scene)
    leaves = dict(pairs)
    for path, value in zip(paths, values, strict=True):
        leaf, some = split_path(path)
        if some is not None:
            whole = jnp.asarray(leaves[leaf])
            value = whole.reshape(-1).at[np.array(some.places)].set(value.reshape(-1))
            value = value.reshape(whole.shape)
        leaves[leaf] = value
    return jax.tree.unflatten(structure, [leaves[path] for path, _ in pairs])
