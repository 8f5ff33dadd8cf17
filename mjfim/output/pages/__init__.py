"""Results in words, tables and names of pictures: a page for each kind of record."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mjfim.errors import MjfimError
from mjfim.output.page import Page
from mjfim.output.pages.check import check_page
from mjfim.output.pages.design import design_page
from mjfim.output.pages.equation import equation_page
from mjfim.output.pages.estimate import estimate_page
from mjfim.output.pages.robots import campaign_page, robots_page, robustness_page
from mjfim.output.pages.studies import comparison_page, study_page
from mjfim.records.base import ShownRecord
from mjfim.records.campaign import Campaign
from mjfim.records.check import Check
from mjfim.records.comparison import Comparison
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.inverse_dynamics import InverseDynamicsFit
from mjfim.records.monte_carlo import MonteCarloStudy
from mjfim.records.robots import RobotComparison
from mjfim.records.robustness import Robustness

# The function that describes each kind of record.
PAGES: dict[type[ShownRecord], Callable[[Any], Page]] = {
    Campaign: campaign_page,
    Check: check_page,
    Comparison: comparison_page,
    Design: design_page,
    Estimate: estimate_page,
    InverseDynamicsFit: equation_page,
    MonteCarloStudy: study_page,
    RobotComparison: robots_page,
    Robustness: robustness_page,
}


def page_of(record: ShownRecord) -> Page:
    """Return the page of a result.

    Raises:
        MjfimError: If there is no page for this kind of record.
    """
    describe = PAGES.get(type(record))
    if describe is None:
        raise MjfimError(f"a {type(record).__name__} cannot be shown as a page")
    return describe(record)
