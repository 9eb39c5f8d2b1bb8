"""Every example in a docstring runs, and every public function has one."""

import doctest
import importlib
import inspect
import pkgutil

import pytest

import rigidjax

MODULES = [
    rigidjax.__name__,
    *sorted(
        info.name
        for info in pkgutil.walk_packages(rigidjax.__path__, "rigidjax.")
        if not info.name.endswith("__main__")
    ),
]


@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name):
    module = importlib.import_module(name)
    names = {"rj": rigidjax, "jnp": importlib.import_module("jax.numpy")}
    finder = doctest.DocTestFinder(exclude_empty=True)
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    for example in finder.find(module, module.__name__, extraglobs=names):
        said: list[str] = []
        runner.run(example, out=said.append)
        assert runner.failures == 0, "".join(said)


@pytest.mark.parametrize("name", ["rigidjax", "rigidjax.motion", "rigidjax.body", "rigidjax.solve"])
def test_public_names_have_docstrings(name):
    package = importlib.import_module(name)
    for key, thing in vars(package).items():
        if not key.startswith("_") and callable(thing):
            assert inspect.getdoc(thing), f"{name}.{key} has no docstring"
