"""The names of public modules: what `dir` shows, old names, and what was meant."""

import ast
import difflib
import functools
import importlib
import inspect
import sys
import warnings
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from types import ModuleType
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
    >>> get("other_thing")
    Traceback (most recent call last):
    AttributeError: module 'rigidjax.plot' has no attribute 'other_thing'
    """

    def look_up(name: str) -> Any:
        if name not in names:
            raise missing(module, name)
        warnings.warn(
            f"{module}.{name} is now {names[name]}; the old name will be removed in 0.3",
            DeprecationWarning,
            stacklevel=2,
        )
        place, _, inner = names[name].rpartition(".")
        return getattr(importlib.import_module(place), inner)

    return look_up


def suggests(module: str) -> Callable[[str], Any]:
    """A `__getattr__` for a public module: a wrong name is answered with what may be meant.

    **Arguments:** `module` the module's `__name__`.

    >>> suggests("rigidjax.body")("heavytop")
    Traceback (most recent call last):
    AttributeError: module 'rigidjax.body' has no attribute 'heavytop'; did you mean \
rj.torques.HeavyTop?
    """

    def look_up(name: str) -> Any:
        raise missing(module, name)

    return look_up


def missing(module: str, name: str) -> AttributeError:
    """The error for a name that a public module does not have, with the nearest that exist.

    >>> str(missing("rigidjax", "HeavyTop"))
    "module 'rigidjax' has no attribute 'HeavyTop'; did you mean rj.torques.HeavyTop?"
    """
    words = f"module {module!r} has no attribute {name!r}"
    # Tools ask for hidden names, and the import system for modules that are not loaded yet.
    if not (name.startswith("_") or _is_module(module, name)):
        found = _nearest(name, module)
        words += f"; did you mean {' or '.join(found)}?" if found else ""
    return AttributeError(words, name=name)


def _is_module(package: str, name: str) -> bool:
    within = hasattr(sys.modules[package], "__path__")
    return within and find_spec(f"{package}.{name}") is not None


def _nearest(name: str, module: str) -> list[str]:
    """At most two full names like `name`: the same in another case, else the most alike."""
    table, wanted = _directory(), name.lower()
    here = module.replace("rigidjax", "rj", 1) + "."
    keys = [wanted] if wanted in table else []
    keys = keys or difflib.get_close_matches(wanted, table, n=2, cutoff=0.75)
    if not keys and len(name) > 2:
        begin = (key for key in table if key.startswith(wanted))
        keys = [key for key in begin if any(one.startswith(here) for one in table[key])]

    def unlike(one: str) -> tuple[bool, bool]:
        return not one.endswith(f".{name}"), not one.startswith(here)

    return [min(table[key], key=unlike) for key in keys[:2]]


@functools.cache
def _directory() -> dict[str, list[str]]:
    """All public names in lower case, and where each is: the shortest way first."""
    root = importlib.import_module("rigidjax")
    queue: list[tuple[str, ModuleType]] = [("rj", root)]
    seen, out = {root.__name__}, {}
    while queue:
        way, module = queue.pop(0)
        for name in dir(module):
            try:
                value = getattr(module, name)
            except ImportError:
                continue
            out.setdefault(name.lower(), []).append(f"{way}.{name}")
            own = isinstance(value, ModuleType) and value.__name__.startswith("rigidjax")
            if own and value.__name__ not in seen:
                seen.add(value.__name__)
                queue.append((f"{way}.{name}", value))
    return out
