"""The reference of the site has every public name, with its signature and its examples."""

import importlib.util
import operator
import re
import sys
from pathlib import Path

import pytest
from surface import public

import rigidjax as rj

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"


@pytest.fixture(scope="module")
def reference():
    spec = importlib.util.spec_from_file_location("docs_reference", NOTEBOOKS / "docs_reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def written(reference, tmp_path_factory):
    folder = tmp_path_factory.mktemp("reference")
    names = reference.write(folder)
    return names, {path.stem: path.read_text(encoding="utf-8") for path in folder.glob("*.md")}


def reached(way):
    """What a name stands for: under `rj`, or in a module that has no public name."""
    try:
        return operator.attrgetter(way)(rj)
    except AttributeError:
        module, _, name = way.rpartition(".")
        return getattr(sys.modules[f"rigidjax.{module}"], name)


def test_every_public_name_is_there_once(written):
    names, pages = written
    assert len(names) == len(set(names))
    ways = [name.removeprefix("rj.").removeprefix("rigidjax.") for name in names]
    shown = {id(found) for way in ways if (found := reached(way))}
    assert not [name for name, thing in public.functions().items() if id(thing) not in shown]
    assert set(pages) == {"index", *(module.__name__ for module in public.modules())}
    text = "\n".join(pages.values())
    for name in names:
        assert re.search(rf"^:::+\{{py:\w+\}} {re.escape(name)}(\(|$)", text, re.M), name


def test_a_signature_is_the_sources(written):
    _, pages = written
    assert "{py:function} rj.so3.exp(v: Vec3Like) -> Mat3\n" in pages["rigidjax.rotation.so3"]
    nuts = "rj.identify.Nuts(samples: int = 1000, warmup: int = 500, acceptance: float = 0.8)\n"
    assert "{py:class} " + nuts in pages["rigidjax.identify"]
    # A name that is documented is a link, by its full name.
    assert "inertia: rj.Inertia" in pages["rigidjax.exact"]


def test_examples_are_blocks(reference):
    def thing():
        """One line.

        Say it so.

        >>> 1 + 1
        2

        And so.
        """

    text = "One line.\n\nSay it so.\n\n\n```pycon\n>>> 1 + 1\n2\n```\n\nAnd so."
    assert reference.body_of(thing) == text


def test_a_page_that_is_gone_is_removed(reference, tmp_path):
    (tmp_path / "rigidjax.gone.md").write_text("# gone")
    reference.write(tmp_path)
    assert not (tmp_path / "rigidjax.gone.md").exists()


def test_the_overview_has_every_page_with_what_one_learns(reference):
    text = reference.overview(NOTEBOOKS.parent / "README.md", NOTEBOOKS / "index.md")
    assert text.startswith("# rigidjax\n\nDifferentiable") and "scalar first" in text
    for path in [*NOTEBOOKS.glob("guide/*.md"), *NOTEBOOKS.glob("*.md")]:
        page = path.relative_to(NOTEBOOKS).with_suffix(".html").as_posix()
        assert text.count(f"]({page}): ") == (page != "index.html"), page
    assert "jnp.where(t < te" in text and "identify.fit(" in text
    # Links of README do not lead from here to anywhere.
    assert not re.search(r"\]\((?!\S+\.html\))", text)
