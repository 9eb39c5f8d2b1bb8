"""README tells the truth: its first example runs, the names it mentions exist."""

import re
from pathlib import Path

import rigidjax as rj

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def test_the_first_example_runs(capsys):
    block = re.search(r"## First example\n\n```python\n(.*?)```", README, re.S)
    assert block is not None
    exec(compile(block.group(1), "README.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    # The middle axis flips within the half minute, and the slope is a number.
    assert any("-" in line for line in lines)
    assert abs(float(lines[-1])) > 1e-3


def test_every_name_that_it_mentions_exists():
    missing = []
    for path in sorted(set(re.findall(r"`rj\.([a-zA-Z_][\w.]*)", README))):
        thing = rj
        for part in path.rstrip(".").split("."):
            thing = getattr(thing, part, None)
            if thing is None:
                missing.append(path)
                break
    assert not missing


def test_every_test_that_it_mentions_exists():
    tests = Path(__file__).parent
    text = "\n".join(path.read_text(encoding="utf-8") for path in tests.rglob("test_*.py"))
    for name in re.findall(r"`(?:[\w/]+\.py::)?(test_\w+)…?`", README):
        assert f"def {name}" in text, name
    for path in re.findall(r"`(tests/[\w/]+\.\w+)`", README):
        assert (tests.parent / path).exists(), path
