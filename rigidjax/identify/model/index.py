"""Find the indices of the numbers of each recording among all free numbers of a model."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rigidjax.identify.model.free import Slot


class Index(eqx.Module):
    """Hold the places (indices) of the numbers of each recording among the n free numbers x of a
    model.

    A slot is an array of the scene (body, torques, sensors, initial state) that a fit may move, and
    a step is a change of this array. x holds the numbers of the bodies, then the steps that
    recordings share, then the numbers that belong to one recording alone. These are the initial
    states of all recordings, and then the own steps of all recordings. The row of a recording holds
    the numbers of its body, the step of each slot, and its initial state. If recordings deviate
    from the shared step of a slot, the step in the row is the sum of two numbers of x: the shared
    step and the deviation of the recording.

    **Fields:**

    - `places`: (R, columns) the place in x of each column of the rows. A slot with deviations has
      further columns at the end, which hold the places of the deviations. A column that stands for
      no number, as in the row of a body whose chart has fewer numbers, has the place n.
    - `start`: (R, k) the places in x of the k free numbers of the initial state of each recording.
    - `columns`: for each column of `places`, the column of the row to which the number at this
      place is added.
    - `alone`: the columns of `places` whose numbers belong to one recording alone.
    - `width`: the number of columns of a row.
    - `bodies`: how many numbers of x describe the bodies.
    - `first`: the first column of the initial state in a row.
    - `size`: n, how many free numbers there are.
    """

    places: Int[Array, "records columns"]
    start: Int[Array, "records n"]
    columns: tuple[int, ...] = eqx.field(static=True)
    alone: tuple[int, ...] = eqx.field(static=True)
    width: int = eqx.field(static=True)
    bodies: int = eqx.field(static=True)
    first: int = eqx.field(static=True)
    size: int = eqx.field(static=True)

    def rows_of_recordings(self, x: Float[Array, " n"]) -> Float[Array, "records row"]:
        """Return the row of each recording: the numbers (R, width) on which each of R recordings
        depends, taken from all n free numbers x (n,) of the model.
        """
        wide = jnp.append(x, jnp.zeros(1, x.dtype))[self.places]
        twice = np.asarray(self.columns[self.width :], int)
        if not twice.size:
            return wide
        return wide[:, : self.width].at[:, twice].add(wide[:, self.width :])


def build_index(
    body_places: Int[np.ndarray, "records numbers"],
    body_number_count: int,
    slots: Sequence[Slot],
    vectors_in_state: int,
) -> tuple[Index, tuple[Slot, ...]]:
    """Return two things: the `Index` of a model, which says where the numbers of each recording are
    among all free numbers x of the model; and the slots of the model with their places in x.

    **Arguments:**

    - `body_places`: (R, K) the places in x of the numbers of each recording's body, −1 where a
      body has fewer than K numbers.
    - `body_number_count`: how many numbers describe all bodies.
    - `slots`: the arrays of a scene that a fit may move, without their places in x.
    - `vectors_in_state`: the number of three-vectors in an initial state, such as 2 for
      attitude and rate.
    """
    count, end = len(body_places), body_number_count

    def take_places(*shape: int) -> np.ndarray:
        nonlocal end
        places = end + np.arange(int(np.prod(shape, dtype=int)))
        end += places.size
        return places.reshape(shape)

    shared = [None if s.each else take_places(max(len(s.labels), 1), *s.shape) for s in slots]
    first_alone = end
    start = np.concatenate(
        [np.zeros((count, 0), int), *(take_places(count, 3) for _ in range(vectors_in_state))], 1
    )
    own = [take_places(count, *s.shape) if s.each or s.spread is not None else None for s in slots]
    blocks, twice, columns, column = [body_places], [], [], body_places.shape[1]
    placed = []
    for slot, of_all, of_each in zip(slots, shared, own, strict=True):
        width = int(np.prod(slot.shape, dtype=int))
        if of_all is None:
            blocks.append(np.asarray(of_each).reshape(count, width))
        else:
            group = np.zeros(count, int) if slot.groups is None else np.asarray(slot.groups)
            blocks.append(of_all[group].reshape(count, width))
            if of_each is not None:
                twice.append(of_each.reshape(count, width))
                columns += range(column, column + width)
        parts = (None if x is None else jnp.asarray(x, jnp.int32) for x in (of_all, of_each))
        placed.append(_slot_with_places(slot, column, *parts))
        column += width
    blocks.append(start)
    width = column + start.shape[1]
    places = np.concatenate([*blocks, *twice], axis=1)
    places = np.where(places < 0, end, places)
    alone = tuple(np.flatnonzero((places >= first_alone).all(axis=0) & (places < end).all(axis=0)))
    index = Index(
        jnp.asarray(places, jnp.int32),
        jnp.asarray(start, jnp.int32),
        (*range(width), *columns),
        tuple(int(place) for place in alone),
        width,
        body_number_count,
        column,
        end,
    )
    return index, tuple(placed)


def _slot_with_places(slot: Slot, column: int, shared: Array | None, own: Array | None) -> Slot:
    """Return a `slot` with the places of its numbers among the free numbers of the model.

    A slot is an array of the scene (the body, torque, sensors and initial state) that a fit may
    move.

    - `slot`: the slot without these places.
    - `column`: the index of its first number among the free numbers of one recording.
    - `shared`: (groups, …) the indices of the numbers that groups of recordings share, among all
      free numbers of the model; `None` if each recording has numbers of its own alone.
    - `own`: (R, …) the indices of the numbers that each of R recordings has alone, among all free
      numbers of the model; `None` if all numbers are shared.
    """
    return dataclasses.replace(slot, column=column, shared=shared, own=own)
