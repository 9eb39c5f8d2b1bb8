"""Write the results of the finished starts of a fit to a file, from which a killed search can
continue.
"""

import contextlib
import dataclasses
import hashlib
import json
import re
import uuid
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from rigidjax.identify.search.stages import Attempt


def without_arrays(attempt: Attempt) -> Attempt:
    """Return the `attempt` without its `blocks`, which take much memory."""
    return attempt if attempt.blocks is None else dataclasses.replace(attempt, blocks=None)


def report_progress(progress: Callable[[str], Any] | None, line: str) -> None:
    """Call the function `progress` with a `line` of text.

    If the line cannot be written, a warning is given and the search goes on.
    """
    if progress is None:
        return
    try:
        progress(line)
    except OSError as error:
        reason = error.strerror or error
        warnings.warn(
            f"fit: progress could not be written ({reason}); the search goes on", stacklevel=3
        )


def require_folder(path: str | Path) -> None:
    """Raise `ValueError` before a search whose checkpoint is no file in an existing folder."""
    path = Path(path)
    if not path.parent.is_dir():
        raise ValueError(f"checkpoint {path}: there is no folder {path.parent}")
    if path.is_dir():
        raise ValueError(f"checkpoint {path}: wanted a file, got a folder")


def fingerprint(*trees: PyTree) -> str:
    """Return a hash of the numbers and the structure of `trees`, equal in every process.

    Of a function only the name enters the hash.
    """
    leaves, structure = jax.tree.flatten(trees)
    words, digest = [repr(structure)], hashlib.sha256()
    for leaf in leaves:
        if not eqx.is_array_like(leaf):
            words.append(repr(leaf))
            continue
        array = np.asarray(leaf)
        words.append(f"{array.dtype} {array.shape}")
        digest.update(array.tobytes())
    # Addresses in memory are left out, since they differ between processes.
    digest.update(re.sub("0x[0-9a-f]+", "", "\n".join(words)).encode())
    return digest.hexdigest()


class Checkpoint:
    """Hold the results of the finished starts of a search, and save them to a file.

    The arrays in the file have the shapes of those of `example`; `print_of` is the `fingerprint` of
    everything that the search depends on. The file is written after every start; if it exists
    already, it is read first. `ValueError` is raised if it belongs to another search, and it is
    then not overwritten.
    """

    def __init__(self, path: str | Path | None, example: Attempt, print_of: str):
        self.path, self.like = None if path is None else Path(path), example
        self.print_of = print_of
        self.done: list[Attempt] = []
        if self.path is not None and self.path.exists():
            self._read(self.path)

    def save(self, attempts: Sequence[Attempt]) -> None:
        """Write the `attempts` to the file, which is replaced in one (atomic) step.

        A warning is given if the file cannot be written.
        """
        if self.path is None:
            return
        head = dict(print_of=self.print_of, done=len(attempts))
        # The new checkpoint is written to a temporary file, which then replaces the old one. The
        # temporary file has a unique name, since another program may write to the same checkpoint.
        part = self.path.with_name(f"{self.path.name}.{uuid.uuid4().hex}.part")
        try:
            with part.open("xb") as file:
                file.write(json.dumps(head).encode() + b"\n")
                eqx.tree_serialise_leaves(file, [without_arrays(item) for item in attempts])
            part.replace(self.path)
        except OSError as error:
            warnings.warn(
                f"fit: the checkpoint {self.path} is not up to date ({error.strerror or error}); "
                "the search goes on",
                stacklevel=2,
            )
        finally:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)

    def _read(self, path: Path) -> None:
        """Read the results of all finished starts into the member `done`."""
        try:
            with path.open("rb") as file:
                head = json.loads(file.readline())
                same = head["print_of"] == self.print_of
                if same:
                    example = [self.like] * int(head["done"])
                    self.done = eqx.tree_deserialise_leaves(file, example)
        except Exception as error:
            raise ValueError(
                f"{path}: wanted the checkpoint of a fit, got another file or a damaged one "
                f"({type(error).__name__}); delete it, or name another file"
            ) from None
        if not same:
            raise ValueError(
                f"{path}: wanted the checkpoint of this model and these options, got that of "
                "others; name another file"
            )
