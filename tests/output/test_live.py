"""The live view: what a viewer receives, and searches that do not depend on it."""

from __future__ import annotations

import itertools
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip("rerun")
import rerun as rr

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
from tests.support.rrd import Recorded


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


def watched(
    events: Sequence[Event],
    experiment: mjfim.Experiment,
    folder: Path,
    step: float = 2.0 * UPDATE_SECONDS,
    end: Callable[[LiveShow], None] = LiveShow.end,
    **options: bool,
) -> Recorded:
    """Transmit events into a file, with a clock that moves on by a step whenever it is read."""
    system = System.resolve(experiment)
    rec = rr.RecordingStream("test")
    rec.save(folder / "live.rrd")
    clock = (step * i for i in itertools.count(1))
    show = LiveShow(rec, system.model_at(system.theta), now=clock.__next__, **options)
    for event in events:
        show(event)
    end(show)
    rec.flush()
    rec.disconnect()

    return Recorded(folder / "live.rrd", "event")


def series(received: Recorded, entity: str) -> list[float]:
    """Values of a curve."""
    values: list[float] = received.scalars(entity)[1].tolist()
    return values


@pytest.fixture(scope="module")
def received(
    searched: Searched, experiment: mjfim.Experiment, tmp_path_factory: pytest.TempPathFactory
) -> Recorded:
    """What a viewer receives from the whole design."""
    return watched(searched[1], experiment, tmp_path_factory.mktemp("live"))


def test_every_iterate_of_a_design_changes_curves_robot_and_path(
    searched: Searched, received: Recorded
) -> None:
    design, events = searched
    for plot, field in (("cost", "cost"), ("eigenvalue", "min_eigenvalue")):
        expected = np.log10([getattr(row, field) for row in design.history])
        assert_allclose(series(received, f"/{plot}/initial\\ control"), expected)

    numbers, paths = received.rows("/robot/path", "LineStrips3D:strips")
    assert numbers.tolist() == list(range(len(events)))
    assert all(np.isfinite(path).all() for path in paths)
    assert not np.allclose(paths[0], paths[-1])
    _, texts = received.rows("/progress", "TextDocument:text")
    assert len(texts) == len(events) + 1, "one before the first event"
    assert "J " in texts[-1][0] and "best so far, shown: initial control" in texts[-1][0]
    _, places = received.rows("/robot/bodies/bob", "Transform3D:translation")
    assert len(places) == len(events)


@pytest.mark.parametrize("name", ["positions/hinge\\ \\[rad\\]", "controls/force\\ \\[N\\]"])
def test_curves_over_time_show_the_positions_and_the_controls(
    name: str, searched: Searched, received: Recorded
) -> None:
    design, events = searched
    curve = design.trajectory
    expected = curve.qpos[:, 1] if "hinge" in name else curve.ctrl[:, 0]
    numbers, curves = received.rows(f"/{name}/iterate", "LineStrips2D:strips")
    assert numbers.tolist() == list(range(len(events)))
    x, y = np.array(curves[-1][0]).T
    shown = np.interp((x - x[0]) / np.ptp(x) * curve.t[-1], curve.t[: len(expected)], expected)
    # Rerun draws downwards.
    assert np.corrcoef(shown, -y)[0, 1] > 0.99

    # The axes hold everything that was shown before, and their numbers are about the values.
    _, axes = received.rows(f"/{name}/axes", "LineStrips2D:strips")
    assert len(axes) == len(events)
    assert 0.2 < np.ptp(y) / np.ptp(np.array(axes[-1][0])[:, 1]) <= 1.0
    _, texts = received.rows(f"/{name}/numbers", "Points2D:labels")
    _, places = received.rows(f"/{name}/numbers", "Points2D:positions")
    beside = [float(text) for text, (x, _) in zip(texts[-1], places[-1], strict=True) if x < 0]
    assert len(beside) > 1
    assert np.abs(np.array(beside) - np.mean(expected)).max() < 2.0 * np.ptp(expected)


def test_the_best_iterate_of_several_starts_is_shown(
    searched: Searched, experiment: mjfim.Experiment, tmp_path: Path
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
    received = watched(events, experiment, tmp_path)
    _, texts = received.rows("/progress", "TextDocument:text")
    names = ["initial control", *("multisine 1",) * 3, "multisine 4"]
    shown = [text.splitlines()[2] for (text,) in texts[1:]]
    assert shown == [f"best so far, shown: {name}" for name in names]
    assert texts[3][0].startswith("newest: multisine 2, searching at")
    _, paths = received.rows("/robot/path", "LineStrips3D:strips")
    assert np.allclose(paths[1], paths[2:4]) and not np.allclose(paths[0], paths[1])

    # The curves of other starts share a name in the legend.
    curves = [name for name in received.entities if name.startswith("/cost/")]
    legend = sorted(received.static(name, "SeriesLines:names")[-1][0] for name in curves)
    assert legend == sorted(["multisine 4", *[OTHER_STARTS] * 4])


def test_the_end_of_a_burst_is_transmitted_without_a_further_event(
    searched: Searched,
    experiment: mjfim.Experiment,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Searches in other processes deliver all iterates at once, and then nothing.

    A clock that stands still gives one transmission at the begin and one at the end.
    """
    timer = Mock()
    monkeypatch.setattr(threading, "Timer", timer)

    def wake(show: LiveShow) -> None:
        """The time of the timer is over."""
        timer.assert_called_once()
        timer.return_value.start.assert_called_once()
        seconds, update = timer.call_args.args
        assert seconds == UPDATE_SECONDS and timer.return_value.daemon is True
        update()

    many = 20 * searched[1]
    for end, options in ((wake, {"wakes": True}), (LiveShow.end, {})):
        received = watched(many, experiment, tmp_path, step=0.0, end=end, **options)
        numbers, _ = received.rows("/robot/path", "LineStrips3D:strips")
        assert numbers.tolist() == [0, len(many) - 1]
        assert len(series(received, "/cost/initial\\ control")) == len(many)


def test_fits_studies_and_streams_have_their_curves(
    experiment: mjfim.Experiment, tmp_path: Path
) -> None:
    fits = [
        FitEvent(phase="all data", iteration=i, cost=10.0**-i, step=0.1 if i else np.inf)
        for i in range(4)
    ]
    part = StudyEvent(study="monte_carlo", part="initial", index=0, count=2, share=0.5)
    record = results.watch()
    streams = [
        replace(
            part,
            study="watch",
            result=replace(record, t=record.t[:k], std_over_time=record.std_over_time[:k]),
        )
        for k in (20, 60)
    ]
    events = [*fits, part, replace(part, index=1), *streams]
    received = watched(events, experiment, tmp_path, step=1.0)
    assert series(received, "/squares/all\\ data") == pytest.approx([0.0, -1.0, -2.0, -3.0])
    assert series(received, "/step/all\\ data") == pytest.approx([-1.0] * 3)
    assert series(received, "/share/monte_carlo") == pytest.approx([25.0, 75.0])
    for j, name in enumerate(record.parameters):
        shares = record.std_over_time[[19, 59], j] / record.wanted[j]
        assert series(received, f"/accuracy/{name}") == pytest.approx(np.log10(shares))
    assert series(received, "/accuracy/wanted") == [0.0, 0.0]


def free_port() -> int:
    """A port at which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.mark.parametrize("listens", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_with_and_without_a_viewer_the_result_is_the_same(
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
    experiment: mjfim.Experiment, monkeypatch: pytest.MonkeyPatch
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
    error: BaseException,
    experiment: mjfim.Experiment,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One sentence says so; Ctrl-C reaches the search."""
    show = Mock(side_effect=error)
    said: list[str] = []
    monkeypatch.setattr(live_module, "_connected", lambda *_, **__: show)
    event = FitEvent(phase="all data", iteration=0, cost=1.0, step=1.0)
    if isinstance(error, InterruptedByUserError):
        with pytest.raises(InterruptedByUserError), live(experiment, say=said.append) as call:
            call(event)
        show.end.assert_called_once()
        assert said == []
        return
    with live(experiment, say=said.append) as call:
        for _ in range(3):
            call(event)
    assert said == ["the live view ended: lost"]
    show.assert_called_once_with(event)
    show.end.assert_not_called()


def test_forms() -> None:
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
def test_the_option_may_stand_without_an_address(words: list[str], completed: list[str]) -> None:
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
