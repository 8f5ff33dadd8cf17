"""Fits of recordings by `mujoco.sysid`, beside the estimate of mjfim.

sysid fits twice: weighted by the noise that the experiment states, and unweighted, where each
signal counts relative to the norm of its measured values.
"""

from __future__ import annotations

import io
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mujoco import sysid

from mjfim.arrays import Array
from mjfim.experiment.system import System
from mjfim.files import replacing, write_json
from mjfim.identification.identify import identify_system
from mjfim.output.summary_parts import Cell, Name, Row, Summary, SummaryTable, columns
from mjfim.output.sysid.sequences import Exported, build, export, silenced
from mjfim.output.vocabulary import NOMINAL
from mjfim.records.estimate import Estimate
from mjfim.records.events import Callback, begin_stage
from mjfim.records.trajectory import Recording

# Largest number of iterations of a fit by sysid.
MAX_ITERATIONS = 200


@dataclass(frozen=True, eq=False, kw_only=True)
class SysidFit:
    """A fit by sysid.

    Attributes:
        theta: (p,) parameters [theta-unit].
        chi2: Sum of squared residuals at theta, whitened by the stated noise.
        seconds: Time of the fit [s].
        status: Last message of sysid about the end of the fit.
        parameters: `ParameterDict` at the optimum, for the report.
        result: `OptimizeResult`, for the report.
    """

    theta: Array
    chi2: float
    seconds: float
    status: str
    parameters: Any
    result: Any


@dataclass(frozen=True, eq=False, kw_only=True)
class SysidComparison:
    """Estimates of mjfim and of sysid from one set of recordings.

    Attributes:
        exported: The experiment in the types of sysid.
        estimate: Estimate of mjfim.
        weighted: Fit by sysid, weighted by the stated noise.
        unweighted: Fit by sysid with its default weights.
    """

    exported: Exported
    estimate: Estimate
    weighted: SysidFit
    unweighted: SysidFit

    @property
    def warnings(self) -> tuple[str, ...]:
        """Settings that sysid does not take, and warnings of the estimate."""
        return (*self.exported.notes, *self.estimate.warnings)

    def summary(self) -> dict[str, Any]:
        """Return the contents of comparison.json."""
        estimate, parameters = self.estimate, self.exported.system.parameters
        return {
            "parameters": list(estimate.parameters),
            "units": list(self.exported.system.units),
            "true": [p.true for p in parameters.parameters],
            "start": estimate.initial_theta,
            "recordings": [r.name for r in estimate.recordings],
            "dof": estimate.dof,
            "mjfim": {
                "theta": estimate.theta,
                "std": estimate.std,
                "interval": estimate.interval,
                "chi2": estimate.chi2,
                "seconds": estimate.seconds,
                "status": estimate.status,
                "misfit": estimate.misfit,
            },
            "sysid_weighted": _fit_summary(self.weighted),
            "sysid_default": _fit_summary(self.unweighted),
            "notes": list(self.exported.notes),
        }


def _fit_summary(fit: SysidFit) -> dict[str, Any]:
    """Return the entry of one fit in comparison.json."""
    return {"theta": fit.theta, "chi2": fit.chi2, "seconds": fit.seconds, "status": fit.status}


def compare_with_sysid(
    system: System, recordings: Sequence[Recording], callback: Callback | None = None
) -> SysidComparison:
    """Fit recordings with mjfim, and twice with sysid.

    Args:
        system: The experiment.
        recordings: Its recordings.
        callback: Called with the events of mjfim's estimation.

    Raises:
        MjfimError: sysid cannot express the problem, or is not installed.
    """
    begin_stage("translating the experiment for mujoco.sysid")
    exported = export(system, recordings)
    estimate = identify_system(system, recordings, callback=callback)

    begin_stage("fitting with mujoco.sysid, weighted by the noise (1 of 2)")
    weighted = fit_with_sysid(exported, weighted=True)
    begin_stage("fitting with mujoco.sysid, default weights (2 of 2)")
    unweighted = fit_with_sysid(exported, weighted=False)
    return SysidComparison(
        exported=exported, estimate=estimate, weighted=weighted, unweighted=unweighted
    )


def fit_with_sysid(exported: Exported, weighted: bool) -> SysidFit:
    """Fit with the optimiser of sysid, from the guess.

    Args:
        exported: The experiment in the types of sysid.
        weighted: True for residuals that are whitened by the stated noise.
    """
    messages, clock = io.StringIO(), time.perf_counter()
    with silenced():
        parameters, result = sysid.optimize(
            exported.parameters,
            exported.residual(weighted),
            verbose=False,
            max_iters=MAX_ITERATIONS,
            output=messages,
        )
    seconds = time.perf_counter() - clock

    theta = np.array(parameters.as_vector())
    lines = [line for line in messages.getvalue().splitlines() if line.startswith("Terminated")]
    return SysidFit(
        theta=theta,
        chi2=chi2(exported, theta),
        seconds=seconds,
        status=lines[-1] if lines else "",
        parameters=parameters,
        result=result,
    )


def chi2(exported: Exported, theta: Array) -> float:
    """Return the sum of squared residuals of the recordings, whitened by the stated noise.

    Args:
        exported: The experiment in the types of sysid.
        theta: (p,) parameters [theta-unit].
    """
    with silenced():
        residuals, _, _ = exported.residual(weighted=True)(theta, exported.parameters.copy())

    # The residuals of the priors come last and do not count.
    count = len(exported.sequences.measured_rollout)
    return float(sum(np.sum(r**2) for r in residuals[:count]))


def report(exported: Exported, fit: SysidFit) -> str:
    """Return the HTML report of sysid.

    Args:
        exported: The experiment in the types of sysid.
        fit: The weighted fit.
    """
    return str(
        sysid.default_report(
            [exported.sequences],
            exported.parameters,
            fit.parameters,
            exported.residual(weighted=True),
            fit.result,
            title=f"{exported.sequences.name}: mujoco.sysid, weighted by the stated noise",
            build_model=build,
            generate_videos=False,
        ).build()
    )


def describe_sysid_comparison(comparison: SysidComparison) -> Summary:
    """Describe both estimators, parameter by parameter.

    Args:
        comparison: The comparison.
    """
    estimate = comparison.estimate
    fits = (comparison.weighted, comparison.unweighted)
    rows = []
    for j, p in enumerate(comparison.exported.system.parameters.parameters):
        low, high = estimate.interval[j]
        cells: tuple[Cell, ...] = (
            Name(name=p.name, unit=p.unit),
            "-" if p.true is None else f"{p.true:.4g}",
            f"{estimate.initial_theta[j]:.4g}",
            f"{estimate.theta[j]:.5g}",
            f"{estimate.std[j]:.2g}",
            f"{low:.4g}",
            f"{high:.4g}",
            *(f"{fit.theta[j]:.5g}" for fit in fits),
        )
        rows.append(Row(cells=cells))

    table = SummaryTable(
        key="estimators",
        title="Estimates from these recordings by mjfim and by mujoco.sysid",
        columns=columns(
            "parameter",
            "true",
            NOMINAL.word,
            "mjfim",
            "formal σ",
            "95 % low",
            "high",
            "sysid, weighted",
            "sysid, default",
            details=["95 % low", "high"],
            optional=["true", NOMINAL.word, "formal σ"],
        ),
        rows=tuple(rows),
    )
    found = (
        ("mjfim", estimate.chi2, estimate.seconds),
        ("sysid, weighted", fits[0].chi2, fits[0].seconds),
        ("sysid, default", fits[1].chi2, fits[1].seconds),
    )
    quality = SummaryTable(
        key="fits",
        title="Squared residuals relative to the stated noise, and the time of each fit",
        columns=columns("fit", "χ²", "time"),
        rows=tuple(
            Row(cells=(title, f"{squares:.6g}", f"{seconds:.2f} s"))
            for title, squares, seconds in found
        ),
    )
    return Summary(title="mjfim and mujoco.sysid", outcome="", parts=(table, quality))


def write_sysid_comparison(folder: Path, comparison: SysidComparison) -> None:
    """Write comparison.json, and sysid_report.html of the weighted fit.

    Args:
        folder: Folder for the results.
        comparison: The comparison.
    """
    page = report(comparison.exported, comparison.weighted)
    write_json(folder / "comparison.json", comparison.summary())
    with replacing(folder / "sysid_report.html") as temporary:
        temporary.write_text(page, encoding="utf-8")
