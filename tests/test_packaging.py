"""The versions that files beside pyproject.toml repeat are the same."""

import re
import tomllib
from pathlib import Path

import rigidjax

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
RECIPE = (ROOT / ".github" / "conda" / "recipe.yaml").read_text(encoding="utf-8")


def listed(head):
    """The items of a list of the recipe."""
    lines = RECIPE.partition(f"\n  {head}:\n")[2].splitlines()
    wanted = [re.fullmatch(r"    - (.+)", line) for line in lines]
    return [found[1] for found in wanted[: wanted.index(None)]]


def test_the_conda_recipe_pins_what_pyproject_pins():
    wanted = {re.sub(r"^([\w-]+)", r"\1 ", one) for one in PROJECT["dependencies"]}
    python = f"python {PROJECT['requires-python']}"
    assert listed("run")[0] == listed("host")[0] == python
    assert set(listed("run")) == wanted | {python} and len(listed("run")) == len(wanted) + 1
    command, place = next(iter(PROJECT["scripts"].items()))
    assert f"- {command} = {place}\n" in RECIPE


def test_the_version_is_one():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert rigidjax.__version__ == PROJECT["version"]
    assert re.search(r"^version: (.+)$", citation, re.M)[1] == PROJECT["version"]
    assert re.search(r"^  version: (.+)$", RECIPE, re.M)[1] == PROJECT["version"]
    assert re.search(r"^## (\S+)", changes, re.M)[1] == PROJECT["version"]


def test_the_package_is_installed_from_a_clone():
    """It is on no index: no message or page asks one for it."""
    places = [
        *ROOT.glob("rigidjax/**/*.py"),
        *ROOT.glob("notebooks/**/*.ipynb"),
        *ROOT.glob("notebooks/**/*.md"),
    ]
    for path in [ROOT / "README.md", *places]:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"pip install (-\w+ )*['\"]?rigidjax\[", text), path
        for extra in re.findall(r"pip install ['\"]?\.\[([\w,]+)\]", text):
            assert set(extra.split(",")) <= set(PROJECT["optional-dependencies"]), path


def test_python_of_the_classifiers_is_allowed():
    named = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    assert f">={named[0]}" == PROJECT["requires-python"]
