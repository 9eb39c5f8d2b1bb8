"""What is public: found by walking, so that nothing new escapes the tests of the surface."""

import ast
import functools
import importlib
import inspect
import re
import sys
import types
import typing
from collections.abc import Callable, Iterator
from pathlib import Path

import rigidjax


def modules() -> list[types.ModuleType]:
    """rigidjax, its packages, and every module that one of them re-exports (`X as X`)."""
    found: dict[str, types.ModuleType] = {}

    def visit(module: types.ModuleType) -> None:
        if module.__name__ in found:
            return
        found[module.__name__] = module
        for name in _reexported(module):
            inner = getattr(module, name)
            if isinstance(inner, types.ModuleType) and inner.__name__.startswith("rigidjax"):
                visit(inner)

    visit(rigidjax)
    for package in sorted(Path(str(rigidjax.__file__)).parent.glob("*/__init__.py")):
        if package.parent.name in dir(rigidjax):
            visit(importlib.import_module(f"rigidjax.{package.parent.name}"))
    return list(found.values())


def functions() -> dict[str, Callable]:
    """Every public function and class by its shortest name, without `rigidjax.`, and `received`."""
    return named() | received()


def named() -> dict[str, Callable]:
    """Every public function and class by its shortest public name, without `rigidjax.`."""
    names: dict[int, list[str]] = {}
    things: dict[int, Callable] = {}
    for module in modules():
        for name in _names(module):
            thing = getattr(module, name)
            if callable(thing) and not isinstance(thing, types.ModuleType):
                names.setdefault(id(thing), []).append(f"{module.__name__}.{name}")
                things[id(thing)] = thing
    return {_shortest(names[key]): thing for key, thing in things.items()}


@functools.cache
def received() -> dict[str, type]:
    """Classes of ours that users are given, and that have no public name: `frames.Instant`.

    Public functions, methods and properties return them, or they are fields of what these return.
    """
    public = named()
    known, walked, found = {id(thing) for thing in public.values()}, set(), {}
    left = [(thing, False) for thing in public.values()]
    for thing, given in left:
        for cls in _given(inspect.unwrap(thing), given):
            if not _ours(cls) or id(cls) in walked:
                continue
            walked.add(id(cls))
            left.append((cls, True))
            if id(cls) not in known:
                name = f"{cls.__module__.split('.')[1]}.{cls.__name__}"
                assert name not in found and name not in public, name
                found[name] = cls
    return found


def given(function: Callable) -> list[type]:
    """The classes in what a function returns."""
    return list(_given(inspect.unwrap(function), False))


def _ours(cls: type) -> bool:
    ours = cls.__module__.startswith("rigidjax") and not cls.__name__.startswith("_")
    return ours and not inspect.isabstract(cls)


def _given(thing: object, fields: bool) -> Iterator[type]:
    """The classes that a function returns; of a class, its methods, and its fields, too."""
    if not inspect.isclass(thing):
        yield from _classes(getattr(thing, "__annotations__", {}).get("return"), thing)
        return
    # Methods of another library's protocol, as of a solver of diffrax, are for that library.
    theirs = {n for b in thing.__mro__ if not b.__module__.startswith("rigidjax") for n in vars(b)}
    for name in sorted(set(dir(thing)) - theirs):
        value = inspect.getattr_static(thing, name)
        plain = value.__func__ if isinstance(value, staticmethod | classmethod) else value
        plain = inspect.unwrap(plain.fget if isinstance(plain, property) else plain)
        if inspect.isfunction(plain) and (name[0] != "_" or name == "__call__"):
            yield from _given(plain, False)
    # What has an `__init__` of its own is made by users: its fields are its own affair, and so are
    # those that a docstring does not name.
    if fields and "\n    def __init__(" not in inspect.getsource(thing):
        for name, value in vars(thing).get("__annotations__", {}).items():
            if f"`{name}`" in (thing.__doc__ or ""):
                yield from _classes(value, thing)


def _classes(annotation: object, where: object) -> Iterator[type]:
    """The classes of an annotation: of `tuple[Alias, ...]` and `"Alias | None"` it is `Alias`."""
    if isinstance(annotation, str):
        known = vars(sys.modules[where.__module__])
        for word in re.findall(r"\w+", annotation):
            yield from _classes(known.get(word), where)
    elif isinstance(annotation, typing.ForwardRef):
        yield from _classes(annotation.__forward_arg__, where)
    elif inner := typing.get_args(annotation):
        for one in (typing.get_origin(annotation), *inner):
            yield from _classes(one, where)
    elif isinstance(annotation, typing.TypeVar):
        for one in annotation.__constraints__:
            yield from _classes(one, where)
    elif inspect.isclass(annotation):
        yield annotation


def methods() -> dict[str, Callable]:
    """The public methods that a public class of ours defines itself, as `Class.method`."""
    found: dict[str, Callable] = {}
    for name, thing in functions().items():
        if not inspect.isclass(thing) or issubclass(thing, Exception):
            continue
        for method, value in vars(thing).items():
            plain = value.__func__ if isinstance(value, staticmethod | classmethod) else value
            if method.startswith("_") and method != "__call__":
                continue
            if inspect.isclass(plain) or isinstance(plain, property) or not callable(plain):
                continue
            if getattr(plain, "__isabstractmethod__", False):
                continue
            found[f"{name}.{method}"] = getattr(thing, method)
    return found


def _names(module: types.ModuleType) -> set[str]:
    found = set(_reexported(module))
    if not str(module.__file__).endswith("__init__.py"):
        found |= {
            name
            for name, thing in vars(module).items()
            if not name.startswith("_") and getattr(thing, "__module__", None) == module.__name__
        }
    return found


def _reexported(module: types.ModuleType) -> Iterator[str]:
    for node in ast.parse(Path(str(module.__file__)).read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            yield from (part.name for part in node.names if part.asname == part.name)


def _shortest(names: list[str]) -> str:
    shortest = min(names, key=lambda name: (name.count("."), len(name)))
    return shortest.removeprefix("rigidjax.")
