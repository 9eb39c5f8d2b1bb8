"""Equal steps on a GPU: several in one kernel, and a reverse mode of two levels, written by hand.

A kernel of one step waits for its numbers: with several steps in a turn of the loop, free bodies
take three times as many steps a second. The kernel of a step backward has too many numbers for
that: it is as slow as it is long, while JAX's transpose of a loop has as many steps in a turn as
the loop itself. On a CPU neither gains anything.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, PyTree

from rigidjax.solve.batching import Arrays
from rigidjax.solve.linear_map import linear_map
from rigidjax.solve.stops import traced

# Operations in a turn of the loop, about, and steps at most: a kernel twice as long compiles four
# times as long and is no faster, half as long it takes a third longer.
_LONG, _MOST = 2800, 8


def piece_length(count: int) -> int:
    """Return about √count steps: a divisor of count if one is near, for less to compile."""
    root = math.isqrt(count - 1) + 1
    near = [d for d in range(root, min(2 * root, count) + 1) if count % d == 0]
    return near[0] if near else root


@dataclasses.dataclass(frozen=True)
class _Program:
    """Run `count` steps `call(constants, y, i)` on lists of arrays, `turn` in a kernel."""

    call: Callable[[Arrays, Arrays, Array], Arrays]
    count: int
    turn: int

    def some(
        self, constants: Arrays, y: Arrays, first: Array, many: int, keep: bool = False
    ) -> tuple[Arrays, Any]:
        """Return the end of `many` steps from number `first` on, and all their starts if `keep`."""

        def one(y: Arrays, i: Array) -> tuple[Arrays, Any]:
            return self.call(constants, y, i), y if keep else None

        return lax.scan(one, y, first + jnp.arange(many, dtype=jnp.int32), unroll=self.turn)

    def forward(self, constants: Arrays, first: Array, y: Arrays) -> tuple[Arrays, Any]:
        """Return the end, and the starts: of pieces of one length, of the steps left over."""
        firsts, length, left = self.pieces(first)

        def piece(y: Arrays, begin: Array) -> tuple[Arrays, Arrays]:
            return self.some(constants, y, begin, length)[0], y

        end, starts = lax.scan(piece, y, firsts)
        last = end
        if left:
            end, _ = self.some(constants, end, first + self.count - left, left)
        return end, (starts, last)

    def back(
        self, constants: Arrays, moving: Sequence[bool], first: Array, starts: Any, bar: Arrays
    ) -> tuple[Arrays, Arrays]:
        """Return the cotangents of the constants that are `moving`, and of the start."""
        firsts, length, left = self.pieces(first)
        chosen = [c for c, m in zip(constants, moving, strict=True) if m]

        def step_of(i: Array) -> Callable[[Arrays, Arrays], Arrays]:
            return lambda some, y: self.call(_with(constants, moving, some), y, i)

        def one(sums: tuple[Arrays, Arrays], at: tuple[Arrays, Array]) -> tuple[Any, None]:
            (total, bar), (y, i) = sums, at
            more, bar = jax.vjp(step_of(i), chosen, y)[1](bar)
            return ([a + b for a, b in zip(total, more, strict=True)], bar), None

        def piece(sums: tuple[Arrays, Arrays], y: Arrays, begin: Array, many: int) -> Any:
            _, states = self.some(constants, y, begin, many, keep=True)
            steps = begin + jnp.arange(many, dtype=jnp.int32)
            return lax.scan(one, sums, (states, steps), reverse=True)[0]

        sums = [jnp.zeros_like(c) for c in chosen], bar
        rows, last = starts
        if left:
            sums = piece(sums, last, first + self.count - left, left)

        def whole(sums: tuple[Arrays, Arrays], at: tuple[Arrays, Array]) -> tuple[Any, None]:
            starts, begin = at
            return piece(sums, starts, begin, length), None

        return lax.scan(whole, sums, (rows, firsts), reverse=True)[0]

    def pieces(self, first: Array) -> tuple[Array, int, int]:
        """Return the first step of each piece, their length, and the number of steps left."""
        length = piece_length(self.count)
        many, left = divmod(self.count, length)
        return first + length * jnp.arange(many, dtype=jnp.int32), length, left


def in_pieces(step: Callable[[Any, Array], Any], first: Array, count: int, y: Any) -> Any:
    """Return the end of `count` steps `y = step(y, i)` from number `first` on.

    In reverse mode the states at the starts of √count pieces are kept, and those in one piece.
    Second derivatives are forward over reverse.
    """
    start, tree = jax.tree.flatten(y)
    one = traced(lambda y, i: jax.tree.leaves(step(tree.unflatten(y), i)), start, first)
    turn = min(max(_LONG // len(one.closed.jaxpr.eqns), 1), _MOST)
    # A power of two, since pieces often are whole multiples of it.
    turn = 1 << (turn.bit_length() - 1)
    program, constants = _Program(one.call, count, turn), one.constants
    number = len(constants)
    smooth = [*[eqx.is_inexact_array(c) for c in constants], False, *[True for _ in start]]

    def end(args: Arrays) -> Arrays:
        return program.forward(args[:number], args[number], args[number + 1 :])[0]

    @jax.custom_jvp
    def run(*args: Array) -> Arrays:
        return end(list(args))

    def run_jvp(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> tuple[Arrays, Arrays]:
        both = zip(smooth, tangents, strict=True)
        moving = [s and not isinstance(t, SymbolicZero) for s, t in both]
        size = len(primals)
        out, starts = program.forward(
            list(primals[:number]), primals[number], list(primals[number + 1 :])
        )
        rows, shape = jax.tree.flatten(starts)

        def push(*args: Array) -> Arrays:
            given = list(args[:size])
            of = lambda *some: end(_with(given, moving, some))  # noqa: E731
            at = [g for g, m in zip(given, moving, strict=True) if m]
            return jax.jvp(of, at, list(args[size + len(rows) :]))[1]

        def pull(*args: Array) -> Arrays:
            given, kept, bars = args[:number], args[size : size + len(rows)], args[-len(start) :]
            total, bar = program.back(
                list(given), moving[:number], args[number], shape.unflatten(kept), list(bars)
            )
            return [*total, *[b for b, m in zip(bar, moving[number + 1 :], strict=True) if m]]

        along = [t for t, m in zip(tangents, moving, strict=True) if m]
        return out, linear_map(push, pull, [*primals, *rows], along)

    run.defjvp(run_jvp, symbolic_zeros=True)
    return tree.unflatten(run(*constants, first, *start))


def _with(all_: Sequence[Any], which: Sequence[bool], some: Sequence[Any]) -> list[Any]:
    """Return all arrays, with those that `which` selects replaced by `some`."""
    rest = iter(some)
    return [next(rest) if w else a for a, w in zip(all_, which, strict=True)]
