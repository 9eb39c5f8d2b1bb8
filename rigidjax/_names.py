"""The names of public modules: what `dir` shows, and old names (floor 0)."""

import ast
import functools
import importlib
import inspect
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any


def own_names(module: str) -> Callable[[], list[str]]:
    """A `__dir__` for a public module: what its source makes public, and nothing else.

    That is what it defines and what it imports as itself (`from … import X as X`, the sign of a
    re-export that type checkers go by), without a leading underscore. The source is read when
    somebody asks; where there is none, all names without an underscore are shown.

    **Arguments:** `module` the module's `__name__`; write `__dir__ = own_names(__name__)` as its
    last line.

    >>> import rigidjax as rj
    >>> "exp" in dir(rj.quaternion), "jnp" in dir(rj.quaternion)
    (True, False)
    """

    @functools.cache
    def names() -> tuple[str, ...]:
        here = sys.modules[module]
        try:
            body = ast.parse(inspect.getsource(here)).body
        except OSError:
            found = set(vars(here))
        else:
            found = set(_public(body))
        return tuple(sorted(name for name in found if not name.startswith("_")))

    return lambda: list(names())


def _public(body: list[ast.stmt]) -> Iterator[str]:
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.ImportFrom | ast.Import):
            yield from (one.name for one in node.names if one.asname == one.name)
        elif isinstance(node, ast.Assign):
            targets = (one for target in node.targets for one in ast.walk(target))
            yield from (one.id for one in targets if isinstance(one, ast.Name))
        elif isinstance(node, ast.If):
            # What is imported for type checkers only is loaded when first asked for.
            yield from _public(node.body)


def renamed(module: str, names: dict[str, str]) -> Callable[[str], Any]:
    """A `__getattr__` for a public module some of whose names are now others.

    The old name gives the new thing and a `DeprecationWarning` that says where it is now. It is
    kept for one release.

    **Arguments:** `module` the module's `__name__`; `names` old name → new full name, which is
    imported when the old one is asked for.

    >>> get = renamed("rigidjax.plot", {"pose": "rigidjax.plot.motion"})
    >>> get("other")
    Traceback (most recent call last):
    AttributeError: module 'rigidjax.plot' has no attribute 'other'
    """

    def look_up(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        warnings.warn(
            f"{module}.{name} is now {names[name]}; the old name will be removed in 0.3",
            DeprecationWarning,
            stacklevel=2,
        )
        place, _, inner = names[name].rpartition(".")
        return getattr(importlib.import_module(place), inner)

    return look_up
