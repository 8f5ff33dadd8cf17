"""Pages as HTML: parts of a report, and the whole page in a notebook."""

from __future__ import annotations

import re
from functools import cache
from typing import TYPE_CHECKING

from mjfim.output.page import Emphasis, as_sentence, capitalised
from mjfim.output.pages import page_of
from mjfim.records.base import ShownRecord

if TYPE_CHECKING:
    from jinja2 import Template
    from markupsafe import Markup

# Folder of the templates, beside this module.
PACKAGE, TEMPLATES = "mjfim.output", "templates"

# Names of commands, keys and files in sentences.
CODE = re.compile(r"`([^`\n]+)`")

# Space between a number and its sign of percent or of a standard deviation.
UNIT_SPACE = re.compile(r"(?<=\d) (?=[%σ])|(?<=±) (?=\d)")

# Style of every emphasis in a notebook, which keeps no style sheets.
STYLES = {
    Emphasis.NORMAL: "",
    Emphasis.STRONG: "font-weight: bold",
    Emphasis.WEAK: "opacity: 0.7",
    Emphasis.WARNING: "border-left: 0.25em solid #cc8800; padding-left: 0.5em",
    Emphasis.DERIVED: "font-style: italic",
}


def as_html(record: ShownRecord) -> str:
    """Write the page of a record for a notebook: verdict and warnings first, then its parts."""
    html: str = template("notebook.html.j2").render(page=page_of(record), styles=STYLES)
    return html


@cache
def template(file: str) -> Template:
    """Return a template of this package; to compile one takes longer than to fill it."""
    # Slow to import, and only reports and notebooks need it.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader(PACKAGE, TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters.update(
        capital=capitalised,
        kind_of=lambda part: type(part).__name__,
        prose=_prose,
        sentence=as_sentence,
    )
    return environment.get_template(file)


def _prose(text: str) -> Markup:
    """A sentence as HTML: words in backquotes are code, and numbers stay with their units."""
    from markupsafe import Markup, escape

    spaced = UNIT_SPACE.sub("\u00a0", str(escape(text)))
    return Markup(CODE.sub(r"<code>\1</code>", spaced))
