"""The reference of the site: a page a public module, from signatures and docstrings.

`write(folder)` walks what `tests/surface` walks, so that nothing public is left out. Docstrings are
Markdown already; their `>>>` examples become blocks. Signatures are taken from the source: there an
argument's type has its short name (`Vec3Like`), and not what that stands for.
"""

import ast
import inspect
import sys
import textwrap
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from surface import public

_OUTER, _INNER = "::::::", ":::::"


def write(folder: Path) -> list[str]:
    """Writes the pages into `folder`, and returns the documented names."""
    folder.mkdir(exist_ok=True)
    modules = sorted(public.modules(), key=lambda module: module.__name__)
    short = shortest(modules)
    found = homes(modules, short)
    names = {id(thing): full for entries in found.values() for full, thing in entries}
    pages, documented = {}, []
    for module, entries in found.items():
        parts = [f"# {short[module.__name__]}", body_of(module)]
        for full, thing in entries:
            parts.append(entry(full, thing, names))
            documented.append(full)
        pages[module] = "\n\n".join(parts) + "\n"
    for module, text in pages.items():
        _put(folder / f"{module.__name__}.md", text)
    _put(folder / "index.md", index(pages, short))
    for path in folder.glob("*.md"):
        if path.stem not in {"index", *(module.__name__ for module in pages)}:
            path.unlink()
    return documented


def _put(path: Path, text: str) -> None:
    """Only what changed is written: the rest is not built again."""
    if not path.exists() or path.read_text("utf-8") != text:
        path.write_text(text, "utf-8")


def shortest(modules: list[types.ModuleType]) -> dict[str, str]:
    """How a user writes a module: `rj.so3` for rigidjax.rotation.so3."""
    names = {module.__name__: [module.__name__] for module in modules}
    for module in modules:
        for name in dir(module):
            inner = getattr(module, name)
            if isinstance(inner, types.ModuleType) and inner.__name__ in names:
                names[inner.__name__].append(f"{module.__name__}.{name}")
    best = {
        key: min(found, key=lambda one: (one.count("."), len(one))) for key, found in names.items()
    }
    return {key: "rj" + name.removeprefix("rigidjax") for key, name in best.items()}


def homes(
    modules: list[types.ModuleType], short: dict[str, str]
) -> dict[types.ModuleType, list[tuple[str, Any]]]:
    """What each public module documents: (shortest name, thing), in the module nearest its source."""
    places: dict[Any, list[tuple[types.ModuleType, str]]] = {}
    for module in modules:
        for name in dir(module):
            thing = getattr(module, name)
            if not isinstance(thing, types.ModuleType):
                places.setdefault(_key(module, name, thing), []).append((module, name))
    found: dict[types.ModuleType, list[tuple[str, Any]]] = {module: [] for module in modules}
    for (source, _), where in places.items():

        def distance(place: tuple[types.ModuleType, str], source: str = source) -> tuple:
            path = place[0].__name__
            inside = source == path or source.startswith(path + ".")
            return (-len(path) if inside else 0, path.count("."), path)

        module, name = min(where, key=distance)
        full = [f"{short[place.__name__]}.{other}" for place, other in where]
        best = min(full, key=lambda one: (one.count("."), len(one), one))
        found[module].append((best, getattr(module, name)))
    return {
        module: sorted(entries, key=lambda e: e[0].lower()) for module, entries in found.items()
    }


def _key(module: types.ModuleType, name: str, thing: Any) -> tuple[str, Any]:
    source = getattr(thing, "__module__", None)
    if isinstance(source, str) and source.startswith("rigidjax"):
        return source, id(thing)
    return module.__name__, name


def index(pages: dict[types.ModuleType, str], short: dict[str, str]) -> str:
    """The list of modules, each with its first line."""
    rows = [f"| [{short[m.__name__]}]({m.__name__}.md) | {first_line(m)} |" for m in pages]
    listed = "\n".join(module.__name__ for module in pages)
    return (
        "# Reference\n\nEvery public name, by module; `rj` is `import rigidjax as rj`. Arguments' "
        "shapes and units are those that the docstrings state.\n\n"
        "| module | what it holds |\n| --- | --- |\n"
        + "\n".join(rows)
        + f"\n\n```{{toctree}}\n:hidden:\n\n{listed}\n```\n"
    )


def first_line(thing: Any) -> str:
    return (inspect.getdoc(thing) or "").partition("\n")[0].replace("|", "\\|")


def body_of(thing: Any) -> str:
    """The docstring, its examples as blocks of code."""
    lines, out, inside = (inspect.getdoc(thing) or "").splitlines(), [], False
    for line in [*lines, ""]:
        starts = line.lstrip().startswith(">>> ")
        if starts and not inside:
            out += ["", "```pycon"]
            inside = True
        if inside and not line.strip():
            out += ["```"]
            inside = False
        out.append(line.strip() if starts else line)
    return "\n".join(out).strip()


def entry(full: str, thing: Any, names: dict[int, str]) -> str:
    """One public name as a directive of Sphinx."""
    if inspect.isclass(thing):
        inner = "\n\n".join(_members(thing, names))
        return directive("class", full + arguments(thing, names), f"{body_of(thing)}\n\n{inner}")
    if inspect.isroutine(thing) or hasattr(thing, "__wrapped__"):
        return directive("function", full + arguments(thing, names), body_of(thing))
    value = repr(thing)
    shown = f"`{value}`" if len(value) < 200 and " at 0x" not in value and "\n" not in value else ""
    return directive("data", full, shown)


def directive(kind: str, head: str, text: str, fence: str = _OUTER) -> str:
    return f"{fence}{{py:{kind}}} {head}\n\n{text}\n{fence}"


def _members(cls: type, names: dict[int, str]) -> Iterator[str]:
    for name, value in vars(cls).items():
        if name.startswith("_") and name != "__call__":
            continue
        plain = value.__func__ if isinstance(value, staticmethod | classmethod) else value
        plain = getattr(plain, "__wrapped__", plain)
        if not inspect.getdoc(plain) or not getattr(plain, "__doc__", None):
            continue
        if isinstance(plain, property):
            yield directive("property", name, body_of(plain), _INNER)
        elif inspect.isfunction(plain):
            yield directive(
                "method", name + arguments(plain, names, bound=True), body_of(plain), _INNER
            )


def arguments(thing: Any, names: dict[int, str], bound: bool = False) -> str:
    """`(x: Vec3Like, t: ScalarLike = 0.0) -> Vec3`, as the source has it."""
    plain = inspect.unwrap(thing)
    if inspect.isclass(plain):
        own = vars(plain).get("__init__")
        if not inspect.isfunction(own) or _source(own) is None:
            return _fields(plain, names)
        plain, bound = own, True
    node = _source(plain)
    if node is None:
        return "(…)"
    given = node.args
    if bound and given.args and given.args[0].arg in ("self", "cls"):
        given.args = given.args[1:]
    node = _Named(plain, names).visit(node)
    back = f" -> {ast.unparse(node.returns)}" if node.returns and node.name != "__init__" else ""
    return f"({ast.unparse(given)}){back}"


class _Named(ast.NodeTransformer):
    """Names of documented things become their full ones, for the links."""

    def __init__(self, thing: Any, names: dict[int, str]):
        self.known = vars(sys.modules[thing.__module__])
        self.names = names

    def visit_Name(self, node: ast.Name) -> ast.Name:
        full = self.names.get(id(self.known.get(node.id)))
        return ast.Name(full or node.id, node.ctx)

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        if isinstance(node.value, str) and node.value in self.known:
            return self.visit_Name(ast.Name(node.value, ast.Load()))
        return node


def _source(function: Any) -> ast.FunctionDef | None:
    try:
        node = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(function)))).body[0]
    except (OSError, TypeError, SyntaxError):
        return None
    return node if isinstance(node, ast.FunctionDef) else None


def _fields(cls: type, names: dict[int, str]) -> str:
    """The arguments of a class whose `__init__` is made from its fields."""
    if issubclass(cls, Exception) or getattr(cls, "__abstractmethods__", None):
        return ""
    try:
        parameters = inspect.signature(cls).parameters.values()
    except (TypeError, ValueError):
        return ""
    written: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not base.__module__.startswith("rigidjax"):
            continue
        node = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        for line in getattr(node, "body", ()):
            if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
                written[line.target.id] = ast.unparse(_Named(base, names).visit(line.annotation))
    parts = []
    for one in parameters:
        if one.kind in (one.VAR_POSITIONAL, one.VAR_KEYWORD):
            continue
        kind = f": {written[one.name]}" if one.name in written else ""
        simple = isinstance(one.default, bool | int | float | str | type(None))
        value = repr(one.default) if simple else "…"
        parts.append(one.name + kind + ("" if one.default is one.empty else f" = {value}"))
    return f"({', '.join(parts)})"
