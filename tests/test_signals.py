"""Starting controls: tables are held from row to row, generated signals keep their amplitude and their seed."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from mjfim.errors import ExperimentError, RecordingError
from mjfim.experiment.control_signal import generate
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import Setup
from mjfim.experiment.system_tables import Signal
from mjfim.recordings.control_table import read_control
from mjfim.recordings.formats.read import read_table
from mjfim.signals import multisine
from tests.support.paths import MODELS

Array = NDArray[np.float64]
Read = Callable[..., Array]

NAMES = ("left", "right")
REST = np.zeros(2)
T = np.arange(400) * 0.01


@pytest.fixture
def read(tmp_path: Path) -> Read:
    """Write columns as CSV and read the control back on a grid of period dt."""

    def run(
        columns: Mapping[str, object], N: int, dt: float, names: tuple[str, ...] = ("u",)
    ) -> Array:
        path = tmp_path / "table.csv"
        rows = zip(*(np.asarray(c).tolist() for c in columns.values()), strict=True)
        lines = [
            ",".join(columns),
            *(",".join("" if v != v else repr(v) for v in row) for row in rows),
        ]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return read_control(path, np.arange(N) * dt, dt, names)

    return run


def held(stamps: Array, values: Array, t: Array) -> Array:
    """Zero-order hold in the plainest way."""
    return np.array([values[max(i for i, s in enumerate(stamps) if s <= now + 1e-9)] for now in t])


def test_coarse_table_is_held(read: Read) -> None:
    """Ten samples per row, each with the row's value; the last row is held for one period."""
    u = read({"t": [0.0, 0.1, 0.2], "u": [1.0, -2.0, 5.0]}, 30, 0.01)
    assert u.shape == (30, 1)
    assert u[:, 0].tolist() == [1.0] * 10 + [-2.0] * 10 + [5.0] * 10


def test_fine_table_is_sampled(read: Read) -> None:
    """The row at the sample's time, not a mean."""
    t = np.arange(41) * 0.0025
    u = read({"t": t, "u": t**2}, 10, 0.01)
    assert u[:, 0].tolist() == (t[:40:4] ** 2).tolist()


def test_rounded_stamps_hit_their_samples(read: Read) -> None:
    """0.1 + 0.2 and its like must not slip by one sample."""
    t = np.cumsum(np.full(300, 0.01)) - 0.01
    u = read({"t": [round(float(x), 4) for x in t], "u": np.arange(300.0)}, 300, 0.01)
    assert u[:, 0].tolist() == list(range(300))
    u = read({"t": t, "u": np.arange(300.0)}, 300, 0.01)
    assert u[:, 0].tolist() == list(range(300))


def test_irregular_table_agrees_with_a_plain_search(read: Read) -> None:
    """Random stamps, some before the start of the experiment."""
    rng = np.random.default_rng(3)
    stamps = np.concatenate([[-0.3, -0.1], np.sort(rng.uniform(0.0, 1.0, 25)), [1.0]])
    values = rng.standard_normal(len(stamps))
    u = read({"t": stamps, "u": values}, 100, 0.01)
    assert u[:, 0].tolist() == held(stamps, values, np.arange(100) * 0.01).tolist()


def test_columns_are_found_by_name(read: Read) -> None:
    """The order of columns is free; `ctrl:` before the name is accepted."""
    t = [0.0, 0.5, 1.0]
    u = read({"right": [1.0, 2.0, 3.0], "t": t, "left": [4.0, 5.0, 6.0]}, 10, 0.1, NAMES)
    assert u[0].tolist() == [4.0, 1.0]
    u = read({"t": t, "ctrl:right": [1.0, 2.0, 3.0], "ctrl:left": [4.0, 5.0, 6.0]}, 10, 0.1, NAMES)
    assert u[0].tolist() == [4.0, 1.0]


def test_a_design_is_a_control(read: Read) -> None:
    """design.csv as it is: states beside the controls, no control in the last row."""
    nan = float("nan")
    u = read({"t": [0.0, 0.1, 0.2], "qpos:j": [0.0, 1.0, 2.0], "ctrl:u": [3.0, 4.0, nan]}, 2, 0.1)
    assert u.tolist() == [[3.0], [4.0]]


def test_a_hole_in_a_design_is_a_fault(read: Read) -> None:
    """Only the last row may have no control."""
    nan = float("nan")
    with pytest.raises(RecordingError, match="row 2"):
        read({"t": [0.0, 0.1, 0.2, 0.3], "ctrl:u": [3.0, nan, 4.0, nan]}, 3, 0.1)


def test_table_must_cover_the_horizon(read: Read) -> None:
    """A row is held for one period, no longer."""
    columns = {"t": [0.0, 0.1, 0.2], "u": [1.0, 2.0, 3.0]}
    assert len(read(columns, 30, 0.01)) == 30
    with pytest.raises(RecordingError, match="too few rows"):
        read(columns, 31, 0.01)


def test_compressed_tables(tmp_path: Path) -> None:
    """gzip is told by the ending."""
    path = tmp_path / "table.csv.gz"
    path.write_bytes(gzip.compress(b"t,u\n0,1.5\n1,2.5\n"))
    table = read_table(path)
    assert {name: column.tolist() for name, column in table.items()} == {
        "t": [0.0, 1.0],
        "u": [1.5, 2.5],
    }


def test_table_keeps_every_digit(tmp_path: Path) -> None:
    """The nearest float64 to what is written."""
    path = tmp_path / "table.csv"
    values = np.random.default_rng(0).standard_normal(50) * 10.0 ** np.arange(-25, 25)
    path.write_text("u\n" + "\n".join(repr(float(v)) for v in values) + "\n", encoding="utf-8")
    assert read_table(path)["u"].tolist() == values.tolist()


@pytest.mark.parametrize("kind", ["constant", "sine", "chirp", "multisine"])
def test_amplitude_bounds_the_signal(kind: str) -> None:
    """|u - offset| <= amplitude, per actuator, and nearly reached."""
    signal = Signal(
        kind=kind,
        amplitude={"left": 2.0, "right": 0.5},
        offset={"left": -1.0, "right": 3.0},
        frequency=1.0,
    )
    u = generate(signal, T, NAMES, REST)
    assert u.shape == (400, 2)
    peak = np.abs(u - [-1.0, 3.0]).max(axis=0)
    assert np.all(peak <= np.array([2.0, 0.5]) * (1 + 1e-12))
    assert np.all(peak >= np.array([2.0, 0.5]) * 0.99)


def test_one_amplitude_for_all_and_none_for_the_unnamed() -> None:
    """A number holds for every actuator; a table leaves the others at rest."""
    u = generate(Signal(kind="constant", amplitude=2.0, offset=1.0), T, NAMES, REST)
    assert np.array_equal(u, np.full((400, 2), 3.0))
    u = generate(Signal(kind="sine", amplitude={"right": 2.0}), T, NAMES, REST)
    assert not u[:, 0].any()
    assert u[:, 1].any()


def test_sine() -> None:
    """Its frequency; each actuator is 17 % faster than the one before, so that no two move alike."""
    u = generate(Signal(kind="sine", amplitude=3.0, frequency=0.5), T, NAMES, REST)
    assert np.allclose(u[:, 0], 3.0 * np.sin(np.pi * T), rtol=0, atol=1e-12)
    assert np.allclose(u[:, 1], 3.0 * np.sin(1.17 * np.pi * T), rtol=0, atol=1e-12)


def test_chirp_sweeps_its_frequencies() -> None:
    """Starts at zero, its frequency grows linearly to the end; the next actuator sweeps 17 % higher."""
    u = generate(
        Signal(kind="chirp", amplitude=2.0, frequency=1.0, frequency_end=5.0), T, NAMES, REST
    )
    turns = 1.0 * T + 0.5 * (5.0 - 1.0) * T**2 / T[-1]
    assert np.allclose(u[:, 0], 2.0 * np.sin(2 * np.pi * turns), rtol=0, atol=1e-9)
    assert np.allclose(u[:, 1], 2.0 * np.sin(2 * np.pi * 1.17 * turns), rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["sine", "chirp"])
def test_signals_begin_at_rest_without_a_jolt(kind: str) -> None:
    """Where no offset is stated they swing about the control at rest; a stated offset replaces all of it."""
    rest = np.array([4.0, -7.0])
    u = generate(Signal(kind=kind, amplitude=2.0), T, NAMES, rest)
    assert u[0] == pytest.approx(rest, abs=1e-12)
    assert np.array_equal(u, rest + generate(Signal(kind=kind, amplitude=2.0), T, NAMES, REST))
    stated = generate(Signal(kind=kind, amplitude=2.0, offset={"right": 1.0}), T, NAMES, rest)
    assert stated[0] == pytest.approx([0.0, 1.0], abs=1e-12)
    assert rest.tolist() == [4.0, -7.0]


def test_chirp_ends_at_five_times_its_start_by_default() -> None:
    """The end of the sweep may be left out."""
    default = generate(Signal(kind="chirp", frequency=0.5), T, ("u",), REST[:1])
    assert np.array_equal(
        default,
        generate(Signal(kind="chirp", frequency=0.5, frequency_end=2.5), T, ("u",), REST[:1]),
    )


def test_multisine_holds_its_harmonics_only() -> None:
    """Over whole periods all power is at f, 2 f, ..., n f."""
    u = generate(Signal(kind="multisine", frequency=0.5, harmonics=4, seed=2), T, ("u",), REST[:1])[
        :, 0
    ]
    spectrum = np.abs(np.fft.rfft(u))  # bins of 0.25 Hz
    expected = {2, 4, 6, 8}
    assert set(np.flatnonzero(spectrum > 1e-9 * spectrum.max())) == expected


def test_multisine_seed() -> None:
    """Same seed, same signal; another seed, another; actuators differ."""
    first, again, other = (
        generate(Signal(kind="multisine", amplitude=1.0, seed=seed), T, NAMES, REST)
        for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again)
    assert np.abs(first - other).max() > 0.1
    assert np.abs(first[:, 0] - first[:, 1]).max() > 0.1


def test_multisine_leaves_the_global_generator_alone() -> None:
    """Randomness is passed in."""
    state = np.random.get_state()[1].tolist()  # noqa: NPY002 - the legacy state is what must not move
    wave = multisine(T, 2, 0.5, 5, np.random.default_rng(0))
    assert np.random.get_state()[1].tolist() == state  # noqa: NPY002
    assert np.abs(wave).max(axis=0) == pytest.approx([1.0, 1.0])


@pytest.mark.parametrize("key", ["amplitude", "offset"])
def test_unknown_actuator(key: str) -> None:
    """Names key, fault, valid names."""
    signal = Signal(kind="sine", **{key: {"lift": 1.0}})
    with pytest.raises(ExperimentError, match=rf"initial\.control\.{key}: .*'lift'.*left, right"):
        generate(signal, T, NAMES, REST)


def test_setup_samples_the_signal_at_its_rate() -> None:
    """At 20 Hz every fifth sample of 100 Hz; a coarser level has the mean over its longer samples."""
    e = Experiment.from_file(MODELS / "cart_pendulum.toml").replace(
        horizon=2.0, initial={"control": {"kind": "sine", "frequency": 0.7}}
    )
    fine, slow = Setup(e), Setup(e.replace(rate=20.0, measure_rate=20.0))
    assert np.allclose(slow.control, fine.control[::5], rtol=0, atol=1e-12)
    coarse = fine.coarser(4)
    assert coarse.dt == pytest.approx(4 * fine.dt)
    assert np.allclose(
        coarse.control[:, 0], fine.control.reshape(-1, 4).mean(axis=1), rtol=0, atol=1e-12
    )


def test_setup_swings_about_the_control_of_the_keyframe(tmp_path: Path) -> None:
    """The keyframe's control is where the signal starts, an offset in the file wins over it."""
    model = (MODELS / "cart_pendulum.xml").read_text(encoding="utf-8")
    held = model.replace('name="hanging"', 'name="hanging" ctrl="1.5"')
    assert held != model
    (tmp_path / "held.xml").write_text(held, encoding="utf-8")
    e = Experiment.from_file(MODELS / "cart_pendulum.toml").replace(
        model=str(tmp_path / "held.xml"),
        horizon=1.0,
        initial={"control": {"kind": "sine", "amplitude": 0.5}},
    )
    control = Setup(e).control[:, 0]
    assert (control[0], control.max(), control.min()) == pytest.approx((1.5, 2.0, 1.5), abs=1e-2)
    stated = Setup(
        e.replace(initial={"control": {"kind": "sine", "amplitude": 0.5, "offset": -1.0}})
    )
    assert stated.control[:, 0] == pytest.approx(control - 2.5, abs=1e-12)
