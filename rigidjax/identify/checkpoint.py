"""The state of a search in a file, so that a killed search can continue."""

import dataclasses
import hashlib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rigidjax.identify.parameters import Parameters


class Tried(eqx.Module):
    """The end of one start; `cost` is ½ Σ of squares; `found` that of `with_blocks` there, if
    known.
    """

    parameters: Parameters
    cost: Float[Array, "*starts"] = eqx.field(converter=jnp.asarray, default=np.inf)
    converged: Bool[Array, "*starts"] = eqx.field(converter=jnp.asarray, default=False)
    found: Any = None


def bare(tried: Tried) -> Tried:
    """The same without its large arrays."""
    return tried if tried.found is None else dataclasses.replace(tried, found=None)


class SearchState(NamedTuple):
    """The search from one start: the next horizon (their number at the end), strides, result."""

    stage: int
    strides: int
    tried: Tried


def require_folder(path: str | Path) -> None:
    """Raise `ValueError` unless a file can be at `path`: before the search, not after a stride."""
    path = Path(path)
    if not path.parent.is_dir():
        raise ValueError(f"checkpoint {path}: there is no folder {path.parent}")
    if path.is_dir():
        raise ValueError(f"checkpoint {path}: wanted a file, this is a folder")


def fingerprint(*trees: Any) -> str:
    """A hash of numbers and structure, the same in every process; a function counts by its name."""
    leaves, structure = jax.tree.flatten(trees)
    words, found = [repr(structure)], hashlib.sha256()
    for leaf in leaves:
        array = np.asarray(leaf)
        words.append(f"{array.dtype} {array.shape}")
        found.update(array.tobytes())
    # An address in memory differs between processes.
    found.update(re.sub("0x[0-9a-f]+", "", "\n".join(words)).encode())
    return found.hexdigest()


class Checkpoint:
    """The results of a long search so far, on disk after every stride of steps.

    `like` is a `Tried` of the right shapes, `print_of` the `fingerprint` of all that the search
    depends on. A file of another problem raises `ValueError`, and is not overwritten.
    """

    def __init__(self, path: str | Path | None, like: Tried, print_of: str):
        self.path, self.like = None if path is None else Path(path), like
        self.print_of = print_of
        self.done: list[Tried] = []
        self.position = SearchState(0, 0, like)
        if self.path is not None and self.path.exists():
            self._read(self.path)

    def save(self, done: Sequence[Tried], position: SearchState) -> None:
        """Write the finished starts and the state of the search, replacing the file at once."""
        if self.path is None:
            return
        stage, strides, current = position
        items = [bare(item) for item in (*done, current)]
        leaves = [np.asarray(x) for item in items for x in jax.tree.leaves(item)]
        beside = self.path.with_name(self.path.name + ".new")
        with beside.open("wb") as file:
            held: dict[str, Any] = {f"leaf{i}": leaf for i, leaf in enumerate(leaves)}
            held |= dict(print_of=self.print_of, stage=stage, strides=strides, done=len(done))
            np.savez(file, **held)
        beside.replace(self.path)

    def _read(self, path: Path) -> None:
        # An empty file raises EOFError; a cut one BadZipFile, or zlib.error.
        try:
            # NumPy leaves the handle open of a file that it opened itself and cannot read.
            with path.open("rb") as raw, np.load(raw) as file:
                held = {name: file[name] for name in file.files}
            print_of, done = str(held["print_of"]), int(held["done"])
            stage, strides = int(held["stage"]), int(held["strides"])
        except Exception as error:
            raise ValueError(
                f"{path}: no checkpoint of a fit, or a damaged one ({type(error).__name__}); "
                "delete it, or name another file"
            ) from None
        leaves, structure = jax.tree.flatten(self.like)
        count = len(leaves)
        found = [held.get(f"leaf{i}", np.zeros(0)) for i in range((done + 1) * count)]
        shapes = [leaf.shape for leaf in leaves] * (done + 1)
        if print_of != self.print_of or [leaf.shape for leaf in found] != shapes:
            raise ValueError(
                f"{path}: the checkpoint of another problem, or of other options; name another file"
            )
        items = [
            jax.tree.unflatten(structure, map(jnp.asarray, found[i * count : (i + 1) * count]))
            for i in range(done + 1)
        ]
        self.done, self.position = items[:-1], SearchState(stage, strides, items[-1])
