"""Results in words, tables and names of pictures: a page for each kind of record."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from mjfim.errors import MjfimError
from mjfim.output.page import Page
from mjfim.records.base import ShownRecord

# The module and the function that describe each kind of record. A verb imports those it needs.
PAGES = {
    "Campaign": ("studies", "campaign_page"),
    "Check": ("design", "check_page"),
    "Comparison": ("studies", "comparison_page"),
    "Design": ("design", "design_page"),
    "DesignComparison": ("design", "designs_page"),
    "Estimate": ("estimate", "estimate_page"),
    "InverseDynamicsFit": ("studies", "equation_page"),
    "MonteCarloStudy": ("studies", "study_page"),
    "RobotComparison": ("studies", "robots_page"),
    "Rehearsal": ("design", "rehearsal_page"),
    "Watch": ("studies", "watch_page"),
    "Worth": ("worth", "worth_page"),
}


def page_of(
    record: ShownRecord,
    *,
    experiment: str | None = None,
    design: Path | None = None,
    output: Path | None = None,
) -> Page:
    """Return the page of a result.

    Args:
        record: The result.
        experiment: Path of its experiment file, which commands name.
        design: Folder or file of the design that it is or is about, likewise.
        output: Its folder; the results of a command stand beside it, with the verb in their name.
            Without one they are named after the experiment.

    Raises:
        MjfimError: If there is no page for this kind of record.
    """
    kind = type(record).__name__
    if kind not in PAGES:
        raise MjfimError(f"a {kind} cannot be shown as a page")
    module, function = PAGES[kind]
    page: Page = getattr(import_module(f"{__name__}.{module}"), function)(record)
    places = {"EXPERIMENT": experiment, "DESIGN_FOLDER": design}

    def with_places(sentence: str) -> str:
        """A sentence with real paths in its commands."""
        for word, place in places.items():
            if place is not None:
                # A file in the folder is one word of the shell, too.
                pattern = rf"(?<= )({word})(/[\w.]+)?(?=[ `])"
                sentence = _with_path(sentence, pattern, str(place))
        folder = output or (experiment and Path(experiment).stem)
        if not folder:
            return sentence
        beside = shlex.quote(str(folder)).replace("\\", r"\\")
        return re.sub(r"mjfim (\w+)([^`]*) -o FOLDER", rf"mjfim \1\2 -o {beside}-\1", sentence)

    return replace(
        page,
        next_steps=tuple(map(with_places, page.next_steps)),
        causes=tuple(map(with_places, page.causes)),
    )


def _with_path(sentence: str, pattern: str, path: str) -> str:
    """Put a path in the place of a word, with the quotation marks that a shell needs."""
    return re.sub(pattern, lambda found: shlex.quote(path + (found[2] or "")), sentence)
