"""The live view: what a viewer receives, and searches that do not depend on it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

pytest.importorskip("rerun")
import rerun as rr
from rerun.chunk import RrdReader

import mjfim
from mjfim.cli.common import with_live_address
from mjfim.errors import ExperimentError, InterruptedByUserError
from mjfim.experiment.system import System
from mjfim.output import live as live_module
from mjfim.output.live import HERE, url_of
from mjfim.output.rerun.live import OTHER_STARTS, UPDATE_SECONDS, LiveShow, live
from mjfim.records.design import Design
from mjfim.records.events import DesignEvent, Event, FitEvent, StudyEvent
from tests.support import results
from tests.support.paths import MODELS


@pytest.fixture(scope="module")
def experiment() -> mjfim.Experiment:
    """A short cart-pendulum experiment with few iterations."""
    stated = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
    return stated.replace(horizon=0.5, descent={"max_iterations": 4}, rehearsal={"robots": 0})


# A design and its events.
Searched = tuple[Design, list[DesignEvent]]


@pytest.fixture(scope="module")
def searched(experiment: mjfim.Experiment) -> Searched:
    """A design without a viewer, and its events."""
    events: list[DesignEvent] = []
    return mjfim.design(experiment, callback=events.append), events


class Clock:
    """A clock that moves on by a step whenever it is read."""

    def __init__(self, step: float) -> None:
        self.time, self.step = 0.0, step

    def __call__(self) -> float:
        self.time += self.step
        return self.time


class Received:
    """What a viewer would receive, read back from a file."""

    def __init__(self, path: Path) -> None:
        self._chunks = list(RrdReader(path).stream().to_chunks())
        self.entities = {str(chunk.entity_path) for chunk in self._chunks}

    def rows(self, entity: str, component: str) -> tuple[list[int], list[Any]]:
        """Numbers of the events and values of a component, in the order of the events."""
        found: list[tuple[int, Any]] = []
        for chunk in self._chunks:
            batch = chunk.to_record_batch()
            if str(chunk.entity_path) == entity and {component, "event"} <= {*batch.schema.names}:
                numbers = batch.column("event").cast("int64").to_pylist()
                found += zip(numbers, batch.column(component).to_pylist(), strict=True)
        found.sort(key=lambda row: row[0])
        return [number for number, _ in found], [value for _, value in found]

    def has_static(self, entity: str) -> bool:
        """Whether an entity has data without a time, which hide the others."""
        return any(each.is_static for each in self._chunks if str(each.entity_path) == entity)

    def curves(self, plot: str) -> list[str]:
        """Names of the entities of the curves of a plot."""
        below = [entity.split("/") for entity in self.entities]
        return [parts[2] for parts in below if parts[1] == plot and len(parts) == 3]

    def name_of(self, entity: str) -> str:
        """Name of a curve in the legend, the last one that was received."""
        names = [
            chunk.to_record_batch().column("SeriesLines:names").to_pylist()[-1][0]
            for chunk in self._chunks
            if str(chunk.entity_path) == entity
            and "SeriesLines:names" in chunk.to_record_batch().schema.names
        ]
        return str(names[-1])

    def height(self, entity: str) -> float:
        """Length of the vertical axis of a plot."""
        _, axes = self.rows(f"{entity}/axes", "LineStrips2D:strips")
        return float(np.ptp(np.array(axes[-1][0])[:, 1]))

    def numbers(self, entity: str) -> tuple[float, float]:
        """Lowest and highest number beside the vertical axis of a plot, the last one."""
        _, texts = self.rows(f"{entity}/numbers", "Points2D:labels")
        _, places = self.rows(f"{entity}/numbers", "Points2D:positions")
        across = np.array(places[-1])[:, 0]
        values = [float(text) for text, x in zip(texts[-1], across, strict=True) if x < 0.0]
        return min(values), max(values)

    def series(self, entity: str) -> list[float]:
        """Values of a curve."""
        return [value for (value,) in self.rows(entity, "Scalars:scalars")[1]]


class HeldTimer:
    """A timer that runs when the test says so."""

    started: ClassVar[list[HeldTimer]] = []

    def __init__(self, seconds: float, function: Callable[[], None]) -> None:
        assert seconds == UPDATE_SECONDS
        self.run, self.daemon = function, False

    def start(self) -> None:
        """Wait for the test."""
        assert self.daemon
        self.started.append(self)


def watched(
    events: Sequence[Event], experiment: mjfim.Experiment, folder: Path, step: float
) -> Received:
    """Transmit events into a file, with a clock that moves on by a step."""
    system = System.resolve(experiment)
    rec = rr.RecordingStream("test")
    rec.save(folder / "live.rrd")
    show = LiveShow(rec, system.model_at(system.theta), now=Clock(step))
    for event in events:
        show(event)
    show.end()

    received = Received(folder / "live.rrd")
    assert not any("warnings" in entity for entity in received.entities)
    return received


@pytest.fixture(scope="module")
def received(
    searched: Searched,
    experiment: mjfim.Experiment,
    tmp_path_factory: pytest.TempPathFactory,
) -> Received:
    """What a viewer receives from the whole design."""
    folder = tmp_path_factory.mktemp("live")
    return watched(searched[1], experiment, folder, step=2.0 * UPDATE_SECONDS)


class TestShown:
    def test_every_iterate_of_a_design_changes_curves_robot_and_path(
        self,
        searched: Searched,
        received: Received,
    ) -> None:
        design, events = searched

        costs = [row.cost for row in design.history]
        eigenvalues = [row.min_eigenvalue for row in design.history]
        start = "initial\\ control"
        np.testing.assert_allclose(received.series(f"/cost/{start}"), np.log10(costs))
        np.testing.assert_allclose(received.series(f"/eigenvalue/{start}"), np.log10(eigenvalues))

        numbers, paths = received.rows("/robot/path", "LineStrips3D:strips")
        assert numbers == list(range(len(events)))
        assert all(np.isfinite(path).all() for path in paths)
        assert not np.allclose(paths[0], paths[-1])
        numbers, texts = received.rows("/progress", "TextDocument:text")
        assert len(texts) == len(events) + 1, "one before the first event"
        assert "J " in texts[-1][0] and "best so far, shown: initial control" in texts[-1][0]
        assert not received.has_static("/progress")
        _, places = received.rows("/robot/bodies/bob", "Transform3D:translation")
        assert len(places) == len(events)

    def test_curves_over_time_show_the_positions_and_the_controls(
        self,
        searched: Searched,
        received: Received,
    ) -> None:
        design, events = searched
        shown = {
            "/positions/hinge\\ \\[rad\\]": design.trajectory.qpos[:, 1],
            "/controls/force\\ \\[N\\]": design.trajectory.ctrl[:, 0],
        }
        for entity, expected in shown.items():
            numbers, curves = received.rows(f"{entity}/iterate", "LineStrips2D:strips")
            assert numbers == list(range(len(events)))
            last = np.array(curves[-1][0])
            heights = np.ptp(last[:, 1]) / received.height(entity)
            low, high = received.numbers(entity)
            assert low >= expected.min() - np.ptp(expected)
            assert high <= expected.max() + np.ptp(expected)
            assert 0.2 < heights <= 1.0

            # The axes hold everything that was shown before.
            _, axes = received.rows(f"{entity}/axes", "LineStrips2D:strips")
            assert len(axes) == len(events)

    def test_the_best_iterate_of_several_starts_is_shown(
        self,
        searched: Searched,
        experiment: mjfim.Experiment,
        tmp_path: Path,
    ) -> None:
        """A finer time grid comes first, then the limits, then the cost."""
        _, (first, *_, last) = searched
        rated = replace(last.row, rate=2.0 * last.row.rate)
        events = [
            first,
            replace(last, start="multisine 1"),
            replace(first, start="multisine 2"),
            replace(last, start="multisine 3", row=replace(last.row, cost=1e-9, margin=-0.1)),
            replace(first, start="multisine 4", row=replace(rated, cost=9.0)),
        ]
        received = watched(events, experiment, tmp_path, step=2.0 * UPDATE_SECONDS)
        _, texts = received.rows("/progress", "TextDocument:text")
        shown = [text.splitlines()[2] for (text,) in texts[1:]]
        assert shown == [
            f"best so far, shown: {name}"
            for name in ("initial control", *("multisine 1",) * 3, "multisine 4")
        ]
        assert texts[3][0].startswith("newest: multisine 2, searching at")
        _, paths = received.rows("/robot/path", "LineStrips3D:strips")
        assert np.allclose(paths[1], paths[2]) and np.allclose(paths[1], paths[3])
        assert not np.allclose(paths[0], paths[1])

        # The curves of other starts share a name in the legend.
        names = {name: received.name_of(f"/cost/{name}") for name in received.curves("cost")}
        assert names.pop("multisine\\ 4") == "multisine 4"
        assert set(names.values()) == {OTHER_STARTS} and len(names) == 4

    def test_the_end_of_a_burst_is_transmitted_without_a_further_event(
        self,
        searched: Searched,
        experiment: mjfim.Experiment,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        """Searches in other processes deliver all iterates at once, and then nothing."""
        monkeypatch.setattr(threading, "Timer", HeldTimer)
        _, events = searched
        system = System.resolve(experiment)
        rec = rr.RecordingStream("test")
        rec.save(tmp_path / "live.rrd")
        show = LiveShow(rec, system.model_at(system.theta), now=Clock(0.0), wakes=True)
        HeldTimer.started.clear()
        for event in events:
            show(event)
        (timer,) = HeldTimer.started
        timer.run()
        rec.flush()
        rec.disconnect()
        numbers, _ = Received(tmp_path / "live.rrd").rows("/robot/path", "LineStrips3D:strips")
        assert numbers == [0, len(events) - 1]

    def test_transmissions_are_rare_and_lose_no_point(
        self,
        searched: Searched,
        experiment: mjfim.Experiment,
        tmp_path: Path,
    ) -> None:
        """A clock that stands still gives one transmission at the begin and one at the end."""
        _, events = searched
        many = [replace(event) for _ in range(20) for event in events]
        received = watched(many, experiment, tmp_path, step=0.0)

        assert len(received.series("/cost/initial\\ control")) == len(many)
        numbers, _ = received.rows("/robot/path", "LineStrips3D:strips")
        assert numbers == [0, len(many) - 1]

    def test_fits_and_studies_have_their_curves(
        self, experiment: mjfim.Experiment, tmp_path: Path
    ) -> None:
        fits = [
            FitEvent(phase="all data", iteration=i, cost=10.0**-i, step=0.1 if i else np.inf)
            for i in range(4)
        ]
        parts = [
            StudyEvent(study="monte_carlo", part="initial", index=k, count=2, share=0.5)
            for k in range(2)
        ]
        received = watched([*fits, *parts], experiment, tmp_path, step=1.0)
        assert received.series("/squares/all\\ data") == pytest.approx([0.0, -1.0, -2.0, -3.0])
        assert received.series("/step/all\\ data") == pytest.approx([-1.0] * 3)
        assert received.series("/share/monte_carlo") == pytest.approx([25.0, 75.0])

    def test_a_stream_shows_its_accuracy_over_its_time(
        self, experiment: mjfim.Experiment, tmp_path: Path
    ) -> None:
        record = results.watch()
        parts = [
            StudyEvent(
                study="watch",
                part="",
                index=0,
                count=None,
                share=0.0,
                result=replace(record, t=record.t[:k], std_over_time=record.std_over_time[:k]),
            )
            for k in (20, 60)
        ]
        received = watched(parts, experiment, tmp_path, step=1.0)
        assert set(received.curves("accuracy")) == {"wanted", *record.parameters}
        for j, name in enumerate(record.parameters):
            shares = record.std_over_time[[19, 59], j] / record.wanted[j]
            assert received.series(f"/accuracy/{name}") == pytest.approx(np.log10(shares))
        assert received.series("/accuracy/wanted") == [0.0, 0.0]


def free_port() -> int:
    """A port at which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class TestIndependence:
    @pytest.mark.parametrize("listens", [False, pytest.param(True, marks=pytest.mark.slow)])
    def test_with_and_without_a_viewer_the_result_is_the_same(
        self,
        listens: bool,
        searched: Searched,
        experiment: mjfim.Experiment,
    ) -> None:
        """The same in every bit."""
        port = free_port()
        with rr.RecordingStream("server") as server:
            if listens:
                server.serve_grpc(grpc_port=port)
            said: list[str] = []
            with live(experiment, f"127.0.0.1:{port}", say=said.append) as show:
                design = mjfim.design(experiment, callback=show)
            server.disconnect()

        assert len(said) == (0 if listens else 1)
        assert listens or "there is no live view: nothing listens at" in said[0]
        expected = searched[0]
        assert np.array_equal(design.trajectory.ctrl, expected.trajectory.ctrl)
        assert np.array_equal(design.final.information, expected.final.information)
        assert [row.cost for row in design.history] == [row.cost for row in expected.history]

    def test_without_a_display_a_sentence_says_so(
        self, experiment: mjfim.Experiment, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(live_module, "has_display", lambda: False)
        monkeypatch.setattr(live_module, "_is_listening", lambda url: False)
        said: list[str] = []
        with live(experiment, say=said.append):
            pass
        assert said == [
            "there is no live view: this computer has no display; start a viewer on another one "
            "with `rerun`, and state its address, such as --live HOST:9876"
        ]

    @pytest.mark.parametrize("error", [RuntimeError("lost"), InterruptedByUserError()])
    def test_a_viewer_that_fails_ends_the_view_only(
        self,
        error: BaseException,
        experiment: mjfim.Experiment,
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        """One sentence says so; Ctrl-C reaches the search."""
        calls: list[Event | None] = []

        class Failing:
            def __call__(self, event: Event) -> None:
                calls.append(event)
                raise error

            def end(self) -> None:
                calls.append(None)

        said: list[str] = []
        monkeypatch.setattr(live_module, "_connected", lambda *_, **__: Failing())
        event = FitEvent(phase="all data", iteration=0, cost=1.0, step=1.0)
        if isinstance(error, InterruptedByUserError):
            with pytest.raises(InterruptedByUserError), live(experiment, say=said.append) as show:
                show(event)
            assert (said, calls) == ([], [event, None])
            return
        with live(experiment, say=said.append) as show:
            for _ in range(3):
                show(event)
        assert said == ["the live view ended: lost"]
        assert calls == [event]


class TestAddress:
    def test_forms(self) -> None:
        assert url_of("robot.local:9876") == "rerun+http://robot.local:9876/proxy"
        assert url_of("rerun+http://a:1/proxy") == "rerun+http://a:1/proxy"
        with pytest.raises(ExperimentError, match=r"--live here: an address is HOST:PORT"):
            url_of("here")

    @pytest.mark.parametrize(
        ("words", "completed"),
        [
            (["a.toml", "--live"], ["a.toml", f"--live={HERE}"]),
            (["--live", "a.toml"], [f"--live={HERE}", "a.toml"]),
            (["--live", "host:9876", "a.toml"], ["--live", "host:9876", "a.toml"]),
            (["--live", "-o", "out"], [f"--live={HERE}", "-o", "out"]),
            (["--live=host:1"], ["--live=host:1"]),
        ],
    )
    def test_the_option_may_stand_without_an_address(
        self, words: list[str], completed: list[str]
    ) -> None:
        assert with_live_address(words) == completed


@pytest.mark.slow
def test_a_viewer_listens_on_this_computer_alone_and_stores_no_statistics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What listens at all addresses answers at 127.0.0.2 as well, on Linux."""
    for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    port = free_port()
    nowhere = subprocess.DEVNULL
    viewer = live_module.start_viewer(
        "--serve-grpc", "--port", str(port), stdout=nowhere, stderr=nowhere
    )
    try:
        deadline = time.monotonic() + 60.0
        while not answers("127.0.0.1", port) and time.monotonic() < deadline:
            time.sleep(0.2)
        assert answers("127.0.0.1", port)
        assert not answers("127.0.0.2", port)
        assert list(tmp_path.rglob("*.json")) == []
    finally:
        os.killpg(viewer.pid, signal.SIGKILL)
        viewer.wait()


def answers(host: str, port: int) -> bool:
    """Whether something listens at an address."""
    try:
        socket.create_connection((host, port), timeout=5.0).close()
    except OSError:
        return False
    return True
