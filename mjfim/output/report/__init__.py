"""The report of a result: one HTML file with words, tables and interactive plots.

In a folder with the results of several verbs, `report.html` is the page of the first one of them in
`VERBS`. Each other one has a page of its own, such as `report_check.html`, and all of them name
each other.
"""

from __future__ import annotations

from pathlib import Path

# Name of the report in a folder of results.
REPORT = "report.html"

# Verbs whose results have a report; of several results in a folder, the first one is the main one.
VERBS = (
    "campaign",
    "identify",
    "design",
    "compare",
    "compare-robots",
    "montecarlo",
    "robustness",
    "check",
)


def own_report(verb: str) -> str:
    """Name of the page of a result beside the main result of its folder.

    Args:
        verb: The verb.
    """
    return f"report_{verb}.html"


# Pages of results beside the main one.
OWN_REPORTS = tuple(own_report(verb) for verb in VERBS)


def is_report(file: Path) -> bool:
    """Whether a file is a report, after its name.

    Args:
        file: The file.
    """
    return file.name in (REPORT, *OWN_REPORTS)
