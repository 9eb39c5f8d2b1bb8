"""Every notebook runs, in its short form, without an error or a warning; what is committed is light."""

import ast
import json
import os
from pathlib import Path
from types import ModuleType

import pytest

import rigidjax as rj

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def outputs(notebook):
    return [out for cell in notebook["cells"] for out in cell.get("outputs", [])]


def complaints(notebook):
    """What a reader would not want to see: tracebacks, and whatever went to standard error."""
    return [
        "\n".join(out.get("traceback", [])) or "".join(out["text"])
        for out in outputs(notebook)
        if out["output_type"] == "error" or out.get("name") == "stderr"
    ]


def pictures(notebook):
    """How many pictures each cell shows."""
    cells = notebook["cells"]
    return [sum("image/png" in o.get("data", {}) for o in c.get("outputs", [])) for c in cells]


def test_each_has_a_number_of_its_own():
    numbers = [path.name[:2] for path in NOTEBOOKS]
    assert len(set(numbers)) == len(numbers) >= 12
    assert set(numbers) <= {f"{k:02d}" for k in range(1, 20)}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_committed_with_outputs_and_light(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert path.stat().st_size < 1_500_000
    assert complaints(notebook) == []
    assert any("image/png" in out.get("data", {}) for out in outputs(notebook))
    counts = [c["execution_count"] for c in notebook["cells"] if c["cell_type"] == "code"]
    assert counts == list(range(1, len(counts) + 1))
    # Nothing of the machine that it ran on.
    text = path.read_text(encoding="utf-8")
    assert "/tmp/" not in text
    assert "site-packages" not in text


def chains(source):
    """The dotted names of a program that begin at a name, such as `rj.body.principal`."""
    for node in ast.walk(ast.parse(source)):
        names = []
        while isinstance(node, ast.Attribute):
            names.append(node.attr)
            node = node.value
        if isinstance(node, ast.Name) and names:
            yield node.id, names[::-1]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_names_of_the_library_exist(path):
    known = {"rj": rj} | {part: getattr(rj, part) for part in ("identify", "torques")}
    notebook = json.loads(path.read_text(encoding="utf-8"))
    count = 0
    for cell in notebook["cells"]:
        if cell["cell_type"] != "code":
            continue
        for first, names in chains("".join(cell["source"])):
            here = known.get(first)
            for name in names:
                if not isinstance(here, ModuleType):
                    break
                # An old name warns, and warnings are errors here.
                here = getattr(here, name)
                count += 1
    assert count > 5 or path.stem == "13_polar_motion"  # its code is in `polar_motion.py`


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_no_cell_is_skipped_for_want_of_data(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    code = "".join("".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code")
    assert "skipped" not in code


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_runs_in_its_short_form(path, monkeypatch):
    nbclient = pytest.importorskip("nbclient", reason="the extra `notebooks` runs notebooks")
    pytest.importorskip("ipykernel", reason="the extra `notebooks` runs notebooks")
    pytest.importorskip("viser", reason="the extra `view` has the player of notebook 2")
    import nbformat

    monkeypatch.setenv("RIGIDJAX_SHORT", "1")
    # As a reader starts it, without the options of XLA that the tests set.
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    # A warning of ours would go to standard error, where `complaints` sees it.
    monkeypatch.setenv("PYTHONWARNINGS", "default")
    roots = [str(FOLDER.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(roots))
    notebook = nbformat.read(path, as_version=4)
    # `python3` is the kernel of the interpreter that runs the tests.
    client = nbclient.NotebookClient(
        notebook,
        timeout=600,
        kernel_name="python3",
        resources={"metadata": {"path": str(FOLDER)}},
    )
    client.execute()
    assert complaints(notebook) == []
    # A clone, without data beside it, shows every picture of what is committed.
    assert pictures(notebook) == pictures(json.loads(path.read_text(encoding="utf-8")))
