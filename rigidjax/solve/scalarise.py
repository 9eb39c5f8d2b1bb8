"""Rewrite a function of small arrays into the same function of scalars.

A vector field is written on arrays of 3 and 4 numbers. XLA on CPU makes one kernel of each small
array operation, and of a step of twelve stages hundreds; of the same step on scalars it makes a
few, and of the loop around it one. So the field is traced once, and its
operations are carried out number by number: elementwise ones on each element, slices and stacks by
moving references, sums and products of matrices written out (which also keeps them out of TF32).
What is not known here is called on arrays, as it was, with its own derivative rules.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

from rigidjax.solve.components import FEW

# One number in, one number out, and no parameter that speaks of shapes.
_ELEMENTWISE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp "
    "convert_element_type copy cos cosh digamma div eq erf erf_inv erfc exp exp2 expm1 floor ge gt "
    "integer_pow is_finite le lgamma log log1p logistic lt max min mul ne neg nextafter not or pow "
    "reduce_precision rem round rsqrt select_n sign sin sinh sqrt square sub tan tanh xor".split()
)
_INLINE = frozenset({"jit", "pjit", "closed_call", "core_call"})

# A value is either an object array of scalars or, when long, a JAX array as it is.
Value = Any


def scalarise(function: Callable[..., Any], *like: Any) -> Callable[..., tuple[Any, ...]]:
    """The function on flat scalars: `scalarise(f, *like)(*numbers)` gives the numbers of `f`.

    **Arguments:** `function` of trees of arrays; `like` one tree per argument, with the shapes and
    dtypes (arrays or `jax.ShapeDtypeStruct`). **Returns** a function that takes all numbers of all
    arguments, leaf by leaf as `components.split` gives them, and returns a tuple of the result's.

    Tracing happens here, once; what `function` closes over is split here too, so that a loop
    around the result sees scalars only.

    >>> scalarise(lambda a, b: jnp.cross(a, b), jnp.zeros(3), jnp.zeros(3))(1.0, 0, 0, 0, 1.0, 0)[2]
    Array(1., dtype=float64)
    """
    leaves, structure = jax.tree.flatten(like)
    shapes = [jax.ShapeDtypeStruct(jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves]

    def flat(*arrays: Any) -> list[Any]:
        return jax.tree.leaves(function(*jax.tree.unflatten(structure, arrays)))

    closed: Any = jax.make_jaxpr(flat)(*shapes)

    constants = [_take(constant) for constant in closed.consts]

    def numbers(*parts: Any) -> tuple[Any, ...]:
        queue = iter(parts)
        values: list[Value] = []
        for shape in shapes:
            if _long(shape.shape):
                values.append(next(queue))
            else:
                size = int(np.prod(shape.shape))
                scalars = [jnp.asarray(next(queue), shape.dtype) for _ in range(size)]
                values.append(_objects(scalars, shape.shape))
        out = _evaluate(closed.jaxpr, constants, values)
        flattened: list[Any] = []
        for value, variable in zip(out, closed.jaxpr.outvars, strict=True):
            scalars = value.reshape(-1) if isinstance(value, np.ndarray) else [value]
            flattened.extend(jnp.asarray(scalar, variable.aval.dtype) for scalar in scalars)
        return tuple(flattened)

    return numbers


def _evaluate(jaxpr: Any, constants: Sequence[Value], arguments: Sequence[Value]) -> list[Value]:
    known: dict[Any, Value] = {}

    def read(atom: Any) -> Value:
        if isinstance(atom, core.Literal):
            return _take(np.asarray(atom.val, jnp.result_type(atom.aval)))
        return known[atom]

    for variable, value in zip(
        [*jaxpr.constvars, *jaxpr.invars], [*constants, *arguments], strict=True
    ):
        known[variable] = value
    for equation in jaxpr.eqns:
        given = [read(atom) for atom in equation.invars]
        for variable, value in zip(equation.outvars, _apply(equation, given), strict=True):
            known[variable] = value
    return [read(atom) for atom in jaxpr.outvars]


def _apply(equation: Any, given: list[Value]) -> list[Value]:
    name, params = equation.primitive.name, equation.params
    if name in _INLINE:
        inner = params["jaxpr"] if "jaxpr" in params else params["call_jaxpr"]
        if not hasattr(inner, "consts"):
            return _evaluate(inner, [], given)
        return _evaluate(inner.jaxpr, [_take(c) for c in inner.consts], given)
    short = all(isinstance(value, np.ndarray) for value in given)
    if not short or any(_long(v.aval.shape) for v in equation.outvars):
        return _on_arrays(equation, given)
    if name in _ELEMENTWISE:
        return [_each(equation, given)]
    rule = _MOVES.get(name)
    return _on_arrays(equation, given) if rule is None else rule(equation, *given)


def _on_arrays(equation: Any, given: list[Value]) -> list[Value]:
    """Carry out one operation as it stands, `custom_jvp` and loops included."""
    arrays = [_array(value, atom.aval) for atom, value in zip(equation.invars, given, strict=True)]
    # JAX before 0.12 gives functions apart from parameters.
    bound: Any = equation.primitive.get_bind_params(equation.params)
    functions, params = bound if isinstance(bound, tuple) else ((), bound)
    out = equation.primitive.bind(*functions, *arrays, **params)
    return [_take(value) for value in (out if equation.primitive.multiple_results else [out])]


def _each(equation: Any, given: list[np.ndarray]) -> np.ndarray:
    shape = equation.outvars[0].aval.shape
    out = np.empty(shape, object)
    # `select_n` and `clamp` mix scalars with arrays, and newer products axes of length 1.
    wide = [np.broadcast_to(value, shape) for value in given]
    for index in np.ndindex(*shape):
        scalars = [value[index] for value in wide]
        out[index] = equation.primitive.bind(*scalars, **equation.params)
    return out


def _broadcast(equation: Any, x: np.ndarray) -> list[Value]:
    shape, places = equation.params["shape"], equation.params["broadcast_dimensions"]
    inner = [1] * len(shape)
    for place, size in zip(places, x.shape, strict=True):
        inner[place] = size
    return [np.broadcast_to(x.reshape(inner), shape)]


def _reshape(equation: Any, x: np.ndarray) -> list[Value]:
    return [x.reshape(equation.outvars[0].aval.shape)]


def _slice(equation: Any, x: np.ndarray) -> list[Value]:
    p = equation.params
    strides = p["strides"] or (1,) * x.ndim
    where = zip(p["start_indices"], p["limit_indices"], strides, strict=True)
    return [x[tuple(slice(*bounds) for bounds in where)]]


def _concatenate(equation: Any, *parts: np.ndarray) -> list[Value]:
    return [np.concatenate(parts, axis=equation.params["dimension"])]


def _stack(equation: Any, *parts: np.ndarray) -> list[Value]:
    return [np.stack(parts, axis=equation.params["axis"])]


def _transpose(equation: Any, x: np.ndarray) -> list[Value]:
    return [np.transpose(x, equation.params["permutation"])]


def _split(equation: Any, x: np.ndarray) -> list[Value]:
    ends = list(itertools.accumulate(equation.params["sizes"]))[:-1]
    return list(np.split(x, ends, axis=equation.params["axis"]))


def _rev(equation: Any, x: np.ndarray) -> list[Value]:
    return [np.flip(x, equation.params["dimensions"])]


def _reduce_sum(equation: Any, x: np.ndarray) -> list[Value]:
    axes = equation.params["axes"]
    kept = [a for a in range(x.ndim) if a not in axes]
    moved = np.transpose(x, [*kept, *axes]).reshape([x.shape[a] for a in kept] + [-1])
    return [_sums(moved, equation.outvars[0].aval.dtype)]


def _dot_general(equation: Any, a: np.ndarray, b: np.ndarray) -> list[Value]:
    (over_a, over_b), (batch_a, batch_b) = equation.params["dimension_numbers"]
    dtype = equation.outvars[0].aval.dtype
    if batch_a or batch_b or any(s.dtype != dtype for s in (*a.flat, *b.flat)):
        return _on_arrays(equation, [a, b])
    kept_a = [i for i in range(a.ndim) if i not in over_a]
    kept_b = [i for i in range(b.ndim) if i not in over_b]
    rows = np.transpose(a, [*kept_a, *over_a]).reshape(-1, _size(a, over_a))
    columns = np.transpose(b, [*kept_b, *over_b]).reshape(-1, _size(b, over_b))
    products = np.empty((rows.shape[0], columns.shape[0], rows.shape[1]), object)
    for i, j, k in np.ndindex(*products.shape):
        products[i, j, k] = rows[i, k] * columns[j, k]
    shape = [a.shape[i] for i in kept_a] + [b.shape[i] for i in kept_b]
    return [_sums(products, dtype).reshape(shape)]


_MOVES: dict[str, Callable[..., list[Value]]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": _concatenate,
    "dot_general": _dot_general,
    "expand_dims": _reshape,
    "reduce_sum": _reduce_sum,
    "reshape": _reshape,
    "rev": _rev,
    "slice": _slice,
    "split": _split,
    "squeeze": _reshape,
    "stack": _stack,
    "transpose": _transpose,
}


def _sums(terms: np.ndarray, dtype: Any) -> np.ndarray:
    """Sums along the last axis, from the first term on."""
    out = np.empty(terms.shape[:-1], object)
    for index in np.ndindex(*out.shape):
        total = None
        for term in terms[index]:
            total = term if total is None else total + term
        out[index] = np.zeros((), dtype) if total is None else total
    return out


def _size(x: np.ndarray, axes: Sequence[int]) -> int:
    return int(np.prod([x.shape[a] for a in axes]))


def _long(shape: tuple[int, ...]) -> bool:
    return int(np.prod(shape)) > FEW


def _take(array: Any) -> Value:
    """A JAX array as its scalars, or as it is if it is long."""
    shape = np.shape(array)
    if _long(shape) or not isinstance(array, jax.Array | np.ndarray | np.generic):
        return array
    if isinstance(array, np.ndarray | np.generic):
        array = np.asarray(array)
        return _objects([array.reshape(-1)[i].reshape(()) for i in range(array.size)], shape)
    if not jnp.issubdtype(array.dtype, jnp.number) and array.dtype != jnp.bool_:
        return array
    if not shape:
        return _objects([array], shape)
    size = int(np.prod(shape))
    if size == 0:
        return np.empty(shape, object)
    parts = lax.split(array.reshape(-1), (1,) * size)
    return _objects([part.reshape(()) for part in parts], shape)


def _array(value: Value, aval: Any) -> Any:
    if not isinstance(value, np.ndarray) or value.dtype != object:
        return value
    scalars = [jnp.asarray(scalar, aval.dtype) for scalar in value.reshape(-1)]
    if not aval.shape:
        return scalars[0]
    if not scalars:
        return jnp.zeros(aval.shape, aval.dtype)
    return jnp.stack(scalars).reshape(aval.shape)


def _objects(scalars: Sequence[Any], shape: tuple[int, ...]) -> np.ndarray:
    out = np.empty(len(scalars), object)
    for i, scalar in enumerate(scalars):
        out[i] = scalar
    return out.reshape(shape)
