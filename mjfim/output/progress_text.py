"""Events of long work in one line of text, for the terminal and for notebooks."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mjfim.output.vocabulary import shown_word
from mjfim.records.events import DesignEvent, Event, FitEvent, StudyEvent


@dataclass(frozen=True, kw_only=True)
class ProgressLine:
    """State of long work.

    Attributes:
        text: What is done, in one line.
        done: Number of finished parts; None if the number of parts is not known.
        count: Number of parts; None if it is not known.
    """

    text: str
    done: float | None = None
    count: int | None = None


def progress_line(event: Event) -> ProgressLine:
    """Describe an event in one line.

    Args:
        event: The event.
    """
    if isinstance(event, DesignEvent):
        return ProgressLine(text=design_text(event))
    if isinstance(event, FitEvent):
        return ProgressLine(text=fit_text(event))
    if event.count is None:
        return ProgressLine(text=event.message)

    text = f"{part_text(event)}  {event.message}".rstrip()
    return ProgressLine(text=text, done=event.index + event.share, count=event.count)


def design_text(event: DesignEvent) -> str:
    """Describe an iterate of a design.

    Args:
        event: The event.
    """
    row = event.row
    text = f"iteration {row.iteration:3d}  J {row.cost:.6g}  λ_min {row.min_eigenvalue:.5g}"
    if math.isinf(row.cost):
        text = f"iteration {row.iteration:3d}  outside the limits"

    # The search for a release has no slope.
    return text if math.isnan(row.slope) else f"{text}  slope {row.slope:.1e}"


def design_stage(event: DesignEvent) -> str:
    """Name the stage of a design; J of two stages cannot be compared.

    Args:
        event: The event.
    """
    row = event.row
    at_rate = f"at {row.rate:.4g} Hz"
    if not row.mu:
        return f"searching {at_rate}"
    if math.isinf(row.mu):
        return f"steering into the limits {at_rate}"
    return f"searching inside the limits {at_rate}, barrier {row.mu:.1g}"


def fit_text(event: FitEvent) -> str:
    """Describe an iterate of an estimation.

    Args:
        event: The event.
    """
    iteration = f"{event.phase}: iteration {event.iteration}"
    return f"{iteration}, cost {event.cost:.6g}, step {event.step:.2g} σ"


def part_text(event: StudyEvent) -> str:
    """Name the part of a study that is running, with its number.

    Args:
        event: The event of a study with a known number of parts.
    """
    return f"{event.index + 1}/{event.count} {shown_word(event.part)}"
