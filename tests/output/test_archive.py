"""Files are read back as they were written, are never incomplete, and are never unpickled."""

from __future__ import annotations

import csv
import errno
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mjfim.errors import RecordingError
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import simulate_system
from mjfim.files import PREFIX, as_json, replacing
from mjfim.output import archive
from mjfim.output.plots import draw
from mjfim.output.rerun import log_design
from mjfim.recordings import read as logs
from mjfim.records.design import MAX_MOTIONS, MOTION_SAMPLES, Design
from mjfim.records.trajectory import Recording
from tests.support import results
from tests.support.cart_pendulum import cart_pendulum
from tests.support.paths import MODELS

Array = NDArray[np.float64]

N, NQ, NV, NU, P = 40, 2, 2, 1, 3


@pytest.fixture(scope="module")
def task() -> DesignTask:
    """The cart-pendulum for 0.4 s, measured at every second sample."""
    tables = {"horizon": 0.4, "measure_rate": 50.0, "descent": {"max_iterations": 2}}
    return DesignTask.resolve(cart_pendulum(**tables, rehearsal={"robots": 4}))


@pytest.fixture(scope="module")
def design(task: DesignTask) -> Design:
    """A design after two iterations."""
    return design_task(task)


@pytest.fixture(scope="module")
def folder(task: DesignTask, design: Design, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with design.json, design.npz and design.csv of the design."""
    home = tmp_path_factory.mktemp("design") / "new" / "folder"
    archive.write_data(home, design, task.system)
    return home


@pytest.fixture(scope="module")
def recording(task: DesignTask, design: Design) -> Recording:
    """A noisy recording along the design."""
    return simulate_system(task.system, design.trajectory, seed=4)


def strict_json(text: str) -> dict[str, Any]:
    """Parse standard JSON, which knows neither NaN nor Infinity."""
    found: dict[str, Any] = json.loads(text, parse_constant=pytest.fail)
    return found


# ---- designs


def test_npz_holds_the_documented_arrays(folder: Path, design: Design) -> None:
    """Names and shapes of the arrays, for the designed and the initial trajectory."""
    with np.load(folder / "design.npz", allow_pickle=False) as data:
        shapes = {key: data[key].shape for key in data.files}
        kinds = {data[key].dtype for key in data.files if key != "record"}
        psi = data["initial_sensitivity"]
    m = shapes["motions.iteration"][0]
    assert 2 <= m <= MAX_MOTIONS
    expected: dict[str, tuple[int, ...]] = {
        **{"theta": (P,), "sizes": (P,), "prior": (P, P), "data": (P, P)},
        **{"motions.qpos": (m, MOTION_SAMPLES, NQ), "rehearsal.theta": (5, P)},
        **{"labels.wanted": (P,), "valley.theta": (2, P), "valley.motion.y": (2, N + 1)},
    }
    for name, prefix in (("final", ""), ("initial", "initial_")):
        expected |= {
            f"{prefix}t": (N + 1,),
            f"{prefix}qpos": (N + 1, NQ),
            f"{prefix}qvel": (N + 1, NV),
            f"{prefix}act": (N + 1, 0),
            f"{prefix}ctrl": (N, NU),
            f"{prefix}gain": (N, NU, 2 * NV),
            f"{prefix}sensitivity": (N + 1, 2 * NV, P),
            f"{name}.information": (P, P),
            f"{name}.eigenvalues": (P,),
            f"{name}.std": (P,),
            f"{name}.std_over_time": (N + 1, P),
        }
    assert {key: shapes[key] for key in expected} == expected
    assert kinds == {np.dtype("float64")}
    assert np.array_equal(psi, design.initial.sensitivity)


def test_trajectories_are_read_as_they_were(
    folder: Path, design: Design, task: DesignTask, tmp_path: Path
) -> None:
    """Every number is read back exactly; the initial trajectory is optional."""
    named = archive.read_design(folder / "design.npz", task.system)
    stated = {"initial": design.initial.trajectory, "final": design.trajectory}
    assert named.keys() == stated.keys()
    for name, curve in stated.items():
        for key in ("t", "qpos", "qvel", "act", "ctrl"):
            assert np.array_equal(getattr(named[name], key), getattr(curve, key)), (name, key)
    path = altered(folder / "design.npz", tmp_path / "alone.npz", initial_t=None)
    assert set(archive.read_design(path, task.system)) == {"final"}


def test_json_holds_the_documented_keys(folder: Path, design: Design) -> None:
    """Keys of design.json and the numbers of the record; the path of the experiment is relative."""
    data = strict_json((folder / "design.json").read_text(encoding="utf-8"))
    assert (data["status"], data["iterations"]) == ("max_iterations", 2)
    assert (data["steps"], data["slope"]) == (design.steps, design.slope)
    assert (data["parameters"], data["theta"]) == (["m", "l", "c"], [2.0, 1.0, 1.0])
    assert data["limits"]["satisfied"] is True
    for name, evaluation in (("initial", design.initial), ("final", design.final)):
        part = data[name]
        assert (part["cost"], part["criterion"]) == (evaluation.cost, evaluation.criterion)
        assert np.array_equal(part["information"], evaluation.information)
        assert part["eigenvalues"] == sorted(part["eigenvalues"])
        covariance = np.linalg.inv(evaluation.information)
        assert part["std"] == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-9)
    assert (folder / data["experiment"]).resolve() == MODELS / "cart_pendulum.toml"


def test_json_names_nuisance_parameters_and_priors_and_has_no_nan() -> None:
    """Infinite and undefined numbers become null.

    The prior, which the information contains, is written so that it can be subtracted.
    """
    prior = np.diag([4.0, 0.0, 0.0])
    made = results.design(nuisance=("damping",), prior=prior, slope=float("nan"))
    blank = replace(made.final, std=np.array([np.inf, np.nan, 1.0]), cost=np.inf)
    data = strict_json(as_json(replace(made, final=blank).summary()))
    assert (data["nuisance"], data["prior"]) == (["damping"], prior.tolist())
    assert data["final"]["std"] == [None, None, 1.0]
    assert (data["final"]["cost"], data["slope"]) == (None, None)


def test_csv_plays_back(folder: Path, design: Design, task: DesignTask) -> None:
    """It can be the initial control of a design, and has all digits."""
    file = str((folder / "design.csv").resolve())
    again = DesignTask.resolve(task.experiment.replace(initial={"control": file}))
    assert np.array_equal(again.control, design.trajectory.ctrl)


# ---- designs that are not


def altered(source: Path, path: Path, **arrays: Any) -> Path:
    """Copy a design.npz with some arrays replaced; None leaves an array out."""
    with np.load(source, allow_pickle=False) as data:
        kept = {**data, **arrays}
    np.savez(path, **{key: value for key, value in kept.items() if value is not None})
    return path


@pytest.mark.parametrize(
    ("name", "array", "said"),
    [
        ("ctrl", None, "array 'ctrl' is missing; a design holds t, qpos, .*ctrl"),
        ("ctrl", np.zeros(N), ""),
        ("ctrl", np.full((N, NU), "strong"), ""),
        ("ctrl", np.zeros((0, NU)), ""),
        ("ctrl", np.full((N, NU), np.nan), ""),
        ("qpos", np.zeros((5, NQ)), ""),
        ("t", np.zeros(N + 1), ""),
        ("t", np.linspace(1.0, 0.0, N + 1), ""),
        ("t", np.linspace(0.0, 1.0, N + 1) ** 2, ""),
        ("t", np.linspace(0.0, 0.8, N + 1), "sampled at 50 Hz, the experiment at 100 Hz"),
    ],
)
def test_wrong_arrays_are_refused(
    folder: Path, tmp_path: Path, task: DesignTask, name: str, array: Array | None, said: str
) -> None:
    """Arrays that do not fit are refused before they are simulated or drawn."""
    path = altered(folder / "design.npz", tmp_path / "odd.npz", **{name: array})
    with pytest.raises(RecordingError, match=rf"odd\.npz: .*{said}"):
        archive.read_design(path, task.system)


# ---- whole or not at all


def test_replacing_replaces(tmp_path: Path) -> None:
    """Folders are made; the temporary file keeps the ending, which some writers check.

    The permissions of results are those of any new file.
    """
    path = tmp_path / "a" / "b" / "x.csv"
    for text in ("old", "new"):
        with replacing(path) as temporary:
            assert (temporary.parent, temporary.suffix) == (path.parent, ".csv")
            temporary.write_text(text, encoding="utf-8")
        assert path.read_text(encoding="utf-8") == text
    assert [p.name for p in path.parent.iterdir()] == ["x.csv"]
    (tmp_path / "plain").touch()
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("fault", ["full", "missing", "stopped"])
def test_replacing_keeps_the_old_file(fault: str, tmp_path: Path) -> None:
    """After a failure the old file is complete and no temporary file remains.

    The error of a full disk names no file, that of a missing file names the temporary one.
    """
    path = tmp_path / "x.json"
    path.write_text("old", encoding="utf-8")

    def write() -> None:
        with replacing(path) as temporary:
            temporary.write_text("half", encoding="utf-8")
            raise {
                "full": OSError(errno.ENOSPC, "no space"),
                "missing": OSError(errno.ENOENT, "no file", str(temporary)),
                "stopped": KeyboardInterrupt(),
            }[fault]

    with pytest.raises((OSError, KeyboardInterrupt)) as caught:
        write()
    assert getattr(caught.value, "filename", str(path)) == str(path)
    assert path.read_text(encoding="utf-8") == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["x.json"]


def test_files_of_killed_processes_are_removed_and_new_ones_stay(tmp_path: Path) -> None:
    kept = {f"{PREFIX}{os.getpid()}-a.png", ".histogram_a.png"}
    old = tmp_path / f"{PREFIX}17-x8.png"
    for path in (old, *(tmp_path / name for name in kept)):
        path.touch()
    os.utime(old, (0.0, 0.0))
    with replacing(tmp_path / "x.json") as temporary:
        assert temporary.name.startswith(PREFIX)
    assert {path.name for path in tmp_path.iterdir()} == {"x.json", *kept}


def half_written(*args: Any, **kwargs: Any) -> None:
    """Write a few bytes to a path or a stream, then fail."""
    for place in args:
        if isinstance(place, Path):
            place.write_bytes(b"half")
        elif hasattr(place, "write"):
            place.write(b"half")
    raise OSError("no space left on device")


def write_all(folder: Path, design: Design, task: DesignTask) -> None:
    """Write a design, a picture and a view of it."""
    archive.write_data(folder, replace(design, seconds=1.0), task.system)
    draw.save(Figure(), folder / "accuracy.png")
    log_design(folder / "design.rrd", task.system.model, design, design.labels)


@pytest.mark.parametrize(
    ("where", "name"),
    [
        ("numpy.savez_compressed", "design.npz"),
        ("pyarrow.csv.write_csv", "design.csv"),
        ("pathlib.Path.write_text", "design.json"),
        ("mjfim.output.plots.draw.content", "accuracy.png"),
        ("mjfim.output.rerun.documents.log_series", "design.rrd"),
    ],
)
def test_failing_disk_keeps_the_old_files(
    where: str, name: str, folder: Path, design: Design, task: DesignTask, tmp_path: Path
) -> None:
    """The file at which the disk fails is completely old, and no temporary file stays."""
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    for written_later in ("accuracy.png", "design.rrd"):
        (copy / written_later).write_bytes(b"old")
    before = {path.name: path.read_bytes() for path in copy.iterdir()}
    with patch(where, half_written), pytest.raises(OSError, match="no space"):
        write_all(copy, design, task)
    assert {path.name for path in copy.iterdir()} == set(before)
    assert (copy / name).read_bytes() == before[name]


# ---- recordings


def test_recording_round_trip(recording: Recording, task: DesignTask, tmp_path: Path) -> None:
    """Numbers have full precision; fields without a measurement are empty."""
    path = tmp_path / "recording.csv"
    extreme = np.array([5e-324, 1e-300, 0.1 + 0.2, -1.2345678901234567e150])
    y = np.array(recording.y)
    y[0] = extreme
    recording = replace(recording, y=y)
    archive.write_recording(path, recording, task.system)
    text = path.read_text(encoding="utf-8")
    assert next(csv.reader(text.splitlines())) == ["t", "ctrl:force", *task.system.outputs.names]
    assert "nan" not in text.lower()
    again = logs.read_recording(path, task.system.channels)
    for name in ("t", "ctrl", "y"):
        assert np.array_equal(getattr(again, name), getattr(recording, name), equal_nan=True)
    assert (again.outputs, again.name) == (recording.outputs, str(path))
    assert np.isnan(recording.y[1::2]).all()
    assert np.isfinite(recording.y[::2]).all()
