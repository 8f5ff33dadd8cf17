"""The pictures of every kind of result, by the names of their files without the ending.

A picture is data until `mjfim.output.plots.draw` draws it; nothing here imports matplotlib. It
takes longer to import than a short design takes, and it draws in one thread. So another process may
draw the pictures, while this one computes and writes files: interruptions and files of the user are
treated as everywhere else.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import partial, singledispatch
from typing import TYPE_CHECKING

from mjfim.errors import MjfimError, unknown
from mjfim.output.page import DESIGNED, INITIAL, PictureFormat
from mjfim.output.panels import Picture
from mjfim.output.plots import design as of_design
from mjfim.output.plots import estimate as of_estimate
from mjfim.output.plots import estimate_studies, studies
from mjfim.records.base import ShownRecord
from mjfim.records.check import Check
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.estimate_parts import InverseDynamicsFit
from mjfim.records.rehearsal import Rehearsal
from mjfim.records.robots import RobotComparison
from mjfim.records.studies import Campaign, Comparison, MonteCarloStudy
from mjfim.records.worth import Watch, Worth

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mjfim.parallel import Pool
    from mjfim.records.base import ShownRecord


# Pictures of a design, and of an estimate beside those of its fits and predictions.
DESIGN_PICTURES = (
    "accuracy_over_time",
    "accuracy",
    "trajectories",
    "convergence",
    "limits",
    "rehearsal",
    "valley",
    "worth",
)
ESTIMATE_PICTURES = (
    "parameters",
    "accuracy",
    "spectra",
    "residual_torque",
    "deciding_seconds",
    "pairs",
    "predictions",
    "horizons",
    "selection",
    "samples",
    "recordings",
)

# Pictures of how a result was found. The report has them folded, and files are drawn on request.
ON_REQUEST = {"convergence", "spectra", "horizons"}

# Largest size of the pictures that are files without a request: to draw them takes less than 3 s on
# one core. A picture counts as much as 3 panels, and a panel as 16 marks or words.
MOST_PANELS, PANELS_OF_PICTURE, PARTS_OF_PANEL = 72.0, 3.0, 16.0

# Functions that make the pictures of a record, by their names.
Pictures = dict[str, Callable[[], Picture]]


def histogram_name(parameter: str) -> str:
    """Return the name of the histogram of a parameter."""
    safe_name = re.sub(r"[^\w.-]", "_", parameter)
    return f"histogram_{safe_name}"


def numbered(name: str, count: int) -> tuple[str, ...]:
    """Return the names of pictures, one for each recording; a single one has no number."""
    return (name,) if count == 1 else tuple(f"{name}_{i + 1}" for i in range(count))


def picture_names(record: ShownRecord) -> tuple[str, ...]:
    """Return the names of the pictures of a record, the usual one first."""
    return tuple(pictures_of(record))


def draw(
    record: ShownRecord, picture: str | None = None, file: str | os.PathLike[str] = ""
) -> Figure:
    """Draw a picture of a record.

    Args:
        record: The record.
        picture: Name of the picture; default: the usual one.
        file: File into which it is written, too; its ending states the format.

    Returns:
        The figure.

    Raises:
        MjfimError: The record has no such picture, or the format is unknown.
    """
    from mjfim.output.plots.draw import figure_of, save  # imports matplotlib, which is slow

    pictures = pictures_of(record)
    if not pictures:
        raise MjfimError(f"this {type(record).__name__} has no results yet that can be drawn")
    name = next(iter(pictures)) if picture is None else picture
    if name not in pictures:
        raise MjfimError(unknown(f"picture of a {type(record).__name__}", name, pictures))
    figure = figure_of(pictures[name]())
    if os.fspath(file):
        save(figure, file)
    return figure


def kind_of_picture(name: str) -> str:
    """Return what pictures of several recordings or parameters have in common."""
    return re.sub(r"_\d+$|(?<=^histogram)_.*", "", name)


def usual(record: ShownRecord) -> Pictures:
    """Return functions that make the pictures of a record that are files without a request.

    The first picture of each kind comes first, and small pictures before large ones, until drawing
    all of them would take too long.
    """
    found = {name: make for name, make in pictures_of(record).items() if name not in ON_REQUEST}
    ranks: dict[str, tuple[bool, float]] = {}
    kinds: set[str] = set()
    for name, make in found.items():
        kind = kind_of_picture(name)
        # A fault is told when the picture is drawn.
        size = 0.0
        with suppress(Exception):
            picture = make()
            size = _size(picture)
            # It is made once.
            found[name] = partial(_given, picture)
        ranks[name] = (kind in kinds, size)
        kinds.add(kind)

    chosen, total = set(), 0.0
    for name in sorted(found, key=ranks.__getitem__):
        if total + ranks[name][1] <= MOST_PANELS:
            chosen.add(name)
            total += ranks[name][1]
    return {name: make for name, make in found.items() if name in chosen}


def _given(picture: Picture) -> Picture:
    """Return a picture that was made before."""
    return picture


def _size(picture: Picture) -> float:
    """Return the time that it takes to draw a picture, over that of an empty panel."""
    parts = sum(
        len(panel.marks)
        + len(panel.x.names or ())
        + len(panel.y.names or ())
        + sum(len(texts) for _, _, texts in panel.beside)
        + sum(map(len, panel.cells.texts if panel.cells else ()))
        for panel in picture.panels
    )
    return PANELS_OF_PICTURE + len(picture.panels) + parts / PARTS_OF_PANEL


@singledispatch
def pictures_of(record: ShownRecord) -> Pictures:
    """Return functions that make the pictures of a record, the usual one first.

    Raises:
        MjfimError: Records of this kind have no pictures.
    """
    raise MjfimError(f"a {type(record).__name__} has no figures")


@pictures_of.register
def _(design: Design) -> Pictures:
    labels = design.labels
    pictures: Pictures = {
        "trajectories": partial(of_design.trajectories, design, labels),
        "accuracy_over_time": partial(of_design.accuracy_over_time, design, labels),
        "accuracy": partial(of_design.accuracy, design, labels),
        "convergence": partial(of_design.convergence, design),
    }
    if design.usage:
        pictures["limits"] = partial(of_design.limits, design, labels)
    motions = [(f"{term} motion", term) for term in (INITIAL, DESIGNED)]
    return pictures | _of_motions(design, motions)


def _of_motions(record: Design | Check, motions: Sequence[tuple[str, str]]) -> Pictures:
    """What motions do to robots, do not determine, and would gain; names and roles of motions."""
    pictures: Pictures = {}
    if record.rehearsal is not None:
        pictures["rehearsal"] = partial(studies.rehearsal, record.rehearsal)
    if record.valley is not None:
        pictures["valley"] = partial(studies.valley, record.valley, motions)
    if record.worth is not None:
        pictures["worth"] = partial(of_design.worth, record.worth)
    return pictures


@pictures_of.register
def _(estimate: Estimate) -> Pictures:
    labels = estimate.labels
    held = sum(prediction.recording is not None for prediction in estimate.predictions)
    fits = {
        name: partial(of_estimate.fit, estimate, i, labels)
        for i, name in enumerate(numbered("fit", len(estimate.recordings)))
    }
    held_out = {
        name: partial(of_estimate.held_out, estimate, i, labels)
        for i, name in enumerate(numbered("held_out", held))
    }
    optional = {
        "selection": (
            estimate.selection is not None,
            partial(estimate_studies.selection, estimate),
        ),
        "horizons": (estimate.horizons is not None, partial(estimate_studies.horizons, estimate)),
        "residual_torque": (
            bool(estimate.residual_forces),
            partial(
                of_estimate.residual_torque,
                estimate.residual_forces,
                is_explained=not estimate.misfit,
            ),
        ),
        "recordings": (
            estimate.recording_comparison is not None,
            partial(estimate_studies.recordings, estimate),
        ),
        "samples": (estimate.draws is not None, partial(estimate_studies.samples, estimate)),
        "deciding_seconds": (
            estimate.in_time is not None,
            partial(of_estimate.deciding_seconds, estimate, labels),
        ),
        "pairs": (
            estimate_studies.has_pairs(estimate.std),
            partial(estimate_studies.estimate_pairs, estimate, labels),
        ),
        "predictions": (
            bool(estimate.predictions),
            partial(of_estimate.predictions, estimate, labels),
        ),
    }
    return {
        "parameters": partial(of_estimate.parameter_intervals, estimate, labels),
        "accuracy": partial(of_estimate.accuracy, estimate, labels),
        "spectra": partial(of_estimate.residual_spectra, estimate, labels),
        **{name: make for name, (has_it, make) in optional.items() if has_it},
        **fits,
        **held_out,
    }


@pictures_of.register
def _(result: InverseDynamicsFit) -> Pictures:
    if not result.residual_forces:
        return {}
    return {"residual_torque": partial(of_estimate.residual_torque, result.residual_forces)}


@pictures_of.register
def _(study: MonteCarloStudy) -> Pictures:
    labels = study.labels
    return {
        "overview": partial(studies.overview, study, labels),
        **{
            histogram_name(name): partial(studies.histogram, study, i, labels)
            for i, name in enumerate(study.parameters)
        },
    }


@pictures_of.register
def _(check: Check) -> Pictures:
    motion = check.source, studies.source_role(check)
    return {"check": partial(studies.check, check), **_of_motions(check, [motion])}


@pictures_of.register
def _(result: Worth) -> Pictures:
    return {"worth": partial(of_design.worth, result)}


@pictures_of.register
def _(result: Watch) -> Pictures:
    return {"watch": partial(studies.watch, result)}


@pictures_of.register
def _(comparison: Comparison) -> Pictures:
    return {"compare": partial(studies.compare, comparison)}


@pictures_of.register
def _(comparison: RobotComparison) -> Pictures:
    """The picture of a comparison of two robots; none without a parameter in common."""
    return {"robots": partial(studies.robots, comparison)} if comparison.parameters else {}


@pictures_of.register
def _(result: Rehearsal) -> Pictures:
    return {"rehearsal": partial(studies.rehearsal, result)}


@pictures_of.register
def _(campaign: Campaign) -> Pictures:
    """The picture of a campaign; none before its first round."""
    return {"campaign": partial(studies.campaign, campaign)} if campaign.rounds else {}


# Messages for developers, which a user does not see.
_log = logging.getLogger(__name__)

# Fewest processors with which another process saves time.
FEWEST_CORES = 2

# Errors of a computer that cannot start another process, as without shared semaphores or memory.
NO_PROCESS = (ImportError, MemoryError, OSError, RuntimeError)

# The process that draws now; None where this process draws itself.
_process: ContextVar[Pool | None] = ContextVar("drawing", default=None)


@contextmanager
def drawing_elsewhere() -> Iterator[None]:
    """Let another process draw the pictures that are begun in the context, if it saves time.

    It ends with the process that has started it, whatever happens to that one.
    """
    from mjfim.parallel import Pool, cores

    pool = None
    if cores() >= FEWEST_CORES:
        with suppress(*NO_PROCESS):
            pool = Pool(1)
    token = _process.set(pool)
    try:
        if pool is not None:
            with suppress(*NO_PROCESS):
                pool.submit(_import_what_draws)
        yield
    finally:
        _process.reset(token)
        if pool is not None:
            pool.end_running(wait=True)


def begin_pictures(
    record: ShownRecord, picture_format: PictureFormat
) -> Callable[[], dict[str, bytes]]:
    """Begin to draw the pictures of a record.

    Args:
        record: The record; it is copied to the other process.
        picture_format: Format of the pictures.

    Returns:
        A function that waits for the contents of the files, by the names of the pictures. They are
        none where this process has to draw, and then says what keeps a picture from being drawn.
    """
    pool, future = _process.get(), None
    # The data of the result are written after this, whatever happens to the other process.
    if pool is not None:
        with suppress(*NO_PROCESS):
            future = pool.submit(_contents, record, picture_format)

    def contents() -> dict[str, bytes]:
        if future is None:
            return {}
        fault = future.exception()
        if fault is None:
            return future.result()
        _log.info("the process that draws has failed, so this one draws: %r", fault)
        return {}

    return contents


# ---- in the other process


def _import_what_draws() -> None:
    """Import all modules that draw pictures, before there is anything to draw."""
    import mjfim.output.plots.draw  # noqa: F401


def _contents(record: ShownRecord, picture_format: PictureFormat) -> dict[str, bytes]:
    from mjfim.output.plots.draw import content

    return {name: content(draw(), picture_format) for name, draw in usual(record).items()}
