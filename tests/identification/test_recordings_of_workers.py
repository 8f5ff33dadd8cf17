"""Recordings that workers read from their files, and that are sent where they cannot."""

from __future__ import annotations

import pickle
import shutil
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
import pytest

import mjfim
from mjfim.errors import RecordingError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.simulate import simulate_system
from mjfim.experiment.system import System
from mjfim.identification import fit_orders, fit_workers, recording_files, segment_simulation
from mjfim.identification.aligned_recording import align
from mjfim.identification.fit_orders import RecordingOrder, SharedRecording
from mjfim.identification.fit_workers import FitWorkers
from mjfim.identification.recording_files import RecordingFiles, RecordingFolder
from mjfim.identification.task import FitTask
from mjfim.output.archive import write_recording
from mjfim.parallel import shared_value
from mjfim.parallel.shared_value import AbsentValueError, require_values
from mjfim.recordings import log_file
from mjfim.recordings.read import read_recording
from tests.support.executors import processes
from tests.support.paths import MODELS

# Segments whose initial states are unknown.
FIT: dict[str, Any] = {"segments": 0.25, "start": "measured"}


@pytest.fixture(scope="module")
def system() -> System:
    """The cart-pendulum for a short time."""
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
    return DesignTask.resolve(experiment.replace(horizon=0.5, fit=FIT), threads=1).system


@pytest.fixture
def logs(system: System, tmp_path: Path) -> list[Path]:
    """Two logs."""
    task = DesignTask.resolve(system.experiment, threads=1)
    paths = [tmp_path / f"log{seed}.csv" for seed in range(2)]
    for seed, path in enumerate(paths):
        write_recording(path, simulate_system(system, task.initial, seed), system)
    return paths


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """No value is found that this process has made, as in a worker process."""
    nothing: WeakValueDictionary[str, Any] = WeakValueDictionary()
    monkeypatch.setattr(shared_value, "_owned", nothing)


def in_a_worker(order: RecordingOrder) -> RecordingOrder:
    """The order as it arrives there."""
    pickled = pickle.dumps(order)
    shared_value._owned.clear()
    arrived = pickle.loads(pickled)
    assert isinstance(arrived, RecordingOrder)
    assert not arrived.value.is_here
    return arrived


@pytest.mark.usefixtures("elsewhere")
def test_a_worker_reads_the_file_and_keeps_the_recording(system: System, logs: list[Path]) -> None:
    recording = align(system, read_recording(logs[0], system.channels))
    order = in_a_worker(RecordingOrder.of(recording, system.channels))
    assert order.is_here

    found = order.made(system)
    for name in ("t", "y", "ctrl"):
        assert np.array_equal(getattr(found, name), getattr(recording, name))
    logs[0].unlink()
    assert order.is_here
    assert order.made(system) is found


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize("change", ["gone", "changed"])
def test_a_file_that_a_worker_does_not_find(system: System, logs: list[Path], change: str) -> None:
    recording = align(system, read_recording(logs[0], system.channels))
    order = RecordingOrder.of(recording, system.channels)
    text = logs[0].read_text(encoding="utf-8")
    logs[0].unlink()
    if change == "changed":
        logs[0].write_text(text[: len(text) // 2].rpartition("\n")[0] + "\n", encoding="utf-8")

    arrived = in_a_worker(order)
    assert not arrived.is_here
    with pytest.raises(AbsentValueError):
        require_values([arrived.value])

    # The caller sends what it has read, unless something has written to the file since.
    if change == "gone":
        assert order.value.to_send() is recording
        return
    with pytest.raises(RecordingError, match=r"log0\.csv: the file has changed since it was read"):
        order.value.to_send()
    anew = align(system, read_recording(logs[0], system.channels))
    assert RecordingOrder.of(anew, system.channels).file != order.file


def test_a_file_that_workers_would_read_otherwise_is_sent(system: System, logs: list[Path]) -> None:
    recording = align(system, read_recording(logs[0], system.channels))
    other = system.experiment.replace(recording={"window": [0.0, 0.2]})
    channels = System.resolve(other, threads=1).channels
    assert RecordingOrder.of(recording, system.channels).file is not None
    assert RecordingOrder.of(recording, channels).file is None

    simulated = simulate_system(system, DesignTask.resolve(system.experiment).initial, 0)
    assert RecordingOrder.of(align(system, simulated), system.channels).file is None


@pytest.mark.parametrize("mode", ["r", None])
def test_a_worker_maps_the_arrays_of_the_caller(
    system: System, logs: list[Path], mode: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are not copied where they are mapped, and an empty control is an array as well."""
    monkeypatch.setattr(recording_files, "MAP_MODE", mode)
    read = align(system, read_recording(logs[0], system.channels))
    for recording in (read, replace(read, ctrl=np.zeros((len(read.t) - 1, 0)))):
        folder = RecordingFolder()
        files = folder.written(recording)
        assert files is not None
        arrived = pickle.loads(pickle.dumps(files))
        assert arrived.is_here
        found = arrived.mapped()
        for name in ("t", "y", "ctrl"):
            array = getattr(found, name)
            assert np.array_equal(array, getattr(recording, name), equal_nan=True)
            assert (array.base is not None) == (mode is not None)
            assert not array.flags.writeable
        assert (found.dt, found.on_grid, found.name) == (read.dt, read.on_grid, read.name)

        # The files are removed with the folder.
        del found, array, folder
        assert not arrived.is_here


def test_without_room_recordings_are_sent(
    system: System, logs: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was written until the disk was full is removed."""
    parts: list[Path] = []

    def full(path: Path, *_: Any, **__: Any) -> None:
        path.write_bytes(b"begun")
        parts.append(path)
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "save", full)
    recording = align(system, read_recording(logs[0], system.channels))
    folder = RecordingFolder()
    assert folder.written(recording) is None
    assert folder.written(recording) is None
    assert len(parts) == 1
    assert not parts[0].parent.exists()


def test_half_of_the_room_is_left_to_others(
    system: System, logs: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = align(system, read_recording(logs[0], system.channels))
    size = recording.t.nbytes + recording.y.nbytes + recording.ctrl.nbytes
    room = SimpleNamespace(free=2 * size - 1)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: room)
    assert RecordingFolder().written(recording) is None
    room.free += 1
    assert isinstance(RecordingFolder().written(recording), RecordingFiles)


def test_a_log_that_changes_while_its_hash_is_computed_is_an_error(
    system: System, logs: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = align(system, read_recording(logs[0], system.channels))

    def changing(_: Any) -> str:
        with logs[0].open("a", encoding="utf-8") as stream:
            stream.write("\n")
        return "0" * 64

    monkeypatch.setattr(log_file, "_hash_of", changing)
    with pytest.raises(RecordingError, match="has changed since it was read"):
        RecordingOrder.of(recording, system.channels)


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize("is_readable", [True, False])
def test_a_log_that_changes_while_a_worker_reads_it_is_sent(
    system: System, logs: list[Path], is_readable: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = align(system, read_recording(logs[0], system.channels))
    order = in_a_worker(RecordingOrder.of(recording, system.channels))
    assert order.is_here

    def changing(path: Path, channels: Any) -> Any:
        found = read_recording(path, channels)
        with path.open("a", encoding="utf-8") as stream:
            stream.write("\n")
        if not is_readable:
            raise RecordingError("the last row has too few values")
        return found

    monkeypatch.setattr(fit_orders, "read_recording", changing)
    with pytest.raises(AbsentValueError):
        order.made(system)
    assert not order.is_here


@pytest.mark.parametrize("shares_memory", [True, False])
def test_workers_read_no_file_that_they_do_not_need(
    system: System, logs: list[Path], shares_memory: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Threads have the recordings already, and processes of this computer map them."""
    monkeypatch.setattr(fit_workers, "MIN_FILE_BYTES", 0)
    recordings = [read_recording(path, system.channels) for path in logs]
    problem = FitTask.resolve(system.experiment, recordings, threads=1).problem()
    kind = ThreadPoolExecutor if shares_memory else ProcessPoolExecutor
    with kind(1) as executor:
        part = FitWorkers(executor).part_of(problem, range(len(problem.segments)), 1)
    assert len(part.value.recordings) == 2
    for order in part.value.recordings.values():
        assert order.file is None
        assert (order.arrays is None) == shares_memory


@pytest.mark.slow
@pytest.mark.parametrize("way", ["mapped", "read", "sent"])
def test_processes_that_read_the_files_find_the_same_estimate(
    system: System, logs: list[Path], way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They map the caller's arrays, read the logs, or receive the recordings."""
    monkeypatch.setattr(segment_simulation, "MAX_NUMBERS_AT_ONCE", 2000)
    monkeypatch.setattr(fit_workers, "MIN_FILE_BYTES", 0 if way == "mapped" else 1e9)
    recordings = [read_recording(path, system.channels) for path in logs]
    alone = mjfim.identify(system.experiment, recordings, threads=1)

    count = 0
    to_send = SharedRecording.to_send

    def counted(shared: SharedRecording) -> Any:
        nonlocal count
        count += 1
        return to_send(shared)

    monkeypatch.setattr(SharedRecording, "to_send", counted)
    with processes("pool") as executor:
        if way != "read":
            for path in logs:
                path.rename(path.with_suffix(".moved"))
        found = mjfim.identify(system.experiment, recordings, threads=1, executor=executor)

    assert (count > 0) == (way == "sent")
    assert np.array_equal(found.theta, alone.theta)
    assert np.array_equal(found.covariance, alone.covariance)
    assert found.chi2 == alone.chi2
