"""Parameters and sequences of mujoco.sysid, which need its classes and not its installation."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from mujoco import sysid
from numpy.testing import assert_allclose

import mjfim
from mjfim.experiment.given import recordings_of
from mjfim.experiment.schema import parameter_tables
from mjfim.experiment.system import System
from mjfim.output.export.sysid import export_sysid, silenced
from tests.support import cart_pendulum
from tests.support.cart_pendulum import MODEL

STATED = {
    **cart_pendulum.STATED,
    "parameters": {"m": "body/bob:mass"},
    "noise": {"qpos:slide": 0.01, "qvel:hinge": 0.1},
}
installed = pytest.mark.skipif(
    not hasattr(sysid, "ModelSequences"), reason="needs mujoco.sysid: pip install 'mjfim[sysid]'"
)


def series(t: Any, data: Any, **signals: Any) -> SimpleNamespace:
    """A `TimeSeries`; a signal has the name of its kind, and columns."""
    mapping = {
        name: (SimpleNamespace(name=kind), np.array([column]))
        for name, (kind, column) in signals.items()
    }
    return SimpleNamespace(times=t, data=data, signal_mapping=mapping)


class Parameter(SimpleNamespace):
    """A parameter as sysid has it."""

    modifier, frozen = None, False
    size = property(lambda self: self.value.size)

    def as_vector(self) -> np.ndarray:
        return self.value

    def get_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.low, self.high

    def update_from_vector(self, vector: np.ndarray) -> None:
        self.value = vector


def parameter(numbers: list[list[float]], **fields: Any) -> Parameter:
    """A parameter by the rows value, lower and upper bound."""
    value, low, high = np.array(numbers)
    return Parameter(value=value, low=low, high=high, **fields)


def dictionary(parameters: dict[str, Parameter]) -> SimpleNamespace:
    """A `ParameterDict`."""
    return SimpleNamespace(
        parameters=parameters, items=parameters.items, as_nominal_vector=lambda: np.zeros(0)
    )


def set_body(spec: Any, parameter: Any) -> None:
    """Set the mass and the place of the bob by one parameter of two numbers."""
    body = spec.body("bob")
    body.mass, body.ipos[2] = parameter.value


def test_modifiers_become_functions_that_edit_as_sysid_does() -> None:
    """All numbers of a parameter come together, as its modifier needs them."""
    bob = parameter([[1.5, -0.2], [0.1, -1.0], [5.0, 1.0]], modifier=set_body)
    damping = parameter([[0.3], [0.0], [2.0]])
    frozen = parameter([[7.0], [0.0], [9.0]], frozen=True)
    given = dictionary({"bob": bob, "joint/hinge:damping": damping, "frozen": frozen})

    experiment = mjfim.Experiment(**{**STATED, "parameters": given})
    system = System.resolve(experiment)

    assert system.parameters.names == ("bob[0]", "bob[1]", "joint/hinge:damping")
    assert system.parameters.guess.tolist() == [1.5, -0.2, 0.3]
    assert system.parameters.upper.tolist() == [5.0, 1.0, 2.0]
    model = system.model_at(np.array([1.2, -0.4, 0.6]))
    spec = mujoco.MjSpec.from_file(str(MODEL))
    set_body(spec, SimpleNamespace(value=[1.2, -0.4]))
    wanted = spec.compile()
    assert_allclose(model.body("bob").mass, wanted.body("bob").mass, rtol=1e-12)
    assert_allclose(model.body("bob").ipos, wanted.body("bob").ipos, rtol=1e-12)
    assert model.joint("hinge").damping[0] == 0.6


def test_parameters_without_modifier_change_those_of_an_experiment() -> None:
    changed = mjfim.Experiment(**STATED).replace(
        parameters=dictionary({"m": parameter([[1.4], [0.5], [3.0]])})
    )

    spec = changed.parameters["m"]
    assert (spec.target, spec.guess, spec.bounds) == ("body/bob:mass", 1.4, (0.5, 3.0))


def test_sequences_are_recordings_at_the_times_of_both_series() -> None:
    """Controls and measurements may have other times; a control is held."""
    system = System.resolve(mjfim.Experiment(**STATED))
    t = 0.02 * np.arange(11)
    control = series(t, np.sin(t)[:, None], force_ctrl=("MjCtrl", 0))
    data = np.stack([np.cos(t), np.sin(3 * t)], axis=1)
    signals = {"slide_qpos": ("MjStateQPos", 0), "qvel:hinge": ("CustomObs", 1)}
    sequences = SimpleNamespace(
        sequence_name=["a", "b"],
        control=[control] * 2,
        sensordata=[series(t + 0.01, data, **signals)] * 2,
    )

    one, two = recordings_of(system, sequences)

    assert (one.name, two.name) == ("a", "b")
    assert one.outputs == ("qpos:slide", "qvel:hinge")
    assert_allclose(one.ctrl[:, 0], np.repeat(np.sin(t), 2)[:-1])
    assert_allclose(one.y[1::2, 0], np.cos(t))
    assert np.isnan(one.y[::2]).all()


@installed
def test_what_is_exported_comes_back() -> None:
    experiment = mjfim.Experiment(**STATED)
    recording = mjfim.simulate(experiment, seed=1)
    problem = export_sysid(experiment, recording)

    found = mjfim.identify(experiment, problem.sequences, progress=False)

    wanted = mjfim.identify(experiment, recording, progress=False)
    assert_allclose(found.theta, wanted.theta, rtol=1e-6)
    tables = parameter_tables(problem.parameters)
    assert tables["m"]["guess"] == experiment.replace(parameters=tables).parameters["m"].guess


@installed
def test_the_control_of_a_design_plays_in_sysid() -> None:
    """One row for each engine step, by the names of the actuators."""
    experiment = mjfim.Experiment(**STATED)
    system = System.resolve(experiment)
    motion = mjfim.evaluate(experiment).trajectory

    series = mjfim.sysid_control(experiment, motion)

    start = sysid.create_initial_state(system.model, motion.qpos[0], motion.qvel[0])
    with silenced():
        (played,) = sysid.sysid_rollout(
            models=[system.model],
            datas=mujoco.MjData(system.model),
            control_signal=[series],
            initial_states=[start],
        )
    step = round(motion.dt / system.model.opt.timestep)
    assert list(series.signal_mapping) == ["force_ctrl"]
    assert_allclose(
        played.state.data[step - 1 :: step][: len(motion.ctrl), 1:3], motion.qpos[1:], atol=1e-9
    )
