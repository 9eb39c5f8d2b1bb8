"""Docstrings are sentences: a verb first, a full stop last."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "rigidjax"
FILES = [*PACKAGE.rglob("*.py")]
VERBS = frozenset(
    """
    Add Apply Attract Bind Broadcast Call Check Choose Compare Compute Connect Control Convert Copy Define Delay Derive Describe
    Draw Estimate Evaluate Fill Find Fit Follow Give Handle Hang Hold Identify Import Integrate Interpolate Join Locate Make Map
    Measure Minimise Name Normalise Predict Prepare Present Print Provide Raise Read Refuse Return Reverse Run Scale Select Set
    Share Show Simulate Solve Sort Split Store Sum Take Trace Turn Warn Wrap Write Yield
    """.split()
)


def docstrings(path):
    """The name, first word and first paragraph of each docstring of a file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text is not None:
                yield (
                    getattr(node, "name", "module"),
                    text.split()[0].rstrip(",:"),
                    text.split("\n\n")[0],
                )


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_docstring_is_a_sentence_that_begins_with_a_verb(path):
    assert [name for name, word, _ in docstrings(path) if word not in VERBS] == []
    # Before a list or a formula there may be a colon.
    assert [name for name, _, first in docstrings(path) if first.rstrip()[-1] not in ".:"] == []


def test_all_files_are_read():
    count = sum(len(list(docstrings(path))) for path in FILES)
    assert len(FILES) > 200 and count > 2000
