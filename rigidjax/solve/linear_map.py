"""Define a linear function together with a transpose of its own.

The function that computes the tangents of a run is such a function. It is called by a JAX primitive
that holds the function and its transpose. Then `jax.jvp`, `jax.vjp`, `jax.vmap` and forward over
reverse mode all work for a loop of unknown length; with `jax.custom_vjp` forward mode would not
work.
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

    Reverse mode then calls `transposed`, and does not transpose `function` itself.

    **Arguments:**

    - `function`: a function `(*given, *tangents)` that returns a list of arrays. It is linear in
      the arrays of `tangents`.
    - `transposed`: a function `(*given, *bars)` that returns the list of the cotangents of
      `tangents`. Here `bars` are the cotangents of the results of `function`.
    - `given`: a list of arrays, in which the function may be nonlinear.
    - `tangents`: a list of arrays, in which the function is linear.

    **Returns** the list `function(*given, *tangents)`. Neither `function` nor `transposed` may
    close over tracers. Derivatives with respect to `given` exist in forward mode only.
    """
    outs = jax.eval_shape(lambda g, t: function(*g, *t), given, tangents)
    inputs, results = (
        tuple((tuple(jnp.shape(a)), jnp.result_type(a)) for a in arrays)
        for arrays in (tangents, outs)
    )
    how = dict(number=len(given), inputs=inputs, results=results)
    return _linear_map.bind(*given, *tangents, function=function, transposed=transposed, **how)


def with_derivatives(known: PyTree, recomputed: PyTree) -> PyTree:
    """Return the numbers of `known`, with the derivatives of the numbers of `recomputed`.

    Both trees hold the same numbers, computed in two ways. Derivatives of every order are those of
    `recomputed`; they may be NaN. The values of `recomputed` are not used, and may be NaN, too.

    - `known`: a tree of arrays, whose values are returned.
    - `recomputed`: a tree of the same structure, whose arrays have derivatives.
    """
    return jax.tree.map(_known, known, recomputed)


@jax.custom_jvp
def _known(known: Array, recomputed: Array) -> Array:
    """Return the array `known`, with the derivatives of an array `recomputed` of equal shape."""
    return match_batch_axes(known, (known, recomputed))


@_known.defjvp
def _array_with_derivatives_of_jvp(
    primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]
) -> Any:
    return _known(*primals), tangents[1]


def nan_derivatives(tree: PyTree, inputs: PyTree) -> PyTree:
    """Return the arrays of `tree`, in which each number that is not finite gets NaN derivatives.

    The derivatives of such a number with respect to all numbers in the tree `inputs` are NaN, in
    forward and in reverse mode. A run uses this function because it sets a state that it did not
    reach to NaN by `jnp.where`, which gives this state the wrong derivative 0. If later code does
    not use a number that is not finite, the cotangent of this number is 0, and the number does not
    change the gradient.
    """
    smooth, rest = eqx.partition(tree, eqx.is_inexact_array)
    outs, structure = jax.tree.flatten(smooth)
    anchors = jax.tree.leaves(eqx.filter(inputs, eqx.is_inexact_array))
    return eqx.combine(structure.unflatten(_nan_derivatives(len(outs), *outs, *anchors)), rest)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _nan_derivatives(count: int, *numbers: Array) -> Arrays:
    """Return the first `count` of the arrays `numbers`, with NaN derivatives where not finite.

    The values are returned as they are. The other arrays of `numbers` are inputs, with respect to
    which derivatives are taken. If a number in a returned array is NaN or infinite, its derivatives
    with respect to all inputs are NaN.
    """
    return match_batch_axes(list(numbers[:count]), numbers)


@_nan_derivatives.defjvp
def _(count: int, primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...]) -> Any:
    outs = _nan_derivatives(count, *primals)

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
    """Call the `function` of a linear map with `args`, and return the list of its results.

    This is the rule by which JAX evaluates the primitive `_linear_map` for arrays that are not
    traced.
    """
    return function(*args)


@_linear_map.def_abstract_eval
def _linear_map_abstract_eval(*_: Any, results: Any, **__: Any) -> list[ShapedArray]:
    """Return the shapes and dtypes of the results of a linear map, as JAX wants them for a trace.

    `results` is a tuple of pairs (shape, dtype), one for each result.
    """
    return [ShapedArray(*result) for result in results]


def _jvp_rule(primals: tuple[PyTree, ...], tangents: tuple[PyTree, ...], **params: Any) -> Any:
    """Return the results of a linear map and the tangents of the results, in forward mode.

    This is the rule of the JAX primitive `_linear_map`.

    - `primals`: the arguments of the map. The first `params["number"]` arrays are those in which
      the map may be nonlinear; in the other arrays it is linear.
    - `tangents`: the tangents of all arguments; `ad.Zero` for an argument without a tangent.
    - `params`: a dict with the map, its transpose, and the shapes and dtypes of the arrays.
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
        parts.append(linear_map(push, no_transpose, list(primals), moved))
    if not parts:
        return out, [_ZERO.from_primal_value(o) for o in out]
    return out, [sum(more, first) for first, *more in zip(*parts, strict=True)]


def no_transpose(*_: Any) -> Arrays:
    """Raise `TypeError`, because reverse mode needs the transpose of a map that has none.

    This function takes the place of the missing transpose. It is called in reverse mode over a
    derivative, such as `jax.grad` of a `jax.grad`.
    """
    raise TypeError(
        "second derivatives through a solver are forward over reverse: wanted "
        "jax.jacfwd(jax.grad(f)) or jax.hessian(f), got reverse mode over a derivative, such as "
        "jax.grad(jax.grad(f))"
    )


def _transpose_rule(cotangents: Any, *args: Any, **params: Any) -> Any:
    """Return the cotangents of the arguments of a linear map, in reverse mode.

    An argument in which the map may be nonlinear gets `None`. This is the rule of the JAX primitive
    `_linear_map`.

    - `cotangents`: the cotangents of the results; `ad.Zero` for a result without a cotangent.
    - `args`: the arguments of the map. The first `params["number"]` are arrays in which the map may
      be nonlinear. In the other arguments the map is linear; JAX passes them as undefined values.
    - `params`: a dict with the map, its transpose, and the shapes and dtypes of the arrays.
    """
    number = params["number"]
    given = args[:number]
    if any(ad.is_undefined_primal(g) for g in given):
        no_transpose()
    whole = [
        jnp.zeros(*result) if isinstance(c, ad.Zero) else c
        for c, result in zip(cotangents, params["results"], strict=True)
    ]
    turned = dict(function=params["transposed"], transposed=params["function"])
    turned |= dict(inputs=params["results"], results=params["inputs"])
    return [None] * number + _linear_map.bind(*given, *whole, number=number, **turned)


def _batch_rule(args: Any, dims: Any, **params: Any) -> Any:
    """Return the results of a linear map for a batch, and the batch axes of the results (all 0).

    This is the rule of the JAX primitive `_linear_map` for `jax.vmap`.

    - `args`: the arguments of the map.
    - `dims`: the batch axis of each argument, or `None` for an argument without a batch axis.
    - `params`: a dict with the map, its transpose, and the shapes and dtypes of the arrays of one
      element of the batch.
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


ad.primitive_jvps[_linear_map] = _jvp_rule
ad.primitive_transposes[_linear_map] = _transpose_rule
batching.primitive_batchers[_linear_map] = _batch_rule
mlir.register_lowering(
    _linear_map, mlir.lower_fun(lambda *args, function, **_: function(*args), multiple_results=True)
)
