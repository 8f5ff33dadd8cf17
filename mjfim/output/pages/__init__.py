"""Results in words, tables and names of pictures: a page for each kind of record."""

from __future__ import annotations

from importlib import import_module

from mjfim.errors import MjfimError
from mjfim.output.page import Page
from mjfim.records.base import ShownRecord

# The module and the function that describe each kind of record. A verb imports those it needs.
PAGES = {
    "Campaign": ("studies", "campaign_page"),
    "Check": ("design", "check_page"),
    "Comparison": ("studies", "comparison_page"),
    "Design": ("design", "design_page"),
    "Estimate": ("estimate", "estimate_page"),
    "InverseDynamicsFit": ("studies", "equation_page"),
    "MonteCarloStudy": ("studies", "study_page"),
    "RobotComparison": ("studies", "robots_page"),
    "Robustness": ("studies", "robustness_page"),
}


def page_of(record: ShownRecord) -> Page:
    """Return the page of a result.

    Raises:
        MjfimError: If there is no page for this kind of record.
    """
    kind = type(record).__name__
    if kind not in PAGES:
        raise MjfimError(f"a {kind} cannot be shown as a page")
    module, function = PAGES[kind]
    page: Page = getattr(import_module(f"{__name__}.{module}"), function)(record)
    return page
