"""What came of a call, and whether a user would say that it is all right."""

import ast
import dataclasses
import functools
import re
import traceback
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import rigidjax

HOME = Path(str(rigidjax.__file__)).parent
OUR_KINDS = (ValueError, TypeError, OSError, ImportError)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The numbers that came back, by place, or what was raised."""

    numbers: dict[str, np.ndarray] | None = None
    error: BaseException | None = None

    def __str__(self) -> str:
        if self.error is not None:
            words = str(self.error).strip().replace("\n", " ")
            return f"{type(self.error).__name__}: {words[:300]}"
        shown = ", ".join(f"{k}={_short(v)}" for k, v in list((self.numbers or {}).items())[:4])
        return f"returned {shown}" if shown else "returned no numbers"


def outcome(call: Any) -> Outcome:
    """What `call()` gives."""
    try:
        return Outcome(numbers_of(jax.block_until_ready(call())))
    except Exception as error:
        return Outcome(error=error)


def numbers_of(value: Any) -> dict[str, np.ndarray]:
    """All numbers in a tree, in the fields of dataclasses too."""
    found: dict[str, np.ndarray] = {}

    def visit(name: str, part: Any) -> None:
        if dataclasses.is_dataclass(part) and not isinstance(part, type | eqx.Module):
            part = {f.name: getattr(part, f.name) for f in dataclasses.fields(part)}
        leaves = jax.tree_util.tree_leaves_with_path(part)
        for path, leaf in leaves:
            where = name + jax.tree_util.keystr(path)
            if isinstance(leaf, bool | int | float | np.number | np.ndarray | np.bool_):
                array = np.asarray(leaf)
            elif isinstance(leaf, jax.Array) and not jnp.issubdtype(
                leaf.dtype, jax.dtypes.prng_key
            ):
                array = np.asarray(leaf)
            elif dataclasses.is_dataclass(leaf) and not isinstance(leaf, type):
                visit(where, leaf)
                continue
            else:
                continue
            if array.dtype.kind in "biufc" or array.dtype == jnp.bfloat16:
                found[where] = array

    visit("", value)
    return found


def raw(error: BaseException, words: set[str]) -> str | None:
    """Why this is not an error in our words; `None` if it is.

    Ours are raised by a `raise` of the library, or by `equinox.error_if`, are of a kind that a
    caller may expect, and say in a sentence which argument or function is meant.
    """
    text = str(error)
    if isinstance(error, eqx.EquinoxRuntimeError):
        # Under `jit` the stack comes first, then the message, then advice on debugging.
        text = text.partition("\n-----")[0].rpartition("EquinoxRuntimeError: ")[2].split("\n")[0]
    elif not isinstance(error, OUR_KINDS):
        return f"raised a raw {type(error).__name__}"
    elif not _raised_by_us(error):
        return "was not raised by the library"
    if len(text.split()) < 4:
        return "does not say what was wanted"
    lower = text.lower()
    if not any(re.search(rf"(?<![a-z]){re.escape(word)}", lower) for word in words):
        return f"names none of {', '.join(sorted(words))}"
    return None


def _raised_by_us(error: BaseException) -> bool:
    frames = traceback.extract_tb(error.__traceback__)
    last = frames[-1]
    file = Path(last.filename)
    if not file.is_relative_to(HOME):
        return False
    return any(first <= (last.lineno or 0) <= end for first, end in _raises(file))


@functools.cache
def _raises(file: Path) -> list[tuple[int, int]]:
    tree = ast.parse(file.read_text("utf-8"))
    return [
        (node.lineno, node.end_lineno or node.lineno)
        for node in ast.walk(tree)
        if isinstance(node, ast.Raise)
    ]


def words_for(name: str, argument: str, value: Any) -> set[str]:
    """What a message about this argument of this function may call it."""
    parts = name.partition(" (")[0].split(".")
    words = {parts[-1], argument, argument.replace("_", " "), *argument.split("_or_")}
    if len(parts) > 1 and parts[-2][0].isupper():
        words.add(parts[-2])
    if isinstance(value, rigidjax.Inertia | rigidjax.MassProperties):
        words |= {"inertia", "mass", "second moment"}
    for path, _ in jax.tree_util.tree_leaves_with_path(value):
        for key in path:
            field = getattr(key, "name", None)
            if isinstance(field, str):
                words |= {field, field.replace("_", " ")}
    return {word.lower() for word in words if word}


def same(ours: Outcome, good: Outcome, rtol: float) -> bool:
    """Whether two results agree, NaN with NaN, each array relative to its own size."""
    a, b = ours.numbers, good.numbers
    if a is None or b is None or a.keys() != b.keys():
        return False
    return all(close(a[key], b[key], rtol) for key in a)


def close(a: np.ndarray, b: np.ndarray, rtol: float) -> bool:
    """Whether two arrays agree, relative to the largest finite entry."""
    a, b = _float(a), _float(b)
    if a.shape != b.shape:
        return False
    if not (np.array_equal(np.isnan(a), np.isnan(b)) and _same_infinities(a, b)):
        return False
    fine = np.isfinite(a) & np.isfinite(b)
    if not fine.any():
        return True
    scale = max(np.abs(a[fine]).max(), np.abs(b[fine]).max())
    return bool(np.abs(a[fine] - b[fine]).max() <= rtol * scale)


def has_nan(result: Outcome) -> bool:
    """Whether a NaN came back."""
    return any(np.isnan(_float(a)).any() for a in (result.numbers or {}).values())


def all_finite(result: Outcome) -> bool:
    """Whether everything that came back is finite."""
    return all(np.isfinite(_float(a)).all() for a in (result.numbers or {}).values())


def _same_infinities(a: np.ndarray, b: np.ndarray) -> bool:
    at = np.isinf(a) | np.isinf(b)
    return bool((a[at] == b[at]).all())


def _float(a: np.ndarray) -> np.ndarray:
    return a if a.dtype.kind == "c" else a.astype(float)


def _short(a: np.ndarray) -> str:
    return np.array2string(a.reshape(-1)[:4], precision=3, separator=",") + (
        f" {a.shape}" if a.ndim else ""
    )
