"""The names that `dir` of a public module shows, and suggestions for a wrong name."""

import difflib
import functools
import inspect
import re
import sys
from importlib.util import find_spec
from types import ModuleType

_NOT_MODELLED = ("joint", "contact", "hinge", "constraint", "collide", "render", "flexib", "urdf")


def show(module: str) -> None:
    """Have `dir` show what a module defines or imports as itself (`X as X`), and `wrong` answer."""
    here = sys.modules[module]

    def names() -> list[str]:
        try:
            text = inspect.getsource(here).split('"""', 2)[-1]
        except OSError:  # Where there is no source, all names without an underscore are shown.
            return sorted(n for n in vars(here) if n[0] != "_")
        found = re.findall(r"^(?:def|class) (\w+)|^(\w+) = |\b(\w+) as \3\b", text, re.M)
        return sorted({name for name in map("".join, found) if name[0] != "_"})

    vars(here).update(__dir__=names, __getattr__=functools.partial(wrong, module))


def wrong(module: str, name: str) -> ModuleType:
    """Answer a wrong name with the nearest that exist, two at most."""
    here, near, ways = sys.modules[module], [], []
    # Tools ask for hidden names, and the import system for modules that are not loaded yet.
    if name[0] != "_" and not (hasattr(here, "__path__") and find_spec(f"{module}.{name}")):
        near = difflib.get_close_matches(name.lower(), _ways(), n=2, cutoff=0.75)
    for one in near[: 1 if name.lower() in near else 2]:
        best = min(_ways()[one], key=lambda w: (not w[1].endswith(f".{name}"), w[0] is not here))
        ways.append(best[1])
    words = f"; did you mean {' or '.join(ways)}?" if ways else ""
    if module == "rigidjax" and any(word in name.lower() for word in _NOT_MODELLED):
        words = (
            "; contact, joints, trees of bodies, flexibility and rendering are not modelled: take "
            "MuJoCo MJX, Brax or Drake"
        )
    raise AttributeError(f"module {module!r} has no attribute {name!r}{words}", name=name)


@functools.cache
def _ways() -> dict[str, list[tuple[ModuleType, str]]]:
    """Module and shortest way of each public name, by the name in lower case."""
    left, found = [("rj", sys.modules["rigidjax"])], {}
    for way, module in left:
        for name in dir(module):
            found.setdefault(name.lower(), []).append((module, f"{way}.{name}"))
            value = getattr(module, name)
            ours = isinstance(value, ModuleType) and value.__name__.startswith("rigidjax")
            if ours and all(value is not old for _, old in left):
                left.append((f"{way}.{name}", value))
    return found
