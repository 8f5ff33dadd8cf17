"""Files are read back as they were written, are never incomplete, and are never unpickled."""

from __future__ import annotations

import csv
import dataclasses
import errno
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

import mjfim
from mjfim.errors import ModelError, RecordingError
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.simulate import simulate_system
from mjfim.files import PREFIX, as_json, replacing
from mjfim.identification.identify import identify_system
from mjfim.output import archive
from mjfim.output.models.mjcf import write_identified
from mjfim.recordings import read as logs
from mjfim.records.design import MAX_MOTIONS, MOTION_SAMPLES, Design
from mjfim.records.trajectory import Recording, Trajectory
from mjfim.studies.monte_carlo import monte_carlo_system
from tests.support.paths import MODELS

Array = NDArray[np.float64]

N, NQ, NV, NU, P = 40, 2, 2, 1, 3


@pytest.fixture(scope="module")
def task() -> DesignTask:
    """The cart-pendulum for 0.4 s, measured at every second sample."""
    e = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
    return DesignTask.resolve(
        e.replace(horizon=0.4, measure_rate=50.0, descent={"max_iterations": 2})
    )


@pytest.fixture(scope="module")
def design(task: DesignTask) -> Design:
    """A design after two iterations."""
    return design_task(task)


@pytest.fixture(scope="module")
def folder(task: DesignTask, design: Design, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with design.json, design.npz and design.csv of the design."""
    home = tmp_path_factory.mktemp("design") / "new" / "folder"
    archive.write_design(home, design, task.system)
    return home


@pytest.fixture(scope="module")
def recording(task: DesignTask, design: Design) -> Recording:
    """A noisy recording along the design."""
    return simulate_system(task.system, design.trajectory, seed=4)


def refuse_constant(name: str) -> float:
    """Refuse NaN and Infinity, which are not JSON."""
    raise AssertionError(f"{name} is not JSON")


def strict_json(text: str) -> dict[str, Any]:
    """Parse standard JSON only."""
    found: dict[str, Any] = json.loads(text, parse_constant=refuse_constant)
    return found


# ---- designs


def test_npz_holds_the_documented_arrays(folder: Path, design: Design) -> None:
    """Names and shapes of all arrays, for the designed and the initial trajectory."""
    with np.load(folder / "design.npz", allow_pickle=False) as data:
        shapes = {key: data[key].shape for key in data.files}
        motions = {key for key in data.files if key.startswith("motions.")}
        kinds = {data[key].dtype for key in {*data.files} - motions - {"record"}}
        kinds_of_motions = {data[key].dtype for key in motions}
        psi = data["initial_sensitivity"]
    known = {
        "t": (N + 1,),
        "qpos": (N + 1, NQ),
        "qvel": (N + 1, NV),
        "act": (N + 1, 0),
        "ctrl": (N, NU),
        "gain": (N, NU, 2 * NV),
        "sensitivity": (N + 1, 2 * NV, P),
    }
    further = {"information": (P, P), "eigenvalues": (P,), "std": (P,), "min_eigenvalue": (N + 1,)}
    m = shapes["motions.iteration"][0]
    moving = {"t": (), "qpos": (NQ,), "ctrl": (NU,)}
    assert 2 <= m <= MAX_MOTIONS
    assert shapes == {
        **known,
        "motions.iteration": (m,),
        **{f"motions.{key}": (m, MOTION_SAMPLES, *size) for key, size in moving.items()},
        **{f"initial_{key}": shape for key, shape in known.items()},
        **{f"final.{key}": shape for key, shape in further.items()},
        **{f"initial.{key}": shape for key, shape in further.items()},
        **{"theta": (P,), "sizes": (P,), "prior": (P, P), "data": (P, P)},
        "record": (),
    }
    assert kinds == {np.dtype("float64")}
    assert kinds_of_motions == {np.dtype("float64")}
    assert np.array_equal(psi, design.initial.sensitivity)


def test_npz_round_trip(folder: Path, design: Design) -> None:
    """Every number is read back exactly."""
    named = archive.read_design(folder / "design.npz")
    assert set(named) == {"initial", "final"}
    for name, evaluation in (("initial", design.initial), ("final", design.final)):
        for key in ("t", "qpos", "qvel", "act", "ctrl"):
            assert np.array_equal(getattr(named[name], key), getattr(evaluation.trajectory, key)), (
                name,
                key,
            )
    assert np.abs(named["final"].ctrl - named["initial"].ctrl).max() > 1e-3


def test_json_holds_the_documented_keys(folder: Path, design: Design) -> None:
    """Keys of design.json and the numbers of the record."""
    data = strict_json((folder / "design.json").read_text(encoding="utf-8"))
    wanted = {
        "status",
        "iterations",
        "seconds",
        "slope",
        "steps",
        "parameters",
        "theta",
        "initial",
        "final",
        "limits",
    }
    assert wanted <= set(data)
    assert (data["status"], data["iterations"], data["steps"]) == (
        "max_iterations",
        2,
        design.steps,
    )
    assert (data["parameters"], data["theta"]) == (["m", "l", "c"], [2.0, 1.0, 1.0])
    assert data["limits"]["satisfied"] is True
    for name, evaluation in (("initial", design.initial), ("final", design.final)):
        part = data[name]
        assert {"cost", "information", "eigenvalues", "std", "criterion"} <= set(part)
        assert part["cost"] == evaluation.cost
        assert np.array_equal(part["information"], evaluation.information)
        assert part["eigenvalues"] == sorted(part["eigenvalues"])
        assert part["std"] == pytest.approx(
            np.sqrt(np.diag(np.linalg.inv(evaluation.information))), rel=1e-9
        )
    assert data["final"]["cost"] < data["initial"]["cost"]
    assert (data["nuisance"], data["combinations"], data["prior"]) == (
        [],
        [],
        np.zeros((P, P)).tolist(),
    )


def test_json_names_nuisance_parameters_and_priors(tmp_path: Path) -> None:
    """The information contains the prior, which is also written so that it can be subtracted."""
    e = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
    table = {"m": {"prior": 0.5}, "c": {"nuisance": True}}
    known = DesignTask.resolve(
        e.replace(
            horizon=0.4,
            parameters=table,
            nuisance={"delay": 0.1, "initial": 0.2},
            descent={"max_iterations": 0},
        )
    )
    archive.write_design(tmp_path, design_task(known), known.system)
    data = strict_json((tmp_path / "design.json").read_text(encoding="utf-8"))
    starts = [
        "initial qpos:slide",
        "initial qpos:hinge",
        "initial qvel:slide",
        "initial qvel:hinge",
    ]
    assert data["parameters"] == ["m", "l", "c", *starts, "delay"]
    assert data["nuisance"] == ["c", *starts, "delay"]
    assert np.allclose(
        data["prior"], np.diag([4.0, 0.0, 0.0, *[25.0] * 4, 100.0]), rtol=1e-12, atol=0
    )
    left = np.array(data["final"]["information"]) - np.array(data["prior"])
    assert np.linalg.eigvalsh(left)[0] > -1e-8 * np.linalg.eigvalsh(left)[-1]


def test_csv_plays_back(folder: Path, design: Design, task: DesignTask) -> None:
    """design.csv has all digits and named columns, and can be the initial control of a design."""
    with (folder / "design.csv").open(newline="", encoding="utf-8") as stream:
        (*header, note), *rows = csv.reader(stream)
    states = ["qpos:slide", "qpos:hinge", "qvel:slide", "qvel:hinge"]
    assert note.startswith("note: gains are for")
    assert header == ["t", *states, "ctrl:force", *(f"gain:force:{name}" for name in states)]
    assert len(rows) == N + 1
    assert rows[-1][5] == ""
    curve = design.trajectory
    assert [float(row[2]) for row in rows] == curve.qpos[:, 1].tolist()
    assert [float(row[5]) for row in rows[:-1]] == curve.ctrl[:, 0].tolist()
    again = DesignTask.resolve(
        task.experiment.replace(initial={"control": str((folder / "design.csv").resolve())})
    )
    assert np.array_equal(again.control, curve.ctrl)


def test_json_names_its_experiment(folder: Path) -> None:
    """The path of the experiment is relative to the folder of the results."""
    data = strict_json((folder / "design.json").read_text(encoding="utf-8"))
    assert (folder / data["experiment"]).resolve() == MODELS / "cart_pendulum.toml"


def test_json_has_no_nan(design: Design) -> None:
    """Infinite and undefined numbers become null."""
    blank = dataclasses.replace(
        design.final,
        std=np.array([np.inf, np.nan, 1.0]),
        cost=float("inf"),
        information=np.full((3, 3), np.nan),
    )
    text = as_json(dataclasses.replace(design, final=blank, slope=float("nan")).summary())
    data = strict_json(text)
    assert data["final"]["std"] == [None, None, 1.0]
    assert (data["final"]["cost"], data["slope"]) == (None, None)
    assert data["final"]["information"] == [[None] * 3] * 3


def test_unsatisfied_limits_are_named(design: Design) -> None:
    """One negative margin makes a limit unsatisfied."""
    outside = dataclasses.replace(design, limits={"position": 0.5, "control": -0.1})
    said = outside.summary()["limits"]
    assert (said["margins"], said["satisfied"]) == ({"position": 0.5, "control": -0.1}, False)


# ---- designs that are not


def altered(source: Path, path: Path, **arrays: Any) -> Path:
    """Copy a design.npz with some arrays replaced; None leaves an array out."""
    with np.load(source, allow_pickle=False) as data:
        kept = {key: data[key] for key in data.files}
    np.savez(path, **{key: value for key, value in {**kept, **arrays}.items() if value is not None})
    return path


class Trap:
    """An object that records that it was unpickled."""

    sprung = False

    def __reduce__(self) -> tuple[Callable[[], None], tuple[()]]:
        return spring, ()


def spring() -> None:
    """Record that code from the file was run."""
    Trap.sprung = True


def test_pickles_are_refused(folder: Path, tmp_path: Path) -> None:
    """An array of objects is refused before it is unpickled."""
    path = altered(
        folder / "design.npz", tmp_path / "hostile.npz", qpos=np.array([Trap()], dtype=object)
    )
    with pytest.raises(RecordingError, match=r"hostile\.npz: not a design archive"):
        archive.read_design(path)
    assert not Trap.sprung
    with np.load(path, allow_pickle=True) as data:  # the trap works
        assert data["qpos"].shape == (1,)
    assert Trap.sprung


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # NumPy leaves the file open
def test_truncated_archives_are_refused(folder: Path, tmp_path: Path, share: float) -> None:
    """A file is refused at whatever place it was cut off."""
    data = (folder / "design.npz").read_bytes()
    path = tmp_path / "torn.npz"
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(RecordingError, match=r"torn\.npz: not a design archive"):
        archive.read_design(path)


def test_corrupt_archives_are_refused(folder: Path, tmp_path: Path) -> None:
    """Changed bytes inside an array are detected."""
    data = bytearray((folder / "design.npz").read_bytes())
    data[2000:2100] = bytes(b ^ 0x55 for b in data[2000:2100])
    (tmp_path / "rotten.npz").write_bytes(data)
    with pytest.raises(RecordingError, match=r"rotten\.npz: not a design archive"):
        archive.read_design(tmp_path / "rotten.npz")


def test_other_files_are_refused(tmp_path: Path) -> None:
    """A missing file, a folder, and a file that is no archive are refused."""
    with pytest.raises(RecordingError, match=r"gone\.npz: no such design file"):
        archive.read_design(tmp_path / "gone.npz")
    with pytest.raises(RecordingError, match=r"this is a folder; name the design file \(\.npz\)"):
        archive.read_design(tmp_path)
    (tmp_path / "text.npz").write_text("hello", encoding="utf-8")
    with pytest.raises(RecordingError, match=r"text\.npz: not a design archive"):
        archive.read_design(tmp_path / "text.npz")


def test_missing_arrays_are_named(folder: Path, tmp_path: Path) -> None:
    """The message also names all arrays of a design."""
    path = altered(folder / "design.npz", tmp_path / "poor.npz", ctrl=None)
    with pytest.raises(
        RecordingError, match=r"poor\.npz: array 'ctrl' is missing; a design holds t, qpos, .*ctrl"
    ):
        archive.read_design(path)


def test_a_design_without_an_initial_trajectory(folder: Path, tmp_path: Path) -> None:
    """The arrays of the initial trajectory are optional."""
    path = altered(folder / "design.npz", tmp_path / "alone.npz", initial_t=None)
    assert set(archive.read_design(path)) == {"final"}


@pytest.mark.parametrize(
    "arrays",
    [
        {"ctrl": np.zeros(N)},
        {"ctrl": np.full((N, NU), "strong")},
        {"ctrl": np.zeros((0, NU))},
        {"ctrl": np.full((N, NU), np.nan)},
        {"qpos": np.zeros((5, NQ))},
        {"t": np.zeros(N + 1)},
        {"t": np.linspace(1.0, 0.0, N + 1)},
        {"t": np.linspace(0.0, 1.0, N + 1) ** 2},
    ],
    ids=["flat", "text", "no-rows", "nan", "too-short", "standing", "backward", "uneven"],
)
def test_wrong_arrays_are_refused(
    folder: Path, tmp_path: Path, task: DesignTask, arrays: dict[str, Array]
) -> None:
    """Arrays that do not fit are refused before they are simulated or drawn."""
    path = altered(folder / "design.npz", tmp_path / "odd.npz", **arrays)
    with pytest.raises(RecordingError, match=r"odd\.npz: "):
        archive.check_fits(path, archive.read_design(path)["final"], task.system)


@pytest.mark.parametrize("kind", ["empty", "bare"])
def test_not_an_archive(tmp_path: Path, kind: str) -> None:
    """An empty file and a single array with the name of an archive are refused."""
    path = tmp_path / "odd.npz"
    with path.open("wb") as stream:
        if kind == "bare":
            np.save(stream, np.zeros(3))
    with pytest.raises(RecordingError, match=r"odd\.npz: not a design archive"):
        archive.read_design(path)


def test_designs_of_other_experiments_are_refused(folder: Path, task: DesignTask) -> None:
    """A design of another model or another rate is refused."""
    path, curve = folder / "design.npz", archive.read_design(folder / "design.npz")["final"]
    archive.check_fits(path, curve, task.system)
    wide = Trajectory(
        t=curve.t,
        qpos=np.zeros((N + 1, 3)),
        qvel=np.zeros((N + 1, 3)),
        act=curve.act,
        ctrl=curve.ctrl,
    )
    with pytest.raises(
        RecordingError,
        match=r"design\.npz: made for \(nq, nv, nu\) = \(3, 3, 1\), .* has \(2, 2, 1\)",
    ):
        archive.check_fits(path, wide, task.system)
    slow = Trajectory(
        t=2 * curve.t, qpos=curve.qpos, qvel=curve.qvel, act=curve.act, ctrl=curve.ctrl
    )
    with pytest.raises(
        RecordingError, match=r"design\.npz: sampled at 50 Hz, the experiment at 100 Hz"
    ):
        archive.check_fits(path, slow, task.system)


# ---- whole or not at all


def test_replacing_replaces(tmp_path: Path) -> None:
    """Folders are made; the temporary file keeps the ending, which some writers check."""
    path = tmp_path / "a" / "b" / "x.csv"
    for text in ("old", "new"):
        with replacing(path) as temporary:
            assert (temporary.parent, temporary.suffix) == (path.parent, ".csv")
            temporary.write_text(text, encoding="utf-8")
        assert path.read_text(encoding="utf-8") == text
    assert [p.name for p in path.parent.iterdir()] == ["x.csv"]


@pytest.mark.parametrize("full", [True, False])
def test_an_error_while_writing_names_the_file(full: bool, tmp_path: Path) -> None:
    """The error of a full disk names no file, that of a missing file names the temporary one."""
    path = tmp_path / "x.json"

    def write() -> None:
        """Fail while the file is written."""
        with replacing(path) as temporary:
            if full:
                raise OSError(errno.ENOSPC, "No space left on device")
            temporary.unlink()
            temporary.open(encoding="utf-8").close()

    with pytest.raises(OSError, match="No s") as caught:
        write()
    assert caught.value.filename == str(path)


def test_files_of_killed_processes_are_removed_and_those_of_others_stay(tmp_path: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    kept = {
        f"{PREFIX}{os.getpid()}-a.png",
        f".mjfim-another-{ended.pid}-a.png",
        f"{PREFIX}notes.txt",
        ".histogram_a.png",
    }
    for name in (f"{PREFIX}{ended.pid}-x8.png", *kept):
        (tmp_path / name).touch()
    with replacing(tmp_path / "x.json") as temporary:
        assert temporary.name.startswith(PREFIX)
    assert {path.name for path in tmp_path.iterdir()} == {"x.json", *kept}


@pytest.mark.parametrize("interruption", [OSError, KeyboardInterrupt])
def test_replacing_keeps_the_old_file(tmp_path: Path, interruption: type[BaseException]) -> None:
    """After a failure the old file is complete and no temporary file remains."""
    path = tmp_path / "x.json"
    path.write_text("old", encoding="utf-8")

    def write() -> None:
        with replacing(path) as temporary:
            temporary.write_text("half", encoding="utf-8")
            raise interruption

    with pytest.raises(interruption):
        write()
    assert path.read_text(encoding="utf-8") == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["x.json"]


def test_files_obey_the_umask(tmp_path: Path) -> None:
    """The permissions of results are those of any new file."""
    (tmp_path / "plain").touch()
    with replacing(tmp_path / "x.json"):
        pass
    assert (tmp_path / "x.json").stat().st_mode == (tmp_path / "plain").stat().st_mode


def half_written(*args: Any, **kwargs: Any) -> None:
    """Write a few bytes to a path or a stream, then fail."""
    for place in args:
        if isinstance(place, Path):
            place.write_bytes(b"half")
        elif hasattr(place, "write"):
            place.write(b"half")
    raise OSError("no space left on device")


@pytest.mark.parametrize(
    "where", ["numpy.savez_compressed", "pyarrow.csv.write_csv", "pathlib.Path.write_text"]
)
def test_failing_disk_keeps_the_old_design(
    where: str,
    folder: Path,
    design: Design,
    task: DesignTask,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each of the three files is completely old or completely new."""
    shutil.copytree(folder, tmp_path / "copy")
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    with monkeypatch.context() as patch:
        patch.setattr(where, half_written)
        with pytest.raises(OSError, match="no space"):
            archive.write_design(
                tmp_path / "copy", dataclasses.replace(design, seconds=1.0), task.system
            )
    after = {p.name for p in (tmp_path / "copy").iterdir()}
    assert after == set(before)
    assert archive.read_design(tmp_path / "copy" / "design.npz").keys() == {"initial", "final"}
    assert (tmp_path / "copy" / "design.csv").read_bytes() == before["design.csv"]
    assert (tmp_path / "copy" / "design.json").read_bytes() == before["design.json"]


# ---- recordings


def test_recording_round_trip(recording: Recording, task: DesignTask, tmp_path: Path) -> None:
    """Numbers have full precision; fields without a measurement are empty."""
    path = tmp_path / "recording.csv"
    archive.write_recording(path, recording, task.system)
    again = logs.read_recording(path, task.system.channels)
    assert np.array_equal(again.t, recording.t)
    assert np.array_equal(again.ctrl, recording.ctrl)
    assert np.array_equal(again.y, recording.y, equal_nan=True)
    assert (again.outputs, again.name) == (recording.outputs, str(path))
    assert np.isnan(recording.y[1::2]).all()
    assert np.isfinite(recording.y[::2]).all()


def test_recording_columns(recording: Recording, task: DesignTask, tmp_path: Path) -> None:
    """Columns are t, controls and outputs; the file contains no word for NaN."""
    path = tmp_path / "recording.csv"
    archive.write_recording(path, recording, task.system)
    text = path.read_text(encoding="utf-8")
    assert next(csv.reader(text.splitlines())) == ["t", "ctrl:force", *task.system.outputs.names]
    assert "nan" not in text.lower()


def test_extreme_numbers_survive(task: DesignTask, tmp_path: Path) -> None:
    """Numbers of the smallest and of the largest accepted magnitude are read back exactly."""
    values = np.array([5e-324, 1e-300, 0.1 + 0.2, -1.2345678901234567e150])
    r = Recording(
        t=np.arange(4) * 0.01, ctrl=values[:3, None], y=values[:, None], outputs=("qpos:slide",)
    )
    archive.write_recording(tmp_path / "r.csv", r, task.system)
    assert np.array_equal(logs.read_recording(tmp_path / "r.csv", task.system.channels).y, r.y)


def test_foreign_recording(task: DesignTask, tmp_path: Path) -> None:
    """A recording may hold some outputs in any order, and no last control."""
    path = tmp_path / "lab.csv"
    path.write_text(
        "qpos:hinge,t,ctrl:force\n3.1,0,1\n3.2,0.01,2\n,0.02,3\n3.4,0.03,\n", encoding="utf-8"
    )
    r = logs.read_recording(path, task.system.channels)
    assert (r.outputs, r.ctrl.tolist()) == (("qpos:hinge",), [[1.0], [2.0], [3.0]])
    assert np.array_equal(r.y[:, 0], [3.1, 3.2, np.nan, 3.4], equal_nan=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,qpos:slide\n0,1\n0.01,1\n0.02,1\n", r"'ctrl:force' is missing; found: t, qpos:slide"),
        ("ctrl:force,qpos:slide\n0,1\n1,1\n1,1\n", r"'t' is missing"),
        ("t,ctrl:force\n0,1\n0.01,1\n0.02,1\n", r"no measured column; .*qpos:hinge, qpos:slide"),
        ("t,ctrl:force,qpos:slid\n0,1,1\n0.01,1,1\n0.02,1,1\n", r".*'qpos:slid'.*'qpos:slide'"),
        ("t,ctrl:force,qpos:slide\n0,1,1\n0.01,1,1\n", r"too few rows \(2\)"),
        ("t,ctrl:force,qpos:slide\n0,1,1\n,1,1\n0.02,1,1\n", r"'t' holds NaN in data row 2"),
        (
            "t,ctrl:force,qpos:slide\n0,1,1\n0.01,1,high\n0.02,1,1\n",
            r"column 'qpos:slide' is not numeric",
        ),
        ("", r"the file is empty"),
    ],
)
def test_unusable_recordings(text: str, message: str, task: DesignTask, tmp_path: Path) -> None:
    """The message names file, column and fault."""
    path = tmp_path / "lab.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(RecordingError, match=rf"lab\.csv: .*{message}"):
        logs.read_recording(path, task.system.channels)


def test_misspelled_output_is_not_ignored(task: DesignTask, tmp_path: Path) -> None:
    """An ignored column would be lost data."""
    path = tmp_path / "lab.csv"
    path.write_text(
        "t,ctrl:force,qpos:slide,qpos:hing\n0,1,1,3\n0.01,1,1,3\n0.02,1,1,3\n", encoding="utf-8"
    )
    with pytest.raises(RecordingError, match=r"'qpos:hing'.*'qpos:hinge'"):
        logs.read_recording(path, task.system.channels)


# ---- identified.xml

VALUES = np.array([2.3456789, 1.2345678, 0.7654321])

# Entries of MjModel that the three parameters of the cart-pendulum set; the rest MuJoCo derives
# from them.
IDENTIFIED = {
    "body_mass": [(3,)],
    "body_pos": [(3, 2)],
    "geom_pos": [(2, 2)],
    "geom_size": [(2, 1)],
    "dof_damping": [(1,)],
}
DERIVED = {
    "actuator_acc0",
    "body_invweight0",
    "body_subtreemass",
    "dof_M0",
    "dof_invweight0",
    "dof_length",
    "geom_aabb",
    "geom_rbound",
    "light_poscom0",
}


def arrays(model: mujoco.MjModel) -> dict[str, Array]:
    """All numeric arrays of a model."""
    found = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    return {
        name: np.array(value, dtype=np.float64)
        for name, value in found.items()
        if isinstance(value, np.ndarray) and value.dtype.kind in "biuf"
    }


def changes(new: mujoco.MjModel, old: mujoco.MjModel) -> dict[str, list[tuple[int, ...]]]:
    """Indices at which two models of one structure differ by more than the six digits that MuJoCo
    prints.
    """
    left, right = arrays(new), arrays(old)
    assert {name: value.shape for name, value in left.items()} == {
        name: value.shape for name, value in right.items()
    }
    far = {
        n: np.argwhere(~np.isclose(left[n], right[n], rtol=1e-5, atol=1e-6 * (n != "opt")))
        for n in left
    }
    return {name: [tuple(map(int, row)) for row in rows] for name, rows in far.items() if len(rows)}


def load(path: Path) -> mujoco.MjModel:
    """Load a model from its file, like a user."""
    return mujoco.MjModel.from_xml_path(str(path))


def test_identified_model_differs_in_the_identified_values_only(
    task: DesignTask, tmp_path: Path
) -> None:
    """All entries of the MjModel are compared."""
    path = tmp_path / "deep" / "identified.xml"
    write_identified(path, task.system, VALUES)
    found = changes(load(path), task.system.model)
    assert {name: rows for name, rows in found.items() if name not in DERIVED} == IDENTIFIED
    model = load(path)
    written = [
        model.body_mass[3],
        model.body_pos[3, 2],
        model.dof_damping[1],
        2 * model.geom_size[2, 1],
    ]
    assert written == pytest.approx([VALUES[0], VALUES[1], VALUES[2], VALUES[1]], rel=1e-5)


def test_identified_model_is_the_model_that_was_fitted(task: DesignTask, tmp_path: Path) -> None:
    """The compiled file agrees with the simulated model, also in derived constants."""
    path = tmp_path / "identified.xml"
    write_identified(path, task.system, VALUES)
    assert changes(load(path), task.system.model_at(VALUES)) == {}


def test_original_model_is_untouched(task: DesignTask, tmp_path: Path) -> None:
    """The original model does not change, neither in memory nor on disk."""
    source = (MODELS / "cart_pendulum.xml").read_bytes()
    write_identified(tmp_path / "identified.xml", task.system, VALUES)
    assert changes(task.system.model, load(MODELS / "cart_pendulum.xml")) == {}
    assert changes(task.system.source.spec.copy().compile(), task.system.model) == {}
    assert (MODELS / "cart_pendulum.xml").read_bytes() == source


MESH = "v 0 0 0\nv 0.2 0 0\nv 0 0.3 0\nv 0 0 0.4\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
MESH_MODEL = """
<mujoco>
  <compiler angle="radian"{meshdir}/>
  <asset><mesh name="tetra" file="{file}"/></asset>
  <worldbody>
    <body name="arm">
      <joint name="j" axis="0 1 0" damping="0.5"/>
      <geom name="shell" type="mesh" mesh="tetra" pos="0.1 0 0" density="500"/>
    </body>
    <body name="other" pos="1 0 0"><joint name="k"/><geom size=".1"/></body>
  </worldbody>
  <actuator><motor name="u" joint="j"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize(
    ("meshdir", "place", "file"),
    [
        (' meshdir="../assets"', "assets", "tetra.obj"),
        (' meshdir="parts"', "model/parts", "tetra.obj"),
        ("", "model", "tetra.obj"),
        ("", "model/deep", "deep/tetra.obj"),
    ],
    ids=["beside", "below", "same", "in-the-file-name"],
)
@pytest.mark.parametrize("target", ["body/arm:mass", "joint/j:damping"])
def test_meshes_are_found_from_another_folder(
    meshdir: str,
    place: str,
    file: str,
    target: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """identified.xml is in another folder, and the path of the experiment is relative."""
    for name in ("model", place):
        (tmp_path / name).mkdir(exist_ok=True, parents=True)
    (tmp_path / place / "tetra.obj").write_text(MESH, encoding="utf-8")
    text = MESH_MODEL.format(meshdir=meshdir, file=file)
    (tmp_path / "model" / "arm.xml").write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    e = mjfim.Experiment(
        model="arm.xml",
        rate=100.0,
        horizon=0.1,
        initial={"control": {"kind": "sine"}},
        parameters={"p": {"target": target}},
        noise={"state": 0.1},
        directory=Path("model"),
    )
    task = DesignTask.resolve(e)
    value = 1.5 * task.parameters.guess
    write_identified(Path("results/run 1/identified.xml"), task.system, value)
    model = load(tmp_path / "results" / "run 1" / "identified.xml")
    original = load(tmp_path / "model" / "arm.xml")
    assert model.nmeshvert == 4
    assert np.array_equal(model.mesh_vert, original.mesh_vert)
    assert changes(model, task.system.model_at(value)) == {}
    changed = {name for name in changes(model, original) if name not in DERIVED | {"stat"}}
    assert changed == ({"body_mass"} if target == "body/arm:mass" else {"dof_damping"})


def test_failing_model_keeps_the_old_file(task: DesignTask, tmp_path: Path) -> None:
    """A negative mass is named, and no invalid model is written."""
    path = tmp_path / "identified.xml"
    write_identified(path, task.system, VALUES)
    before = path.read_bytes()
    with pytest.raises(ModelError, match="mass"):
        write_identified(path, task.system, np.array([-1.0, 1.0, 1.0]))
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["identified.xml"]


# ---- estimates and studies


def test_estimate_summary(task: DesignTask, recording: Recording) -> None:
    """estimate.json has the documented keys and is standard JSON."""
    estimate = identify_system(task.system, [recording])
    data = strict_json(as_json(estimate.summary()))
    assert {"theta", "std", "covariance", "chi2", "dof", "status", "residual_rms", "misfit"} <= set(
        data
    )
    assert np.array_equal(data["theta"], estimate.theta)
    assert np.array(data["covariance"]).shape == (P, P)
    assert np.sqrt(np.diag(data["covariance"])) == pytest.approx(data["std"], rel=1e-6)
    assert set(data["residual_rms"]) == set(task.system.outputs.names)
    assert data["misfit"] is False
    assert (data["parameters"], data["units"]) == (["m", "l", "c"], list(task.system.units))
    assert data["prior"] == np.zeros((P, P)).tolist()


@pytest.mark.slow
def test_study_summary(task: DesignTask, design: Design) -> None:
    """montecarlo.json has the documented keys for each trajectory."""
    curves = {"initial": design.initial.trajectory, "final": design.trajectory}
    data = strict_json(as_json(monte_carlo_system(task.system, curves, trials=4).summary()))
    for name in curves:
        assert {"mean", "covariance", "crlb", "efficiency", "trials", "failed"} <= set(data[name])
        assert (data[name]["trials"], np.array(data[name]["crlb"]).shape) == (4, (P, P))
