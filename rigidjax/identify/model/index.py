"""Find the places of the parameters of each recording among all parameters of a model."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rigidjax.identify.model.free import Slot


class Index(eqx.Module):
    """Hold the places of the parameters of each recording among the n parameters x of a model.

    x holds the parameters of the bodies, the steps of the `Slot`s that recordings share, the
    initial states of all recordings, and then the steps that one recording has alone. The row of a
    recording holds the parameters of its body, the step of each slot, and its initial state. If
    recordings deviate from the shared step of a slot, the step in the row is the sum of the shared
    step and of the deviation.
    """

    # The place in x of each column of the rows. A slot with deviations has further columns at the
    # end, which hold the places of the deviations. A column that stands for no parameter, as in the
    # row of a body whose chart has fewer parameters, has the place n.
    places: Int[Array, "records columns"]
    # The places in x of the parameters of each initial state.
    start: Int[Array, "records k"]
    # For each column of `places`, the column of the row to which its parameter is added.
    columns: tuple[int, ...] = eqx.field(static=True)
    # The columns of `places` whose parameters belong to one recording alone.
    alone: tuple[int, ...] = eqx.field(static=True)
    # The number of columns of a row.
    width: int = eqx.field(static=True)
    # How many parameters describe the bodies.
    bodies: int = eqx.field(static=True)
    # The first column of the initial state in a row.
    first: int = eqx.field(static=True)
    # The number n of parameters.
    size: int = eqx.field(static=True)

    def rows(self, x: Float[Array, " n"]) -> Float[Array, "records width"]:
        """Return the row of each recording: the parameters on which it depends."""
        wide = jnp.append(x, jnp.zeros(1, x.dtype))[self.places]
        twice = np.asarray(self.columns[self.width :], int)
        if not twice.size:
            return wide
        return wide[:, : self.width].at[:, twice].add(wide[:, self.width :])


class Placed(NamedTuple):
    """Hold the index of a model, and its slots with their places in x."""

    model_index: Index
    slots: tuple[Slot, ...]


def build_index(
    body_places: Int[np.ndarray, "records k"],
    slots: Sequence[Slot],
    start_size: int,
) -> Placed:
    """Return the index of a model, and its `slots` with their places in x.

    `body_places` is −1 where a body has fewer than k parameters. `start_size` is the number of
    parameters of an initial state, such as 6 for attitude and rate, or 2 for angle and rate.
    """
    count, body_number_count = len(body_places), int(body_places.max(initial=-1)) + 1
    end = body_number_count

    def take_places(*shape: int) -> np.ndarray:
        nonlocal end
        places = end + np.arange(int(np.prod(shape, dtype=int)))
        end += places.size
        return places.reshape(shape)

    shared = [None if s.each else take_places(max(len(s.labels), 1), *s.shape) for s in slots]
    first_alone = end
    # Three-vectors, or an angle and its rate.
    widths = (3,) * (start_size // 3) or (start_size,)
    start = np.concatenate([take_places(count, width) for width in widths], 1)
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
        parts = [None if x is None else jnp.asarray(x, jnp.int32) for x in (of_all, of_each)]
        placed.append(dataclasses.replace(slot, column=column, shared=parts[0], own=parts[1]))
        column += width
    width = column + start.shape[1]
    places = np.concatenate([*blocks, start, *twice], axis=1)
    places = np.where(places < 0, end, places)
    alone = np.flatnonzero((places >= first_alone).all(axis=0) & (places < end).all(axis=0))
    index = Index(
        jnp.asarray(places, jnp.int32),
        jnp.asarray(start, jnp.int32),
        (*range(width), *columns),
        tuple(alone.tolist()),
        width,
        body_number_count,
        column,
        end,
    )
    return Placed(index, tuple(placed))
