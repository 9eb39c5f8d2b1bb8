"""What `dir` of a public module shows, and what a wrong name may mean."""

import ast
import difflib
import functools
import inspect
import sys
from importlib.util import find_spec
from types import ModuleType
from typing import Any


def own_names(module: str) -> Any:
    """A `__dir__`: what a module defines and imports as itself (`X as X`), as its source has it."""

    def names() -> list[str]:
        try:
            body = ast.parse(inspect.getsource(sys.modules[module])).body
        except OSError:  # Where there is no source, all names without an underscore are shown.
            return sorted(n for n in vars(sys.modules[module]) if n[0] != "_")
        body += [inner for node in body if isinstance(node, ast.If) for inner in node.body]
        nodes = [n for one in body for n in getattr(one, "names", getattr(one, "targets", [one]))]
        named = [(getattr(one, "name", getattr(one, "id", "_")), one) for one in nodes]
        return sorted({n for n, one in named if n[0] != "_" and getattr(one, "asname", n) == n})

    return names


def suggests(module: str) -> Any:
    """A `__getattr__`: a wrong name is answered with the nearest that exist, two at most."""

    def look_up(name: str) -> Any:
        words, near = f"module {module!r} has no attribute {name!r}", []
        # Tools ask for hidden names, and the import system for modules that are not loaded yet.
        if name[0] != "_" and not (hasattr(here, "__path__") and find_spec(f"{module}.{name}")):
            near = difflib.get_close_matches(name.lower(), _ways(), n=2, cutoff=0.75)
            near = near[: 1 if name.lower() in near else 2]
        ways = [
            min(_ways()[one], key=lambda way: (not way[1].endswith(f".{name}"), way[0] != module))
            for one in near
        ]
        if ways:
            words += f"; did you mean {' or '.join(way for _, way in ways)}?"
        raise AttributeError(words, name=name)

    here = sys.modules[module]
    return look_up


@functools.cache
def _ways() -> dict[str, list[tuple[str, str]]]:
    """Module and shortest way of each public name, by the name in lower case."""
    left, seen, found = [("rj", sys.modules["rigidjax"])], set(), {}
    for way, module in left:
        if module not in seen:
            seen.add(module)
            for name in dir(module):
                found.setdefault(name.lower(), []).append((module.__name__, f"{way}.{name}"))
                value = getattr(module, name)
                if isinstance(value, ModuleType) and value.__name__.startswith("rigidjax"):
                    left.append((f"{way}.{name}", value))
    return found
