"""How large the library is: lines, names, and how many functions a first call goes through.

`python tests/benchmarks/bench_house.py` prints one line a figure. Lines of code have no docstring, comment or
blank; the longest function is counted in such lines. Functions entered are named ones of ours,
each counted once, in a call that nothing was compiled for (`sys.setprofile`).
"""

import ast
import io
import re
import sys
import tokenize
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp

import rigidjax as rj

ROOT = Path(rj.__file__).parent
SPARE = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)


def code_lines(text: str) -> set[int]:
    """The numbers of the lines that have code."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    lines = set()
    for token in tokens:
        if token.type not in (*SPARE, tokenize.ENDMARKER):
            lines |= set(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node
        ):
            word = node.body[0]
            lines -= set(range(word.lineno, (word.end_lineno or word.lineno) + 1))
    return lines


def furniture() -> None:
    """Print how many statements, private functions and docstring lines of what is not exported."""
    trees = {file: ast.parse(file.read_text()) for file in ROOT.rglob("*.py")}
    imports = [n for t in trees.values() for n in ast.walk(t) if isinstance(n, ast.ImportFrom)]
    exported = {a.name for n in imports for a in n.names if a.asname == a.name}
    holders = ast.Module | ast.ClassDef | ast.FunctionDef
    nodes = [node for tree in trees.values() for node in ast.walk(tree)]
    docs = sum(bool(ast.get_docstring(n)) for n in nodes if isinstance(n, holders))
    print(f"statements {sum(isinstance(n, ast.stmt) for n in nodes) - docs}")
    private = once = plain = hidden = things = 0
    for file, tree in trees.items():
        used = [n.id for n in ast.walk(tree) if isinstance(n, ast.Name)]
        calls = [n.func for n in ast.walk(tree) if isinstance(n, ast.Call)]
        called = {n.id for n in calls if isinstance(n, ast.Name)}
        for node in tree.body:
            if isinstance(node, ast.FunctionDef) and node.name.startswith("_"):
                private += 1
                short = sum(isinstance(n, ast.stmt) for n in ast.walk(node)) <= 15
                single = short and used.count(node.name) <= 1
                once += single
                # A rule of differentiation, a program of its own and a function that is passed on
                # as a value have to be functions; what one place calls does not.
                plain += single and not node.decorator_list and node.name in called
            if not isinstance(node, ast.FunctionDef | ast.ClassDef):
                continue
            for inner in ast.walk(node):
                own = isinstance(inner, ast.FunctionDef | ast.ClassDef)
                if own and ast.get_docstring(inner):
                    if node.name not in exported or inner.name.startswith("_"):
                        word = inner.body[0]
                        hidden += (word.end_lineno or 0) - word.lineno + 1
        things += len(re.findall(r"\b(?:two|three|four|five|six) things\b", file.read_text()))
    names = [n.name.strip("_") for n in nodes if isinstance(n, ast.FunctionDef)]
    names = [n for n in names if n]
    long = sum(len(n) >= 30 for n in names)
    print(f"private functions of modules {private}, of these short and named once {once},", end=" ")
    print(f"neither decorated nor passed on as a value {plain}")
    print(
        f"letters of a function's name {sum(map(len, names)) / len(names):.1f}; 30 and more: {long}"
    )
    print(f"docstring lines of what is not exported {hidden}; 'two things': {things}")


def entered(call: object, part: str = "") -> tuple[int, int]:
    """Return how many functions of a part of the library are entered, of how many modules."""
    root = str(ROOT / part)
    seen: set[tuple[str, str]] = set()

    def watch(frame, event, _):
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(root) and code.co_name[0] != "<":
            seen.add((code.co_filename, code.co_qualname))

    sys.setprofile(watch)
    try:
        jax.block_until_ready(call())  # pyright: ignore[reportCallIssue]
    finally:
        sys.setprofile(None)
    return len(seen), len({file for file, _ in seen})


def rooms() -> dict[str, set[str]]:
    """Return which rooms of `identify` each room imports."""
    home, found = ROOT / "identify", {}
    for file in sorted(home.glob("*/*.py")):
        room = file.parent.name
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
                "rigidjax.identify."
            ):
                other = str(node.module).split(".")[2]
                if other != room and (home / other).is_dir():
                    found.setdefault(room, set()).add(other)
    return found


def of_identification() -> None:
    """Print the rooms of identification, and what a cold fit, a filter and a fit of windows enter."""
    arrows = rooms()
    parts = ("identify", "cli")
    lines = {
        p: sum(len(f.read_text().splitlines()) for f in (ROOT / p).rglob("*.py")) for p in parts
    }
    print("identify:", f"{sum(map(len, arrows.values()))} arrows between rooms,", lines, "lines")
    text = "".join(f.read_text() for f in (ROOT / "identify").rglob("*.py"))
    for word in ("jitter", "Bodies", "flat_limit"):
        files = [f for f in (ROOT / "identify").rglob("*.py") if word in f.read_text()]
        print(f"modules with {word}: {len(files)}", end="; ")
    print("jax.jacfwd or jvp in identify:", text.count("jax.jacfwd(") + text.count("jax.jvp("))
    t = jnp.linspace(0.0, 5.0, 40)
    body = rj.Inertia.from_principal(1.0, 1.6, 2.2)
    rates = rj.simulate(body, rj.Spin([1.0, 0.5, 1.2]), t).ys.omega
    record = rj.identify.Recording(t, (rj.identify.Gyro(0.01), rates))
    jax.clear_caches()
    model = rj.identify.Model(record, rj.identify.PrincipalRatios())
    call = lambda: rj.identify.fit(model, starts=1).x
    print("functions and modules of a cold fit", *entered(call, "identify"))
    noise = rj.torques.RandomTorque(1e-4)
    followed = rj.identify.Model(record, rj.identify.Known(body), process=noise)
    first = rj.identify.first_belief(followed, rate=0.1)
    jax.clear_caches()
    call = lambda: rj.identify.filter(followed, first).log_likelihood
    print("functions and modules of a cold filter", *entered(call, "identify"))
    drag = rj.torques.Damping([0.1, 0.1, 0.1])
    cut = rj.identify.windows(t, rj.Spin(rates), length=8, stride=4)
    free = [rj.identify.Free(lambda s: s.torque.coefficient, "drag")]
    jax.clear_caches()
    model = rj.identify.Model(cut, rj.identify.Known(body), torque=drag, free=free)
    call = lambda: rj.identify.fit(model).x
    print("functions and modules of a cold fit of windows", *entered(call, "identify"))


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    files = sorted(ROOT.rglob("*.py"))
    texts = {file: file.read_text() for file in files}
    code = {file: code_lines(text) for file, text in texts.items()}
    print(f"modules {len(files)}, lines {sum(len(t.splitlines()) for t in texts.values())}")
    print(f"lines of code {sum(len(lines) for lines in code.values())}")
    floors = [f for f in files if f.relative_to(ROOT).parts[0] in ("solve", "exact", "batch")]
    print(f"solve + exact + batch {sum(len(texts[f].splitlines()) for f in floors)}")
    names = [n for n in dir(rj) if not isinstance(getattr(rj, n), ModuleType)]
    print(f"names in rj.* that are no module {len(names)}: {' '.join(names)}")
    packages = [getattr(rj, n) for n in dir(rj) if hasattr(getattr(rj, n), "__path__")]
    print(
        f"public names of rj and its {len(packages)} packages {sum(map(len, map(dir, [rj, *packages])))}"
    )
    lengths = [
        (
            len(code[file] & set(range(node.lineno, (node.end_lineno or 0) + 1))),
            node.name,
            file.name,
        )
        for file, text in texts.items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef)
    ]
    print("longest functions", *sorted(lengths, reverse=True)[:5])
    furniture()

    body = rj.Inertia.from_principal(1.6, 2.0, 3.0)
    top = rj.torques.HeavyTop(1.0, [0.1, 0.2, 0.9], [0.0, 0.0, -9.81])

    def last(omega):
        start = rj.Attitude([1.0, 0, 0, 0], omega)
        return rj.simulate(body, start, [0.0, 1.0, 2.0], top).ys.omega[-1, 0]

    omega = jnp.array([0.5, 1.0, 6.0])
    print("functions and modules of a cold forced value", *entered(lambda: last(omega)))
    jax.clear_caches()
    print("functions and modules of its gradient", *entered(lambda: jax.grad(last)(omega)))
    of_identification()


if __name__ == "__main__":
    main()
