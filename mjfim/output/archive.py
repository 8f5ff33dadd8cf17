"""Results on disk: design.json/npz/csv, estimate.json, montecarlo.json, recordings as CSV. No pickles."""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv

from mjfim.arrays import Array
from mjfim.atomic_io import replacing
from mjfim.errors import RecordingError
from mjfim.experiment.system import Setup
from mjfim.output.playback import design_columns, reference_columns, simulate_playback
from mjfim.records.check import Check
from mjfim.records.combinations import ParameterGroup
from mjfim.records.comparison import Comparison, MethodResult
from mjfim.records.design import Design, Evaluation
from mjfim.records.estimate import Estimate, MissingTerm, Prediction, PredictionErrors
from mjfim.records.monte_carlo import MonteCarloStudy
from mjfim.records.recording import Recording
from mjfim.records.trajectory import Trajectory

ARRAYS = ("t", "qpos", "qvel", "act", "ctrl", "gain", "sensitivity")


def as_json(values: Mapping[str, Any]) -> str:
    """Readable JSON; non-finite numbers become null, as JSON has no name for them."""
    return json.dumps(_plain(values), indent=2, allow_nan=False) + "\n"


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """A JSON file."""
    with replacing(path) as temporary:
        temporary.write_text(as_json(values), encoding="utf-8")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value


def design_summary(design: Design) -> dict[str, Any]:
    """Contents of design.json."""
    return {
        "status": design.status.name.lower(),
        "message": design.status.value,
        "iterations": design.history[-1].iteration if design.history else 0,
        "seconds": design.seconds,
        "slope": design.slope,
        "steps": design.steps,
        "parameters": list(design.parameters),
        "theta": design.theta,
        "initial": _evaluation(design.initial),
        "final": _evaluation(design.final),
        "limits": {
            "margins": design.limits,
            "satisfied": all(m >= 0.0 for m in design.limits.values()),
        },
        "found_by": design.found_by,
        "starts": [
            {
                "name": s.name,
                "cost": s.cost,
                "status": s.status.name.lower(),
                "iterations": s.iterations,
            }
            for s in design.starts
        ],
        "warnings": list(design.warnings),
        "nuisance": list(design.nuisance),
        "combinations": list(design.combinations),
        "combined": [
            {
                "words": c.expression,
                "value": c.value,
                "std_initial": c.std_initial,
                "std_final": c.std_final,
            }
            for c in design.combined
        ],
        "prior": design.prior,
        "data": design.data,
    }


def _evaluation(e: Evaluation) -> dict[str, Any]:
    return {
        "cost": e.cost,
        "criterion": e.criterion,
        "growth": e.growth,
        "information": e.information,
        "eigenvalues": e.eigenvalues,
        "std": e.std,
    }


def write_design(folder: Path, design: Design, setup: Setup) -> None:
    """design.json, design.npz, design.csv and reference.csv."""
    played = simulate_playback(setup, design.trajectory, design.final.gain)
    arrays: dict[str, Array] = {}
    for prefix, e in (("", design.final), ("initial_", design.initial)):
        own = {
            **{n: getattr(e.trajectory, n) for n in ARRAYS[:5]},
            "gain": e.gain,
            "sensitivity": e.sensitivity,
        }
        arrays.update({prefix + name: value for name, value in own.items()})
    with replacing(folder / "design.npz") as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)
    write_table(folder / "design.csv", design_columns(played, setup))
    write_table(folder / "reference.csv", reference_columns(played, setup))
    source = Path(setup.experiment.source)
    experiment = os.path.relpath(source.resolve(), folder.resolve()) if source.is_file() else None
    write_json(folder / "design.json", {"experiment": experiment, **design_summary(design)})


def _controls(ctrl: Array, names: tuple[str, ...]) -> dict[str, Array]:
    """One column per actuator; the last sample has no control."""
    padded = np.concatenate([ctrl, np.full((1, ctrl.shape[1]), np.nan)])
    return {f"ctrl:{name}": padded[:, i] for i, name in enumerate(names)}


def write_table(path: Path, columns: Mapping[str, Array]) -> None:
    """CSV with full precision; NaN is an empty field."""
    arrays = {name: pyarrow.array(np.asarray(v), from_pandas=True) for name, v in columns.items()}
    with replacing(path) as temporary:
        options = pyarrow.csv.WriteOptions(quoting_style="none")
        pyarrow.csv.write_csv(pyarrow.table(arrays), temporary, options)


def read_design(path: Path) -> dict[str, Trajectory]:
    """Trajectories of a design.npz by name, `initial` and `final`. Raises RecordingError; never unpickles."""
    if not path.is_file():
        raise RecordingError(f"{path}: no such design file")
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
    except (
        ValueError,
        OSError,
        EOFError,
        AttributeError,
        TypeError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        reason = (
            "it is not NumPy's, or holds pickles, which are refused"
            if "pickle" in str(error)
            else str(error)
        )
        raise RecordingError(
            f"{path}: not a design archive (npz without pickles): {reason}"
        ) from None
    found = {}
    for name, prefix in (("initial", "initial_"), ("final", "")):
        missing = [prefix + key for key in ARRAYS[:5] if prefix + key not in arrays]
        if not missing:
            found[name] = _trajectory(path, prefix, arrays)
        elif name == "final":
            raise RecordingError(
                f"{path}: array {missing[0]!r} is missing; a design holds {', '.join(ARRAYS)}"
            )
    return found


def _trajectory(path: Path, prefix: str, arrays: Mapping[str, Array]) -> Trajectory:
    """A trajectory whose arrays are numbers and fit each other."""
    rows = len(arrays[prefix + "t"]) if arrays[prefix + "t"].ndim == 1 else 0
    if rows < 3:
        raise RecordingError(f"{path}: array '{prefix}t' must be a row of at least 3 times")
    for key in ARRAYS[:5]:
        array, wanted = arrays[prefix + key], rows - 1 if key == "ctrl" else rows
        if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
            raise RecordingError(f"{path}: array '{prefix}{key}' must hold finite numbers only")
        if array.ndim != (1 if key == "t" else 2) or len(array) != wanted:
            shape = f"({wanted},)" if key == "t" else f"({wanted}, columns)"
            raise RecordingError(
                f"{path}: array '{prefix}{key}' has shape {array.shape}, wanted {shape}"
            )
    return Trajectory(**{key: arrays[prefix + key] for key in ARRAYS[:5]})


def write_control(path: Path, control: Array, setup: Setup) -> None:
    """A control: (N, nu) as a table that `initial.control` reads."""
    columns = {"t": setup.t, **{name: control[:, i] for i, name in enumerate(setup.controls)}}
    write_table(path, columns)


def check_fits(path: Path, trajectory: Trajectory, setup: Setup) -> None:
    """Raise RecordingError where a design belongs to another model or rate."""
    wanted = (setup.model.nq, setup.model.nv, len(setup.controls))
    got = (trajectory.qpos.shape[1], trajectory.qvel.shape[1], trajectory.ctrl.shape[1])
    if got != wanted:
        raise RecordingError(
            f"{path}: made for (nq, nv, nu) = {got}, the experiment's model has {wanted}"
        )
    if abs(trajectory.dt - setup.dt) > 1e-6 * setup.dt:
        raise RecordingError(
            f"{path}: sampled at {1 / trajectory.dt:g} Hz, the experiment at {1 / setup.dt:g} Hz"
        )


def write_recording(path: Path, recording: Recording, setup: Setup) -> None:
    """A recording as CSV: t, ctrl:<actuator>, and its outputs (empty where not measured)."""
    columns = {"t": recording.t, **_controls(recording.ctrl, setup.controls)}
    columns.update({name: recording.y[:, i] for i, name in enumerate(recording.outputs)})
    write_table(path, columns)


def estimate_summary(estimate: Estimate, setup: Setup) -> dict[str, Any]:
    """Contents of estimate.json."""
    return {
        "parameters": list(estimate.parameters),
        "units": list(setup.units),
        "theta": estimate.theta,
        "std": estimate.std,
        "covariance": estimate.covariance,
        "initial_theta": estimate.initial_theta,
        "chi2": estimate.chi2,
        "dof": estimate.dof,
        "status": estimate.status,
        "success": estimate.success,
        "interrupted": estimate.interrupted,
        "iterations": estimate.iterations,
        "residual_rms": estimate.residual_rms,
        "sigma": estimate.sigma,
        "misfit": estimate.misfit,
        "reasons": list(estimate.reasons),
        "worst": None if estimate.worst_residual is None else vars(estimate.worst_residual),
        "whiteness": [vars(w) for w in estimate.whiteness],
        "per_recording": estimate.per_recording,
        "suspects": [_missing_term(term) for term in estimate.missing_terms],
        "std_sandwich": estimate.std_sandwich,
        "interval": estimate.interval,
        "between_recordings": estimate.between_recordings,
        "predictions": [
            {
                "name": p.name,
                "held_out": p.held_out,
                **{key: _by_output(own, values) for key, own, values in _errors(p)},
                "ratio": p.ratio,
            }
            for p in estimate.predictions
        ],
        "seconds": estimate.seconds,
        "steps": estimate.steps,
        "sloppy": list(estimate.sloppy),
        "at_bound": list(estimate.at_bound),
        "recordings": [r.name for r in estimate.recordings],
        "warnings": list(estimate.warnings),
        "prior": setup.parameters.prior_information,
        "data": estimate.data,
        "combinations": list(estimate.combinations),
    }


def _missing_term(term: MissingTerm) -> dict[str, Any]:
    """Contents of one entry of `suspects`."""
    return {
        "words": term.description,
        "path": term.path,
        "value": term.value,
        "unit": term.unit,
        "sigmas": term.sigmas,
        "share": term.share,
    }


def _errors(p: Prediction) -> list[tuple[str, PredictionErrors, Array]]:
    """Names of errors, and where they are."""
    own, plain = p.identified, p.nominal
    pairs = [("rms", own, own.rms), ("mae", own, own.mae), ("nominal_rms", plain, plain.rms)]
    return [*pairs, ("nominal_mae", plain, plain.mae)]


def _by_output(errors: PredictionErrors, values: Array) -> dict[str, float]:
    return dict(zip(errors.outputs, values.tolist(), strict=True))


def study_summary(study: MonteCarloStudy) -> dict[str, Any]:
    """Contents of montecarlo.json."""
    summary: dict[str, Any] = {
        "parameters": list(study.parameters),
        "theta": study.theta,
        "measure_rate": study.measure_rate,
    }
    for name, s in study.sets.items():
        summary[name] = {
            "mean": s.mean,
            "covariance": s.covariance,
            "crlb": s.crlb,
            "efficiency": s.efficiency,
            "efficiency_interval": s.efficiency_interval,
            "information": study.information[name],
            "trials": s.trials,
            "failed": s.failed,
            "seconds": s.seconds,
        }
    return summary


def check_summary(check: Check) -> dict[str, Any]:
    """Contents of check.json."""
    rough = check.self_test.roughness
    return {
        "ok": check.ok,
        "verdict": list(check.verdict),
        "source": check.source,
        "horizon": check.horizon,
        "parameters": [
            {
                "name": row.name,
                "unit": row.unit,
                "value": row.value,
                "size": row.size,
                "nuisance": row.nuisance,
                "std": row.std,
                "relative": row.relative,
                "wanted": row.wanted,
                "repetitions": row.repetitions,
                "seconds": row.seconds,
            }
            for row in check.rows
        ],
        "eigenvalues": check.eigenvalues,
        "condition": check.condition,
        "information": check.information,
        "wanted": list(check.wanted),
        "correlation": check.correlation,
        "confounded": [
            {"a": p.first, "b": p.second, "correlation": p.correlation} for p in check.confounded
        ],
        "combinations": [_group(g) for g in check.not_separable],
        "combined": [
            {"words": c.expression, "value": c.value, "std": c.std_final} for c in check.combined
        ],
        "not_excited": [_group(g) for g in check.not_excited],
        "self_test": {
            "passed": check.self_test.passed,
            "recursion": check.self_test.recursion,
            "slope": check.self_test.slope,
            "suspect": check.self_test.likely_cause,
            "rough": None
            if rough is None
            else {
                "error": rough.error,
                "parameter": rough.parameter,
                "sample": rough.sample,
                "time": rough.time,
                "causes": list(rough.causes),
            },
        },
    }


def comparison_summary(comparison: Comparison) -> dict[str, Any]:
    """Contents of compare.json."""
    return {
        "ok": comparison.ok,
        "verdict": list(comparison.verdict),
        "interrupted": comparison.interrupted,
        "criterion": comparison.criterion,
        "budget": {"seconds": comparison.seconds, "steps": comparison.steps},
        "seed": comparison.seed,
        "parameters": list(comparison.parameters),
        "units": list(comparison.units),
        "scale": comparison.scale,
        "nuisance": list(comparison.nuisance),
        "best": None if comparison.best is None else comparison.best.method,
        "beating": [row.method for row in comparison.beating],
        "methods": [_compared(row) for row in comparison.rows],
    }


def _compared(row: MethodResult) -> dict[str, Any]:
    return {
        "method": row.method,
        "title": row.title,
        "outcome": row.outcome.name.lower(),
        "message": row.outcome.value,
        "cost": row.cost,
        "criterion": row.criterion,
        "smallest_eigenvalue": row.smallest,
        "worst_relative_sigma": row.worst,
        "std": row.std,
        "seconds": row.seconds,
        "steps": row.steps,
        "limits": {"margins": row.margins, "shares": row.shares},
        "found_by": row.found_by,
        "note": row.note,
    }


def _group(group: ParameterGroup) -> dict[str, Any]:
    return {
        "members": list(group.members),
        "identifiable": [
            dict(zip(c.members, c.coefficients, strict=True)) for c in group.combinations
        ],
        "words": str(group),
    }
