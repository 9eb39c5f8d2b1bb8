"""The scripts that measure: what they call by name is there, though no test runs them."""

import ast
import csv
import importlib
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import rigidjax as rj

TESTS = Path(__file__).parent
NAMES = ("bench_*.py", "inertia.py", "table.py", "peers.py", "speed.py", "accuracy.py")
FOUND = sorted(path for name in NAMES for path in TESTS.glob(f"**/{name}"))
SCRIPTS = [path for path in FOUND if "rigidjax" in path.read_text(encoding="utf-8")]


def modules(tree):
    """The names in a script that stand for modules of the library, and what it imports of them."""
    known = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for each in node.names:
                if each.name.startswith("rigidjax"):
                    importlib.import_module(each.name)
                    known[each.asname or "rigidjax"] = (
                        importlib.import_module(each.name) if each.asname else rj
                    )
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rigidjax"):
            for each in node.names:
                try:
                    thing = importlib.import_module(f"{node.module}.{each.name}")
                except ModuleNotFoundError:
                    thing = getattr(importlib.import_module(str(node.module)), each.name)
                known[each.asname or each.name] = thing
    return known


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_names_of_the_library_exist(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    known, count = modules(tree), 0
    for node in ast.walk(tree):
        names = []
        while isinstance(node, ast.Attribute):
            names.append(node.attr)
            node = node.value
        here = known.get(node.id) if isinstance(node, ast.Name) else None
        for name in reversed(names):
            if not isinstance(here, ModuleType):
                break
            # An old name warns, and warnings are errors here.
            here = getattr(here, name)
            count += 1
    assert count or known


def test_answers_of_others_are_scored_against_the_truth(tmp_path):
    bench = TESTS / "benchmarks" / "inertia.py"
    run = lambda *words: subprocess.run(
        [sys.executable, bench, "polar", "bicycles", "--data", tmp_path, *words],
        capture_output=True, text=True, check=True, cwd=TESTS.parent,
    ).stdout  # fmt: skip
    run("--records", tmp_path)
    with (tmp_path / "answers.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 49
    period = next(row for row in rows if row["quantity"] == "period")
    # An error of 2 %, an interval that holds; of all others no answer.
    period |= {"value": 433 * 1.02, "low": 430, "high": 450, "method": "mine"}
    with (tmp_path / "answers.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    said = run("--score", tmp_path / "answers.csv").splitlines()
    assert said[-1] == "| polar | mine | 1 | 0.02 | 0.02 | 1 of 1 | – | – |" and len(said) == 3
