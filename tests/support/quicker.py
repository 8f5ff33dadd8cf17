"""Smaller budgets for the documents, whose tests show that everything runs."""

from __future__ import annotations

import shutil
from pathlib import Path

from tests.support.paths import MODELS

# Budgets of documents, notebooks and models/, and what takes their place.
QUICKER = {
    "--seconds 10 ": "--seconds 2 ",
    "seconds=4.0": "seconds=1.0",
    "(experiment, seconds=10)": '(experiment.replace(rehearsal={"robots": 4}), seconds=1)',
    "--samples 50": "--samples 5",
    "--trials 200": "--trials 20",
    "trials=60": "trials=10",
    '"starts": 3': '"starts": 2',
    '"max_iterations": 20': '"max_iterations": 5',
    '"max_iterations": 25': '"max_iterations": 5',
    "np.arange(1000)": "np.arange(400)",
    "horizon = 3.0": "horizon = 1.5",
    "horizon=3.0": 'horizon=1.5, rehearsal={"robots": 4}',
    "horizon=4.0": 'horizon=2.0, rehearsal={"robots": 4}',
    "max_iterations = 300": "max_iterations = 3",
    "--robots 300": "--robots 20",
    "horizon = 4.0": "horizon = 2.0",
    "tolerance = 1e-7": "tolerance = 1e-3",
    "starts = 4  ": "starts = 2  ",
    "tolerance = 1e-2": "tolerance = 1e-1",
}


def quicker(text: str) -> str:
    """Return a text with smaller budgets."""
    for stated, smaller in QUICKER.items():
        text = text.replace(stated, smaller)
    return text


def quicker_models(folder: Path) -> None:
    """Copy models/ to a new folder, with smaller budgets and few robots of a rehearsal."""
    shutil.copytree(MODELS, folder)
    for path in folder.rglob("*.toml"):
        text = quicker(path.read_text(encoding="utf-8"))
        few = "" if "[rehearsal]" in text else "rehearsal.robots = 4\n"
        path.write_text(few + text, encoding="utf-8")
