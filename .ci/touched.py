"""A pytest plugin: the run fails unless every rule of differentiation of rigidjax was taken.

The rules are those given to `defjvp`, `defvjp`, `def_jvp` and `def_vmap`, and to JAX's tables for
primitives. They are read from the source, and watched while the tests run: JAX takes a rule when it
traces, hence once at least.
"""

import ast
import functools
import inspect
from pathlib import Path

import equinox as eqx
import jax
import pytest
from jax.interpreters import ad

GIVEN = {"defjvp", "defvjp", "def_jvp", "def_vmap"}
TABLES = {
    "primitive_jvps": ad.primitive_jvps,
    "primitive_transposes": ad.primitive_transposes,
}
PACKAGE = Path(__file__).resolve().parents[1] / "rigidjax"
taken: set[str] = set()


def _name_of(rule):
    while isinstance(rule, functools.partial):
        rule = rule.func
    code = inspect.unwrap(rule).__code__
    return f"{code.co_filename}: {code.co_name}"


def _watched(rule):
    @functools.wraps(rule)
    def noting(*args, **kwargs):
        taken.add(_name_of(rule))
        return rule(*args, **kwargs)

    return noting


def _watch(kind, method):
    plain = getattr(kind, method)

    @functools.wraps(plain)
    def given(self, *rules, **options):
        plain(self, *(_watched(rule) for rule in rules), **options)
        return rules[0]

    setattr(kind, method, given)


def _written():
    """Where each rule stands, by reading the source."""
    for path in sorted(PACKAGE.rglob("*.py")):
        nodes = list(ast.walk(ast.parse(path.read_text())))
        functions = {node.name: node for node in nodes if isinstance(node, ast.FunctionDef)}
        names = [n for n, f in functions.items() if any(map(_gives, f.decorator_list))]
        for node in nodes:
            if isinstance(node, ast.Call) and _gives(node.func):
                inside = [n for arg in node.args for n in ast.walk(arg)]
                names += [n.id for n in inside if isinstance(n, ast.Name) and n.id in functions]
            if isinstance(node, ast.Assign) and _is_entry(node.targets[0]):
                names.append(node.value.id)
        yield from (f"{path}: {name}" for name in names)


def _gives(tree):
    return any(isinstance(n, ast.Attribute) and n.attr in GIVEN for n in ast.walk(tree))


def _is_entry(tree):
    return isinstance(tree, ast.Subscript) and getattr(tree.value, "attr", None) in TABLES


# Now, not in a hook: conftest.py imports rigidjax before `pytest_configure`.
_watch(jax.custom_jvp, "defjvp")
_watch(jax.custom_vjp, "defvjp")
_watch(jax.custom_batching.custom_vmap, "def_vmap")
_watch(eqx.filter_custom_jvp, "def_jvp")


def pytest_configure(config):
    ours = [p for p in ad.primitive_jvps if p.name.startswith("rigidjax")]
    for table in TABLES.values():
        for primitive in ours:
            table[primitive] = _watched(table[primitive])


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node, error):
    taken.update(getattr(node, "workeroutput", {}).get("taken", ()))


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session):
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["taken"] = sorted(taken)
        return
    written = set(_written())
    missed = sorted(written - taken)
    print(f"\n{len(written) - len(missed)} of {len(written)} rules of differentiation were taken")
    for rule in missed:
        print(f"not taken: {rule}")
    if missed and session.exitstatus == 0:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
