"""Models, parameters, recordings and motions as a Python program gives them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mjfim
from mjfim.errors import ExperimentError, MjfimError
from mjfim.experiment.given import recordings_of
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.output.archive import write_recording
from tests.support.cart_pendulum import MODEL, STATED
from tests.support.mesh_model import MESH
from tests.support.paths import ROOT


@pytest.fixture(scope="module")
def system() -> System:
    """The experiment on its model."""
    return System.resolve(Experiment(**STATED))


@pytest.fixture(scope="module")
def recording(system: System) -> mjfim.Recording:
    """A recording of the initial motion."""
    return mjfim.simulate(system.experiment, seed=3)


# ---- parameters


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        (["body/bob:mass"], {"body/bob:mass": "body/bob:mass"}),
        (
            ["joint/*:damping", "body/bob:ipos[*]"],
            {
                path: path
                for path in (
                    "joint/slide:damping",
                    "joint/hinge:damping",
                    *(f"body/bob:ipos[{i}]" for i in range(3)),
                )
            },
        ),
        ({"m": "body/bob:mass"}, {"m": "body/bob:mass"}),
    ],
)
def test_a_path_stands_for_its_table_and_a_star_for_any_text(
    parameters: Any, expected: dict[str, str]
) -> None:
    """In a list each match is a parameter with its path as the name."""
    found = Experiment(**{**STATED, "parameters": parameters}).parameters

    assert list(found) == list(expected)
    assert {name: spec.target for name, spec in found.items()} == expected


def test_none_removes_what_is_stated() -> None:
    experiment = Experiment(**{**STATED, "fit": {"segments": 0.2}})

    changed = experiment.replace(
        parameters={"m": None, "l": "body/bob:ipos[2]"},
        noise={"qvel:hinge": None, "qpos:slide": np.float64(0.02)},
        fit={"segments": None},
        horizon=None,
    )

    assert list(changed.parameters) == ["c", "l"]
    assert changed.noise == {"qpos:slide": 0.02, "qpos:hinge": 0.01}
    assert (changed.fit.segments, changed.horizon) == (None, None)


def test_lists_and_arrays_are_taken() -> None:
    experiment = Experiment(**STATED).replace(
        initial={"qpos": np.array([0.1, 0.2]), "qvel": [0, np.float32(0.5)]},
        parameters={"m": {"bounds": np.array([0.5, 2.0])}},
    )

    assert experiment.initial.qpos == (0.1, 0.2)
    assert experiment.parameters["m"].bounds == (0.5, 2.0)


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"parameters": ["joint/*:dampng"]}, "unknown parameter path 'joint/*:dampng'"),
        ({"parameters": {"d": "joint/*:damping"}}, 'in a list, parameters = ["joint/*:damping"]'),
        ({"parameters": [3]}, "parameters: should be a table"),
        ({"parameters": {"a": None}}, "parameters.a: should be a table"),
        ({"noise": {"qvel:slide": None}}, "noise.qvel:slide: should be a number or a table"),
        ({"model": MODEL.with_name("nothing.xml")}, "nothing.xml"),
    ],
)
def test_what_is_wrong_is_named(tables: dict[str, Any], message: str) -> None:
    with pytest.raises(MjfimError) as caught:
        System.resolve(Experiment(**STATED).replace(**tables))

    assert message in str(caught.value)


# ---- models


def test_patterns_match_in_a_model_whose_files_are_bytes() -> None:
    text = """
    <mujoco><asset><mesh name="part" file="part.obj"/></asset><worldbody>
      <body name="arm"><joint name="turn"/><geom type="mesh" mesh="part"/></body>
    </worldbody></mujoco>
    """
    spec = mujoco.MjSpec.from_string(text, assets={"part.obj": MESH.encode()})

    found = Experiment(model=spec, rate=50.0, parameters=["body/*:mass"], noise={"state": 0.1})

    assert list(System.resolve(found).parameters.names) == ["body/arm:mass"]


def test_another_model_replaces_the_one_in_memory() -> None:
    text = MODEL.read_text()
    experiment = Experiment(**{**STATED, "model": text})

    heavier = experiment.replace(model=text.replace('mass="2"', 'mass="1.5"'))

    masses = [System.resolve(each).model.body("bob").mass[0] for each in (experiment, heavier)]
    assert masses == [2.0, 1.5]


# ---- recordings


def test_a_recording_is_taken_in_all_kinds(
    recording: mjfim.Recording, system: System, tmp_path: Path
) -> None:
    t, ctrl, qpos, hinge = recording.t, recording.ctrl, recording.y[:, :2], recording.y[:, 2]
    table = tmp_path / "log.csv"
    write_recording(table, recording, system)
    padded = {"force": np.append(ctrl[:, 0], np.nan)}
    for given in (
        recording,
        [recording],
        table,
        str(table),
        (table,),
        {"t": t, "ctrl": ctrl, "qpos": qpos, "qvel": {"hinge": hinge}},
        {"t": t.tolist(), "ctrl": ctrl.tolist(), "qpos": qpos.tolist(), "qvel:hinge": hinge},
        {"t": t, "ctrl": padded, "qpos": qpos.T, "qvel:hinge": hinge},
    ):
        (found,) = recordings_of(system, given)
        assert found.outputs == recording.outputs
        for name in ("t", "ctrl", "y"):
            assert_allclose(getattr(found, name), getattr(recording, name), rtol=1e-12, atol=1e-12)


def test_the_table_of_a_log_says_how_columns_are_read_and_not_arrays(
    recording: mjfim.Recording, system: System
) -> None:
    """Columns of a log have its names and units, arrays those of MuJoCo."""
    table = {
        "time": "s",
        "columns": {"ctrl:force": "u", "qpos:hinge": {"column": "q", "unit": "deg"}},
    }
    stated = System.resolve(system.experiment.replace(recording=table))
    t, ctrl, hinge = recording.t, recording.ctrl, recording.y[:, 1]

    (column,) = recordings_of(stated, {"s": t, "u": ctrl, "q": np.rad2deg(hinge)})
    (array,) = recordings_of(stated, {"t": t, "ctrl": ctrl, "qpos": {"hinge": hinge}})

    assert_allclose(column.y, array.y, rtol=1e-12)
    assert column.outputs == array.outputs == ("qpos:hinge",)


def test_arrays_of_sensors_are_in_the_order_of_mujoco(recording: mjfim.Recording) -> None:
    system = System.resolve(Experiment(**{**STATED, "noise": {"hinge_velocity": 0.1}}))
    width = system.model.nsensordata
    address = system.model.sensor("hinge_velocity").adr[0]
    data = np.arange(width * len(recording.t), dtype=float).reshape(-1, width)

    (found,) = recordings_of(
        system, {"t": recording.t, "ctrl": recording.ctrl, "sensordata": 0.1 * np.sin(data)}
    )

    assert found.outputs == ("hinge_velocity",)
    assert_array_equal(found.y[:, 0], 0.1 * np.sin(data[:, address]))


def test_positions_of_joints_serve_their_sensors(recording: mjfim.Recording) -> None:
    """The noise that an MJCF states is that of its sensors; a robot's log has its joints."""
    stated = {key: value for key, value in STATED.items() if key != "noise"}
    system = System.resolve(Experiment(**stated))
    arrays = {"t": recording.t, "ctrl": recording.ctrl, "qpos": recording.y[:, :2]}

    (found,) = recordings_of(system, arrays)

    assert set(found.outputs) == {"slide_position", "hinge_angle"}
    assert found.outputs[0] in system.outputs.names
    order = [found.outputs.index(name) for name in ("slide_position", "hinge_angle")]
    assert_array_equal(found.y[:, order], recording.y[:, :2])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"qpos": np.zeros((21, 3))}, "array 'qpos' has 3 columns; the model needs 2"),
        ({"ctrl": np.zeros((21, 2))}, "array 'ctrl' has 2 columns; the model needs 1"),
        ({"ctrl": np.zeros((5, 1))}, "has 5 rows, but 't' has 21"),
        ({"qpos": "text"}, "'qpos': needs an array of numbers; not 'text'"),
        ({"qpos": [[1.0], [1.0, 2.0]]}, "'qpos': needs an array of numbers"),
        ({"t": None}, "'t': needs an array of numbers; not None"),
        ({"t": [0.0] * 21}, "t"),
        ({"t": ...}, "'t' is missing"),
        ({"ctrl": ...}, "found: t, .*; arrays are called `t`"),
    ],
)
def test_a_wrong_array_is_named(
    change: dict[str, Any], message: str, recording: mjfim.Recording, system: System
) -> None:
    """An array in place of which stands `...` is left out."""
    arrays = {"t": recording.t, "ctrl": recording.ctrl, "qpos": recording.y[:, :2], **change}
    given = {name: values for name, values in arrays.items() if values is not ...}

    with pytest.raises(MjfimError, match=message):
        mjfim.identify(system.experiment, **given, progress=False)


def test_an_empty_text_names_no_log(system: System) -> None:
    with pytest.raises(MjfimError, match='"" names no log'):
        recordings_of(system, "")


def test_each_verb_takes_one_recording_without_a_list(
    recording: mjfim.Recording, system: System
) -> None:
    experiment = system.experiment
    verbs = [
        lambda given: mjfim.identify(experiment, given, progress=False).theta,
        lambda given: mjfim.check(experiment, given, progress=False).information,
        lambda given: mjfim.predict(experiment, [1.0, 1.0], given)[0].rms,
        lambda given: mjfim.inverse_dynamics(experiment, given).theta,
    ]
    for verb in verbs:
        assert np.array_equal(verb(recording), verb([recording]), equal_nan=True)


# ---- experiments and motions


def test_a_path_stands_for_the_experiment_and_a_design_for_its_motion() -> None:
    file = ROOT / "models" / "cart_pendulum.toml"
    experiment = Experiment.from_file(file).replace(descent={"max_iterations": 2, "starts": 1})
    design = mjfim.design(experiment, seconds=5.0, progress=False)

    for verb in (mjfim.evaluate, mjfim.simulate):
        by_design, by_motion = verb(file, design), verb(str(file), design.trajectory)
        names = ("ctrl", "y") if verb is mjfim.simulate else ("information", "std")
        for name in names:
            assert_array_equal(getattr(by_design, name), getattr(by_motion, name))
    checked = mjfim.check(file, trajectory=design, progress=False)
    assert checked.source == "the given trajectory"
    assert list(mjfim.monte_carlo(file, design, trials=4, progress=False).sets) == ["final"]


def test_the_initial_motion_is_the_default(system: System) -> None:
    experiment = system.experiment
    initial = mjfim.check(experiment, progress=False)

    assert mjfim.evaluate(experiment).information.tolist() == initial.information.tolist()
    assert mjfim.simulate(experiment).ctrl.shape == (20, 1)


def test_a_motion_of_another_model_is_refused(system: System) -> None:
    one = np.zeros((3, 1))
    motion = mjfim.Trajectory(t=[0.0, 0.02, 0.04], qpos=one, qvel=one, act=one, ctrl=one[1:])

    for verb in (mjfim.evaluate, mjfim.simulate, mjfim.monte_carlo, mjfim.sysid_control):
        with pytest.raises(MjfimError, match=r"made for|sysid is not installed"):
            verb(system.experiment, motion)
    with pytest.raises(MjfimError, match=r"the motion: made for .* = \(1, 1, 1, 1\), .* has"):
        mjfim.check(system.experiment, trajectory=motion, progress=False)
    with pytest.raises(ExperimentError, match="expected a row for each sample with 1 columns"):
        mjfim.simulate(system.experiment, np.zeros((4, 2)))
