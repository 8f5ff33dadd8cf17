"""Folders of results: writes the files of every verb and finds those of earlier runs."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ModelError, RecordingError
from mjfim.experiment.system import System, labels_of_system
from mjfim.files import read_json, remove_earlier_result, replacing
from mjfim.output import archive
from mjfim.output import rerun as rerun_log
from mjfim.output.archive import write_table
from mjfim.output.export.mjcf import identified_files, write_identified
from mjfim.output.manifest import MANIFEST, write_optional
from mjfim.output.page import REPORT, PictureFormat
from mjfim.output.panels import Picture
from mjfim.output.plots.pictures import (
    DESIGN_PICTURES,
    ESTIMATE_PICTURES,
    ON_REQUEST,
    Pictures,
    begin_pictures,
    pictures_of,
    usual,
)
from mjfim.output.report import Media, kinds_in, write_report
from mjfim.output.video import report_video
from mjfim.parallel.budget import current_interruption
from mjfim.records.base import ShownRecord
from mjfim.records.check import Check
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate, ParameterDraws
from mjfim.records.events import begin_stage
from mjfim.records.studies import Campaign, Comparison, MonteCarloStudy
from mjfim.records.trajectory import with_unit

# Table of the drawn robots, and folder of their models.
SAMPLES_TABLE = "samples.csv"
SAMPLES_FOLDER = "samples"

# Name of the model of a robot without its ending, by its number from 1; and names of all files that
# an earlier run has written into the folder.
ROBOT = "robot_{:04d}"
SAMPLE_FILES = r"robot_\d+(_.*)?\.(xml|urdf)"


def sample_files(folder: Path) -> tuple[str, ...]:
    """List the files of drawn robots in the folder of an estimate, relative to it."""
    models = matching(folder / SAMPLES_FOLDER, SAMPLE_FILES)
    return (SAMPLES_TABLE, *(f"{SAMPLES_FOLDER}/{file.name}" for file in models))


def write_samples(folder: Path, draws: ParameterDraws, theta: Array, system: System) -> list[str]:
    """Write the table and the models of the robots that are drawn from an estimate.

    Models are written for all robots or for none.

    Args:
        folder: Folder of the estimate.
        draws: The robots.
        theta: (p,) the estimate.
        system: The system that was identified.

    Returns:
        Sentences about models that could not be written completely.
    """
    columns = dict(zip(map(with_unit, draws.parameters, draws.units), draws.values.T, strict=True))
    write_table(folder / SAMPLES_TABLE, {"robot": np.arange(1, len(draws) + 1), **columns})

    # Robots differ in their numbers alone, so that a remark stands for all of them.
    remarks: Counter[str] = Counter()
    drawn = theta.copy()
    for i, values in enumerate(draws.values, start=1):
        path = folder / SAMPLES_FOLDER / f"{ROBOT.format(i)}.xml"
        drawn[~system.parameters.initial_deviations] = values
        try:
            found = write_identified(path, system, drawn)
        except ModelError as error:
            _clear_models(folder / SAMPLES_FOLDER)
            return [f"no models of drawn robots were written: {error}"]
        remarks.update(remark.replace(path.stem, "robot") for remark in found)
    return [
        f"{SAMPLES_FOLDER}/: {remark}"
        + (f" ({count} of {len(draws)} robots)" if count < len(draws) else "")
        for remark, count in remarks.items()
    ]


def clear_samples(folder: Path) -> None:
    """Remove the files of drawn robots that an earlier run wrote.

    Args:
        folder: Folder of the estimate.
    """
    if (folder / SAMPLES_TABLE).is_file():
        remove_earlier_result(folder / SAMPLES_TABLE)
    _clear_models(folder / SAMPLES_FOLDER)


def _clear_models(place: Path) -> None:
    """Remove the models of drawn robots, and their folder where nothing else is in it."""
    if not place.is_dir():
        return
    clear(place, SAMPLE_FILES)
    if {file.name for file in place.iterdir()} <= {MANIFEST}:
        (place / MANIFEST).unlink(missing_ok=True)
        place.rmdir()


# The identified model.
IDENTIFIED = "identified.xml"

# Names of the pictures of a result without their endings, as patterns, where they are not those of
# its other files.
ENDINGS = "|".join(PictureFormat)
PICTURES: dict[type[ShownRecord], str] = {
    Check: "check|worth|rehearsal|valley",
    Design: "|".join(DESIGN_PICTURES),
    Estimate: rf"(fit|held_out)(_\d+)?|{'|'.join(ESTIMATE_PICTURES)}",
    MonteCarloStudy: "overview|histogram_.*",
}

# Names of files of an earlier run that may not be written again.
STALE: dict[type[ShownRecord], str] = {
    Comparison: r"control_[\w-]+\.csv",
    Design: rf"({PICTURES[Design]})\.({ENDINGS})",
    Estimate: rf"({PICTURES[Estimate]})\.({ENDINGS})|identified(_.*)?\.(xml|urdf)",
}

# Files that a design consists of, without figures; and the settings with which a simulated campaign
# began: the call that continues it needs the same.
DESIGN_ARCHIVE = ("design.npz", "design.csv", "reference.csv", "design.json")
SETTINGS_FILE = "settings.json"

# Files beside the data, the report and the pictures of a result.
FURTHER: dict[type[ShownRecord], str] = {
    Campaign: SETTINGS_FILE,
    Design: "|".join(DESIGN_ARCHIVE),
}


def names_of(kind: type[ShownRecord], picture_format: PictureFormat) -> str:
    """Return the pattern of the names of all files that a result of a kind may have.

    Those that hold names of the user are not among them; see `identified_models`.
    """
    pictures = PICTURES.get(kind, kind.file_stem)
    data = rf"{kind.file_stem}\.(json|npz|rrd)|{REPORT}|{FURTHER.get(kind, '')}"
    return rf"{data}|({pictures})\.{picture_format}"


def matching(folder: Path, names: str) -> list[Path]:
    """List the files of a folder whose whole names match a pattern."""
    return [file for file in folder.glob("*") if re.fullmatch(names, file.name)]


def identified_models(folder: Path, model: Path) -> tuple[str, ...]:
    """List the files of an identified model: the MJCF, what it includes, and URDFs.

    Args:
        folder: Folder of `identified.xml`.
        model: The user's MJCF.
    """
    return (IDENTIFIED, *identified_files(folder / IDENTIFIED, model))


def find_rerun_file(source: Path) -> Path:
    """Find the Rerun file that a folder of results or a file names.

    Args:
        source: Folder of results, or an .rrd file.

    Returns:
        The .rrd file.

    Raises:
        RecordingError: There is none.
    """
    if not source.exists():
        raise RecordingError(f"{source}: no such file or folder")

    if source.is_dir():
        for name in ("design.rrd", "estimate.rrd"):
            if (source / name).is_file():
                return source / name
        raise RecordingError(f"{source}: no design.rrd or estimate.rrd in this folder")

    if source.suffix != ".rrd":
        raise RecordingError(f"{source}: give a folder of results, an .rrd file or a design .npz")
    return source


def find_experiment_file(source: Path) -> Path:
    """Find the experiment file that the design.json beside a design.npz names.

    Args:
        source: The design.npz.

    Returns:
        The experiment file.

    Raises:
        RecordingError: There is no design.json beside it, or it names no experiment.
    """
    try:
        experiment = read_json(source.parent / "design.json").get("experiment")
    except RecordingError:
        experiment = None

    if not isinstance(experiment, str):
        raise RecordingError(
            f"{source}: no design.json beside it names the experiment; give its file with "
            "--experiment"
        )
    # As a person would type it: from the current folder, where the file is in it.
    found = Path(os.path.normpath(source.parent.resolve() / experiment))
    return found.relative_to(Path.cwd()) if found.is_relative_to(Path.cwd()) else found


def write_result(
    folder: Path,
    record: ShownRecord,
    system: System | None = None,
    picture_format: PictureFormat = PictureFormat.PNG,
    further: Mapping[str, object] | None = None,
) -> tuple[list[str], Callable[[], list[str]]]:
    """Write the data, the report and the Rerun file of a result.

    Files that an earlier run wrote and that are not written again are removed.

    Args:
        folder: Folder for the results.
        record: The result.
        system: The experiment of the result; None for a comparison of robots.
        picture_format: Format of the pictures.
        further: Further entries of its JSON file.

    Returns:
        Sentences about models that could not be written completely, and a function that writes the
        pictures and the video of the report. It returns the names of pictures that would take too
        long.
    """
    # Another process draws the pictures, while this one writes the other files.
    drawn = begin_pictures(record, picture_format)
    if type(record) in STALE:
        clear(folder, STALE[type(record)])
    remarks = _write_data(folder, record, system, further or {})

    # A video of the robot belongs to the motion of an earlier design or estimate.
    media = Media() if isinstance(record, Design | Estimate) else None
    write_optional(REPORT, lambda: write_report(folder, record, media))
    if system is not None and isinstance(record, Design | Estimate):
        log = f"{record.file_stem}.rrd"
        write_optional(log, lambda: _write_log(folder / log, record, system))

    def draw() -> list[str]:
        """Write the pictures and the video; return the names of pictures that are left out."""
        _write_figures(folder, record, picture_format, drawn)
        # Who has pressed Ctrl-C does not wait for a video.
        interruption = current_interruption()
        is_pressed = interruption is not None and interruption.presses
        if system is not None and isinstance(record, Design | Estimate) and not is_pressed:
            write_optional("the video", lambda: _add_video(folder, record, system))
        return sorted(pictures_of(record).keys() - usual(record).keys() - ON_REQUEST)

    return remarks, draw


def _write_data(
    folder: Path, record: ShownRecord, system: System | None, further: Mapping[str, object]
) -> list[str]:
    """Write the data of a result, and the models that it identifies."""
    archive.write_data(folder, record, system, further)
    if system is None or not isinstance(record, Estimate):
        return []

    clear_samples(folder)
    try:
        remarks = write_identified(folder / IDENTIFIED, system, record.theta, record)
    except ModelError as error:
        remarks = [str(error)]
    draws = record.draws
    if draws is not None:
        begin_stage("writing the models of the drawn robots")
        write_optional(
            "the drawn robots",
            lambda: remarks.extend(write_samples(folder, draws, record.theta, system)),
        )
    return remarks


def _write_log(file: Path, record: Design | Estimate, system: System) -> None:
    """Write the Rerun file of a result that holds a motion."""
    labels = labels_of_system(system)
    if isinstance(record, Design):
        from mjfim.output.film import robots_beside

        beside = robots_beside(system, record)
        rerun_log.log_design(file, system.model_at(system.theta), record, labels, beside)
    elif record.motion is not None:
        from mjfim.identification.aligned_recording import measured_trajectory

        end = float(record.motion.t[-1])
        measured = measured_trajectory(system, record.recordings[0], end)
        model = system.model_at(record.theta)
        rerun_log.log_estimate(file, model, record, measured, record.motion, labels)


def _add_video(folder: Path, record: Design | Estimate, system: System) -> None:
    """Write the report once more, with its video or with the sentence why there is none."""
    begin_stage("drawing the video of the report")
    video, sentence = report_video(system, record)
    write_report(folder, record, Media(video, sentence))


def _write_figures(
    folder: Path,
    record: ShownRecord,
    picture_format: PictureFormat,
    drawn: Callable[[], dict[str, bytes]],
) -> None:
    """Write all pictures of a result, which another process may have drawn."""
    contents = {}
    write_optional("the pictures", lambda: contents.update(drawn()))
    if contents:
        _clear_other_formats(folder, contents, picture_format)
        for name, content in contents.items():
            with replacing(folder / picture_format.file_of(name)) as temporary:
                temporary.write_bytes(content)
        return

    # Matplotlib takes seconds to import, which nobody waits for who has pressed Ctrl-C twice.
    pictures = {}
    write_optional("the pictures", lambda: pictures.update(usual(record)))
    write_pictures(folder, pictures, picture_format)


def missing_pictures(folder: Path) -> Pictures:
    """List the pictures of the results in a folder that are not there, in whatever format.

    A picture that is older than the data of its result shows those of an earlier run.

    Args:
        folder: Folder of results.

    Returns:
        Functions that draw, by name of the picture.

    Raises:
        RecordingError: The folder holds no result that has a report, or one cannot be read.
    """
    drawn: dict[str, int] = {}
    for path in folder.iterdir():
        if path.suffix[1:] in set(PictureFormat):
            drawn[path.stem] = max(drawn.get(path.stem, 0), path.stat().st_mtime_ns)

    # Pictures of two results may have the same name; the later result has written it.
    written = {
        kind: (folder / f"{kind.file_stem}.npz").stat().st_mtime_ns for kind in kinds_in(folder)
    }
    wanted: dict[str, tuple[int, Callable[[], Picture]]] = {}
    for kind, time in sorted(written.items(), key=lambda each: each[1]):
        wanted |= {name: (time, draw) for name, draw in pictures_of(kind.load(folder)).items()}
    return {name: draw for name, (time, draw) in wanted.items() if drawn.get(name, 0) < time}


def write_pictures(folder: Path, pictures: Pictures, picture_format: PictureFormat) -> list[Path]:
    """Draw pictures and write them; those of an earlier run in another format are removed.

    Args:
        folder: Folder for the results.
        pictures: Functions that draw, by name of the picture.
        picture_format: Format of the pictures.

    Returns:
        The files.
    """

    def write(make: Callable[[], Picture], file: Path) -> None:
        from mjfim.output.plots.draw import save  # imports matplotlib, which is slow

        save(make(), file)

    _clear_other_formats(folder, pictures, picture_format)
    files = {name: folder / picture_format.file_of(name) for name in pictures}
    for name, draw in pictures.items():
        write_optional(files[name].name, partial(write, draw, files[name]))
    return [file for file in files.values() if file.is_file()]


def _clear_other_formats(
    folder: Path, names: Collection[str], picture_format: PictureFormat
) -> None:
    """Remove pictures of an earlier run in other formats."""
    others = "|".join(other for other in PictureFormat if other is not picture_format)
    clear(folder, rf"({'|'.join(re.escape(name) for name in names)})\.({others})")


def clear(folder: Path, names: str) -> None:
    """Remove the files that an earlier run wrote, by the pattern of their names.

    Files of the user that have such a name remain.

    Args:
        folder: The folder.
        names: Regular expression for whole names.
    """
    for stale in matching(folder, names):
        remove_earlier_result(stale)
