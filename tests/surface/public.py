"""What is public: found by walking, so that nothing new escapes the tests of the surface."""

import ast
import importlib
import inspect
import types
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
        visit(importlib.import_module(f"rigidjax.{package.parent.name}"))
    return list(found.values())


def functions() -> dict[str, Callable]:
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
