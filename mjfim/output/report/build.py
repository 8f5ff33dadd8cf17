"""The report of every kind of result, and the report of a folder."""

from __future__ import annotations

from functools import singledispatch
from pathlib import Path, PurePath

from mjfim.atomic_io import replacing
from mjfim.errors import MjfimError, RecordingError, first_ones, listed
from mjfim.output.report import REPORT
from mjfim.output.report.campaign import campaign_page
from mjfim.output.report.check import check_page
from mjfim.output.report.comparison import comparison_page
from mjfim.output.report.design import design_page
from mjfim.output.report.estimate import estimate_page
from mjfim.output.report.monte_carlo import study_page
from mjfim.output.report.page import Page
from mjfim.output.report.render import no_video_in, rendered, video_in
from mjfim.output.report.robustness import robustness_page
from mjfim.output.video import Video
from mjfim.records.campaign import Campaign
from mjfim.records.check import Check
from mjfim.records.comparison import Comparison
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.monte_carlo import MonteCarloStudy
from mjfim.records.robustness import Robustness
from mjfim.records.serialization import read_json
from mjfim.records.shown import ShownRecord

# Kinds of records that have a report.
KINDS: tuple[type[ShownRecord], ...] = (
    Campaign,
    Design,
    Estimate,
    Check,
    MonteCarloStudy,
    Comparison,
    Robustness,
)


@singledispatch
def page_of(record: ShownRecord) -> Page:
    """Return the report of a result.

    Args:
        record: The result of a verb.

    Raises:
        MjfimError: This kind of record has no report.
    """
    raise MjfimError(f"a {type(record).__name__} has no report")


page_of.register(Design, design_page)
page_of.register(Estimate, estimate_page)
page_of.register(Check, check_page)
page_of.register(MonteCarloStudy, study_page)
page_of.register(Comparison, comparison_page)
page_of.register(Robustness, robustness_page)
page_of.register(Campaign, campaign_page)


def newest_kind(folder: Path) -> type[ShownRecord]:
    """Return the kind of the result that a folder holds; of several results, the newest one.

    Args:
        folder: Folder of results.

    Raises:
        RecordingError: The folder holds no result that has a report.
    """
    if not folder.is_dir():
        raise RecordingError(f"{folder}: no such folder")

    archives = {kind: folder / f"{kind.file_stem}.npz" for kind in KINDS}
    found = {kind: path for kind, path in archives.items() if path.is_file()}
    if not found:
        names = listed([path.name for path in archives.values()])
        raise RecordingError(f"{folder}: holds no result; a report needs one of {names}")
    return max(found, key=lambda kind: found[kind].stat().st_mtime_ns)


def write_report(
    folder: Path, kind: type[ShownRecord], video: Video | None = None, no_video: str = ""
) -> Path:
    """Write the report of a folder, from the files in it alone.

    Args:
        folder: Folder of results.
        kind: Kind of the result in it.
        video: A video of the robot, or None.
        no_video: Sentence that says why there is no video; may be empty.

    Returns:
        The file.

    Raises:
        RecordingError: The result cannot be read.
    """
    record = kind.load(folder)
    html = rendered(page_of(record), _name(folder, record), video, no_video)

    target = folder / REPORT
    with replacing(target) as temporary:
        temporary.write_text(html, encoding="utf-8", newline="\n")
    return target


def rewrite_report(folder: Path) -> Path:
    """Write the report of a folder again; the video of the present report is kept.

    Args:
        folder: Folder of results.

    Returns:
        The file.

    Raises:
        RecordingError: The folder holds no result that has a report, or it cannot be read.
    """
    kind = newest_kind(folder)
    present = folder / REPORT
    html = present.read_text(encoding="utf-8", errors="replace") if present.is_file() else ""
    return write_report(folder, kind, video_in(html), no_video_in(html))


def _name(folder: Path, record: ShownRecord) -> str:
    """Return what a report is named after: the experiment or the recordings, else the folder."""
    if isinstance(record, Estimate):
        return first_ones([PurePath(recording.name).name for recording in record.recordings])

    if isinstance(record, Design):
        try:
            experiment = read_json(folder / "design.json").get("experiment")
        except RecordingError:
            experiment = None
        if isinstance(experiment, str):
            return PurePath(experiment).stem
    if isinstance(record, Comparison):
        return PurePath(record.source).stem
    return folder.resolve().name
