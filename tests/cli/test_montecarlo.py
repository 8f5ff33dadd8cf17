"""`mjfim montecarlo`: its files and exit codes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mjfim.output.manifest import MANIFEST
from tests.support.cli import (
    STUDY,
    done,
    loads,
    misused,
    names,
    read,
    run,
)


@pytest.mark.usefixtures("empty_figures")
def test_montecarlo_leaves_its_files(study: Path, archived: Path, tmp_path: Path) -> None:
    """Trials of the initial and the designed trajectory, at a lower measurement rate."""
    out = tmp_path / "mc"
    options = ("--trials", 20, "--seed", 3, "--measure-rate", 25, "--json")
    result = done("montecarlo", study, archived, "-o", out, *options)
    assert names(out) == STUDY | {MANIFEST}
    data = read(out / "montecarlo.json")
    assert loads(result.stdout) == data
    assert data["measure_rate"] == pytest.approx(25.0)
    assert [(data[name]["trials"], data[name]["failed"]) for name in ("initial", "final")] == [
        (20, 0)
    ] * 2
    assert np.all(np.diag(data["final"]["crlb"]) < np.diag(data["initial"]["crlb"]))


def test_montecarlo_of_a_diverging_design(study: Path, archived: Path, tmp_path: Path) -> None:
    """The simulation at the true parameters diverges under the control."""
    with np.load(archived) as data:
        arrays = {key: data[key] for key in data.files}
    np.savez(tmp_path / "wild.npz", **{**arrays, "ctrl": np.full_like(arrays["ctrl"], 1e15)})
    for verb, place, *more in (("simulate", "r.csv"), ("montecarlo", "mc", "--trials", 2)):
        words = (verb, study, tmp_path / "wild.npz", "-o", tmp_path / place, *more)
        misused(run(*words), "diverges at the true parameters")
    assert names(tmp_path) == {"wild.npz"}
