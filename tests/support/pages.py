"""Pages as texts."""

from __future__ import annotations

from rich.console import Console

from mjfim.output.page import Page, Part, Text
from mjfim.output.terminal import laid_out
from mjfim.records.base import Level, Verdict


def printed(page: Page, width: int = 200, *, verbose: bool = False) -> str:
    """The text in a terminal without colours."""
    console = Console(width=width, no_color=True)
    with console.capture() as capture:
        console.print(laid_out(page, console, verbose=verbose))
    return "\n".join(line.rstrip() for line in capture.get().splitlines())


def sentences(page: Page) -> str:
    """All sentences of a page."""
    return "\n".join(part.text for part in page.parts if isinstance(part, Text))


def page_with(*parts: Part, verdict: str = "Done.") -> Page:
    """A page with these parts."""
    found = Verdict(verdict, Level.GOOD)
    return Page(kind="Kind", verdict=found, sections={"": parts})
