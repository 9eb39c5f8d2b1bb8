"""Check arguments at public boundaries; say what was wanted, what came, and the likely cause."""

import contextlib
import functools
import importlib
import inspect
import os
import re
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import DTypeLike
from jaxtyping import Array, ArrayLike, Bool, PyTree

Numbers = TypeVar("Numbers", bound=Any)

# The SI unit of each argument whose name means one kind of quantity everywhere in the library, such
# as `mass`.
_UNITS = {
    "omega": "rad/s", "angle": "rad", "angles": "rad", "latitude": "rad",
    "t": "s", "ts": "s", "dt": "s", "delay": "s", "mass": "kg", "com": "m", "gravity": "m/s²",
    "i1": "kg m²", "i2": "kg m²", "i3": "kg m²", "inertia tensor": "kg m²", "torque": "N m",
}  # fmt: skip
# Each unit as powers of SI base units; the radian counts as 1.
_DIMENSIONS: dict[str, dict[str, int]] = {
    "rad": {}, "rad/s": {"s": -1}, "s": {"s": 1}, "kg": {"kg": 1}, "m": {"m": 1},
    "m/s": {"m": 1, "s": -1}, "m/s²": {"m": 1, "s": -2}, "kg m²": {"kg": 1, "m": 2},
    "N m": {"kg": 1, "m": 2, "s": -2},
}  # fmt: skip
# The SI base unit of each dimension, by the name that the package pint has for the dimension.
_PINT = {"[length]": "m", "[mass]": "kg", "[time]": "s"}


def array_of_shape(
    value: object,
    shape: tuple[int, ...],
    name: str,
    *,
    hint: str = "",
    batched: bool = False,
    unit: str = "",
) -> Array:
    """Return `value` as a float32 or float64 array of exactly `shape`, or raise an error.

    Integers become the default float type. With `batched`, `value` may have leading axes before
    `shape`. `name` is the argument's name in messages, and `hint` a likely cause of a wrong shape.
    A quantity with a unit must have the dimension of `unit`. If `unit` is empty, the table `_UNITS`
    may contain a unit for `name`; without an entry there, any dimension is accepted.

    **Raises:** `TypeError` for anything but an array of real numbers, for half precision (its 3
    digits cannot hold a rotation), and for a unit of another dimension; `ValueError` for a wrong
    shape.
    """
    array = numeric_array(value, name, unit)
    got_shape = array.shape[array.ndim - len(shape) :] if batched else array.shape
    if got_shape != shape:
        many = array.ndim > len(shape) and array.shape[array.ndim - len(shape) :] == shape
        advice = hint or ("functions take one body; batch with jax.vmap" if many else "")
        raise ValueError(
            f"{name}: wanted shape {shape}, got {array.shape}{_hint_as_message_end(advice)}"
        )
    return array


def array_of_rows(value: object, shape: tuple[int, ...], name: str, *, hint: str = "") -> Array:
    """Return `value` as a float32 or float64 array (n, *shape) of any number n of rows, each of the
    given `shape`. **Raises:** `TypeError` for anything but real numbers, and for half precision;
    `ValueError` for another shape. The texts `name` (of the argument) and `hint` (a likely cause)
    are for messages.
    """
    array = numeric_array(value, name)
    if array.ndim != len(shape) + 1 or array.shape[1:] != shape:
        wanted = ", ".join(map(str, ("n", *shape))) + ("," if not shape else "")
        raise ValueError(
            f"{name}: wanted shape ({wanted}), got {array.shape}{_hint_as_message_end(hint)}"
        )
    return array


def _hint_as_message_end(hint: str) -> str:
    """Return the end of a message: a semicolon and the `hint`, or an empty text if the hint is
    empty.
    """
    return f"; {hint}" if hint else ""


def type_name(value: object) -> str:
    """Return a text for a message that says of what type `value` is: the shape of an array of JAX,
    "the class X" for a class X, and the name of its class for any other object.
    """
    if isinstance(value, jax.Array):
        return f"an array of shape {value.shape}"
    return f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__


def numeric_array(value: object, name: str, unit: str = "") -> Array:
    """Return `value` as a float32 or float64 array of any shape. **Raises:** `TypeError` for
    anything but real numbers, for half precision, and for a unit of another dimension than that of
    `unit`.

    Integers become the default float type. A quantity with a unit is converted to SI units.

    - `name`: the name of the argument, for messages
    - `unit`: an SI unit, whose dimension a quantity must have; if it is empty, the table `_UNITS`
      may contain a unit for `name`; without an entry there, any dimension is accepted
    """
    value = _convert_to_si(value, name, unit)
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError) as error:
        got = type(value).__name__
        got += f" of {value.dtype}" if isinstance(value, np.ndarray) else ""
        raise TypeError(f"{name}: wanted an array of numbers, got {got}") from error
    if isinstance(value, np.ndarray) and value.dtype == np.float64 and array.dtype != np.float64:
        _warn_of_float64_as_float32()
    if jnp.issubdtype(array.dtype, jnp.integer):
        array = array.astype(jnp.result_type(float))
    if array.dtype not in (jnp.float32, jnp.float64):
        half = jnp.issubdtype(array.dtype, jnp.floating) and array.dtype.itemsize == 2
        reason = " (half precision cannot hold a rotation)" if half else ""
        raise TypeError(f"{name}: wanted float32 or float64, got {array.dtype}{reason}")
    return array


def differentiable_array(value: object, name: str) -> Array:
    """Return `value` as a float32 or float64 array of any shape, of which a derivative is to be
    taken. **Raises:** as `numeric_array`, and `TypeError` for whole numbers and truth values, whose
    derivative would be zero; the text `name` is for the message.
    """
    dtype = jnp.result_type(value) if isinstance(value, int | Array | np.ndarray) else None
    if dtype is not None and not jnp.issubdtype(dtype, jnp.inexact):
        raise TypeError(
            f"{name}: wanted numbers that vary smoothly, got {dtype}: a whole number or a truth "
            "value has no derivative, from which an interval is made"
        )
    return numeric_array(value, name)


def data_and_mask(value: object) -> tuple[Any, np.ndarray | None]:
    """Return two things: the data of a masked array; and its mask, true where an entry has no
    value.

    The mask is `None` if no entry is masked. A value that is no masked array is returned unchanged,
    with the mask `None`.
    """
    mask = getattr(value, "mask", None) if isinstance(value, np.ndarray) else None
    if mask is None:
        return value, None
    data: Any = value
    data = np.ma.getdata(value) if isinstance(value, np.ma.MaskedArray) else data.unmasked
    return data, np.broadcast_to(mask, data.shape) if np.any(mask) else None


def without_mask(value: object, name: str) -> Any:
    """Return `value`; of a masked array of NumPy or astropy return the data alone. **Raises:**
    `ValueError` if an entry is masked: the number under a mask is often a wrong reading.
    """
    value, mask = data_and_mask(value)
    if mask is not None:
        raise ValueError(
            f"{name}: wanted numbers, got a masked array with {int(mask.sum())} of {mask.size} "
            f"entries masked, the first at index {tuple(int(i) for i in np.argwhere(mask)[0])}; "
            "they have no value: leave them out"
        )
    return value


def _convert_to_si(value: Any, name: str, si_unit: str = "") -> Any:
    """Return `value` as plain numbers in SI units if it is a quantity of astropy or pint, that is,
    numbers with a unit. **Raises:** `TypeError` if the unit has another dimension.

    A `Rotation` of SciPy becomes its quaternion (w, x, y, z), a list is converted item by item, and
    other values are returned unchanged.

    - `value`: anything that a user may pass for an array.
    - `name`: the name of the argument, such as `mass`, for messages.
    - `si_unit`: the SI unit whose dimension the quantity must have; if it is empty, the unit of
      `name` in the table `_UNITS` is taken; without an entry there, any dimension is accepted.
    """
    if is_rotation(value):
        # The order (w, x, y, z) is made here by indices, since `as_quat(scalar_first=True)` needs
        # SciPy 1.14.
        return value.as_quat()[..., [3, 0, 1, 2]]
    value = without_mask(value, name)
    if isinstance(value, (list, tuple)):
        items = [_convert_to_si(item, name, si_unit) for item in value]
        same = all(a is b for a, b in zip(items, value, strict=True))
        return value if same else type(value)(items)
    unit = getattr(value, "unit", getattr(value, "units", None))
    if unit is None or isinstance(value, jax.Array):
        return value
    si_unit = si_unit or _UNITS.get(name, "")
    kind = _powers_of_si_units(value, unit)
    if si_unit and kind is not None and kind != _DIMENSIONS[si_unit]:
        raise TypeError(f"{name}: wanted a unit such as {si_unit}, got {unit or 'no unit'}")
    if hasattr(value, "si"):
        return np.asarray(value.si.value)
    if hasattr(value, "to_base_units"):
        return np.asarray(value.to_base_units().magnitude)
    raise TypeError(
        f"{name}: wanted plain numbers in SI units, got {type(value).__name__} in {unit}; convert "
        "it to m, kg, s, rad and give its numbers"
    )


def is_rotation(value: object) -> bool:
    """Return whether `value` is a `Rotation` of `scipy.spatial.transform`, which may hold one
    rotation or many.
    """
    return hasattr(value, "as_quat")


def _powers_of_si_units(value: Any, unit: Any) -> dict[str, Any] | None:
    """Return the dimension of a quantity as powers of SI units, such as {"m": 1, "s": -2}; angles
    are left out.

    The result is `None` if the quantity is neither of the package astropy nor of pint.

    - `value`: the quantity.
    - `unit`: the unit of the quantity, an object of the same package as the quantity.
    """
    if hasattr(value, "dimensionality"):
        return {_PINT.get(name, str(name)): power for name, power in value.dimensionality.items()}
    if not hasattr(unit, "decompose"):
        return None
    base = unit.decompose()
    parts = zip(base.bases, base.powers, strict=True)
    return {str(part.name): power for part, power in parts if part.name != "rad"}


def require_same_batch(**arrays: tuple[Array, int]) -> None:
    """Raise `ValueError` if arrays that describe the same bodies have different batch axes. A
    container of many bodies has the same batch axes in every field; one body has none.

    - `arrays`: for each field `name=(array, n)`, where the last n axes of the array belong to one
      body, and the axes before them are batch axes
    """
    leading = {name: a.shape[: a.ndim - n] for name, (a, n) in arrays.items()}
    if len(set(leading.values())) > 1:
        shapes = ", ".join(f"{name} {a.shape}" for name, (a, _) in arrays.items())
        wanted = ", ".join(f"{name} {a.shape[a.ndim - n :]}" for name, (a, n) in arrays.items())
        raise ValueError(
            f"{', '.join(arrays)}: wanted one of each, {wanted}, or the same leading axes before "
            f"all of them, got shapes {shapes}"
        )


@functools.cache
def _warn_of_float64_as_float32() -> None:
    """Warn, once in a process, that float64 numbers become float32 because JAX computes with 32
    bits (`jax_enable_x64` is off).
    """
    # `functools.cache` runs this function once in a process: the warning appears only once.
    warnings.warn(
        "rigidjax: float64 numbers become float32, seven digits, because JAX's 64 bits are off; "
        "set jax.config.update('jax_enable_x64', True), or pass float32 if that is meant",
        stacklevel=5,
    )


def is_known(value: object) -> bool:
    """Return whether all numbers in `value` are known: whether none of its arrays is traced by
    JAX, as within `jax.jit`, `jax.grad` or `jax.vmap`.

    - `value`: an array, or any tree of arrays
    """
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value))


def array_module(value: object) -> ModuleType:
    """Return the module that a check of `value` computes with: `jax.numpy` if JAX traces `value`,
    else `numpy`.

    A check of known numbers is done by NumPy: a JAX operation outside `jit` costs some 30 µs, and
    ten of them cost more than a whole short simulation.
    """
    return np if is_known(value) else jnp


def error_if(value: PyTree, bad: Bool[ArrayLike, "..."], message: str) -> Any:
    """Return `value`; raise an error with `message`, also under `jit`, if any entry of `bad` is
    true.

    If `bad` is known, the error is a `ValueError` with `message` alone. If JAX traces `bad`,
    `equinox.error_if` raises the error when the program runs; the caller must use the returned
    value, or XLA drops the check.
    """
    if is_known(bad):
        if bool(np.any(np.asarray(bad))):
            raise ValueError(message)
        return value
    return eqx.error_if(value, bad, message)


def error_without_equinox_text(error: RuntimeError) -> RuntimeError:
    r"""Return an error of the same type as `error`, whose message is only the sentence of the check
    that failed, without the long text that Equinox adds. An error of another origin is returned
    unchanged.
    """
    match = re.search(r"^\S*EquinoxRuntimeError: (.+?)\n\n-+$", str(error), re.M | re.S)
    return type(error)(match[1]) if match else error


# A check of more rows than this number is quicker as one compiled program than by NumPy, and the
# rows stay on their device.
_MANY = 4096


def index_of_first_bad_row(
    are_bad: Callable[[ModuleType, Any], Any], rows: Array | np.ndarray
) -> Array | np.ndarray:
    """Return the index of the first bad row among n rows, as a scalar, or −1 if no row is bad. The
    index may be an array of JAX that is still being computed.

    - `are_bad`: a function (xp, rows) → booleans (n,), true for each bad row, written with the
      functions of the module `xp`, which is `numpy` or `jax.numpy`. Define it once, at the head of
      a module: JAX compiles it for many rows, and would compile each new function again.
    - `rows`: (n, …), not traced
    """
    with np.errstate(invalid="ignore", over="ignore"):
        if rows.shape[0] > _MANY:
            # The index is computed at once, also while JAX traces the function that makes this
            # check: it would otherwise not be known there.
            with jax.ensure_compile_time_eval():
                return _compiled_index_of_first_bad_row(are_bad, rows)
        return _index_of_first_true(np, are_bad(np, np.asarray(rows)))


def _index_of_first_true(xp: ModuleType, booleans: Array | np.ndarray) -> Array | np.ndarray:
    """Return the index of the first true entry of the `booleans` (n,), as a scalar, or −1 if no
    entry is true.

    - `xp`: the module of the array, `numpy` or `jax.numpy`
    """
    return xp.where(booleans.any(), xp.argmax(booleans), -1)


@functools.partial(jax.jit, static_argnums=0)
def _compiled_index_of_first_bad_row(
    are_bad: Callable[[ModuleType, Any], Any], rows: Array
) -> Array | np.ndarray:
    """Return the index of the first bad row among n rows, as a scalar, or −1 if no row is bad; JAX
    compiles the search.

    - `are_bad`: a function (xp, rows) → booleans (n,), true for each bad row; `xp` is `jax.numpy`
    - `rows`: (n, …), the rows are the entries along the first axis
    """
    return _index_of_first_true(jnp, are_bad(jnp, rows))


def _are_not_finite(xp: ModuleType, rows: Array | np.ndarray) -> Array | np.ndarray:
    """Return booleans (n,), one for each of n rows: whether the row contains a NaN or an infinity.

    - `xp`: the module of the array, `numpy` or `jax.numpy`
    - `rows`: (n, …)
    """
    return ~xp.isfinite(rows).reshape(rows.shape[0], -1).all(axis=1)


def require_finite(value: Numbers, name: str) -> Numbers:
    """Return the array `value`. **Raises:** `ValueError` (`equinox` error under `jit`) if it
    contains a NaN or an infinity; the text `name` names the array in the message.
    """
    rows: Any = value
    if isinstance(rows, jax.Array) and is_known(rows) and rows.ndim and rows.shape[0] > _MANY:
        row = int(index_of_first_bad_row(_are_not_finite, rows))
        if row < 0:
            return value
        place = row, *(int(i) for i in np.argwhere(~np.isfinite(np.asarray(value)[row]))[0])
        raise ValueError(f"{name}: contains NaN or infinity at index {place}")
    xp = array_module(value)
    bad = ~xp.isfinite(value)
    where = ""
    if xp is np and bad.ndim and bad.any():
        where = f" at index {tuple(int(i) for i in np.argwhere(bad)[0])}"
    return error_if(value, bad.any(), f"{name}: contains NaN or infinity{where}")


def finite_array(value: object, shape: tuple[int, ...], name: str, **options: Any) -> Array:
    """Return `value` as a float32 or float64 array of the given `shape`. **Raises:** `TypeError`
    for anything but real numbers; `ValueError` for another shape, and, unless JAX traces the array,
    for a NaN or an infinity.

    - `name`: the name of the argument, for messages
    - `options`: further arguments of `array_of_shape`, such as `hint` and `unit`
    """
    array = array_of_shape(value, shape, name, **options)
    return require_finite(array, name) if is_known(array) else array


def scalar_arrays_of_one_dtype(**named: object) -> list[Array]:
    """Return numbers, which are given as `name=number`, as a list of scalar arrays, all of the
    widest dtype among them. **Raises:** `TypeError` or `ValueError` for an argument that is not one
    real number; its name stands in the message.
    """
    numbers = [array_of_shape(value, (), name) for name, value in named.items()]
    return [value.astype(jnp.result_type(*numbers)) for value in numbers]


def checked_time(value: object, name: str = "t") -> Array:
    """Return a time, s, as a scalar array. **Raises:** `TypeError` for anything but a real number;
    `ValueError` for several numbers, and for a NaN or an infinity, unless JAX traces the time. The
    text `name` names the time in messages.
    """
    return finite_array(value, (), name)


def require_positive(
    value: Array, name: str, requirement: str, *, allow_zero: bool = False
) -> Array:
    """Return the array `value`. **Raises:** `ValueError` (`equinox` error under `jit`) if a number
    is not finite or not positive.

    - `name`: the name of the array, for the message
    - `requirement`: what was wanted, for the message, such as "a positive mass (kg)"
    - `allow_zero`: whether a number may also be zero
    """
    xp = array_module(value)
    numbers = xp.asarray(value)
    bad = ~(((numbers >= 0) if allow_zero else (numbers > 0)) & xp.isfinite(numbers))
    example = f", got {numbers[bad][0]}" if xp is np and bad.any() else ""
    return error_if(value, bad.any(), f"{name}: wanted {requirement}{example}")


def check_if_known(check: Callable[..., Array], value: Array, *args: Any, **options: Any) -> Array:
    """Return `check(value, *args, **options)` if JAX does not trace the array `value` and the array
    is not empty; else return `value` unchanged.
    """
    return check(value, *args, **options) if is_known(value) and value.size else value


def require_instance(
    value: object,
    kinds: type | tuple[type, ...],
    name: str,
    *,
    requirement: str = "",
    hint: str = "",
) -> Any:
    """Return `value` if it is an instance of a class in `kinds`. **Raises:** `TypeError` if not.
    The texts `name` (of the argument), `requirement` (what was wanted; by default the names of the
    classes) and `hint` (a likely cause) are for the message.
    """
    if isinstance(value, kinds):
        return value
    if not requirement:
        several = kinds if isinstance(kinds, tuple) else (kinds,)
        requirement = " or ".join(kind.__name__ for kind in several)
    # The hint names a common mistake: a whole solution was given in the place of its states `ys`,
    # or a body with mass in the place of its `inertia`.
    own = [name for name in ("ys", "inertia") if isinstance(getattr(value, name, None), kinds)]
    hint = hint or (f"give its .{own[0]}" if own else "")
    raise TypeError(
        f"{name}: wanted {requirement}, got {type_name(value)}{_hint_as_message_end(hint)}"
    )


# The shape of each field of one body or one state, by the name of the field.
_ONE = {
    "tensor": (3, 3), "mass": (), "com": (3,), "second_moment": (3, 3),
    "x": (3,), "v": (3,), "q": (4,), "omega": (3,),
}  # fmt: skip


def require_unbatched_instance(
    value: object,
    kinds: type | tuple[type, ...],
    name: str,
    *,
    requirement: str = "",
    hint: str = "",
) -> Any:
    """Return `value` if it is an instance of a class in `kinds`, and one body or one state, not a
    batch. **Raises:** `TypeError` for another class, `ValueError` for a batch. The texts `name` (of
    the argument), `requirement` (what was wanted) and `hint` (a likely cause) are for messages.

    A batch of bodies has the class of one body; without this check its shape would raise an error
    in the middle of the arithmetic.
    """
    require_instance(value, kinds, name, requirement=requirement, hint=hint)
    for field in (field for field in _ONE if field in vars(value)):
        part, shape = getattr(value, field), _ONE[field]
        if getattr(part, "shape", None) != shape or part.dtype not in (jnp.float32, jnp.float64):
            array_of_shape(part, shape, f"{name}.{field}")
    return value


def require_function(value: object, name: str, description: str, *, hint: str = "") -> Any:
    """Return `value` if it is a function. **Raises:** `TypeError` for a class, for anything else
    that cannot be called, and for a wrong number of arguments.

    - `name`: the name of the argument, for the message
    - `description`: the arguments and the result of the function, for the message, such as
      "t → (3,)". The number of arguments is checked if the text begins with a list of them, as in
      "(t, state, body) → scalar".
    - `hint`: a likely cause, for the message
    """
    got = type_name(value)
    if callable(value) and not isinstance(value, type):
        listed = re.match(r"\w*\(([^()]*)\)", description)
        if listed is None or _accepts_arguments(value, len(listed[1].split(","))):
            return value
        got = f"one with other arguments: {inspect.signature(value)}"
    raise TypeError(
        f"{name}: wanted a function {description}, got {got}{_hint_as_message_end(hint)}"
    )


def _accepts_arguments(value: Callable[..., Any], count: int) -> bool:
    """Return whether the function `value` can be called with `count` positional arguments."""
    try:
        inspect.signature(value).bind(*[None] * count)
    except (TypeError, ValueError) as error:
        # A `ValueError` says that the function has no signature, as some functions written in C: it
        # is accepted. A `TypeError` says that the number of arguments is wrong.
        return isinstance(error, ValueError)
    return True


@contextlib.contextmanager
def explain_tracing(kind: str, function: object) -> Iterator[None]:
    """Raise one line for JAX's errors about a traced number that Python or NumPy reads: where the
    user's `function` does so, and what to write; `kind` is its role, such as "torque".
    """
    try:
        yield
    except (
        jax.errors.ConcretizationTypeError,
        jax.errors.TracerArrayConversionError,
        jax.errors.TracerIntegerConversionError,
    ) as error:
        name = getattr(function, "__name__", type(function).__name__)
        inside = os.sep + "jax" + os.sep
        where = [f for f in traceback.extract_tb(error.__traceback__) if inside not in f.filename]
        raise TypeError(
            f"{kind} {name}, line {where[-1].lineno} of {Path(where[-1].filename).name} "
            f"({where[-1].line}): Python or NumPy needs the value of a number that JAX traces (the "
            "time, the state); write jnp.where(condition, a, b) for if, jnp.sin for np.sin and "
            "math.sin, and leave out float()"
        ) from None


def integer(value: object, name: str, least: int, most: int | None = None) -> int:
    """Return `value` as a Python integer. **Raises:** `TypeError` for anything but an integer of
    Python or NumPy, such as a traced number; `ValueError` for one below `least` or above `most`.
    The text `name` names the argument in messages.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name}: wanted a whole number of Python, got {_number_or_type(value)}")
    if value < least:
        raise ValueError(f"{name}: wanted a whole number of at least {least}, got {value}")
    if most is not None and value > most:
        raise ValueError(f"{name}: wanted a whole number of at most {most}, got {value}")
    return int(value)


def python_float(value: object, name: str) -> float:
    """Return `value` as one Python float. **Raises:** `TypeError` for a number that JAX traces, and
    for anything that is not a number; `ValueError` for several numbers. The text `name` names the
    argument in messages.
    """
    array = host_array(value, name)
    if array.shape != ():
        raise ValueError(f"{name}: wanted one number, got shape {array.shape}")
    return float(array)


def positive_float(value: object, name: str, requirement: str = "a positive number") -> float:
    """Return `value` as a positive and finite Python float. **Raises:** `TypeError` for a number
    that JAX traces, and for anything that is not a number; `ValueError` for several numbers, and
    for any other float. The texts `name` (of the argument) and `requirement` (what was wanted) are
    for messages.
    """
    number = python_float(value, name)
    if not 0 < number < np.inf:
        raise ValueError(f"{name}: wanted {requirement}, got {number}")
    return number


def fraction(value: object, name: str, requirement: str = "a number between 0 and 1") -> float:
    """Return `value` as a Python float between 0 and 1, both excluded. **Raises:** `TypeError` for
    a number that JAX traces, and for anything that is not a number; `ValueError` for several
    numbers, and for any other float. The texts `name` (of the argument) and `requirement` (what was
    wanted) are for messages.
    """
    number = positive_float(value, name, requirement)
    if not number < 1:
        raise ValueError(f"{name}: wanted {requirement}, got {number}")
    return number


def nonnegative_float(value: object, name: str) -> float:
    """Return `value` as a finite Python float that is not negative. **Raises:** `TypeError` for a
    number that JAX traces, and for anything that is not a number; `ValueError` for several numbers,
    and for any other float. The text `name` names the argument in messages.
    """
    number = python_float(value, name)
    return 0.0 if number == 0 else positive_float(number, name, "a number ≥ 0")


def host_array(value: object, name: str) -> np.ndarray:
    """Return the numbers `value` as a NumPy array of floats. **Raises:** `TypeError` for numbers
    that JAX traces, and for anything but real numbers; the text `name` names the argument in the
    message.
    """
    if isinstance(value, Tracer):
        raise TypeError(
            f"{name}: wanted numbers that are known, got a traced array; this works on the host: "
            "call it outside of jax.jit, jax.grad and jax.vmap"
        )
    value = _convert_to_si(value, name)
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name}: wanted numbers, got {type(value).__name__}") from error
    if array.dtype.kind not in "iuf" and array.dtype != jnp.bfloat16:
        got = type_name(value) if array.dtype == object else f"{type_name(value)} of {array.dtype}"
        raise TypeError(f"{name}: wanted numbers, got {got}")
    return array.astype(float)


def file_path(value: Any, name: str = "path") -> Path:
    """Return the `Path` of a file whose name is `value`. **Raises:** `TypeError` if `value` is
    empty, or neither a text nor a path; the text `name` names the argument in the message.
    """
    named = isinstance(value, str | os.PathLike) and isinstance(os.fspath(value), str)
    if not named or value == "":
        raise TypeError(f"{name}: wanted the name of a file, got {_number_or_type(value)}")
    return Path(value)


def escape_controls(text: object) -> str:
    """Return `text` with its control characters, such as an end of line, replaced by what Python
    writes for them, such as a backslash and n.
    """
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))


def escape_formulas(text: object) -> str:
    """Return `text` in a form that matplotlib shows unchanged. A `$` no longer begins a formula,
    and an initial `_`, with which matplotlib would hide a label, gets a space before it.
    """
    text = str(text).replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def require_option(value: object, options: Sequence[str], name: str) -> str:
    """Return `value` if it is one of the texts in `options`. **Raises:** `ValueError` if not; the
    text `name` names the argument in the message.
    """
    if isinstance(value, str) and value in options:
        return value
    raise ValueError(f"{name}: wanted one of {', '.join(options)}, got {_number_or_type(value)}")


def _number_or_type(value: object) -> str:
    """Return what stands in a message after "got": a number or a text as Python writes it, and the
    name of the type for any other `value`.
    """
    return repr(value) if isinstance(value, int | float | str) else type(value).__name__


def random_key(value: object, name: str = "key") -> Array:
    """Return `value` if it is one random key of JAX, as `jax.random.key` (the new type) or
    `jax.random.PRNGKey` (the old type) makes it. **Raises:** `TypeError` if not; the text `name`
    names the argument in the message.
    """
    array = isinstance(value, jax.Array)
    if array and jnp.issubdtype(value.dtype, jax.dtypes.prng_key) and value.shape == ():
        return value
    if array and value.dtype == jnp.uint32 and value.ndim == 1:
        return value
    got = f"{value.dtype} of shape {value.shape}" if array else type(value).__name__
    raise TypeError(
        f"{name}: wanted one random key, such as jax.random.key(0), got {got}; for many use "
        "jax.vmap over jax.random.split(key, n)"
    )


def import_library(module: str, extra: str, caller: str) -> ModuleType:
    """Import the module of an optional package, and return it. **Raises:** `ModuleNotFoundError`
    if the package is missing, with the command that installs it.

    - `module`: the name of the module
    - `extra`: the name of the group of optional packages of rigidjax that contains the package
    - `caller`: what needs the module, such as a function or a file, by its name, for the message
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        words = f"{caller}: {module} is missing; in the clone: pip install '.[{extra}]'"
        raise ModuleNotFoundError(words, name=module) from error


def float_type(value: Any, name: str = "dtype") -> np.dtype:
    """Return the dtype float32 or float64 that `value` names; for the type `float` return JAX's
    default of the two. **Raises:** `TypeError` for anything else; the text `name` names the
    argument in the message.
    """
    if value is float:
        return jnp.result_type(float)
    try:
        kind = None if value is None else np.dtype(value)
    except (TypeError, ValueError):
        kind = None
    if kind not in (np.float32, np.float64):
        raise TypeError(f"{name}: wanted float32 or float64, got {_number_or_type(value)}")
    return kind


def advice_for_large_times(dtype: DTypeLike) -> str:
    """Return advice, as the end of a message, for times that are too large for their `dtype`: a
    step that is added to such a time is lost to rounding.
    """
    if np.dtype(dtype) == np.float64:
        return "count time from a later origin, such as the first time of the run"
    return "count time from a later origin, or use float64"
