"""Define a linear function together with a transpose of its own.

The tangent rule of a run is such a function, a JAX primitive that holds the function and its
transpose. Then `jax.jvp`, `jax.vjp`, `jax.vmap` and forward over reverse mode all work for a loop
of unknown length; with `jax.custom_vjp` forward mode would not work.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.custom_derivatives import zero_from_primal
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, PyTree

from rigidjax.rotation.barrier import match_batch_axes

Arrays = list[Any]
Map = Callable[..., Arrays]
_ZERO: Any = ad.Zero


def linear_map(function: Map, transposed: Map, given: Arrays, tangents: Arrays) -> Arrays:
    """Call a function that is linear in some of its arguments, and give it a transpose.

    Reverse mode then calls this transpose, and does not transpose the function itself.

    **Arguments:**

    - `function`: a function of the arrays in `given` and those in `tangents`, linear in the latter,
      which returns a list of arrays.
    - `transposed`: a function `(*given, *bars)` that returns the list of the cotangents of
      `tangents`; `bars` are the cotangents of the results.
    - `given`, `tangents`: lists of arrays.

    **Returns** the list `function(*given, *tangents)`. Neither function may close over tracers.
    Derivatives with respect to `given` exist in forward mode only.
    """
    outs = jax.eval_shape(lambda g, t: function(*g, *t), given, tangents)
    inputs, results = (
        tuple((tuple(jnp.shape(a)), jnp.result_type(a)) for a in arrays)
        for arrays in (tangents, outs)
    )
    how = dict(number=len(given), inputs=inputs, results=results)
    return _linear_map.bind(*given, *tangents, function=function, transposed=transposed, **how)


def known_with_derivatives_of(known: PyTree, recomputed: PyTree) -> PyTree:
    """Return known numbers, with the derivatives of the same numbers, computed once more.

    Derivatives of every order are those of `recomputed`. Its values are not used, and may be NaN;
    its derivatives may be NaN, too.

    - `known`: a tree of arrays, the known numbers.
    - `recomputed`: a tree of the same structure, whose arrays have derivatives.
    """
    return jax.tree.map(_array_with_derivatives_of, known, recomputed)


@jax.custom_jvp
def _array_with_derivatives_of(known: Array, recomputed: Array) -> Array:
    """Return the array `known`, with the derivatives of an array `recomputed` of equal shape."""
    return match_batch_axes(known, (known, recomputed))


@_array_with_derivatives_of.defjvp
def _array_with_derivatives_of_jvp(
    primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]
) -> Any:
    return _array_with_derivatives_of(*primals), tangents[1]


def nan_derivatives_where_not_finite(tree: PyTree, inputs: PyTree) -> PyTree:
    """Return the numbers of `tree`; those that are not finite get NaN as derivatives.

    The derivatives are those with respect to all numbers in `inputs`, in forward and in reverse
    mode. A state that a run did not reach is set to NaN by `jnp.where`, whose derivative would be
    0, which is wrong. If such a number is not used, its cotangent is 0, and it does not change the
    gradient.
    """
    smooth, rest = eqx.partition(tree, eqx.is_inexact_array)
    outs, structure = jax.tree.flatten(smooth)
    anchors = jax.tree.leaves(eqx.filter(inputs, eqx.is_inexact_array))
    return eqx.combine(structure.unflatten(_with_nan_derivatives(len(outs), *outs, *anchors)), rest)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _with_nan_derivatives(count: int, *numbers: Array) -> Arrays:
    """Return the first `count` of the arrays `numbers`, some of them with NaN as derivatives.

    The values are returned as they are. The other arrays in `numbers` are the inputs: a number that
    is NaN or infinite gets NaN as its derivative with respect to all of the inputs.
    """
    return match_batch_axes(list(numbers[:count]), numbers)


@_with_nan_derivatives.defjvp
def _(count: int, primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
    outs = _with_nan_derivatives(count, *primals)

    def along(*args: Array) -> Arrays:
        moved = args[count : 2 * count]
        return [jnp.where(t, m, jnp.nan) for t, m in zip(args[:count], moved, strict=True)]

    def back(*args: Array) -> Arrays:
        there, bars = args[:count], args[count:]
        kept = [jnp.where(t, bar, 0) for t, bar in zip(there, bars, strict=True)]
        bad = [jnp.any(~t & (bar != 0)) for t, bar in zip(there, bars, strict=True)]
        lost = jnp.where(jnp.any(jnp.stack(bad)), jnp.nan, 0)
        return [*kept, *[jnp.full(a.shape, lost, a.dtype) for a in primals[count:]]]

    return outs, linear_map(along, back, [jnp.isfinite(a) for a in outs], list(tangents))


_linear_map = Primitive("rigidjax_linear_map")
_linear_map.multiple_results = True


@_linear_map.def_impl
def _linear_map_impl(*args: Any, function: Map, **_: Any) -> Arrays:
    """Return the results of a linear map, a list of arrays: its `function`, called with `args`.

    This is the rule of the JAX primitive `_linear_map` for known arrays.
    """
    return function(*args)


@_linear_map.def_abstract_eval
def _linear_map_abstract_eval(*_: Any, results: Any, **__: Any) -> list[ShapedArray]:
    """Return the shapes and dtypes of the results of a linear map, as JAX wants them for a trace.

    `results` is a tuple of pairs (shape, dtype), one for each result.
    """
    return [ShapedArray(*result) for result in results]


def _linear_map_jvp(
    primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...], **params: Any
) -> Any:
    """Return the results of a linear map and the tangents of the results, in forward mode.

    This is the rule of the JAX primitive `_linear_map`. `primals` are the arguments of the map, the
    arrays that it is linear in after the others; `tangents` are their tangents (`ad.Zero` where
    there is none). `params` holds the map, its transpose, and the shapes and dtypes of the arrays.
    """
    number, function = params["number"], params["function"]
    out, parts = _linear_map.bind(*primals, **params), []
    moving = [not isinstance(t, ad.Zero) for t in tangents]
    if any(moving[number:]):
        whole = [
            t if m else jnp.zeros_like(p) for t, m, p in zip(tangents, moving, primals, strict=True)
        ]
        parts.append(_linear_map.bind(*primals[:number], *whole[number:], **params))
    which = [m and eqx.is_inexact_array(p) for m, p in zip(moving[:number], primals, strict=False)]
    if any(which):

        def push(*args: Any) -> Arrays:
            given, along = args[:number], args[number : len(primals)]
            rest = iter(args[len(primals) :])
            both = zip(given, which, strict=True)
            moved = [next(rest) if w else zero_from_primal(g) for g, w in both]
            return jax.jvp(lambda *g: function(*g, *along), given, tuple(moved))[1]

        moved = [t for t, w in zip(tangents, which, strict=False) if w]
        parts.append(linear_map(push, raise_for_missing_transpose, list(primals), moved))
    if not parts:
        return out, [_ZERO.from_primal_value(o) for o in out]
    return out, [sum(more, first) for first, *more in zip(*parts, strict=True)]


def raise_for_missing_transpose(*_: Any) -> Arrays:
    """Raise `TypeError`: this function stands for the transpose of a map that has no transpose."""
    raise TypeError(
        "second derivatives through a solver are forward over reverse: wanted "
        "jax.jacfwd(jax.grad(f)) or jax.hessian(f), got reverse mode over a derivative, such as "
        "jax.grad(jax.grad(f))"
    )


def _linear_map_transpose(cotangents: Any, *args: Any, **params: Any) -> Any:
    """Return the cotangents of the arguments of a linear map, in reverse mode.

    This is the rule of the JAX primitive `_linear_map`. `cotangents` are those of the results;
    `args` are the arguments, of which those that the map is linear in are undefined; `params` holds
    the map, its transpose, and the shapes and dtypes of the arrays. The arguments that the map is
    not linear in get `None`.
    """
    number = params["number"]
    given = args[:number]
    if any(ad.is_undefined_primal(g) for g in given):
        raise_for_missing_transpose()
    whole = [
        jnp.zeros(*result) if isinstance(c, ad.Zero) else c
        for c, result in zip(cotangents, params["results"], strict=True)
    ]
    turned = dict(function=params["transposed"], transposed=params["function"])
    turned |= dict(inputs=params["results"], results=params["inputs"])
    return [None] * number + _linear_map.bind(*given, *whole, number=number, **turned)


def _linear_map_batching(args: Any, dims: Any, **params: Any) -> Any:
    """Return the results of a linear map for a batch, and the batch axes of the results (all 0).

    This is the rule of the JAX primitive `_linear_map` for `jax.vmap`. `args` are the arguments;
    `dims` has the batch axis of each argument, or `None` for an argument without one; `params`
    holds the map, its transpose, and the shapes and dtypes of the arrays.
    """
    number = params["number"]
    size = next(a.shape[d] for a, d in zip(args, dims, strict=True) if d is not None)
    given, own = args[:number], dims[:number]
    along = [
        jnp.broadcast_to(a, (size, *a.shape)) if d is None else jnp.moveaxis(a, d, 0)
        for a, d in zip(args[number:], dims[number:], strict=True)
    ]

    def over(function: Map, count: int) -> Map:
        return jax.vmap(function, in_axes=(*own, *[0] * count), out_axes=0, axis_size=size)

    def longer(shapes: Any) -> Any:
        return tuple(((size, *shape), dtype) for shape, dtype in shapes)

    inputs, results = params["inputs"], params["results"]
    both = dict(function=over(params["function"], len(inputs)), inputs=longer(inputs))
    both |= dict(transposed=over(params["transposed"], len(results)), results=longer(results))
    return _linear_map.bind(*given, *along, number=number, **both), [0] * len(results)


ad.primitive_jvps[_linear_map] = _linear_map_jvp
ad.primitive_transposes[_linear_map] = _linear_map_transpose
batching.primitive_batchers[_linear_map] = _linear_map_batching
mlir.register_lowering(
    _linear_map, mlir.lower_fun(lambda *args, function, **_: function(*args), multiple_results=True)
)
