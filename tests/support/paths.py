"""Paths of the repository, of its models and scripts, and of the data of others beside it."""

from __future__ import annotations

from pathlib import Path

# The top folder of the repository: the nearest one above this file that holds pyproject.toml.
ROOT = next(
    folder for folder in Path(__file__).resolve().parents if (folder / "pyproject.toml").is_file()
)

# The experiments and MuJoCo models that the package ships.
MODELS = ROOT / "models"

# The scripts that users copy.
SCRIPTS = ROOT / "scripts"

# Models and recordings of others; the folder lies beside the repository and may be absent.
SHARED = ROOT.parent / "shared"
SHARED_MODELS = SHARED / "models"
SHARED_DATA = SHARED / "data"
