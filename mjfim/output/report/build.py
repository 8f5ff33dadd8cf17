"""The report of every kind of result, and the reports of a folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import singledispatch
from pathlib import Path, PurePath, PurePosixPath, PureWindowsPath

from mjfim.errors import MjfimError, RecordingError, first_ones, listed
from mjfim.files import read_json, replacing
from mjfim.output.report import OWN_REPORTS, REPORT, own_report
from mjfim.output.report.campaign import campaign_page
from mjfim.output.report.check import check_page
from mjfim.output.report.comparison import comparison_page
from mjfim.output.report.design import design_page
from mjfim.output.report.estimate import estimate_page
from mjfim.output.report.monte_carlo import study_page
from mjfim.output.report.page import Page
from mjfim.output.report.render import is_page_of, no_video_in, rendered, video_in
from mjfim.output.report.robot_comparison import robots_page
from mjfim.output.report.robustness import robustness_page
from mjfim.output.video import Video
from mjfim.records.base import ShownRecord
from mjfim.records.campaign import Campaign
from mjfim.records.check import Check
from mjfim.records.comparison import Comparison
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.monte_carlo import MonteCarloStudy
from mjfim.records.robots import RobotComparison
from mjfim.records.robustness import Robustness

# Kinds of results that have a report, by the verb, in the order of `VERBS`.
KINDS: dict[str, type[ShownRecord]] = {
    "campaign": Campaign,
    "identify": Estimate,
    "design": Design,
    "compare": Comparison,
    "compare-robots": RobotComparison,
    "montecarlo": MonteCarloStudy,
    "robustness": Robustness,
    "check": Check,
}

# Longest list of recordings among the facts [characters].
MAX_RECORDINGS_TEXT = 60


@dataclass(frozen=True, kw_only=True)
class Media:
    """The video of a page.

    Attributes:
        video: The video, or None.
        no_video: Sentence that says why there is none; may be empty.
    """

    video: Video | None = None
    no_video: str = ""


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
page_of.register(RobotComparison, robots_page)
page_of.register(Robustness, robustness_page)
page_of.register(Campaign, campaign_page)


def verbs_in(folder: Path) -> list[str]:
    """Return the verbs whose results a folder holds, that of the main result first.

    Args:
        folder: Folder of results.

    Raises:
        RecordingError: The folder holds no result that has a report.
    """
    if not folder.is_dir():
        raise RecordingError(f"{folder}: no such folder")

    archives = {verb: folder / f"{kind.file_stem}.npz" for verb, kind in KINDS.items()}
    found = [verb for verb, path in archives.items() if path.is_file()]
    if not found:
        names = listed([path.name for path in archives.values()])
        raise RecordingError(f"{folder}: holds no result; a report needs one of {names}")
    return found


def report_files(folder: Path) -> dict[str, Path]:
    """Return the page of every result of a folder, by its verb; the main result comes first.

    Args:
        folder: Folder of results.

    Raises:
        RecordingError: The folder holds no result that has a report.
    """
    main, *others = verbs_in(folder)
    return {main: folder / REPORT, **{verb: folder / own_report(verb) for verb in others}}


def write_report(
    folder: Path,
    kind: type[ShownRecord],
    video: Video | None = None,
    no_video: str = "",
    *,
    made: ShownRecord | None = None,
) -> Path:
    """Write the report of a result, as the files in its folder give it.

    Pages of other results in the folder are written again, because they name this result, or give
    it their place.

    Args:
        folder: Folder of results.
        kind: Kind of the result.
        video: A video of the robot, or None.
        no_video: Sentence that says why there is no video; may be empty.
        made: The result, where this process has just written it; its files are not read then.

    Returns:
        The file.

    Raises:
        RecordingError: The result cannot be read.
    """
    verb = next(verb for verb, other in KINDS.items() if other is kind)
    records: dict[str, ShownRecord] = {}
    for other in verbs_in(folder):
        # A result of an earlier version, which cannot be read, keeps the page that it has.
        try:
            if other == verb and made is not None:
                records[other] = made.as_saved()
            else:
                records[other] = KINDS[other].load(folder)
        except RecordingError:
            if other == verb:
                raise

    # The page of this result is the last one, so that it is the latest of the folder.
    media = {verb: Media(video=video, no_video=no_video)}
    records[verb] = records.pop(verb)
    return _write_pages(folder, records, media)[-1]


def rewrite_reports(folder: Path) -> list[Path]:
    """Write all reports of a folder again; the videos of the present ones are kept.

    Args:
        folder: Folder of results.

    Returns:
        The files, that of the main result first.

    Raises:
        RecordingError: The folder holds no result that has a report, or one cannot be read.
    """
    return _write_pages(folder, records_in(folder), {})


def records_in(folder: Path) -> dict[str, ShownRecord]:
    """Read all results of a folder that have a report, by their verbs; the main one comes first.

    Args:
        folder: Folder of results.

    Raises:
        RecordingError: The folder holds no such result, or one cannot be read.
    """
    return {verb: KINDS[verb].load(folder) for verb in verbs_in(folder)}


def _write_pages(
    folder: Path, records: Mapping[str, ShownRecord], media: Mapping[str, Media]
) -> list[Path]:
    """Write the pages of several results of a folder.

    Args:
        folder: The folder.
        records: The results by their verbs.
        media: Videos of pages that have a new one, by verb; others keep that of the present page.

    Returns:
        The files.
    """
    files = report_files(folder)
    present = _present_pages(folder)
    written = []
    for verb, record in records.items():
        page = page_of(record)
        page = replace(page, facts={**_origin(folder, record), **page.facts})
        found = media.get(verb) or _media_of(page, present)
        others = {other: file.name for other, file in files.items() if other != verb}
        name = _name(folder, record)
        html = rendered(page, name, found.video, found.no_video, others=others)

        with replacing(files[verb]) as temporary:
            temporary.write_text(html, encoding="utf-8", newline="\n")
        written.append(files[verb])
    return written


def _present_pages(folder: Path) -> list[str]:
    """Read the reports that a folder holds already."""
    files = [folder / name for name in (REPORT, *OWN_REPORTS)]
    return [f.read_text(encoding="utf-8", errors="replace") for f in files if f.is_file()]


def _media_of(page: Page, present: Sequence[str]) -> Media:
    """Return the video of the present page of a result, whatever the name of its file is."""
    for html in present:
        if is_page_of(html, page.kind):
            return Media(video=video_in(html), no_video=no_video_in(html))
    return Media()


# ---- what a report is named after


def _stated(folder: Path, record: ShownRecord, key: str) -> str:
    """Return the name of a file that the JSON file of a result names; empty where it does not."""
    try:
        stated = read_json(folder / f"{record.file_stem}.json").get(key)
    except RecordingError:
        return ""

    # The file may have been written on another system.
    if not isinstance(stated, str):
        return ""
    return PurePosixPath(PureWindowsPath(stated).as_posix()).name


def _origin(folder: Path, record: ShownRecord) -> dict[str, str]:
    """Return the experiment, the model and the recordings of a result, as far as they are known."""
    found = {key: _stated(folder, record, key) for key in ("experiment", "model")}
    if isinstance(record, Estimate):
        names = [PurePath(recording.name).name for recording in record.recordings]
        found["recordings"] = first_ones(names, longest=MAX_RECORDINGS_TEXT)
    return {key: name for key, name in found.items() if name}


def _name(folder: Path, record: ShownRecord) -> str:
    """Return what a report is named after: the experiment, else the recordings or the folder."""
    experiment = _stated(folder, record, "experiment")
    if experiment:
        return PurePath(experiment).stem

    if isinstance(record, Estimate):
        return first_ones([PurePath(recording.name).name for recording in record.recordings])
    if isinstance(record, Comparison):
        return PurePath(record.source).stem
    if isinstance(record, RobotComparison):
        return " and ".join(record.names)
    return folder.resolve().name
