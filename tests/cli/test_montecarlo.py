"""`mjfim montecarlo`: its files and exit codes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mjfim.output.manifest import MANIFEST
from tests.support.cli import STUDY, done, loads, misused, names, read, run


@pytest.mark.usefixtures("empty_figures")
def test_montecarlo_leaves_its_files(folder: Path) -> None:
    """Trials of the initial and the designed trajectory, at a lower measurement rate."""
    words = "montecarlo study.toml out -o mc --trials 20 --seed 3 --measure-rate 25 --json"
    data = loads(done(words).stdout)
    assert names(folder / "mc") == STUDY | {MANIFEST}
    assert read(folder / "mc" / "montecarlo.json") == data
    assert data["measure_rate"] == pytest.approx(25.0)
    for name in ("initial", "final"):
        assert (data[name]["trials"], data[name]["failed"]) == (20, 0)
    assert np.all(np.diag(data["final"]["crlb"]) < np.diag(data["initial"]["crlb"]))


def test_a_design_that_diverges_at_the_true_parameters_is_refused(folder: Path) -> None:
    with np.load(folder / "out" / "design.npz") as data:
        arrays = dict(data)
    np.savez(folder / "wild.npz", **{**arrays, "ctrl": np.full_like(arrays["ctrl"], 1e15)})
    for words in ("simulate study.toml wild.npz -o new", "montecarlo study.toml wild.npz -o new"):
        misused(run(words), "diverges at the true parameters")
        assert not (folder / "new").exists()
