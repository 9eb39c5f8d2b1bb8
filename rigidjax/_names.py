"""Make `dir` list the public names of a module, and answer a wrong name, of a module or of an
argument, with the nearest right ones.
"""

import difflib
import functools
import inspect
import sys
from collections.abc import Callable
from importlib.util import find_spec
from types import ModuleType
from typing import Any, NoReturn, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])

# Names of arguments in other libraries, and ours for them.
_OTHERS = {
    "t0": "ts", "t1": "ts", "t_span": "ts", "t_eval": "ts", "saveat": "ts", "times": "ts",
    "y0": "state0", "state": "state0", "method": "solver", "events": "event", "force": "torque",
    "tol": "rtol", "dt": "dt0", "args": "torque",
}  # fmt: skip
_NOT_MODELLED = ("joint", "contact", "hinge", "constraint", "collide", "render", "flexib", "urdf")


def define_dir_and_getattr(module_name: str) -> None:
    """Define `__dir__` and `__getattr__` of a module: `dir` lists its `__all__`, and the look-up of
    another name raises `AttributeError` with the nearest public names.
    """
    here = sys.modules[module_name]
    vars(here).update(
        __dir__=lambda: sorted(here.__all__),
        __getattr__=functools.partial(raise_unknown, module_name),
    )


def raise_unknown(module_name: str, name: str) -> NoReturn:
    """Raise `AttributeError` for a name that a module lacks, with the public names of the library
    that are nearest to it.
    """
    here, hint = sys.modules[module_name], ""
    if module_name == "rigidjax" and any(word in name.lower() for word in _NOT_MODELLED):
        hint = (
            "; contact, joints, trees of bodies, flexibility and rendering are not modelled: take "
            "MuJoCo MJX, Brax or Drake"
        )
    # No near name is searched for in two cases: for a name that begins with an underscore, since
    # tools ask for such names; and for a module that is not loaded yet, since the import system
    # asks for it.
    elif name[0] != "_" and not (hasattr(here, "__path__") and find_spec(f"{module_name}.{name}")):
        paths = _paths()
        # `fit` and `Fit` are two names: the name is looked up first as it was written, and then in
        # lower case.
        same = next((one for one in (name, name.lower()) if one in paths), None)
        near = [same] if same else difflib.get_close_matches(name.lower(), paths, n=4, cutoff=0.75)
        nearest = list(dict.fromkeys(paths[one] for one in near))[:2]
        hint = f"; did you mean {' or '.join(nearest)}?" if nearest else ""
    raise AttributeError(f"module {module_name!r} has no attribute {name!r}{hint}", name=name)


def suggest_arguments(function: Function) -> Function:
    """Return `function`, which answers an argument that it lacks with the nearest of its own."""
    names = inspect.signature(function).parameters

    @functools.wraps(function)
    def checked(*args: Any, **given: Any) -> Any:
        for name in given.keys() - names.keys():
            near = difflib.get_close_matches(name, names, n=1)
            near = [_OTHERS[name]] if _OTHERS.get(name) in names else near
            hint = f"; did you mean {near[0]}?" if near else f"; it has {', '.join(names)}"
            raise TypeError(f"{function.__name__}: there is no argument {name}{hint}")
        return function(*args, **given)

    return checked  # pyright: ignore[reportReturnType]


@functools.cache
def _paths() -> dict[str, str]:
    """Return the shortest path of each public name: from `Sum` (and `sum`) to `rj.torques.Sum`, for
    example.
    """
    modules, paths = [("rj", sys.modules["rigidjax"])], {}
    for path, module in modules:
        for name in dir(module):
            paths.setdefault(name, f"{path}.{name}")
            value = getattr(module, name)
            ours = isinstance(value, ModuleType) and value.__name__.startswith("rigidjax")
            if ours and all(value is not known for _, known in modules):
                modules.append((f"{path}.{name}", value))
    # Two names that differ in capitals only, such as `fit` and `Fit`, each keep their own path: a
    # name as it is written has precedence over another name in lower case.
    return {name.lower(): path for name, path in reversed(paths.items())} | paths
