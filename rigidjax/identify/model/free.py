"""Find the free numbers of a scene: which leaf of the scene each number changes, and how."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from rigidjax import _checks
from rigidjax._types import Scalar
from rigidjax.identify.model.scene import Scene


class Free(eqx.Module):
    """Define a free number, which a fit moves: a number or an array in the torque or in the sensors
    of a `Scene` (the body, torques, sensors and initial state of a recording).

    **Arguments:**

    - `where`: a function that picks the number from a `Scene`, such as
      `lambda s: s.sensors[0].bias` or `lambda s: s.torque.coefficient`, or entries of an array,
      such as `lambda s: s.torque.coefficient[0]`. The value in the scene is the starting value. The
      numbers of the body are those of the model's chart.
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

    where: Callable[[Scene], Any]
    name: str
    scale: float
    each: bool | str | tuple[Any, ...]
    positive: bool
    prior: float | None
    spread: float | str | None
    unit: str | None

    def __init__(
        self,
        where: Callable[[Scene], Any],
        name: str,
        *,
        scale: float = 1.0,
        each: bool | str | Sequence[Any] = False,
        positive: bool = False,
        prior: float | None = None,
        spread: float | str | None = None,
        unit: str | None = None,
    ):
        _checks.require_function(
            where, "where", "of a scene, such as lambda s: s.torque.coefficient"
        )
        _checks.require_instance(name, str, "name")
        self.where, self.name = where, name
        here = f"Free {name!r}"
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
    """Return, after checks, the argument `each` of a `Free` (number that a fit may move). It says
    which recordings share a value of the number.

    `True`, `False` and `"body"` are returned as they are, and a sequence of labels (one for each
    recording) as a tuple. Another `each` raises an error, in which the argument is called `name`.
    """
    if isinstance(each, bool):
        return each
    if isinstance(each, str):
        return _checks.require_option(each, ("body",), name)
    wanted = 'True, False, "body", or a sequence of labels, one for each recording'
    return tuple(_checks.require_instance(each, Sequence, name, requirement=wanted))


class Slot(eqx.Module):
    """Hold a `Free` (a number or an array that a fit may move) together with its place in the
    scene.

    The scene is the body, torques, sensors and initial state of a recording. It is a JAX tree, and
    the number or array is a leaf of this tree.

    A `Slot` contains no function: a `Free` contains the function `where`, and a new function in a
    second model would force a new compilation. A *step* is the change of the leaf (of its
    logarithm, if `positive` is true) in units of `scale`.

    **Fields:**

    - `path`: the path of the leaf in the scene.
    - `name`, `unit`, `positive`, `scale`: the arguments of the `Free` with these names.
    - `each`: whether each recording has a value of its own.
    - `shape`: the shape of a step, which is the shape of the leaf or broadcasts to the shape of the
      leaf.
    - `labels`: the labels of the groups of recordings that share a value.
    - `groups`: (R,) the index of the group of each of R recordings; `None` if all recordings share
      one value, or each recording has a value of its own.
    - `prior`, `spread`: the standard deviations `prior` and `spread` of the `Free`, in units of
      `scale`, or `None`.
    - `estimated`: whether the fit estimates the `spread`.
    - `column`: the index of the first step among the free numbers on which one recording depends.
    - `shared`: (groups, *shape) the indices, among all free numbers, of the steps that recordings
      share; `None` if no recordings share a step.
    - `own`: (R, *shape) the indices, among all free numbers, of the steps that each recording has
      alone. Such a step is the change of the recording's own value, or the deviation from the
      shared step. `None` if all steps are shared.
    """

    path: tuple[Any, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    each: bool = eqx.field(static=True)
    positive: bool = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)
    labels: tuple[str, ...] = eqx.field(static=True)
    groups: Int[Array, " records"] | None
    scale: Float[Array, ""]
    prior: Float[Array, ""] | None
    spread: Float[Array, ""] | None
    estimated: bool = eqx.field(static=True, default=False)
    column: int = eqx.field(static=True, default=0)
    shared: Int[Array, "groups *shape"] | None = None
    own: Int[Array, "records *shape"] | None = None

    @property
    def columns_in_row(self) -> slice:
        """Return a slice that picks the steps of this slot from the free numbers of one recording.

        A slot describes an array of the scene that a fit may move. A step is the change of one
        number of this array, in units of `scale`.
        """
        return slice(self.column, self.column + int(np.prod(self.shape, dtype=int)))

    def moved_value(self, start: Array, step: Array) -> Array:
        """Return the value of the leaf (the free array of the scene) after a change by `step` from
        the value `start`.

        `step` is in units of `scale`. For a `positive` leaf it changes the logarithm of the value.
        `step` has the shape of `start`, or a shape that broadcasts to it.
        """
        if self.positive:
            return start * jnp.exp(step * self.scale)
        return start + step * self.scale

    def step_between(self, start: Array, value: Array) -> Array:
        """Return the change of the leaf (the free array of the scene) from the value `start` to the
        value `value`, in units of `scale`.

        For a `positive` leaf it is the change of the logarithm. This function is the inverse of
        `moved_value`.
        """
        if self.positive:
            return jnp.log(value / start) / self.scale
        return (value - start) / self.scale


def group_of_each_recording(
    each: str | tuple[Any, ...], body_names: Sequence[str], name: str
) -> tuple[Int[Array, " records"], tuple[str, ...]]:
    """Return two things: the index (R,) of the group of each of R recordings; and the labels of the
    groups.

    The recordings of a group share the value of a free number. The index of a group is the index of
    its label among the labels of the groups.

    - `each`: a tuple (R,) of labels, one for each recording: recordings with the same label are a
      group. The text `"body"` makes a group of the recordings of each body.
    - `body_names`: (R,) the name of the body of each recording.
    - `name`: what the object with the labels is called in an error, which is raised unless there
      are R labels.
    """
    row = list(body_names) if isinstance(each, str) else list(each)
    if len(row) != len(body_names):
        raise ValueError(
            f"{name}: wanted one label for each of {len(body_names)} recordings, got {len(row)}"
        )
    labels = list(dict.fromkeys(map(str, row)))
    rows = [labels.index(str(label)) for label in row]
    return jnp.asarray(rows, jnp.int32), tuple(labels)


def find_slots(free: Sequence[Free], scene: Scene, body_names: Sequence[str]) -> list[Slot]:
    """Return a `Slot` for each `Free` (number that a fit may move): the `Free` together with the
    path of its array in a `scene`, which is the body, torques, sensors and initial state of a
    recording.

    `body_names` (R,) holds the name of the body of each of R recordings. An error is raised if a
    `Free` picks no numbers, if it picks the numbers of another `Free`, or if it has the name of
    another `Free`.
    """
    slots: list[Slot] = []
    for item in free:
        _checks.require_instance(item, Free, "free", requirement="Free(where, name)")
        here = f"Free {item.name!r}"
        path, value = leaf_at(item.where, scene, here, "it")
        if any(share_numbers(slot.path, path) for slot in slots):
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
        prior = _tolerance_of_sensor(scene, path) if item.prior is None else item.prior
        prior, spread = (
            None if x is None else jnp.asarray(x / item.scale) for x in (prior, spread)
        )
        groups, labels = None, ()
        if not isinstance(item.each, bool):
            groups, labels = group_of_each_recording(item.each, body_names, here)
        unit = _unit_implied_by_name(scene, path) if item.unit is None else item.unit
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
    """Hold the last key of a path that leads to some entries of an array: their `places` in the
    array as one row, and the `shape` in which they were picked.
    """

    places: tuple[int, ...]
    shape: tuple[int, ...]


class _Picked:
    """Hold the place of a leaf of a tree, or of entries of it, for a function that picks one.

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


_ELSEWHERE = {
    "body": "the numbers of the body are those of the model's chart; instead of Known(body) take "
    'a chart of what is free, such as Ratios(), Tensor() or Mass(guess, ["inertia"])',
    "start": "the initial state needs no Free: it is free in every recording",
}


def leaf_at(
    where: Callable[[Any], Any], tree: PyTree, name: str, role: str
) -> tuple[tuple[Any, ...], Any]:
    """Return two things: the path of the numbers that the function `where` picks from a tree; and
    the numbers, an array or a float.

    The path is that of a leaf; if only some entries of the leaf are picked, an `Entries` follows.

    - `where`: a function of the `tree` that returns one of its leaves, or entries of it.
    - `tree`: a tree of JAX, such as a `Scene`.
    - `name`: what the object that has the function `where` is called in an error.
    - `role`: what the object that needs a starting value is called in an error.

    A `ValueError` is raised if `where` does not pick one array of numbers.
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
        return paths[picked.leaf], leaf
    flat = picked.places.ravel().tolist()
    if not flat or len(set(flat)) < len(flat):
        raise ValueError(f"{name}: wanted entries of an array, each once, got {flat}")
    path = (*paths[picked.leaf], Entries(tuple(flat), picked.places.shape))
    return path, entries_at(leaf, path)


def leaf_and_entries(path: tuple[Any, ...]) -> tuple[tuple[Any, ...], Entries | None]:
    """Return two things: the path of the leaf to which a path leads; and the entries of the leaf
    that it picks, or `None` for all of them.
    """
    return (path[:-1], path[-1]) if isinstance(path[-1], Entries) else (path, None)


def share_numbers(one: tuple[Any, ...], other: tuple[Any, ...]) -> bool:
    """Return whether two paths lead to the same leaf and have an entry of it in common."""
    (leaf, mine), (same, theirs) = leaf_and_entries(one), leaf_and_entries(other)
    apart = mine is not None and theirs is not None and not set(mine.places) & set(theirs.places)
    return leaf == same and not apart


def entries_at(leaf: Any, path: tuple[Any, ...], axes: int = 0) -> Array:
    """Return the numbers of a `leaf` to which its `path` leads. The first `axes` axes of the leaf
    count recordings, and are kept.
    """
    leaf, (_, some) = jnp.asarray(leaf), leaf_and_entries(path)
    if some is None:
        return leaf
    rows = leaf.shape[:axes]
    return leaf.reshape(*rows, -1)[..., np.array(some.places)].reshape(*rows, *some.shape)


# This maps the name of a number in the scene to its unit. A bias is not in this dict: its unit is
# the unit of its sensor.
_UNITS = {"offset": "s", "delay": "s", "mounting": "rad", "tilt": "rad", "place": "m"}


def _unit_implied_by_name(scene: Scene, path: tuple[Any, ...]) -> str:
    """Return the unit of the numbers at a `path` in a `scene`, if the name of these numbers implies
    a unit, else an empty text.

    A delay is in s, for instance, a mounting in rad, and the bias of a sensor in the unit of the
    sensor.

    - `scene`: the body, torque, sensors and initial state of a recording, as a tree of JAX.
    - `path`: the path (a tuple of keys of JAX) of the numbers in the tree; its last key has the
      name.
    """
    *way, last = leaf_and_entries(path)[0]
    name = getattr(last, "name", "")
    if name != "bias":
        return _UNITS.get(name, "")
    holder: Any = scene
    for key in way:
        holder = getattr(holder, key.name) if hasattr(key, "name") else holder[key.idx]
    return getattr(holder, "unit", "")


# This maps the name of a member of a sensor to the name of the tolerance from a data sheet that
# limits this member.
TOLERANCES = {"scale": "scale", "skew": "cross_axis", "bias": "bias", "offset": "clock"}


def _tolerance_of_sensor(scene: Scene, path: tuple[Any, ...]) -> Scalar | None:
    """Return the tolerance that a sensor states for the numbers at a `path` in a `scene`, or `None`
    if they are not numbers of a sensor, or have no tolerance.

    The tolerance is a standard deviation from a data sheet, such as the standard deviation of the
    bias of a gyro. It is taken as the standard deviation of the prior of these numbers.

    - `scene`: the body, torque, sensors and initial state of a recording, as a tree of JAX.
    - `path`: the path (a tuple of keys of JAX) of the numbers in the tree.
    """
    path, _ = leaf_and_entries(path)
    if len(path) != 3 or getattr(path[0], "name", "") != "sensors":
        return None
    tolerance = getattr(scene.sensors[path[1].idx], "tolerance", None)
    return getattr(tolerance, TOLERANCES.get(path[2].name, ""), None)


def with_steps(scene: Scene, slots: Sequence[Slot], row: Float[Array, " columns"]) -> Scene:
    """Return the `scene` of a recording after the changes of its free leaves (arrays of numbers).

    - `scene`: the scene with the starting value of each leaf.
    - `slots`: a `Slot` for each free leaf, with its path, scale and columns.
    - `row`: all free numbers of the recording. The columns of a slot (the numbers of `row` at these
      indices) are the change of its leaf, in units of its scale.
    """
    paths = [slot.path for slot in slots]
    values = []
    for slot, start in zip(slots, leaves_at(scene, paths), strict=True):
        value = slot.moved_value(start, row[slot.columns_in_row].reshape(slot.shape))
        values.append(value.astype(start.dtype))
    return with_leaves(scene, paths, values)


def leaves_at(scene: Scene, paths: Sequence[tuple[Any, ...]]) -> tuple[Array, ...]:
    """Return the leaves (arrays of numbers) of a `scene` at the `paths`, which are tuples of keys
    of JAX, or entries of leaves, as JAX arrays.

    A scene is the body, torques, sensors and initial state of a recording, as a tree of JAX.
    """
    leaves = dict(jax.tree.leaves_with_path(scene))
    return tuple(entries_at(leaves[leaf_and_entries(path)[0]], path) for path in paths)


def with_leaves(scene: Scene, paths: Sequence[tuple[Any, ...]], values: Sequence[Array]) -> Scene:
    """Return the `scene` with other leaves (arrays of numbers): the leaf at each of the `paths`,
    which are tuples of keys of JAX, is replaced by the array in `values` with the same index.

    A scene is the body, torques, sensors and initial state of a recording, as a tree of JAX.
    """
    pairs, structure = jax.tree.flatten_with_path(scene)
    leaves = dict(pairs)
    for path, value in zip(paths, values, strict=True):
        leaf, some = leaf_and_entries(path)
        if some is not None:
            whole = jnp.asarray(leaves[leaf])
            value = whole.reshape(-1).at[np.array(some.places)].set(value.reshape(-1))
            value = value.reshape(whole.shape)
        leaves[leaf] = value
    return jax.tree.unflatten(structure, [leaves[path] for path, _ in pairs])
