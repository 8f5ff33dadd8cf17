"""Where results may be written, and where earlier ones are found."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

from mjfim.errors import ModelError, RecordingError
from mjfim.experiment.system import Setup
from mjfim.identification.aligned_recording import measured_trajectory
from mjfim.output import archive, plots
from mjfim.output import rerun as rerun_log
from mjfim.output.labels import Labels
from mjfim.output.mjcf.write import write_identified
from mjfim.records.check import Check
from mjfim.records.comparison import Comparison
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.monte_carlo import MonteCarloStudy


def recording_of(source: Path) -> Path:
    """The .rrd that a folder or file names."""
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


def experiment_beside(source: Path) -> Path:
    """Experiment file that the design.json beside an npz names."""
    beside = source.parent / "design.json"
    try:
        named = json.loads(beside.read_text(encoding="utf-8"))["experiment"]
        return source.parent.resolve() / str(Path(named))
    except (OSError, ValueError, KeyError, TypeError):
        raise RecordingError(
            f"{source}: no usable design.json beside it; name the experiment with --experiment"
        ) from None


def check_folder(folder: Path) -> None:
    """Fail before the work, not after it, where results cannot be written."""
    existing = next(p for p in (folder, *folder.absolute().parents) if p.exists())
    if not existing.is_dir():
        raise RecordingError(f"{existing}: is a file; -o needs a folder")
    if not os.access(existing, os.W_OK):
        raise RecordingError(f"{existing}: no permission to write here")


def check_file(path: Path) -> None:
    """Fail before the work where a file cannot be written."""
    if path.is_dir():
        raise RecordingError(f"{path}: is a folder; -o and --save need a file here")
    check_folder(path.parent)


def leave_design(folder: Path, design: Design, setup: Setup) -> None:
    """design.json, design.npz, design.csv, design.rrd and pictures."""
    archive.write_design(folder, design, setup)
    labels = Labels.of_system(setup)
    for name, figure in (
        ("trajectories", plots.trajectories(design, labels)),
        ("sensitivity_phase", plots.sensitivity_phase(design, labels)),
        ("convergence", plots.convergence(design)),
        ("standard_deviations", plots.std_bars(design, labels)),
        ("table_eigenvalues", plots.design_table(design, labels)),
        *((("limits", plots.limits(design)),) if design.usage else ()),
    ):
        plots.save(figure, folder / f"{name}.png")
    rerun_log.log_design(folder / "design.rrd", setup.model_at(setup.theta), design, labels)


def leave_check(folder: Path, check: Check) -> None:
    """check.json and a picture: accuracies and correlations."""
    archive.write_json(folder / "check.json", archive.check_summary(check))
    plots.save(plots.check_figure(check), folder / "check.png")


def leave_comparison(folder: Path, comparison: Comparison, setup: Setup) -> None:
    """compare.json, a picture, and the control that each method found, `initial.control` of a later experiment."""
    _clear(folder, r"control_[\w-]+\.csv")
    archive.write_json(folder / "compare.json", archive.comparison_summary(comparison))
    for row in comparison.rows:
        if row.control is not None:
            archive.write_control(folder / f"control_{row.method}.csv", row.control, setup)
    plots.save(plots.compare_figure(comparison), folder / "compare.png")


def leave_estimate(folder: Path, estimate: Estimate, setup: Setup) -> list[str]:
    """estimate.json, identified.xml, estimate.rrd and pictures; returns sentences about what is not as it should be."""
    _clear(folder, r"fit(_\d+)?\.png|identified\.xml|predictions\.png")
    archive.write_json(folder / "estimate.json", archive.estimate_summary(estimate, setup))
    missing = []
    try:
        said = write_identified(folder / "identified.xml", setup, estimate.theta)
        missing += [said] if said else []
    except ModelError as error:
        missing.append(str(error))
    labels = Labels.of_system(setup)
    for i in range(len(estimate.recordings)):
        name = "fit.png" if len(estimate.recordings) == 1 else f"fit_{i + 1}.png"
        plots.save(plots.fit(estimate, i, labels, list(estimate.sigma.values())), folder / name)
    plots.save(plots.parameter_intervals(estimate, labels), folder / "parameters.png")
    plots.save(plots.residual_spectra(estimate, labels), folder / "spectra.png")
    if estimate.predictions:
        plots.save(plots.predictions(estimate, labels), folder / "predictions.png")
    if estimate.motion is not None:
        measured, model = (
            measured_trajectory(setup, estimate.recordings[0]),
            setup.model_at(estimate.theta),
        )
        rerun_log.log_estimate(
            folder / "estimate.rrd", model, estimate, measured, estimate.motion, labels
        )
    return missing


def leave_study(folder: Path, study: MonteCarloStudy, setup: Setup) -> None:
    """montecarlo.json, a histogram per parameter, the tables."""
    archive.write_json(folder / "montecarlo.json", archive.study_summary(study))
    labels = Labels.of_system(setup)
    for i, name in enumerate(study.parameters):
        safe = re.sub(r"[^\w.-]", "_", name)
        plots.save(plots.histogram(study, i, labels), folder / f"histogram_{safe}.png")
    plots.save(plots.study_table(study, labels), folder / "table_covariance.png")


def _clear(folder: Path, names: str) -> None:
    """Remove what an earlier run could have left, by the exact names."""
    for stale in list(folder.iterdir()):
        if re.fullmatch(names, stale.name):
            stale.unlink()
