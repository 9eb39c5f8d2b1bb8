"""The site: python -m sphinx -W -b html notebooks build/site (extra `docs`). Nothing is downloaded."""

import re
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import docs_reference
from docutils import nodes
from docutils.utils.math import latex2mathml

import rigidjax

project, author, version = "rigidjax", "the authors of rigidjax", rigidjax.__version__
extensions = ["myst_nb", "sphinx.ext.viewcode", "sphinx_copybutton"]
copybutton_prompt_text = ">>> "
copybutton_only_copy_prompt_lines = True
exclude_patterns = ["images/*.py"]
nb_execution_mode = "off"  # notebooks are shown as they were run and committed
myst_enable_extensions = ["colon_fence", "dollarmath", "amsmath"]
myst_heading_anchors = 3
maximum_signature_line_length = 80
add_module_names = False
toc_object_entries_show_parents = "hide"
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = f"rigidjax {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_show_copyright = False
html_copy_source = False
html_math_renderer = "mathml"


def _mathml(node, as_block):
    r"""MathML of a formula. `\tfrac12` is written out first: docutils reads it as twelve."""
    formula = re.sub(r"\\([td]?frac)\s*(\d)(\d)", r"\\\1{\2}{\3}", node.astext())
    return latex2mathml.tex2mathml(formula, as_block=as_block)


def _inline(self, node):
    self.body.append(_mathml(node, False))
    raise nodes.SkipNode


def _block(self, node):
    self.body.append(f'<div class="math">{_mathml(node, True)}</div>')
    raise nodes.SkipNode


def _overview(app, exception):
    """Write `llms.txt` beside the pages."""
    if exception is None:
        text = docs_reference.overview(HERE.parent / "README.md", HERE / "index.md")
        (Path(app.outdir) / "llms.txt").write_text(text, encoding="utf-8")


def setup(app):
    """Formulas become MathML, which browsers draw themselves; the reference is written first."""
    app.add_html_math_renderer(
        "mathml", inline_renderers=(_inline, None), block_renderers=(_block, None)
    )
    app.connect("builder-inited", lambda _: docs_reference.write(HERE / "reference"))
    app.connect("build-finished", _overview)
    app.connect("doctree-read", docs_reference.link_to_source, priority=100)  # before viewcode
