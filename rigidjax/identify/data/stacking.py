"""Join several recordings in one tree with a leading axis, so that one program fits all of them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Int, PyTree

from rigidjax import _checks
from rigidjax.identify.data.recording import Reading, Recording, unchecked_recording
from rigidjax.motion.torques import Linear, Series


class Stacked(NamedTuple):
    """Hold several recordings as one, whose arrays have a leading axis."""

    records: Recording
    # The number of sample times of each recording, without padding.
    counts: Int[np.ndarray, " records"]


def stack(recordings: Sequence[Recording]) -> Stacked:
    """Return the recordings as one `Recording` whose arrays have a leading axis.

    Shorter recordings are padded as by `pad_recording`.
    """
    counts = np.array([r.t.shape[0] for r in recordings], np.int32)
    rows = max(_table_rows(recording, 0) for recording in recordings)
    alike = [pad_recording(r, int(counts.max()), rows) for r in recordings]

    def stackable(leaf: PyTree) -> bool:
        return eqx.is_array_like(leaf) and not isinstance(leaf, bool | int | complex)

    # An input may contain objects that are not numbers, such as functions. Such objects must be the
    # same for all recordings.
    numbers, others = zip(*(eqx.partition(r, stackable) for r in alike), strict=True)
    shapes = [[np.shape(x) for x in jax.tree.leaves(r)] for r in numbers]
    for index, other in enumerate(others):
        if not (eqx.tree_equal(other, others[0]) is True and shapes[index] == shapes[0]):
            raise ValueError(
                f"recordings: the one at index {index} differs from the first in its sensors or "
                "its inputs; give all recordings the same kinds in the same order, with the same "
                "options"
            )

    def join(*leaves: PyTree) -> Array:
        # Use NumPy if the numbers are not traced: JAX would compile a program for each shape.
        if _checks.is_known(leaves):
            return _constant(np.stack([np.asarray(leaf) for leaf in leaves]))
        return jnp.stack(leaves)

    return Stacked(eqx.combine(jax.tree.map(join, *numbers), others[0]), counts)


def pad_to_few(model: PyTree) -> PyTree:
    """Return a `model` with its recordings padded by masked readings to one of a few lengths.

    Recordings of similar length then share one compiled program. There are about four lengths
    between any length and its double. All windows have one length already.
    """
    if model.clusters is not None:
        return model

    def longer(records: Recording) -> Recording:
        count, rows = _padded_length(records.t.shape[1]), _padded_length(_table_rows(records, 1))
        return pad_recording(records, count, rows, 1)

    return with_records(model, [longer(one.records) for one in kinds_of(model)])


def kinds_of(model: PyTree) -> list[Any]:
    """Return a model for each kind of recordings of a `model`."""
    return [part.model for part in model.parts] or [model]


def with_records(model: PyTree, kinds: Sequence[Recording]) -> PyTree:
    """Return a `model` with other recordings, given kind by kind."""
    model = with_field(model, "records", kinds)
    return eqx.tree_at(lambda m: m.records, model, unite(kinds)) if model.parts else model


def with_field(model: PyTree, name: str, values: Sequence[Any]) -> PyTree:
    """Return a `model` with other `values` of a field, given kind by kind."""
    # `equinox.tree_at` takes an empty tuple as a leaf, which is no sequence.
    several = bool(model.parts)
    return eqx.tree_at(
        lambda m: [getattr(one, name) for one in (kinds_of(m) if several else [m])],
        model,
        list(values),
        is_leaf=lambda node: node is None,
    )


def unite(kinds: Sequence[Recording]) -> Recording:
    """Return recordings of several kinds, each with a leading axis, as one with all sensors.

    A sensor reads nothing in the recordings of another kind. Inputs are left out.
    """
    long, ends = max(r.t.shape[1] for r in kinds), np.cumsum([r.t.shape[0] for r in kinds])
    kinds = [r if r.t.shape[1] == long else pad_recording(r, long, 0, 1) for r in kinds]
    readings, every = [], np.arange(ends[-1])
    for record, end in zip(kinds, ends.tolist(), strict=True):
        count = record.t.shape[0]
        mine = (every >= end - count) & (every < end)
        for reading in pick(record.readings, np.clip(every - end + count, 0, count - 1)):
            mask = _apply("logical_and", reading.mask, mine[:, None])
            readings.append(eqx.tree_at(lambda r: r.mask, reading, mask))
    return unchecked_recording(_apply("concatenate", [r.t for r in kinds]), tuple(readings), {})


def _apply(name: str, *arrays: Any) -> Array:
    """Return the result of a function of NumPy, or of JAX if an array is traced."""
    if _checks.is_known(arrays):
        return _constant(getattr(np, name)(*arrays))
    return getattr(jnp, name)(*arrays)


def _table_rows(recording: Recording, axis: int) -> int:
    """Return the length of the longest table of time in the inputs and sensors, or 0.

    The times of a table are along `axis`: 0 for one recording, 1 for several.
    """
    parts = recording.inputs, recording.sensors
    tables = filter(_is_table, jax.tree.leaves(parts, is_leaf=_is_table))
    return max((int(table.values.shape[axis]) for table in tables), default=0)


def _padded_length(count: int) -> int:
    """Return the least allowed length that is not below `count`, or 0 for 0.

    Allowed are the powers of 2^(1/4), rounded up to multiples of 16.
    """
    if not count:
        return 0
    octaves = np.array([-1, 0]) + np.ceil(4.0 * np.log2(count))
    lengths = 16 * np.ceil(2.0 ** (octaves / 4.0) / 16)
    return int(lengths[0] if lengths[0] >= count else lengths[1])


def pick(records: PyTree, index: int | slice | Int[Array | np.ndarray, "*rows"]) -> PyTree:
    """Return the recordings at `index`, in the leading axis of all arrays of a pytree."""

    def chosen(leaf: PyTree) -> Any:
        if not eqx.is_array(leaf):
            return leaf
        known = _checks.is_known((leaf, index))
        return _constant(np.asarray(leaf)[index]) if known else leaf[index]

    return jax.tree.map(chosen, records)


def _constant(array: np.ndarray | np.generic) -> Array:
    """Return a JAX array that is known even within `jit`."""
    with jax.ensure_compile_time_eval():
        return jnp.asarray(array)


def on_host(records: Recording, counts: Int[ArrayLike, " records"]) -> tuple[Recording, ...]:
    """Return single recordings with NumPy arrays, so that work on them compiles nothing.

    `counts` holds the number of sample times of each recording without padding.
    """
    known = jax.tree.map(lambda leaf: np.asarray(leaf) if eqx.is_array(leaf) else leaf, records)
    return tuple(
        take_rows(jax.tree.map(lambda x, i=i: x[i] if isinstance(x, np.ndarray) else x, known), n)
        for i, n in enumerate(np.asarray(counts).tolist())
    )


def take_rows(recording: Recording, end: int, begin: int = 0, axis: int = 0) -> Recording:
    """Return a recording with the times and readings of indices `begin` to `end` − 1.

    Times are along `axis`: 0 for one recording, 1 for several.
    """
    if recording.t.shape[axis] == end - begin:
        return recording
    rows = (slice(None),) * axis + (slice(begin, end),)

    def arrays_over_time(r: Recording) -> list[Any]:
        parts = [(reading.values, reading.mask, reading.jitter_error) for reading in r.readings]
        return jax.tree.leaves((r.t, parts))

    shorter = eqx.tree_at(
        arrays_over_time, recording, [leaf[rows] for leaf in arrays_over_time(recording)]
    )
    inputs = {
        name: source[rows] if eqx.is_array(source) else source
        for name, source in recording.inputs.items()
    }
    return eqx.tree_at(lambda r: r.inputs, shorter, inputs) if inputs else shorter


def _is_table(node: PyTree) -> bool:
    return isinstance(node, Linear | Series)


def pad_recording(recording: Recording, count: int, rows: int = 0, axis: int = 0) -> Recording:
    """Return the recording with masked readings at its last time, `count` times in all.

    Tables of time in inputs and sensors are padded to `rows` rows with their last value. Times are
    along `axis`: 0 for one recording, 1 for several.
    """
    missing = count - recording.t.shape[axis]
    # Pad the tables (values at given times) in sensors as well as in inputs: a sensor that observes
    # a moving object, for example, may hold a table, too.
    inputs, sensors = jax.tree.map(
        lambda node: _pad_table(node, rows, axis) if _is_table(node) else node,
        (recording.inputs, recording.sensors),
        is_leaf=_is_table,
    )
    t = recording.t
    parts = [(r.values, r.mask, r.jitter_error) for r in recording.readings]
    if missing:
        inputs = {
            name: _extend(source, missing, axis) if eqx.is_array(source) else source
            for name, source in inputs.items()
        }
        t = _extend(t, missing, axis)
        parts = [
            (
                _extend(values, missing, axis),
                _extend(mask, missing, axis, False),
                None if late is None else _extend(late, missing, axis),
            )
            for values, mask, late in parts
        ]
    return eqx.tree_at(
        lambda r: (r.t, r.inputs, r.readings),
        recording,
        (t, inputs, tuple(Reading(s, *part) for s, part in zip(sensors, parts, strict=True))),
        is_leaf=lambda node: node is None,
    )


def _pad_table(table: Linear | Series, rows: int, axis: int) -> Linear | Series:
    """Return a table of time with its last value repeated at later times, up to `rows` rows."""
    missing = rows - table.values.shape[axis]
    if missing <= 0:
        return table
    values = _extend(table.values, missing, axis)
    if isinstance(table, Series):
        slopes = _extend(table.slopes, missing, axis, 0.0)
        return eqx.tree_at(lambda s: (s.values, s.slopes), table, (values, slopes))
    last = table.times[..., -1:]
    more = last + (last - table.times[..., -2:-1]) * np.arange(1, missing + 1, dtype=last.dtype)
    times = jnp.concatenate([table.times, more], axis=-1)
    return eqx.tree_at(lambda s: (s.times, s.values), table, (times, values))


def _extend(values: ArrayLike, count: int, axis: int, fill: float | bool | None = None) -> Array:
    """Return `values` with `count` copies of the last entry, or of `fill`, at its end."""
    # Use NumPy if the numbers are not traced: JAX would compile a program for each shape.
    xp: Any = np if _checks.is_known(values) else jnp
    array = xp.asarray(values)
    edge = array[(slice(None),) * axis + (slice(-1, None),)]
    more = xp.repeat(edge if fill is None else xp.full_like(edge, fill), count, axis)
    return jnp.asarray(xp.concatenate([array, more], axis))
