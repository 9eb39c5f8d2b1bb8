"""Join several recordings in one tree with a leading axis, so that one program fits all of them."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Int, PyTree

from rigidjax import _checks
from rigidjax.identify.data.recording import Reading, Recording
from rigidjax.motion.torques import Linear, Series


def stack(recordings: Sequence[Recording]) -> tuple[Recording, np.ndarray]:
    """Return the recordings as one `Recording` whose arrays have a leading axis, and the number of
    samples in time of each recording.

    Shorter recordings are padded with masked readings at their last time. Inputs and sensors may
    hold tables of time (a `Linear` or `Series`, which interpolates values between times). Shorter
    tables are padded with their last value.
    """
    counts = np.array([r.t.shape[0] for r in recordings], np.int32)
    rows = max(_count_table_rows(recording, 0) for recording in recordings)
    alike = [pad_recording(r, int(counts.max()), rows) for r in recordings]
    # An input may contain objects that are not numbers, such as functions. Such objects must be the
    # same for all recordings.
    numbers, others = zip(*(eqx.partition(r, _is_stackable) for r in alike), strict=True)
    shapes = [[np.shape(x) for x in jax.tree.leaves(r)] for r in numbers]
    for index, other in enumerate(others):
        if not (eqx.tree_equal(other, others[0]) is True and shapes[index] == shapes[0]):
            raise ValueError(
                f"recordings: the one at index {index} differs from the first in its sensors or "
                "its inputs; give all recordings the same kinds in the same order, with the same "
                "options"
            )
    return eqx.combine(jax.tree.map(_stack_leaves, *numbers), others[0]), counts


def _is_stackable(leaf: PyTree) -> bool:
    """Return whether a `leaf` (an end) of a tree of JAX is an array or a Python float.

    Such leaves of several recordings are stacked along a new axis; all other leaves must be the
    same in all recordings.
    """
    return eqx.is_array_like(leaf) and not isinstance(leaf, bool | int | complex)


def pad_to_few_lengths(model: PyTree) -> PyTree:
    """Return a `model` with its recordings padded by masked readings to one of a few allowed
    lengths.

    Recordings of similar length then share one compiled program. There are about four allowed
    lengths between any length and its double. A model of windows (short parts of a record of
    measured states) stays unchanged: all windows have one length already.
    """
    records = model.records
    if model.clusters is not None:
        return model
    longer = pad_recording(
        records,
        _padded_length(records.t.shape[1]),
        _padded_length(_count_table_rows(records, 1)),
        1,
    )
    return eqx.tree_at(lambda m: m.records, model, longer)


def _count_table_rows(recording: Recording, axis: int) -> int:
    """Return the length of the longest table in the inputs and sensors of a `recording`, or 0 if
    there is no table.

    A table is a `Linear` or a `Series`, which interpolates values between given times; its length
    is the count of these times. Inputs are logged quantities such as a motor command. The times of
    a table are along `axis`: 0 for one recording, 1 for several recordings with a leading axis.
    """
    parts = recording.inputs, recording.sensors
    tables = filter(_is_table, jax.tree.leaves(parts, is_leaf=_is_table))
    return max((int(table.values.shape[axis]) for table in tables), default=0)


def _padded_length(count: int) -> int:
    """Return the number of samples to which a recording or a table of time with `count` samples is
    padded.

    It is the least allowed number that is not below `count`. Only few numbers are allowed, so that
    few programs are compiled: the powers of 2^(1/4), rounded up to multiples of 16. For a `count`
    of 0 the result is 0.
    """
    if not count:
        return 0
    octaves = np.array([-1, 0]) + np.ceil(4.0 * np.log2(count))
    lengths = 16 * np.ceil(2.0 ** (octaves / 4.0) / 16)
    return int(lengths[0] if lengths[0] >= count else lengths[1])


def _stack_leaves(*leaves: PyTree) -> Array:
    """Return the `leaves`, arrays of one shape, stacked along a new first axis.

    The leaves are the arrays or numbers that have the same place in several trees of JAX.
    """
    # Use NumPy if the numbers are not traced: JAX would compile a program for each shape.
    if _checks.is_known(leaves):
        return _constant_array(np.stack([np.asarray(leaf) for leaf in leaves]))
    return jnp.stack(leaves)


def pick_records(records: PyTree, index: int | slice | Int[Array | np.ndarray, "*rows"]) -> PyTree:
    """Return the recordings at `index` from a tree whose arrays have a leading axis over
    recordings.

    **Arguments:**

    - `records`: the tree. Leaves that are not arrays are returned unchanged.
    - `index`: one index, a slice, or an array of indices.
    """

    def pick(leaf: PyTree) -> Any:
        if not eqx.is_array(leaf):
            return leaf
        known = _checks.is_known((leaf, index))
        return _constant_array(np.asarray(leaf)[index]) if known else leaf[index]

    return jax.tree.map(pick, records)


def _constant_array(array: np.ndarray | np.generic) -> Array:
    """Return a JAX array with the numbers of the NumPy `array`.

    Even within `jit` the result is a known array, which JAX does not trace.
    """
    with jax.ensure_compile_time_eval():
        return jnp.asarray(array)


def recordings_on_host(
    records: Recording, counts: Int[ArrayLike, " records"]
) -> tuple[Recording, ...]:
    """Return a tuple of single recordings with NumPy arrays, so that work on them compiles nothing.

    `records` holds the recordings with a leading axis, and `counts` (R,) the number of samples in
    time of each recording without padding.
    """
    known = jax.tree.map(lambda leaf: np.asarray(leaf) if eqx.is_array(leaf) else leaf, records)
    return tuple(
        take_rows(jax.tree.map(lambda x, i=i: x[i] if isinstance(x, np.ndarray) else x, known), n)
        for i, n in enumerate(np.asarray(counts).tolist())
    )


def take_rows(recording: Recording, end: int, begin: int = 0, axis: int = 0) -> Recording:
    """Return a recording with the times and readings of indices `begin` to `end` − 1.

    Times are along `axis`, which is 0 for one recording, and 1 for several recordings with a
    leading axis.
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
    """Return whether a `node` (a branch or an end) of a tree of JAX is a table of time: a `Linear`
    or a `Series`, which interpolates values between times.
    """
    return isinstance(node, Linear | Series)


def pad_recording(recording: Recording, count: int, rows: int = 0, axis: int = 0) -> Recording:
    """Return the recording padded to `count` times, with its tables of time padded to `rows` rows.

    Masked readings are added at the last time. A table of time (a `Linear` or `Series`, which
    interpolates values between times) is padded with its last value. Times are along `axis`, which
    is 0 for one recording, and 1 for several recordings with a leading axis.
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
            name: _extend_at_end(source, missing, axis) if eqx.is_array(source) else source
            for name, source in inputs.items()
        }
        t = _extend_at_end(t, missing, axis)
        parts = [
            (
                _extend_at_end(values, missing, axis),
                _extend_at_end(mask, missing, axis, False),
                None if late is None else _extend_at_end(late, missing, axis),
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
    """Return a `table` of time (a `Linear` or `Series`, which interpolates values between times)
    padded to `rows` times along `axis`.

    The last value of the table is repeated at later times. A table with enough times is unchanged.
    `axis` is 0 for the table of one recording, 1 for stacked tables of several recordings.
    """
    missing = rows - table.values.shape[axis]
    if missing <= 0:
        return table
    values = _extend_at_end(table.values, missing, axis)
    if isinstance(table, Series):
        slopes = _extend_at_end(table.slopes, missing, axis, 0.0)
        return eqx.tree_at(lambda s: (s.values, s.slopes), table, (values, slopes))
    last = table.times[..., -1:]
    more = last + (last - table.times[..., -2:-1]) * np.arange(1, missing + 1, dtype=last.dtype)
    times = jnp.concatenate([table.times, more], axis=-1)
    return eqx.tree_at(lambda s: (s.times, s.values), table, (times, values))


def _extend_at_end(
    values: ArrayLike, count: int, axis: int, fill: float | bool | None = None
) -> Array:
    """Return the array `values` with `count` entries added at the end of its axis number `axis`.

    Each added entry is a copy of the last entry or, if `fill` is given, filled with the number
    `fill`.
    """
    # Use NumPy if the numbers are not traced: JAX would compile a program for each shape.
    xp: Any = np if _checks.is_known(values) else jnp
    array = xp.asarray(values)
    edge = array[(slice(None),) * axis + (slice(-1, None),)]
    more = xp.repeat(edge if fill is None else xp.full_like(edge, fill), count, axis)
    return jnp.asarray(xp.concatenate([array, more], axis))
