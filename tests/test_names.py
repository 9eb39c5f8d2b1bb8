"""What a user sees with Tab: each public module shows its own names, and nothing that it works with."""

import ast
import importlib
import inspect
import pydoc
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import rigidjax as rj

ROOT = Path(__file__).parents[1]


def public_modules():
    found, left = {}, [("rj", rj)]
    while left:
        name, module = left.pop()
        if module.__name__ not in found:
            found[module.__name__] = module
            things = ((f"{name}.{part}", getattr(module, part)) for part in dir(module))
            left += [(path, thing) for path, thing in things if isinstance(thing, ModuleType)]
    return found


MODULES = public_modules()


def test_the_modules_are_reached():
    reached = {"body", "body.shapes", "rotation.quaternion", "identify.report", "motion.torques"}
    assert {f"rigidjax.{name}" for name in reached} | {"rigidjax.plot"} <= set(MODULES)


@pytest.mark.parametrize("name", MODULES)
def test_a_module_shows_its_own_names_only(name):
    module = MODULES[name]
    shown = dir(module)
    assert shown and not any(part.startswith("_") for part in shown)
    strange = {
        part
        for part in shown
        if not getattr(getattr(module, part), "__module__", "rigidjax").startswith("rigidjax")
        and type(getattr(module, part)).__module__ not in ("typing", "types", "builtins")
    }
    assert not strange
    assert not {"jax", "jnp", "np", "eqx", "dfx", "Array", "Any", "own_names"} & set(shown)


def defined(module):
    """What a module defines without an underscore, or imports as itself (`X as X`)."""
    for node in ast.walk(ast.parse(Path(module.__file__).read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            yield from (part.name for part in node.names if part.asname == part.name)
    for node in ast.parse(Path(module.__file__).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            yield node.targets[0].id


@pytest.mark.parametrize("name", MODULES)
def test_all_lists_what_a_module_defines(name):
    module = MODULES[name]
    names = {one for one in defined(module) if not one.startswith("_")}
    assert set(module.__all__) == names and len(module.__all__) == len(names)
    assert all(hasattr(module, one) for one in module.__all__)


@pytest.mark.parametrize("module", [rj, rj.identify, rj.so3])
def test_help_lists_the_functions(module):
    page = pydoc.plain(pydoc.render_doc(module))
    named = [one for one in dir(module) if inspect.isfunction(getattr(module, one))]
    assert len(named) > 9 and all(f"\n    {one}(" in page for one in named)


def test_nothing_public_is_lost():
    assert {"body", "quaternion", "plot", "workprecision", "simulate", "Inertia"} <= set(dir(rj))
    assert {"exp", "log", "normalise", "check"} <= set(dir(rj.quaternion))
    assert {"box", "mesh_file"} <= set(dir(rj.shapes)) and "hat" in dir(rj.so3)
    assert "sources" not in dir(rj)
    with pytest.raises(AttributeError, match="module 'rigidjax' has no attribute 'sources'"):
        rj.sources  # noqa: B018


@pytest.mark.parametrize(
    ("module", "name", "meant"),
    [
        (rj, "HeavyTop", "rj.torques.HeavyTop"),
        (rj, "fit", "rj.identify.fit"),
        (rj, "Simulate", "rj.simulate"),
        (rj.identify, "HeavyTop", "rj.torques.HeavyTop"),
        (rj.torques, "heavytop", "rj.torques.HeavyTop"),
        (rj.torques, "Dampning", "rj.torques.Damping"),
        (rj.body, "Sphere", "rj.shapes.sphere"),
        (rj.plot, "polhodes", "rj.plot.polhode or rj.plot.herpolhode"),
        (rj.frames, "CR3BP", "rj.orbits.cr3bp"),
    ],
)
def test_a_wrong_name_is_answered_with_what_is_meant(module, name, meant):
    with pytest.raises(AttributeError) as caught:
        getattr(module, name)
    assert str(caught.value).endswith(f"did you mean {meant}?")


def test_what_is_like_nothing_gets_no_answer_and_hidden_names_no_search():
    for name in ("banana", "__wrapped__", "_simulate"):
        with pytest.raises(AttributeError) as caught:
            getattr(rj, name)
        assert "did you mean" not in str(caught.value)
    # A module that is not loaded yet: the import system asks the package first.
    assert importlib.import_module("rigidjax.cli.spec")


def test_readme_and_guide_use_what_is_shown():
    pages = [ROOT / "README.md", *(ROOT / "notebooks").glob("*.md")]
    pages += (ROOT / "notebooks" / "guide").glob("*.md")
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    used = set(re.findall(r"\brj\.([a-zA-Z_]\w*)", text))
    assert "body" in used and not used - set(dir(rj)) - {"__version__"}


LATER = """
import sys, rigidjax
heavy = "scipy.signal", "scipy.stats", "scipy.interpolate", "scipy.special", "scipy.optimize", "optax.contrib",
heavy += "matplotlib", "rigidjax.plot", "rigidjax.workprecision", "rigidjax.elliptic", "rigidjax.orbits", "rigidjax.lagrangian", "rigidjax.tumblers", "rigidjax.suspensions"
print([name for name in heavy if name in sys.modules])
rigidjax.plot.fit, rigidjax.workprecision.measure
"""


def test_what_few_programs_need_is_loaded_when_it_is_asked_for():
    out = subprocess.run([sys.executable, "-c", LATER], capture_output=True, text=True, cwd=ROOT)
    assert out.stdout.strip() == "[]", out.stdout + out.stderr
    assert out.returncode == 0, out.stderr


@pytest.mark.parametrize("name", ["long.txt", "slow.txt"])
def test_the_tests_that_a_default_run_is_spared_are_there(name):
    lines = (ROOT / "tests" / name).read_text(encoding="utf-8").splitlines()
    assert lines == sorted(set(lines))
    for line in lines:
        path, _, name = line.partition("::")
        source = (ROOT / path).read_text(encoding="utf-8")
        assert f"def {name.partition('[')[0]}(" in source, line


@pytest.mark.parametrize(
    ("call", "meant"),
    [
        (lambda: rj.simulate(None, None, [0.0, 1.0], atoll=1e-3), "simulate: .* atoll; .* atol?"),
        (lambda: rj.simulate(None, None, t0=0.0, t1=1.0), "simulate: .* did you mean ts?"),
        (lambda: rj.identify.fit(None, start=3), "fit: .* did you mean starts?"),
        (lambda: rj.batch.simulate(None, None, chunks=2), "did you mean chunk?"),
        (lambda: rj.batch.rollout(None, adjoin=2), "rollout: there is no argument adjoin"),
        (lambda: rj.crossings(None, qqq=2), "qqq; it has body, state0, t0"),
    ],
)
def test_a_wrong_argument_is_answered_with_what_is_meant(call, meant):
    with pytest.raises(TypeError, match=meant):
        call()
