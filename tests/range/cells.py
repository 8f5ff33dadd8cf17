"""Cells of the matrix: what check, design, simulate and identify say, and whether it is true."""

from __future__ import annotations

import tempfile
import time
import traceback
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import mjfim
from mjfim.errors import MjfimError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System
from mjfim.records.design import Status
from tests.range.plants import PLANTS, Setting, Study
from tests.range.truth import information, relative_change

# Relative error of the information that is claimed without a warning.
TOLERANCE = 0.02

# Error of an estimate [standard deviations], and of chi^2 [its standard deviations].
MAX_ERROR = 4.5


@dataclass(kw_only=True)
class Verdict:
    """How a verb ended.

    Attributes:
        verb: "check", "design" or "identify".
        word: "works", "said", or "WRONG".
        detail: The sentence that was said, or what is wrong.
        seconds: Duration [s].
    """

    verb: str
    word: str
    detail: str
    seconds: float = 0.0


@dataclass(kw_only=True)
class Cell:
    """A plant in a setting.

    Attributes:
        plant: Its name in PLANTS.
        setting: Integrator, timestep, masses and horizon.
        verbs: What is tried.
        verdicts: How each verb ended.
    """

    plant: str
    setting: Setting
    verbs: tuple[str, ...] = ("check", "design", "identify")
    verdicts: list[Verdict] = field(default_factory=list)

    def __str__(self) -> str:
        return f"{self.plant}, {self.setting}"


def run(cell: Cell) -> Cell:
    """Run the verbs of a cell, and judge what they say."""
    study = PLANTS[cell.plant](cell.setting)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "plant.xml").write_text(study.xml, encoding="utf-8")
        experiment = mjfim.Experiment(
            model="plant.xml", **study.tables, directory=folder, source="range.toml"
        )
        for verb in cell.verbs:
            cell.verdicts.append(_judged(verb, experiment, study, cell.setting))
    return cell


def _judged(verb: str, experiment: Any, study: Study, setting: Setting) -> Verdict:
    """Run a verb; an error of the package is something that was said."""
    begun = time.perf_counter()
    try:
        verdict = VERBS[verb](experiment, study, setting)
    except MjfimError as error:
        verdict = Verdict(verb=verb, word="said", detail=f"refused: {error}")
    except Exception:
        verdict = Verdict(verb=verb, word="WRONG", detail=traceback.format_exc())
    return replace(verdict, seconds=time.perf_counter() - begun)


def _claim(
    verb: str, claimed: Any, said: str, study: Study, ctrl: Any, setting: Setting
) -> Verdict:
    """Compare a claimed information matrix with that of plain MuJoCo."""
    true = information(study.xml, study.tables, ctrl, setting.substeps)
    values = np.array([entry["true"] for entry in study.tables["parameters"].values()])
    relative = claimed * np.outer(values, values)
    error = relative_change(relative, true.matrix)

    about = f"information differs by {error:.1e} from plain MuJoCo (known to {true.error:.1e})"
    if true.warning:
        about = f"plain MuJoCo warns {true.warning}"
    if said:
        return Verdict(verb=verb, word="said", detail=f"{said} [{about}]")
    good = error <= TOLERANCE + 3.0 * true.error and true.error < 0.1
    return Verdict(verb=verb, word="works" if good else "WRONG", detail=about)


def _check(experiment: Any, study: Study, setting: Setting) -> Verdict:
    """Check the initial control."""
    checked = mjfim.check(experiment, threads=1)
    system = System.resolve(experiment, threads=1)
    tested = checked.self_test
    said = ""
    if not tested.passed:
        said = next(s for s in checked.findings if "not smooth" in s or "derivatives" in s)
    ctrl = DesignTask.of(system).initial.ctrl
    return _claim("check", checked.information, said, study, ctrl, setting)


def _design(experiment: Any, study: Study, setting: Setting) -> Verdict:
    """Design with few iterations."""
    design = mjfim.design(experiment, threads=1)
    said = "; ".join(design.warnings)
    if design.status not in (Status.MAX_ITERATIONS, Status.CONVERGED):
        said = "; ".join(filter(None, (design.status.value, said)))
    verdict = _claim(
        "design", design.final.information, said, study, design.final.trajectory.ctrl, setting
    )
    gain = design.initial.cost / design.final.cost
    return replace(verdict, detail=f"J {gain:.2f} times smaller; {verdict.detail}")


def _identify(experiment: Any, study: Study, setting: Setting) -> Verdict:
    """Simulate the initial control at the truth, and fit from a guess that is 10 % off."""
    system = System.resolve(experiment, threads=1)
    trajectory = DesignTask.of(system).initial
    recording = mjfim.simulate(experiment, trajectory, seed=1, threads=1)
    estimate = mjfim.identify(experiment, [recording], threads=1)

    true = np.array([entry["true"] for entry in study.tables["parameters"].values()])
    errors = np.abs(estimate.theta - true) / estimate.std
    worst = float(np.nanmax(errors)) if np.isfinite(errors).any() else np.inf
    excess = float((estimate.chi2 / estimate.dof - 1.0) / np.sqrt(2.0 / estimate.dof))
    relative = estimate.std / np.abs(true)
    about = (
        f"{worst:.1f} sigma from the truth, chi2/dof {estimate.chi2 / estimate.dof:.3f}, "
        f"sigma {relative.min():.1e} to {relative.max():.1e} of the value, {estimate.status}"
    )
    if estimate.misfit or not estimate.converged or estimate.warnings:
        said = "; ".join((*estimate.warnings, "" if estimate.converged else estimate.status))
        return Verdict(verb="identify", word="said", detail=f"{said} [{about}]")
    good = worst < MAX_ERROR and abs(excess) < MAX_ERROR
    return Verdict(verb="identify", word="works" if good else "WRONG", detail=about)


VERBS = {"check": _check, "design": _design, "identify": _identify}
