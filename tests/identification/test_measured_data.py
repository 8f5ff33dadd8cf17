"""Measured data of other groups: parameters from some recordings predict the others.

Poor data are named. The data are not in the repository; without them, these tests are skipped.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.experiment.system import System
from mjfim.identification.identify import identify_system
from mjfim.recordings.read import read_recording
from mjfim.records.estimate import Estimate
from mjfim.records.trajectory import Recording
from tests.support.paths import ROOT, SHARED_DATA

PENDULUM, SERVO = (
    SHARED_DATA / "dfki_simple_pendulum",
    SHARED_DATA / "bam_xl330" / "raw",
)

pytestmark = pytest.mark.skipif(
    not SHARED_DATA.is_dir(), reason="the measured recordings are not beside the repository"
)

# J, m c, viscous and Coulomb friction as published; atan(100 qd) levels off at pi/2
PUBLISHED_PENDULUM = {"J": 0.06259, "mc": 0.1022, "damping": 0.04707, "coulomb": 0.1839 * np.pi / 2}


# Parameters published by BAM, in the units of models/bam_xl330.toml.
KT, R = 0.32321, 4.76365


PUBLISHED_SERVO = {
    "gain": KT / R,
    "brake": KT**2 / R,
    "damping": 0.0104948,
    "coulomb": 0.00696597,
    "armature": 0.00164322,
    "mounting": 0.0179525,
}


def experiment(name: str, guess: dict[str, float] | None = None, **fit: object) -> mjfim.Experiment:
    """An experiment of models/ with other guesses and settings of the fit."""
    found = mjfim.Experiment.from_file(ROOT / "models" / f"{name}.toml")
    return found.replace(
        parameters={key: {"guess": value} for key, value in (guess or {}).items()}, fit=dict(fit)
    )


def identified(
    stated: mjfim.Experiment, files: list[Path], held_out: list[Path], part: float = 1.0
) -> Estimate:
    """Estimate from the first part of some files, with predictions of held-out ones."""
    system = System.resolve(stated)
    fitted, kept = (
        [begin(read_recording(path, system.channels), part) for path in paths]
        for paths in (files, held_out)
    )
    return identify_system(system, fitted, held_out=kept)


def begin(recording: Recording, part: float) -> Recording:
    """The first part of a recording."""
    return recording.first_rows(int(part * len(recording.t)))


@pytest.mark.slow
def test_pendulum_predicts_the_other_file_far_better_than_published_and_both_agree() -> None:
    """The intervals from both files overlap. One test, because each fit takes long."""
    files = [PENDULUM / f"{name}_measured.csv" for name in ("dircol", "energy_shaping")]
    stated = experiment("dfki_simple_pendulum", PUBLISHED_PENDULUM, bootstrap=100)
    intervals = []
    for fitted, held_out in (files, files[::-1]):
        found = identified(stated, [fitted], [held_out])
        (prediction,) = found.predictions
        assert prediction.held_out and found.misfit
        assert (prediction.identified.rms < 0.5 * prediction.nominal.rms).all()
        assert not any(text.startswith("poor data") for text in found.warnings)

        J, mc, coulomb = (found.parameters.index(name) for name in ("J", "mc", "coulomb"))
        assert 0.12 < found.theta[J] < 0.24
        # The torque constant scales both alike.
        assert 0.4 < found.theta[mc] / found.theta[J] / (0.3042 / 0.14) < 1.6
        # What other rollouts gave, and their spread.
        low, high = found.interval[coulomb]
        assert low < 0.25 and high > 0.10
        # Formal deviations of a model that does not fit are no accuracy.
        assert (0.25 * np.ptp(found.interval[:2], axis=1) > 4.0 * found.std[:2]).all()
        intervals.append(found.interval[[J, mc, coulomb]])
    assert (np.max(intervals, axis=0)[:, 0] <= np.min(intervals, axis=0)[:, 1]).all()


@pytest.mark.slow
def test_poor_data_are_named() -> None:
    stated = experiment("dfki_simple_pendulum", bootstrap=0, max_iterations=2)
    poor = identified(stated, [PENDULUM / "sysid_measured.csv"], [])
    remarks = [s for s in poor.warnings if s.startswith("poor data in sysid_measured.csv")]
    assert any("jumps from row to row" in s and "'torque'" in s for s in remarks)
    assert any("speed is rough" in s for s in remarks)
    assert any("ctrlrange" in s for s in remarks)


@pytest.mark.slow
def test_servo_predicts_held_out_logs_as_well_as_published() -> None:
    """Mean absolute errors of rollouts over three seconds, at two gains of the firmware."""
    files = [SERVO / f"2026-01-15_10h{t}.json" for t in ("28m10", "28m57", "28m24", "28m42")]
    stated = experiment("bam_xl330", bootstrap=100, max_iterations=3)
    found = identified(stated, files[:2], files[2:], part=0.5)
    mine = np.mean([p.identified.mae[0] for p in found.predictions])
    published = experiment("bam_xl330", PUBLISHED_SERVO)
    system = System.resolve(published)
    logs = [begin(read_recording(path, system.channels), 0.5) for path in files[2:]]
    theirs = [each.mae[0] for each in mjfim.predict(published, system.theta, logs)]
    assert mine < 1.05 * np.mean(theirs)
    assert "coulomb" in found.sloppy
