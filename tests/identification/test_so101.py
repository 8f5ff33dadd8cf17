"""The benchmark of a real SO-101 arm, on a few seconds of one motion."""

from __future__ import annotations

from pathlib import Path

import pytest

from scripts.benchmarks import so101
from tests.support.paths import SHARED_DATA, SHARED_MODELS

DATA, MODEL = SHARED_DATA / "sage_so101", SHARED_MODELS / "so101" / "so101_nomesh.xml"

pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason="the measured recordings are not beside the repository"
)


@pytest.mark.parametrize(
    ("motion", "expected"),
    [
        ("multisine", [28.1, 19.3, 18.5, 15.5]),
        ("step_response", [29.8, 20.4, 22.8, 19.6]),
    ],
)
def test_published_sets_have_their_known_errors(motion: str, expected: list[float]) -> None:
    """Another program found these errors [mrad] of the first 30 s, at finer delays."""
    rows = so101.read_motion(DATA / motion)[:1500]
    found = [so101.published_rms(MODEL, each, rows)[0] for each in so101.PUBLISHED.values()]

    assert found == pytest.approx(expected, abs=2.0)


@pytest.mark.slow
def test_a_fit_to_seconds_predicts_the_motion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Servos from two seconds of the multisine predict its first six better than published ones."""
    whole = so101.read_motion(DATA / "multisine")[:300]
    monkeypatch.setattr(so101, "FITTED", {"multisine": (0, 100)})
    monkeypatch.setattr(so101, "HELD_OUT", "")
    monkeypatch.setattr(so101, "ARM", so101.ARM.replace("fit = {", "fit = { max_iterations = 6,"))
    # Delays and drag keep their guesses.
    law, rest = so101.JOINT.split("[parameters.latency_JOINT]")
    frictions = rest[rest.index("[parameters.damping") : rest.index("[parameters.drag")]
    monkeypatch.setattr(so101, "JOINT", law + frictions)
    monkeypatch.setattr(so101, "SHOWN", {"multisine": (("wrist_roll", "gripper"), 0, 300)})
    monkeypatch.setattr(so101, "read_motion", lambda folder: whole)
    monkeypatch.setattr("sys.argv", ["so101", str(DATA), str(MODEL), str(tmp_path)])

    assert so101.main() == 0

    row = next(
        line for line in capsys.readouterr().out.splitlines() if "multisine" in line and "│" in line
    )
    numbers = [float(cell) for cell in row.split("│")[2:-1]]
    assert 1.2 * numbers[0] < min(numbers[7:])
