"""Signs of controls and angles that are opposite to those of the model are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System, simulate_system
from mjfim.identification.identify import identify_system
from mjfim.records.trajectory import Recording
from tests.support.paths import ROOT

CONTROL = {"kind": "multisine", "amplitude": 4.0, "frequency": 0.4, "harmonics": 6}


@pytest.fixture(scope="module")
def system() -> System:
    """The cart-pendulum under a multisine."""
    base = mjfim.Experiment.from_file(ROOT / "models" / "cart_pendulum.toml")
    return System.resolve(
        base.replace(
            initial={"control": CONTROL},
            fit={"bootstrap": 0, "max_iterations": 15, "segments": "whole"},
            horizon=2.0,
        )
    )


@pytest.fixture(scope="module")
def recording(system: System) -> Recording:
    """A recording of the complete model."""
    return simulate_system(system, DesignTask.of(system).initial, seed=3)


def flipped(recording: Recording, *names: str, control: bool = False) -> Recording:
    """The recording with the other sign of some outputs or of the control."""
    y = np.array(recording.y)
    for name in names:
        y[:, recording.outputs.index(name)] *= -1.0
    return replace(recording, y=y, ctrl=-recording.ctrl if control else recording.ctrl)


def said(system: System, recording: Recording) -> list[str]:
    """Warnings about signs."""
    found = identify_system(system, [recording])
    return [text for text in found.warnings if "looks flipped" in text]


@pytest.mark.slow
def test_a_flipped_control_is_found(system: System, recording: Recording) -> None:
    (sentence,) = said(system, flipped(recording, control=True))
    assert sentence.startswith("the sign of control force looks flipped")
    assert "scale = -1.0" in sentence


@pytest.mark.slow
@pytest.mark.parametrize(
    ("outputs", "words"),
    [
        (("qpos:slide", "qvel:slide"), "joint slide"),
        (("qvel:hinge",), "qvel:hinge"),
        (("qpos:slide",), "qpos:slide"),
    ],
)
def test_a_flipped_coordinate_is_found(
    outputs: tuple[str, ...], words: str, system: System, recording: Recording
) -> None:
    (sentence,) = said(system, flipped(recording, *outputs))
    assert sentence.startswith(f"the sign of {words} looks flipped")


def test_right_data_have_no_flipped_sign(system: System, recording: Recording) -> None:
    assert said(system, recording) == []


@pytest.mark.slow
def test_other_misfits_have_no_flipped_sign(system: System, recording: Recording) -> None:
    """Outputs of half the size, a large bias, and a control that did not act."""
    halved = replace(recording, y=0.5 * recording.y)
    biased = replace(recording, y=recording.y + 2.0)
    without = replace(recording, ctrl=np.zeros_like(recording.ctrl))
    for wrong in (halved, biased, without):
        assert said(system, wrong) == []


@pytest.mark.slow
def test_a_log_without_any_motion_of_the_model_has_no_flipped_sign(
    system: System, recording: Recording
) -> None:
    noise = np.random.default_rng(0).normal(size=recording.y.shape)
    assert said(system, replace(recording, y=noise)) == []
