"""Packed experiments: they contain their files, and compute the same to the last digit."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjfim.errors import ExperimentError, ModelError
from mjfim.excitation.evaluation import evaluate_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.model import loading
from mjfim.parallel.shared_value import Kept
from tests.support.mesh_model import write_mesh_model

# An experiment with a model of several files and with the table of a control.
STATED: dict[str, Any] = {
    "model": "robot/tool.xml",
    "rate": 50.0,
    "horizon": 1.0,
    "initial": {"control": "tables/push.csv"},
    "parameters": {
        "mass": {"target": "body/tool:mass"},
        "damping": {"target": "joint/turn:damping"},
    },
    "noise": {"angle": 0.01},
    "cost": {"control": 1e-3},
}


def stated(folder: Path) -> Experiment:
    """The experiment, with its files in a folder."""
    write_mesh_model(folder)
    table = folder / "tables" / "push.csv"
    table.parent.mkdir()
    rows = [f"{0.02 * k},{np.sin(0.3 * k)}" for k in range(60)]
    table.write_text("\n".join(["t,motor", *rows]))
    return Experiment(**STATED, directory=folder, source=str(folder / "tool.toml"))


def cost_of(experiment: Experiment) -> float:
    """Cost J of the initial control."""
    task = DesignTask.resolve(experiment, threads=1)
    return float(evaluate_task(task, task.initial).cost)


def sent(experiment: Experiment) -> Experiment:
    """The experiment as a worker process receives it."""
    received: Experiment = pickle.loads(pickle.dumps(experiment.packed()))
    return received


def test_a_packed_experiment_needs_no_file_and_has_the_same_cost(tmp_path: Path) -> None:
    experiment = stated(tmp_path / "study")
    before = cost_of(experiment)

    received = sent(experiment)
    shutil.rmtree(tmp_path / "study")

    assert cost_of(received) == before


def test_a_packed_experiment_does_not_see_later_changes_of_its_files(tmp_path: Path) -> None:
    experiment = stated(tmp_path)
    packed = experiment.packed()
    options = tmp_path / "robot/parts/options.xml"
    options.write_text(options.read_text().replace("0.005", "0.001"))

    assert System.resolve(packed).model.opt.timestep == 0.005
    assert System.resolve(experiment).model.opt.timestep == 0.001


def test_a_changed_copy_keeps_the_files_and_takes_new_ones(tmp_path: Path) -> None:
    experiment = stated(tmp_path)
    packed = experiment.packed()
    (tmp_path / "tables" / "other.csv").write_text("t,motor\n0,0.5\n0.02,0.5\n")

    changed = packed.replace(horizon=0.4)
    further = changed.replace(initial={"control": "tables/other.csv"}).packed()

    assert packed.packed() is packed
    assert changed.packed() is changed
    assert further.files.content(tmp_path / "tables" / "other.csv") is not None
    assert further.files.content(tmp_path / "robot/tool.xml") is not None


def test_a_process_parses_a_packed_model_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed = []
    original = loading.ModelSource

    def counted(path: Path, **options: Any) -> Any:
        """A model, the parsing of which is counted."""
        parsed.append(path)
        return original(path, **options)

    monkeypatch.setattr(loading, "ModelSource", counted)
    monkeypatch.setattr(loading, "_models", Kept(loading.KEPT_MODELS))
    experiment = stated(tmp_path)

    for _ in range(3):
        System.resolve(sent(experiment), threads=1)
    System.resolve(sent(experiment.replace(horizon=0.5)), threads=1)

    assert len(parsed) == 1


def test_messages_of_packed_files_name_the_file_of_the_user(tmp_path: Path) -> None:
    experiment = stated(tmp_path)
    (tmp_path / "robot/parts/sensors.xml").write_text("<mujoco><nothing/></mujoco>")

    with pytest.raises(ModelError, match=r"tool\.xml"):
        System.resolve(experiment.packed())


def test_missing_files_are_named(tmp_path: Path) -> None:
    experiment = stated(tmp_path)

    with pytest.raises(ExperimentError, match=r"absent\.csv: cannot read the file"):
        experiment.replace(initial={"control": "absent.csv"}).packed()
    with pytest.raises(ModelError, match=r"absent\.xml: no such model file"):
        experiment.replace(model="absent.xml").packed()
