"""Trace functions, so that the arrays that they close over become an argument."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.extend.core import (
    ClosedJaxpr,  # pyright: ignore[reportPrivateImportUsage]
    jaxpr_as_fun,
)

from rigidjax.solve.programs.batching import Arrays


class TracedProgram(NamedTuple):
    """Hold a traced function, which is called as `call(constants, *args)`.

    The constants are the JAX arrays that the function closes over.
    """

    closed: ClosedJaxpr
    tree: Any  # the tree structure of the result of the function
    jax_constants: Arrays  # the JAX arrays that it closes over, without its NumPy arrays

    def replace_jax_constants(self, jax_arrays: Arrays) -> Arrays:
        """Return a list of all constants of the traced function, with new JAX arrays.

        `jax_arrays` replace the JAX arrays among the constants, in order; NumPy arrays are kept.
        """
        arrays = iter(jax_arrays)
        return [next(arrays) if eqx.is_array(c) else c for c in self.closed.consts]

    def call(self, constants: Arrays, *args: Any) -> Any:
        closed = ClosedJaxpr(self.closed.jaxpr, self.replace_jax_constants(constants))
        return self.tree.unflatten(jaxpr_as_fun(closed)(*jax.tree.leaves(args)))


def trace_program(function: Callable[..., Any], *examples: Any) -> TracedProgram:
    """Trace a function, so that the arrays that it closes over become an argument.

    Of the `examples` of its arguments only shapes and dtypes count.
    """

    def traced(*args: Any) -> Any:  # its name shows in the lines of code of the equations
        return function(*args)

    closed, out = jax.make_jaxpr(traced, return_shape=True)(*examples)
    constants = [c for c in closed.consts if eqx.is_array(c)]
    return TracedProgram(closed, jax.tree.structure(out), constants)


def extract_constants(
    functions: list[Callable[..., Any]], *examples: Any
) -> tuple[list[Callable[..., Any]], Arrays]:
    """Return functions of the same arguments as `f(constants, *args)`, and all their constants.

    The constants are the arrays that any of the functions closes over; each takes the whole list.
    """
    programs = [trace_program(function, *examples) for function in functions]
    ends = np.cumsum([0, *(len(program.jax_constants) for program in programs)])

    def call(i: int, constants: Arrays, *args: Any) -> Any:
        return programs[i].call(constants[ends[i] : ends[i + 1]], *args)

    calls = [partial(call, i) for i in range(len(programs))]
    return calls, [c for program in programs for c in program.jax_constants]
