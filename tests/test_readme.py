"""Everything the README shows runs: its Python blocks, its command lines, its experiment file; and CI uses its commands."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from mjfim.excitation.initial_controls import starts_of
from mjfim.excitation.verification import require_inside
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import Setup
from tests.support.paths import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    """Fenced code blocks of one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with the models, where results may be written."""
    shutil.copytree(ROOT / "models", tmp_path / "models")
    return tmp_path


def run(command: list[str], folder: Path, code: int = 0) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "error"}
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == code, done.stdout + done.stderr


@pytest.mark.parametrize("block", blocks("python"))
def test_python_blocks_run(block: str, checkout: Path) -> None:
    run([sys.executable, "-c", block], checkout)


def test_command_lines_run(checkout: Path) -> None:
    lines = [
        line for block in blocks("sh") for line in block.splitlines() if line.startswith("mjfim ")
    ]
    verbs = {"check", "design", "simulate", "identify", "montecarlo", "replay"}
    assert {line.split()[1] for line in lines} == verbs
    for line in lines:
        command, _, comment = line.partition("#")
        run(
            [sys.executable, "-m", *command.split()],
            checkout,
            1 if "exits with 1" in comment else 0,
        )
    assert (checkout / "out" / "replay.rrd").is_file()


def test_experiment_block_is_a_valid_experiment() -> None:
    setup = Setup(Experiment(**tomllib.loads(blocks("toml")[0]), directory=ROOT / "models"))
    assert setup.parameters.names == ("m", "c")


def test_further_tables_extend_it() -> None:
    whole, *further = (tomllib.loads(block) for block in blocks("toml"))
    assert further
    for tables in further:
        merged = {**whole, **{k: {**whole.get(k, {}), **v} for k, v in tables.items()}}
        setup = Setup(Experiment(**merged, directory=ROOT / "models"))
        assert set(tables.get("parameters", {})) < set(setup.parameters.names)
        assert np.isfinite(setup.problem.point(setup.initial).cost)
        require_inside(setup)
        assert len(list(starts_of(setup, None))) == len(
            {start.name for start in starts_of(setup, None)}
        )


def test_every_example_is_in_the_tour() -> None:
    listed = set(re.findall(r"models/(\w+)\.toml", README))
    assert {path.stem for path in (ROOT / "models").glob("*.toml")} <= listed


def test_two_install_commands_stand_alone_and_ci_takes_them_from_here() -> None:
    commands = [block.strip() for block in blocks("sh") if block.startswith("python3 -m venv")]
    assert len(commands) == 2
    assert all("\n" not in command for command in commands)
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "README.md" in script
    assert "-m pytest" not in script.replace("'-m pytest'", "")


def test_links_point_to_files() -> None:
    targets = re.findall(r"\]\((?!http)([^)#]+)", README)
    assert targets
    assert all((ROOT / target).exists() for target in targets), targets
