"""Run a program on many bodies, with the bodies in the last axis of every array.

XLA on CPU makes vector instructions for arrays whose last axis is the batch. `jax.vmap` puts the
batch axis first, which makes a loop over small states many times slower. Therefore a rule of
`jax.custom_batching.custom_vmap` moves the batch axis of any `jax.vmap` to the end.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero, zero_from_primal
from jaxtyping import Array, PyTree

from rigidjax.rotation.barrier import platform

Arrays = list[Any]

# The number of bodies that go through a loop together on CPU. It is small, so that the arrays of
# these bodies stay in the first-level cache.
BLOCK = 16


class Layout(NamedTuple):
    """Describe which arrays of a program have a last axis for the bodies of a batch."""

    bodies: bool  # whether the arrays of each body have this axis; without it there is one body
    shared: tuple[bool, ...]  # for each constant, whether all bodies share it, without this axis

    def vmap(self, function: Callable[..., PyTree]) -> Callable[..., PyTree]:
        """Map `function(constants, t, y)` of one body over the bodies in the last axis, if any."""
        axes = [None if s else -1 for s in self.shared]
        return jax.vmap(function, (axes, -1, -1), -1) if self.bodies else function

    def broadcast(
        self, constants: Arrays, per_body: list[bool], like: Array
    ) -> tuple["Layout", Arrays]:
        """Give the shared constants that are `per_body` a last axis, as long as that of `like`."""
        if not self.bodies:
            return self, constants
        own = [s and w for s, w in zip(self.shared, per_body, strict=True)]
        constants = [
            jnp.broadcast_to(c[..., None], (*c.shape, like.shape[-1])) if o else c
            for c, o in zip(constants, own, strict=True)
        ]
        shared = tuple(s and not o for s, o in zip(self.shared, own, strict=True))
        return self._replace(shared=shared), constants


# `program(layout, constants, each)` takes two lists of arrays: `constants`, which bodies may share,
# and `each`, in whose arrays each body has values of its own. It returns a list of arrays in which
# each body has values of its own.
Program = Callable[[Layout, Arrays, Arrays], Arrays]


def bodies_last(
    program: Program,
    constants: Arrays,
    each: Arrays,
    num_linear: int = 0,
    layout: Layout | None = None,
) -> Arrays:
    """Run a program with the bodies of any `jax.vmap` in the last axis of all arrays.

    It is linear in the last `num_linear` arrays of `each`, such as tangents. A `jax.vmap` over
    these alone adds tangents, not bodies: its axis is not moved. `layout` says which arrays have
    bodies already; `None` stands for one body.
    """
    was = Layout(False, (True,) * len(constants)) if layout is None else layout
    number = len(constants)
    call: Any = jax.custom_batching.custom_vmap(partial(_in_blocks, program, was, number))

    @call.def_vmap
    def _(size: int, batched: Any, *args: Any) -> Any:
        constants, each = list(args[:number]), list(args[number:])
        own, rest = batched[:number], batched[number:]
        many = len(each) - num_linear
        if not any(batched):
            # JAX calls this rule for `vmap` even where no argument is batched, but only tangents of
            # the arguments are: there is no new axis.
            out = program(was, constants, each)
            return out, [False] * len(out)
        if not any(own) and not any(rest[:many]):
            axes = [0 if b else None for b in rest[many:]]

            def over(layout: Layout, constants: Arrays, each: Arrays) -> Arrays:
                one = lambda *along: program(layout, constants, [*each[:many], *along])  # noqa: E731
                return jax.vmap(one, axes, axis_size=size)(*each[many:])

            out = bodies_last(over, constants, each, num_linear, was)
            return out, [True] * len(out)
        new = Layout(True, tuple(s and not b for s, b in zip(was.shared, own, strict=True)))
        count = each[0].shape[-1] if was.bodies else 1

        def last(a: Any, is_batched: bool, has_bodies: bool) -> Any:
            a = jnp.moveaxis(a, 0, -1) if is_batched else a[..., None]
            a = a if was.bodies and has_bodies else a[..., None, :]
            a = jnp.broadcast_to(a, (*a.shape[:-2], count, size))
            return a.reshape(*a.shape[:-2], count * size)

        constants = [
            c if shared else last(c, b, not before)
            for c, shared, b, before in zip(constants, new.shared, own, was.shared, strict=True)
        ]
        each = [last(a, b, True) for a, b in zip(each, rest, strict=True)]
        out = bodies_last(program, constants, each, num_linear, new)

        def first(a: Any) -> Any:
            a = a.reshape(*a.shape[:-1], count, size) if was.bodies else a
            return jnp.moveaxis(a, -1, 0)

        return [first(a) for a in out], [True] * len(out)

    answer: Any = jax.custom_jvp(lambda *args: call(*args))
    # The derivative rule of `custom_vmap` gives wrong shapes for a batch of tangents, so that
    # `_with_tangent` is used instead.
    answer.defjvp(partial(_with_tangent, program, was, number, num_linear), symbolic_zeros=True)
    return answer(*constants, *each)


def _with_tangent(
    program: Program,
    layout: Layout,
    num_constants: int,
    num_linear: int,
    primals: tuple[PyTree, ...],
    tangents: tuple[PyTree, ...],
) -> tuple[Arrays, Arrays]:
    """Return the result of a program and its tangent, by one run of both."""
    # The other primals are the arrays `each`.
    constants, each = list(primals[:num_constants]), list(primals[num_constants:])
    moving = [not isinstance(t, SymbolicZero) for t in tangents]
    # The tangents are passed together with the arrays `each`, in which every body has values of its
    # own. The tangent of a constant that all bodies share therefore needs a last axis of bodies.
    # `with_tangents` adds this axis to the constant, too, so that it has the shape of its tangent.
    _, along = layout.broadcast(list(tangents[:num_constants]), moving[:num_constants], each[0])
    along = [t for t, m in zip([*along, *tangents[num_constants:]], moving, strict=True) if m]

    def with_tangents(layout: Layout, constants: Arrays, rest: Arrays) -> Arrays:
        layout, constants = layout.broadcast(constants, moving[:num_constants], rest[0])
        args = [*constants, *rest[: len(each)]]
        moved = with_replacements([zero_from_primal(a) for a in args], moving, rest[len(each) :])
        one = lambda *args: program(layout, list(args[:num_constants]), list(args[num_constants:]))  # noqa: E731
        pairs = zip(*jax.jvp(one, args, moved), strict=True)
        return [a for o, m in pairs for a in ([o, m] if eqx.is_inexact_array(o) else [o])]

    out, moved = [], []
    found = iter(
        bodies_last(with_tangents, constants, [*each, *along], num_linear + len(along), layout)
    )
    for a in found:
        out.append(a)
        moved.append(next(found) if eqx.is_inexact_array(a) else zero_from_primal(a))
    return out, moved


def _in_blocks(program: Program, layout: Layout, num_constants: int, *args: Any) -> Arrays:
    """Return the result of a program, computed on CPU for at most `BLOCK` bodies at a time."""
    constants, each = list(args[:num_constants]), list(args[num_constants:])
    count = each[0].shape[-1] if layout.bodies else 1
    if platform() != "cpu" or count <= BLOCK:
        return program(layout, constants, each)
    num_blocks = -(-count // BLOCK)
    size = -(-count // num_blocks)

    def cut(a: Any) -> Any:
        room = num_blocks * size - count
        if room:
            a = jnp.concatenate([a, jnp.repeat(a[..., -1:], room, -1)], -1)
        return jnp.moveaxis(a.reshape(*a.shape[:-1], num_blocks, size), -2, 0)

    own = [None if s else cut(c) for c, s in zip(constants, layout.shared, strict=True)]

    def block(part: Any) -> Any:
        own, each = part
        mixed = [c if o is None else o for c, o in zip(constants, own, strict=True)]
        return program(layout, mixed, each)

    def joined(a: Any) -> Any:
        a = jnp.moveaxis(a, 0, -2)
        return a.reshape(*a.shape[:-2], num_blocks * size)[..., :count]

    return [joined(a) for a in lax.map(block, (own, [cut(a) for a in each]))]


def lift(array: Array, like: Array) -> Array:
    """Return `array` with leading axes of length 1, so that it broadcasts against `like`.

    An array with one number for each body then multiplies states (n, *bodies).
    """
    return array.reshape((1,) * (like.ndim - array.ndim) + array.shape)


def with_replacements(
    arrays: Sequence[Any], selected: Sequence[bool], replacements: Sequence[Any]
) -> list[Any]:
    """Return the list `arrays` with its `selected` items replaced, in order."""
    rest = iter(replacements)
    return [next(rest) if new else a for a, new in zip(arrays, selected, strict=True)]
