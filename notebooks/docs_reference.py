"""The reference of the site: a page a public module, from signatures and docstrings.

`write(folder)` walks what `tests/surface` walks, so that nothing public is left out. What functions
give back, and has no public name, is at the end of their page, by its name in the source. Docstrings are
Markdown already; their `>>>` examples become blocks. Signatures are taken from the source: there an
argument's type has its short name (`Vec3Like`), and not what that stands for. The order is that of
`docs_topics`, then that of the source. `link_to_source` gives each name its link to the source.
"""

import ast
import inspect
import re
import sys
import textwrap
import types
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "tests")]

import docs_topics
from surface import public

_OUTER, _INNER = "::::::", ":::::"


def overview(readme: Path, contents: Path) -> str:
    """Returns `llms.txt`: what the library is, by examples, its conventions, and its pages in groups.

    A page is named with its title and with what one learns from it.
    """
    parts, text = [], readme.read_text(encoding="utf-8")
    for title, end in (("# rigidjax", "![Left: time of a run"), ("## Conventions", "\n## ")):
        part = text.partition(title)[2].partition(end)[0]
        part = re.sub(r"^!.*\n\n|\s*\(\[[^]]*\]\([^)]*\)\)", "", part, flags=re.M)
        part = re.sub(r"\[([^]]*)\]\((?:notebooks|#)[^)]*\)", r"\1", part)
        parts += [title, part.strip()]
    trees = re.findall(
        r"^```{toctree}\n:caption: (.*?)\n(.*?)^```",
        contents.read_text(encoding="utf-8"),
        re.M | re.S,
    )
    for caption, lines in trees:
        rows = []
        for path in (contents.parent / f"{name}.md" for name in lines.split()):
            if path.exists():
                title, _, learnt, *_ = path.read_text(encoding="utf-8").split("\n", 3)
                page = path.relative_to(contents.parent).with_suffix(".html").as_posix()
                learnt = learnt.removeprefix("*You learn: ").removesuffix("*")
                rows.append(f"- [{title.removeprefix('# ')}]({page}): {learnt}")
        parts += ["## " + caption.strip('"'), "\n".join(rows)]
    return "\n\n".join(parts) + "\n"


def write(folder: Path) -> list[str]:
    """Writes the pages into `folder`, and returns the documented names."""
    folder.mkdir(exist_ok=True)
    modules = sorted(public.modules(), key=lambda module: module.__name__)
    short = shortest(modules)
    found = homes(modules, short)
    given = results(modules)
    entries_of = (*found.values(), *given.values())
    names = {id(thing): full for entries in entries_of for full, thing in entries}
    pages, documented = {}, []
    for module, entries in found.items():
        parts = [f"# {short[module.__name__]}", body_of(module)]
        topics = by_topic(short[module.__name__], entries)
        topics += [("What these give back", given[module])] if module in given else []
        if module.__name__ == "rigidjax":
            rows = ((links([full]), first_line(thing)) for full, thing in _own(module, names))
            parts.append(table("name | what it is", rows))
        if len(topics) > 1:
            rows = ((title, links((full for full, _ in inner), "~")) for title, inner in topics)
            parts.append(table("topic | names", rows))
        for title, inner in topics:
            parts += [f"## {title}"] * (len(topics) > 1)
            parts += [entry(full, thing, names) for full, thing in inner]
            documented += [full for full, _ in inner]
        pages[module] = "\n\n".join(parts) + "\n"
    for module, text in pages.items():
        _put(folder / f"{module.__name__}.md", text)
    _put(folder / "index.md", index(modules, short, names))
    for path in folder.glob("*.md"):
        if path.stem not in {"index", *(module.__name__ for module in pages)}:
            path.unlink()
    return documented


def results(
    modules: list[types.ModuleType],
) -> dict[types.ModuleType, list[tuple[str, type]]]:
    """By module: (full name, class) of what its functions give back and has no public name."""
    found: dict[types.ModuleType, list[tuple[str, type]]] = {}
    for name, cls in public.received().items():
        full = f"{cls.__module__}.{cls.__name__}"
        package = f"rigidjax.{name.partition('.')[0]}"
        found.setdefault(sys.modules[package], []).append((full, cls))
    assert set(found) <= set(modules)
    return found


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
    places_of = {module: list(vars(module)) for module in modules}
    return {
        module: sorted(entries, key=lambda e: places_of[module].index(e[0].rpartition(".")[2]))
        for module, entries in found.items()
    }


def _key(module: types.ModuleType, name: str, thing: Any) -> tuple[str, Any]:
    source = getattr(thing, "__module__", None)
    if isinstance(source, str) and source.startswith("rigidjax"):
        return source, id(thing)
    return module.__name__, name


def by_topic(name: str, entries: list[tuple[str, Any]]) -> list[tuple[str, list]]:
    """The entries of a module under its topics, and those of none under More."""
    left = {full.rpartition(".")[2]: (full, thing) for full, thing in entries}
    found = [
        (title, [left.pop(word) for word in words.split()])
        for title, words in docs_topics.TOPICS.get(name, {}).items()
    ]
    return [*found, ("More", list(left.values()))] if left else found


def _own(module: types.ModuleType, names: dict[int, str]) -> list[tuple[str, Any]]:
    """What a package shows that is no module: what is asked for first, then the rest."""
    first = " ".join(docs_topics.FIRST.values()).split()
    things = [getattr(module, name) for name in dir(module)]
    found = [(names[id(thing)], thing) for thing in things if id(thing) in names]
    return sorted(found, key=lambda one: (*first, one[0]).index(one[0]))


def links(names: Iterable[str], short: str = "") -> str:
    """Links by the full names, or by the last part of each (`~`)."""
    return ", ".join(f"{{py:obj}}`{short}{name}`" for name in names)


def table(head: str, rows: Iterable[tuple[str, str]]) -> str:
    lines = [f"| {one} | {other} |" for one, other in rows]
    return "\n".join([f"| {head} |", "| --- | --- |", *lines])


def index(modules: list[types.ModuleType], short: dict[str, str], names: dict[int, str]) -> str:
    """What is asked for first, then the modules in their groups, each with its first line."""
    found = {short[module.__name__]: module for module in modules}
    first = {title: words.split() for title, words in docs_topics.FIRST.items()}
    strange = {full for row in first.values() for full in row} - set(names.values())
    assert not strange, f"docs_topics.FIRST names {strange}"
    parts = [
        "# Reference",
        "Every public name, by topic; `rj` is `import rigidjax as rj`, `jnp` is `jax.numpy`. "
        "Docstrings state the shapes, units and frames of arguments; functions and classes have a "
        "link to their source.",
        table("wanted | names", ((title, links(row)) for title, row in first.items())),
    ]
    for title, inside in docs_topics.GROUPS.items():
        rows = [(f"[{n}]({found[n].__name__}.md)", first_line(found[n])) for n in inside]
        parts += [f"## {title}", table("module | what it holds", rows)]
    listed = [found.pop(name).__name__ for inside in docs_topics.GROUPS.values() for name in inside]
    assert not found, f"docs_topics.GROUPS leaves out {list(found)}"
    return "\n\n".join([*parts, "```{toctree}\n:hidden:\n\n" + "\n".join(listed) + "\n```\n"])


def link_to_source(app: Any, doctree: Any) -> None:
    """Tells `sphinx.ext.viewcode` where a name is: in the module that its full name begins with."""
    modules = public.modules()
    short = shortest(modules)
    sys.modules.update({short[module.__name__]: module for module in modules})
    received = {cls.__module__ for cls in public.received().values()}
    homes_of = sorted({*short.values(), *received}, key=len, reverse=True)
    for node in doctree.findall(lambda node: "fullname" in getattr(node, "attributes", ())):
        full = node["fullname"]
        home = next((name for name in homes_of if full.startswith(name + ".")), None)
        if home and not node.get("module"):
            node["module"], node["fullname"] = home, full.removeprefix(home + ".")


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
        text = body_of(thing) + gives(thing, names)
        return directive("function", full + arguments(thing, names), text)
    value = repr(thing)
    shown = f"`{value}`" if len(value) < 200 and " at 0x" not in value and "\n" not in value else ""
    return directive("data", full, shown)


def gives(thing: Any, names: dict[int, str]) -> str:
    """A line with links to the classes without a public name that a function gives back."""
    ids = {id(cls) for cls in public.received().values()}
    found = dict.fromkeys(cls for cls in public.given(thing) if id(cls) in ids)
    return f"\n\nGives back {links((names[id(cls)] for cls in found), '~')}." if found else ""


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
            text = body_of(plain) + gives(plain.fget, names)
            yield directive("property", name, text, _INNER)
        elif inspect.isfunction(plain):
            yield directive(
                "method",
                name + arguments(plain, names, bound=True),
                body_of(plain) + gives(plain, names),
                _INNER,
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
