"""One good call of each public function and class: the table that the fuzz goes through."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

from surface import public

ALL = ("same", "single", "whole", "shape", "stranger", "kind", "function", "size", "nan", "inf")
# For what is dear to run: only what is refused before anything is computed.
KINDS = ("stranger", "kind", "function", "shape")
TRANSFORMS = ("jit", "vmap", "grad", "jacfwd", "hessian", "scan", "checkpoint")


@dataclasses.dataclass(frozen=True)
class Call:
    """A good call.

    **Fields:** `name` as in `public`; `run` what is called, with keywords; `given` makes the
    arguments; `groups` which replacements are tried, of which `arguments` (all of them); `traced`
    which arguments are traced (all that hold floats); `transforms` which are tried: none for what
    works on the host, which under `jit` must then say so (`host`); `says` other words by which a
    message may name what is wrong; `dear` a good call that takes a minute and is made in the tests
    of its own: only what must be refused is tried.
    """

    name: str
    run: Callable
    given: Callable[[], dict[str, Any]]
    groups: Sequence[str] = ALL
    arguments: Sequence[str] | None = None
    traced: Sequence[str] | None = None
    transforms: Sequence[str] = TRANSFORMS
    host: bool = False
    says: Sequence[str] = ()
    dear: bool = False


TABLE: dict[str, Call] = {}
# Public, and with no row: why.
WITHOUT: dict[str, str] = {}


def row(name: str, given: Any = None, /, run: Callable | None = None, **more: Any) -> None:
    """A row: `row("so3.exp", dict(v=V))`; `given` may be a function that makes the arguments.

    A second row of the same callable has something in brackets after its name.
    """
    if name in TABLE or name in WITHOUT:
        raise ValueError(f"{name} is in the table already")
    made = given if callable(given) else (lambda: given or {})
    TABLE[name] = Call(name, _found(name) if run is None else run, made, **more)


def _found(name: str) -> Callable:
    found = _everything().get(name)
    if found is None:
        raise ValueError(f"{name} is no public function, class or method")
    return found


@functools.cache
def _everything() -> dict[str, Callable]:
    return public.functions() | public.methods()


def leave_out(reason: str, *names: str) -> None:
    """Names without a row."""
    for name in names:
        if name in TABLE or name in WITHOUT:
            raise ValueError(f"{name} is in the table already")
        WITHOUT[name] = reason
