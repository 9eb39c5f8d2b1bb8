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
    """Return `value` as a float32 or float64 array of exactly `shape`; with `batched` leading axes
    may stand before it.

    Integers become the default float type. A quantity must have the dimension of `unit`, or of the
    unit of `name` in `_UNITS`. **Raises:** `TypeError` for anything but an array of real numbers,
    for half precision (its 3 digits cannot hold a rotation), and for a unit of another dimension;
    `ValueError` for a wrong shape, with a likely cause as `hint`.
    """
    array = numeric_array(value, name, unit)
    got_shape = array.shape[array.ndim - len(shape) :] if batched else array.shape
    if got_shape != shape:
        many = array.ndim > len(shape) and array.shape[array.ndim - len(shape) :] == shape
        advice = hint or ("functions take one body; batch with jax.vmap" if many else "")
        raise ValueError(f"{name}: wanted shape {shape}, got {array.shape}{_advice(advice)}")
    return array


def array_of_rows(value: object, shape: tuple[int, ...], name: str, *, hint: str = "") -> Array:
    """Return `value` as a float array (n, *shape) of any number of rows; raise as
    `array_of_shape`.
    """
    array = numeric_array(value, name)
    if array.ndim != len(shape) + 1 or array.shape[1:] != shape:
        wanted = ", ".join(map(str, ("n", *shape))) + ("," if not shape else "")
        raise ValueError(f"{name}: wanted shape ({wanted}), got {array.shape}{_advice(hint)}")
    return array


def _advice(hint: str) -> str:
    """Return the end of a message: a semicolon and the hint, if there is one."""
    return f"; {hint}" if hint else ""


def type_name(value: object) -> str:
    """Return what a message says of the type of `value`: an array has a shape, a class is told from
    its object.
    """
    if isinstance(value, jax.Array):
        return f"an array of shape {value.shape}"
    return f"the class {value.__name__}" if isinstance(value, type) else type(value).__name__


def numeric_array(value: object, name: str, unit: str = "") -> Array:
    """Return `value` as a float32 or float64 array of any shape, converted to SI; raise `TypeError`
    as `array_of_shape`.
    """
    value = _si(value, name, unit)
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError) as error:
        got = f" of {value.dtype}" if isinstance(value, np.ndarray) else ""
        words = f"{name}: wanted an array of numbers, got {type(value).__name__}{got}"
        raise TypeError(words) from error
    if isinstance(value, np.ndarray) and value.dtype == np.float64 and array.dtype != np.float64:
        _warn_of_float32()
    if jnp.issubdtype(array.dtype, jnp.integer):
        array = array.astype(jnp.result_type(float))
    if array.dtype not in (jnp.float32, jnp.float64):
        half = jnp.issubdtype(array.dtype, jnp.floating) and array.dtype.itemsize == 2
        reason = " (half precision cannot hold a rotation)" if half else ""
        raise TypeError(f"{name}: wanted float32 or float64, got {array.dtype}{reason}")
    return array


def differentiable_array(value: object, name: str) -> Array:
    """Return `value` as `numeric_array` does; raise `TypeError` for whole numbers and truth values,
    whose derivative would be zero.
    """
    dtype = jnp.result_type(value) if isinstance(value, int | Array | np.ndarray) else None
    if dtype is not None and not jnp.issubdtype(dtype, jnp.inexact):
        raise TypeError(
            f"{name}: wanted numbers that vary smoothly, got {dtype}: a whole number or a truth "
            "value has no derivative, from which an interval is made"
        )
    return numeric_array(value, name)


def data_and_mask(value: object) -> tuple[Any, np.ndarray | None]:
    """Return the data of a masked array and its mask, true where an entry has no value; `None` if
    no entry is masked.
    """
    mask = getattr(value, "mask", None) if isinstance(value, np.ndarray) else None
    if mask is None:
        return value, None
    data: Any = value
    data = np.ma.getdata(value) if isinstance(value, np.ma.MaskedArray) else data.unmasked
    return data, np.broadcast_to(mask, data.shape) if np.any(mask) else None


def without_mask(value: object, name: str) -> Any:
    """Return the data of an array; raise `ValueError` if an entry is masked: the number under a
    mask is often a wrong reading.
    """
    value, mask = data_and_mask(value)
    if mask is not None:
        raise ValueError(
            f"{name}: wanted numbers, got a masked array with {int(mask.sum())} of {mask.size} "
            f"entries masked, the first at index {tuple(int(i) for i in np.argwhere(mask)[0])}; "
            "they have no value: leave them out"
        )
    return value


def _si(value: Any, name: str, si_unit: str = "") -> Any:
    """Return a quantity of astropy or pint, also in a list, as plain numbers in SI units, a
    `Rotation` of SciPy as its quaternion (w, x, y, z), all else unchanged; raise `TypeError` for a
    unit of another dimension.
    """
    if isinstance(value, jax.Array | float | int):
        return value
    if isinstance(value, (list, tuple)):
        items = [_si(item, name, si_unit) for item in value]
        same = all(a is b for a, b in zip(items, value, strict=True))
        return value if same else type(value)(items)
    if is_rotation(value):
        # The order (w, x, y, z) is made here by indices, since `as_quat(scalar_first=True)` needs
        # SciPy 1.14.
        return value.as_quat()[..., [3, 0, 1, 2]]
    value = without_mask(value, name)
    unit = getattr(value, "unit", getattr(value, "units", None))
    if unit is None:
        return value
    si_unit = si_unit or _UNITS.get(name, "")
    kind = _dimension(value, unit)
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
    """Return whether `value` is a `Rotation` of `scipy.spatial.transform`, of one rotation
    or many.
    """
    return hasattr(value, "as_quat")


def _dimension(value: Any, unit: Any) -> dict[str, Any] | None:
    """Return the dimension of a quantity of astropy or pint, such as {"m": 1, "s": -2}, without
    angles; `None` for others.
    """
    if hasattr(value, "dimensionality"):
        return {_PINT.get(name, str(name)): power for name, power in value.dimensionality.items()}
    if not hasattr(unit, "decompose"):
        return None
    base = unit.decompose()
    parts = zip(base.bases, base.powers, strict=True)
    return {str(part.name): power for part, power in parts if part.name != "rad"}


def require_same_batch(**arrays: tuple[Array, int]) -> None:
    """Raise `ValueError` if the arrays of one container have different batch axes; each is given as
    `name=(array, n)`, where the last n axes belong to one body.
    """
    leading = {name: a.shape[: a.ndim - n] for name, (a, n) in arrays.items()}
    if len(set(leading.values())) > 1:
        shapes = ", ".join(f"{name} {a.shape}" for name, (a, _) in arrays.items())
        wanted = ", ".join(f"{name} {a.shape[a.ndim - n :]}" for name, (a, n) in arrays.items())
        raise ValueError(
            f"{', '.join(arrays)}: wanted one of each, {wanted}, or the same leading axes before "
            f"all of them, got shapes {shapes}; repeat what the bodies share: jnp.broadcast_to"
        )


@functools.cache
def _warn_of_float32() -> None:
    """Warn that float64 numbers become float32 because JAX's 64 bits are off."""
    # `functools.cache` runs this function, and the warning appears, only once in a process.
    warnings.warn(
        "rigidjax: float64 numbers become float32, seven digits, because JAX's 64 bits are off; "
        "set jax.config.update('jax_enable_x64', True), or pass float32 if that is meant",
        stacklevel=5,
    )


def is_known(value: object) -> bool:
    """Return whether JAX traces no array in `value`, as it does within `jax.jit`, `jax.grad` or
    `jax.vmap`.
    """
    return not any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value))


def array_module(value: object) -> ModuleType:
    """Return the module that a check of `value` computes with: `jax.numpy` if JAX traces it, else
    `numpy`.

    A JAX operation outside `jit` costs some 30 µs: ten of them cost more than a whole short
    simulation.
    """
    return np if is_known(value) else jnp


def error_if(value: PyTree, bad: Bool[ArrayLike, "..."], message: str) -> Any:
    """Return `value`; raise an error with `message`, also under `jit`, if any entry of `bad` is
    true: a `ValueError` if `bad` is known.

    If JAX traces `bad`, the error is raised when the program runs; the caller must use the returned
    value, or XLA drops the check.
    """
    if is_known(bad):
        if bool(np.any(np.asarray(bad))):
            raise ValueError(message)
        return value
    return eqx.error_if(value, bad, message)


def plain_error(error: RuntimeError) -> RuntimeError:
    r"""Return an error of a check with its sentence alone, without the long text that Equinox adds;
    others unchanged.
    """
    match = re.search(r"^\S*EquinoxRuntimeError: (.+?)\n\n-+$", str(error), re.M | re.S)
    return type(error)(match[1]) if match else error


# A check of more rows than this number is quicker as one compiled program than by NumPy, and the
# rows stay on their device.
_MANY = 4096


def first_bad_row(
    are_bad: Callable[[ModuleType, Any], Any], rows: Array | np.ndarray
) -> Array | np.ndarray:
    """Return the index of the first bad row, or −1 if none is bad, as a scalar, which JAX may still
    be computing.

    The function (xp, rows) → booleans is written with the functions of `xp`, which is `numpy` or
    `jax.numpy`. Define it once, at the head of a module: JAX compiles it for many rows, and would
    compile each new function again.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        if rows.shape[0] > _MANY:
            # The index is computed at once, also while JAX traces the function that makes this
            # check: it would otherwise not be known there.
            with jax.ensure_compile_time_eval():
                return _compiled_first(are_bad, rows)
        return _first_true(np, are_bad(np, np.asarray(rows)))


def _first_true(xp: ModuleType, booleans: Array | np.ndarray) -> Array | np.ndarray:
    """Return the index of the first true entry, or −1 if none is true."""
    return xp.where(booleans.any(), xp.argmax(booleans), -1)


@functools.partial(jax.jit, static_argnums=0)
def _compiled_first(are_bad: Callable[[ModuleType, Any], Any], rows: Array) -> Array | np.ndarray:
    """Return the index of the first bad row, or −1 if none is bad, by a compiled program."""
    return _first_true(jnp, are_bad(jnp, rows))


def _not_finite(xp: ModuleType, rows: Array | np.ndarray) -> Array | np.ndarray:
    """Return, for each row, whether it contains a NaN or an infinity."""
    return ~xp.isfinite(rows).reshape(rows.shape[0], -1).all(axis=1)


def common_dtype(tree: Any, name: str) -> Any:
    """Return the one dtype of all arrays of a tree; raise `TypeError` if they have several."""
    kinds = {jnp.result_type(leaf) for leaf in jax.tree.leaves(tree)}
    if len(kinds) != 1:
        found = ", ".join(sorted(map(str, kinds)))
        raise TypeError(f"{name}: wanted arrays of one dtype, got {found}; convert them to one")
    return kinds.pop()


def require_finite(value: Numbers, name: str) -> Numbers:
    """Return the array; raise `ValueError` (`equinox` error under `jit`) if it contains a NaN or an
    infinity.
    """
    rows: Any = value
    if isinstance(rows, jax.Array) and is_known(rows) and rows.ndim and rows.shape[0] > _MANY:
        row = int(first_bad_row(_not_finite, rows))
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
    """Return `value` as `array_of_shape` does; raise `ValueError` for a NaN or an infinity, unless
    JAX traces it.
    """
    array = array_of_shape(value, shape, name, **options)
    return require_finite(array, name) if is_known(array) else array


def scalars(**named: object) -> list[Array]:
    """Return numbers, given by name, as scalar arrays of the widest dtype among them; raise as
    `array_of_shape`.
    """
    numbers = [array_of_shape(value, (), name) for name, value in named.items()]
    return [value.astype(jnp.result_type(*numbers)) for value in numbers]


def checked_time(value: object, name: str = "t") -> Array:
    """Return a time, s, as a scalar array; raise as `finite_array`."""
    return finite_array(value, (), name)


def require_positive(
    value: Array, name: str, requirement: str, *, allow_zero: bool = False
) -> Array:
    """Return the array; raise `ValueError` (`equinox` error under `jit`) if a number is not finite
    or not positive; `requirement` is what was wanted.
    """
    xp = array_module(value)
    numbers = xp.asarray(value)
    bad = ~(((numbers >= 0) if allow_zero else (numbers > 0)) & xp.isfinite(numbers))
    example = f", got {numbers[bad][0]}" if xp is np and bad.any() else ""
    return error_if(value, bad.any(), f"{name}: wanted {requirement}{example}")


def check_if_known(check: Callable[..., Array], value: Array, *args: Any, **options: Any) -> Array:
    """Return `check(value, …)` for an array that is known and not empty, else `value` unchanged."""
    return check(value, *args, **options) if is_known(value) and value.size else value


def require_instance(
    value: object,
    kinds: type | tuple[type, ...],
    name: str,
    *,
    requirement: str = "",
    hint: str = "",
) -> Any:
    """Return `value` if it is an instance of `kinds`, else raise `TypeError`; `requirement` is what
    was wanted, by default the names of the classes.
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
    raise TypeError(f"{name}: wanted {requirement}, got {type_name(value)}{_advice(hint)}")


# The shape of each field of one body or one state, by the name of the field.
_ONE = {
    "tensor": (3, 3), "mass": (), "com": (3,), "second_moment": (3, 3),
    "x": (3,), "v": (3,), "q": (4,), "omega": (3,),
    "angle": (), "rate": (),
}  # fmt: skip


def require_unbatched_instance(
    value: object,
    kinds: type | tuple[type, ...],
    name: str,
    *,
    requirement: str = "",
    hint: str = "",
) -> Any:
    """Return `value` if it is an instance of `kinds`, and one body or one state; raise `TypeError`
    for another class, `ValueError` for a batch.

    A batch of bodies has the class of one body: without this check its shape would raise an error
    in the middle of the arithmetic.
    """
    require_instance(value, kinds, name, requirement=requirement, hint=hint)
    for field in (field for field in _ONE if field in vars(value)):
        part, shape = getattr(value, field), _ONE[field]
        if getattr(part, "shape", None) != shape or part.dtype not in (jnp.float32, jnp.float64):
            array_of_shape(part, shape, f"{name}.{field}")
    return value


def require_function(value: object, name: str, description: str, *, hint: str = "") -> Any:
    """Return `value` if it is a function; raise `TypeError` for a class, for what cannot be called,
    and for a wrong number of arguments.

    The number is checked if `description` begins with a list of arguments, as "(t, state, body) →
    scalar".
    """
    got = type_name(value)
    if callable(value) and not isinstance(value, type):
        listed = re.match(r"\w*\(([^()]*)\)", description)
        try:
            if listed is not None:
                inspect.signature(value).bind(*listed[1].split(","))
            return value
        except ValueError:
            # The function has no signature, as some functions written in C: it is accepted.
            return value
        except TypeError:
            got = f"one with other arguments: {inspect.signature(value)}"
    raise TypeError(f"{name}: wanted a function {description}, got {got}{_advice(hint)}")


@contextlib.contextmanager
def explain_tracing(kind: str, function: object) -> Iterator[None]:
    """Raise one line for JAX's errors about a traced number that Python or NumPy reads: where the
    user's function, of this kind (such as "torque"), does so, and what to write.
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
    """Return `value` as a Python integer; raise `TypeError` for anything but an integer of Python
    or NumPy, `ValueError` outside of `least` to `most`.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name}: wanted a whole number of Python, got {_shown(value)}")
    if value < least:
        raise ValueError(f"{name}: wanted a whole number of at least {least}, got {value}")
    if most is not None and value > most:
        raise ValueError(f"{name}: wanted a whole number of at most {most}, got {value}")
    return int(value)


def python_float(value: object, name: str) -> float:
    """Return `value` as one Python float; raise `TypeError` for a traced number or none,
    `ValueError` for several.
    """
    array = host_array(value, name)
    if array.shape != ():
        raise ValueError(f"{name}: wanted one number, got shape {array.shape}")
    return float(array)


def positive_float(value: object, name: str, requirement: str = "a positive number") -> float:
    """Return `value` as a positive and finite Python float; raise as `python_float`, and
    `ValueError` for any other.
    """
    number = python_float(value, name)
    if not 0 < number < np.inf:
        raise ValueError(f"{name}: wanted {requirement}, got {number}")
    return number


def fraction(value: object, name: str, requirement: str = "a number between 0 and 1") -> float:
    """Return `value` as a Python float between 0 and 1, both excluded; raise as
    `positive_float`.
    """
    number = positive_float(value, name, requirement)
    if not number < 1:
        raise ValueError(f"{name}: wanted {requirement}, got {number}")
    return number


def host_array(value: object, name: str) -> np.ndarray:
    """Return numbers as a NumPy array of floats, in SI units; raise `TypeError` for traced numbers,
    and for anything but real numbers.
    """
    if isinstance(value, Tracer):
        raise TypeError(
            f"{name}: wanted numbers that are known, got a traced array; this works on the host: "
            "call it outside of jax.jit, jax.grad and jax.vmap"
        )
    value = _si(value, name)
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name}: wanted numbers, got {type(value).__name__}") from error
    if array.dtype.kind not in "iuf" and array.dtype != jnp.bfloat16:
        got = type_name(value) if array.dtype == object else f"{type_name(value)} of {array.dtype}"
        raise TypeError(f"{name}: wanted numbers, got {got}")
    return array.astype(float)


def file_path(value: Any, name: str = "path") -> Path:
    """Return the `Path` of a file; raise `TypeError` for an empty name, and for anything but a text
    or a path.
    """
    named = isinstance(value, str | os.PathLike) and isinstance(os.fspath(value), str)
    if not named or value == "":
        raise TypeError(f"{name}: wanted the name of a file, got {_shown(value)}")
    return Path(value)


def escape_controls(text: object) -> str:
    """Return a text with control characters, such as an end of line, as Python writes them, such as
    a backslash and n.
    """
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))


def escape_formulas(text: object) -> str:
    """Return a text that matplotlib shows unchanged: `$` begins no formula, and an initial `_`,
    which hides a label, gets a space before it.
    """
    text = str(text).replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def require_option(value: object, options: Sequence[str], name: str) -> str:
    """Return `value` if it is one of the texts in `options`, else raise `ValueError`."""
    if isinstance(value, str) and value in options:
        return value
    raise ValueError(f"{name}: wanted one of {', '.join(options)}, got {_shown(value)}")


def _shown(value: object) -> str:
    """Return what stands after "got": a number or a text as Python writes it, else the name of the
    type.
    """
    return repr(value) if isinstance(value, int | float | str) else type(value).__name__


def random_key(value: object, name: str = "key") -> Array:
    """Return `value` if it is one random key of JAX, of the new type or the old, else raise
    `TypeError`.
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
    """Import a module of an optional package, of the group `extra`; raise `ModuleNotFoundError`,
    with the command that installs it, if it is missing.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        words = f"{caller}: {module} is missing; in the clone: pip install '.[{extra}]'"
        raise ModuleNotFoundError(words, name=module) from error


def float_type(value: Any, name: str = "dtype") -> np.dtype:
    """Return the dtype float32 or float64 that `value` names, JAX's default of the two for `float`;
    raise `TypeError` for others.
    """
    if value is float:
        return jnp.result_type(float)
    try:
        kind = None if value is None else np.dtype(value)
    except (TypeError, ValueError):
        kind = None
    if kind not in (np.float32, np.float64):
        raise TypeError(f"{name}: wanted float32 or float64, got {_shown(value)}")
    return kind


def advice_on_times(dtype: DTypeLike) -> str:
    """Return advice for times so large for their dtype that a step added to one is lost to
    rounding.
    """
    if np.dtype(dtype) == np.float64:
        return "count time from a later origin, such as the first time of the run"
    return "count time from a later origin, or use float64"
