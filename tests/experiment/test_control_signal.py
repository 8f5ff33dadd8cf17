"""Generated controls keep their amplitude, their frequencies and their seed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mjfim.errors import ExperimentError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.initial import generate
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system_tables import Signal
from tests.support.paths import MODELS

NAMES = ("left", "right")
REST = np.zeros(2)
T = np.arange(400) * 0.01


@pytest.mark.parametrize("kind", ["constant", "multisine"])
def test_amplitude_bounds_the_signal(kind: str) -> None:
    """|u - offset| <= amplitude, per actuator, and nearly reached."""
    size, offset = np.array([2.0, 0.5]), np.array([-1.0, 3.0])
    tables = (dict(zip(NAMES, values, strict=True)) for values in (size, offset))
    stated = dict(zip(("amplitude", "offset"), tables, strict=True))
    u = generate(Signal(kind=kind, frequency=1.0, **stated), T, NAMES, REST)
    peak = np.abs(u - offset).max(axis=0)
    assert np.all(peak <= size * (1 + 1e-12))
    assert np.all(peak >= size * 0.99)


def test_one_amplitude_for_all_and_none_for_the_unnamed() -> None:
    """A number holds for every actuator; a table leaves the others at rest."""
    u = generate(Signal(kind="constant", amplitude=2.0, offset=1.0), T, NAMES, REST)
    assert np.array_equal(u, np.full((400, 2), 3.0))
    u = generate(Signal(kind="sine", amplitude={"right": 2.0}), T, NAMES, REST)
    assert not u[:, 0].any()
    assert u[:, 1].any()


def test_sine_has_its_frequency() -> None:
    """Each actuator is 17 % faster than the one before, so that no two have equal frequencies."""
    u = generate(Signal(kind="sine", amplitude=3.0, frequency=0.5), T, NAMES, REST)
    expected = 3.0 * np.sin(np.pi * np.outer(T, [1.0, 1.17]))
    assert np.allclose(u, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("end", [{"frequency_end": 5.0}, {}], ids=["stated", "default"])
def test_chirp_sweeps_its_frequencies(end: dict[str, float]) -> None:
    """Starts at zero, its frequency grows linearly to the end, which is five times as high by
    default; the next actuator sweeps 17 % higher.
    """
    u = generate(Signal(kind="chirp", amplitude=2.0, frequency=1.0, **end), T, NAMES, REST)
    turns = 1.0 * T + 0.5 * (5.0 - 1.0) * T**2 / T[-1]
    expected = 2.0 * np.sin(2 * np.pi * np.outer(turns, [1.0, 1.17]))
    assert np.allclose(u, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["sine", "chirp"])
def test_signals_begin_without_a_jump(kind: str) -> None:
    """Without an offset they oscillate about the control at rest; a stated offset replaces it."""
    rest = np.array([4.0, -7.0])
    u = generate(Signal(kind=kind, amplitude=2.0), T, NAMES, rest)
    assert u[0] == pytest.approx(rest, abs=1e-12)
    assert np.ptp(u, axis=0) == pytest.approx(4.0, abs=0.1)
    stated = generate(Signal(kind=kind, amplitude=2.0, offset={"right": 1.0}), T, NAMES, rest)
    assert stated[0] == pytest.approx([0.0, 1.0], abs=1e-12)
    assert rest.tolist() == [4.0, -7.0]


def test_multisine_contains_its_harmonics_only() -> None:
    """Over whole periods all power is at f, 2 f, ..., n f."""
    u = generate(Signal(kind="multisine", frequency=0.5, harmonics=4, seed=2), T, NAMES, REST)
    spectrum = np.abs(np.fft.rfft(u[:, 0]))  # bins of 0.25 Hz
    assert np.flatnonzero(spectrum > 1e-9 * spectrum.max()).tolist() == [2, 4, 6, 8]


def test_multisine_seed() -> None:
    first, again, other = (
        generate(Signal(kind="multisine", amplitude=1.0, seed=seed), T, NAMES, REST)
        for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again)
    assert np.abs(first - other).max() > 0.1
    assert np.abs(first[:, 0] - first[:, 1]).max() > 0.1


@pytest.mark.parametrize("key", ["amplitude", "offset"])
def test_unknown_actuator(key: str) -> None:
    signal = Signal(kind="sine", **{key: {"lift": 1.0}})
    with pytest.raises(ExperimentError, match=rf"initial\.control\.{key}: .*'lift'.*left, right"):
        generate(signal, T, NAMES, REST)


def test_the_signal_oscillates_about_the_control_of_the_keyframe(tmp_path: Path) -> None:
    model = (MODELS / "cart_pendulum.xml").read_text(encoding="utf-8")
    held = model.replace('name="hanging"', 'name="hanging" ctrl="1.5"')
    (tmp_path / "held.xml").write_text(held, encoding="utf-8")
    e = Experiment.from_file(MODELS / "cart_pendulum.toml").replace(
        model=str(tmp_path / "held.xml"),
        horizon=1.0,
        initial={"control": {"kind": "sine", "amplitude": 0.5}},
    )
    control = DesignTask.resolve(e).control[:, 0]
    assert (control[0], control.max(), control.min()) == pytest.approx((1.5, 2.0, 1.5), abs=1e-2)
