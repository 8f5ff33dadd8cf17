"""Models, tasks, plain loops around the engine and checks of derivatives, for many tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.records.trajectory import Sensitivity
from tests.support.paths import SHARED_MODELS

Array = NDArray[np.float64]


# A pendulum on a cart, by one of the integrators; every joint free of limits, no contacts.
CART_PENDULUM = """
<mujoco model="cart_pendulum">
  <option timestep="0.01" integrator="{integrator}"><flag contact="disable"/></option>
  <default><geom mass="0" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="cart">
      <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
      <joint name="slide" type="slide" axis="1 0 0" damping="0.1"/>
      <body name="pendulum">
        <joint name="hinge" type="hinge" axis="0 -1 0" damping="0.4"/>
        <body name="bob" pos="0 0 0.8">
          <inertial pos="0 0 0" mass="1.5" diaginertia="1e-3 1e-3 1e-3"/>
          <site name="bob"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="force" joint="slide"/></actuator>
  <sensor>
    <jointpos name="angle" joint="hinge" noise="0.01"/>
    <jointvel name="rate" joint="hinge" noise="0.05"/>
    <accelerometer name="acc" site="bob" noise="0.3"/>
    <actuatorfrc name="drive" actuator="force" noise="0.1"/>
  </sensor>
</mujoco>
"""

# A body in free flight, pushed off its centre; an arm hangs from it by a ball joint.
FREE_BODY = """
<mujoco model="free_body">
  <option timestep="0.01" integrator="{integrator}" gravity="0 0 -0.5">
    <flag contact="disable"/>
  </option>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="hull" pos="0 0 1">
      <freejoint name="float"/>
      <inertial pos="0.02 0.01 -0.03" mass="1.2" diaginertia="0.05 0.07 0.04"/>
      <site name="thruster" pos="0.1 0.2 -0.1"/>
      <body name="arm" pos="0.1 0.05 0.1">
        <joint name="ball" type="ball" damping="0.05"/>
        <inertial pos="0.05 0 0.25" mass="0.4" diaginertia="0.01 0.012 0.006"/>
        <site name="tip" pos="0 0 0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" site="thruster" gear="0.3 0 1 0 0 0.1"/>
    <motor name="twist" joint="ball" gear="0.2 0.1 0.3"/>
  </actuator>
  <sensor>
    <gyro name="gyro" site="thruster" noise="0.02"/>
    <accelerometer name="acc" site="tip" noise="0.1"/>
    <framepos name="tip" objtype="site" objname="tip" noise="0.01"/>
  </sensor>
</mujoco>
"""

# A servo with an activation state: the force follows the command through a first-order filter.
FILTERED = """
<mujoco model="filtered">
  <option timestep="0.005" integrator="{integrator}"/>
  <worldbody>
    <body name="link">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.2"/>
      <geom name="link" type="capsule" fromto="0 0 0 0.1 0 -0.5" size="0.03" mass="1"
            contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>
    <general name="servo" joint="hinge" dyntype="filter" dynprm="0.08" gainprm="3"/>
  </actuator>
  <sensor>
    <jointpos name="angle" joint="hinge" noise="0.01"/>
    <actuatorfrc name="torque" actuator="servo" noise="0.05"/>
  </sensor>
</mujoco>
"""

CART_PARAMETERS = {
    "m": {"target": "body/bob:mass"},
    "l": {"target": "body/bob:pos[2]"},
    "c": {"target": "joint/hinge:damping"},
}

# The force of the cart is the product of the gain and the gear of its motor.
PRODUCT = {
    "gear": {"target": "actuator/force:gear[0]"},
    "gain": {"target": "actuator/force:gainprm[0]"},
    "mass": {"target": "body/bob:mass"},
}
BODY_PARAMETERS = {
    "mass": {"target": "body/arm:mass"},
    "com": {"target": "body/arm:ipos[2]"},
    "inertia": {"target": "body/hull:inertia[1]"},
    "damping": {"target": "joint/ball:damping"},
}
FILTERED_PARAMETERS = {
    "mass": {"target": "body/link:mass"},
    "gain": {"target": "actuator/servo:gainprm"},
}


def shared_model(relative: str) -> Path:
    """Return the path of a model that others wrote; skip the test where it is absent."""
    path = SHARED_MODELS / relative
    if not path.is_file():
        pytest.skip(f"the shared model {relative} is not here")
    return path


def sensitivity_of(task: DesignTask) -> Sensitivity:
    """Sensitivities along the initial trajectory, at the guess."""
    return task.plant.derivatives.sensitivity(task.theta, task.initial)


def make_task(model: str | Path, folder: Path, **tables: Any) -> DesignTask:
    """Resolve an experiment; by default it takes 0.5 s at 100 Hz under a chirp.

    Args:
        model: Text of an MJCF, which is written into the folder, or its path.
        folder: Folder of the model.
        **tables: Tables of the experiment; `control` is the initial control.
    """
    path = model
    if isinstance(model, str):
        path = folder / "model.xml"
        path.write_text(model, encoding="utf-8")

    chirp = {"kind": "chirp", "amplitude": 1.0, "frequency": 0.7, "frequency_end": 2.0}
    few = {"robots": 4}
    values = {
        "rate": 100.0,
        "horizon": 0.5,
        "initial": {"control": chirp},
        "rehearsal": few,
        **tables,
    }
    if "control" in values:
        values["initial"] = {**values["initial"], "control": values.pop("control")}

    return DesignTask.resolve(Experiment(model=str(path), **values), threads=1)


def cart_task(folder: Path, integrator: str = "RK4", **tables: Any) -> DesignTask:
    """Cart-pendulum near hanging, all states measured."""
    control = {"kind": "sine", "amplitude": 4.0, "frequency": 0.9}
    defaults = {
        "parameters": CART_PARAMETERS,
        "noise": {"state": 0.05},
        "initial": {"qpos": (0.1, 3.0), "qvel": (0.0, 0.4), "control": control},
    }
    return make_task(CART_PENDULUM.format(integrator=integrator), folder, **{**defaults, **tables})


# Orientation of a body that has turned about all axes.
TILT = (np.array([0.9, 0.3, -0.2, 0.1]) / np.sqrt(0.95)).tolist()


def body_task(folder: Path, integrator: str = "RK4", **tables: Any) -> DesignTask:
    """Free body with a ball joint, measured by its sensors alone, tumbling from the start."""
    spin = (0.2, -0.1, 0.3, 0.8, -0.5, 0.6, -0.4, 0.7, 0.3)
    control = {"kind": "sine", "amplitude": 1.5, "frequency": 1.3, "offset": 0.4}
    qpos = (0.0, 0.0, 1.0, *TILT, 0.8, 0.6, 0.0, 0.0)
    defaults = {
        "parameters": BODY_PARAMETERS,
        "initial": {"qpos": qpos, "qvel": spin, "control": control},
    }
    return make_task(FREE_BODY.format(integrator=integrator), folder, **{**defaults, **tables})


def filtered_task(folder: Path, integrator: str = "implicitfast", **tables: Any) -> DesignTask:
    """A link behind a filtered motor: one activation state, two steps per sample."""
    control = {"kind": "sine", "amplitude": 1.0, "frequency": 1.5, "offset": 0.5}
    defaults = {"parameters": FILTERED_PARAMETERS, "initial": {"act": (0.2,), "control": control}}
    return make_task(FILTERED.format(integrator=integrator), folder, **{**defaults, **tables})


class Loop:
    """F, h and their differences by a plain loop around `mj_step`, one simulation at a time."""

    def __init__(self, model: Any, substeps: int) -> None:
        self.model, self.substeps, self.data = model, substeps, mujoco.MjData(model)

    def load(self, state: Array, ctrl: Array) -> None:
        """Put a state (qpos, qvel, act) and a control into fresh data."""
        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        data.qpos[:] = state[: model.nq]
        data.qvel[:] = state[model.nq : model.nq + model.nv]
        data.act[:] = state[model.nq + model.nv :]
        data.ctrl[:] = ctrl

    def F(self, state: Array, ctrl: Array) -> Array:
        """Next state."""
        self.load(state, ctrl)
        for _ in range(self.substeps):
            mujoco.mj_step(self.model, self.data)
        return np.concatenate([self.data.qpos, self.data.qvel, self.data.act])

    def h(self, state: Array, ctrl: Array) -> Array:
        """All sensor data at this state."""
        self.load(state, ctrl)
        mujoco.mj_forward(self.model, self.data)
        return np.array(self.data.sensordata)

    def plus(self, state: Array, dx: Array) -> Array:
        """State moved along a tangent vector, positions by `mj_integratePos`."""
        m = self.model
        qpos = np.array(state[: m.nq])
        mujoco.mj_integratePos(m, qpos, np.ascontiguousarray(dx[: m.nv]), 1.0)
        return np.concatenate([qpos, state[m.nq :] + dx[m.nv :]])

    def minus(self, state: Array, origin: Array) -> Array:
        """Tangent vector from origin to state, positions by `mj_differentiatePos`."""
        m, dq = self.model, np.zeros(self.model.nv)
        mujoco.mj_differentiatePos(m, dq, 1.0, np.array(origin[: m.nq]), np.array(state[: m.nq]))
        return np.concatenate([dq, state[m.nq :] - origin[m.nq :]])

    def jacobians(
        self, state: Array, ctrl: Array, step: float = 1e-6
    ) -> tuple[Array, Array, Array, Array]:
        """A, B, C, D of one sample by central differences; C and D of all sensor data."""
        nx = 2 * self.model.nv + self.model.na
        nu = self.model.nu
        dx, dy = [], []

        for i in range(nx + nu):
            e = step * np.eye(nx + nu)[i]
            forward = (self.plus(state, e[:nx]), ctrl + e[nx:])
            backward = (self.plus(state, -e[:nx]), ctrl - e[nx:])
            dx.append(self.minus(self.F(*forward), self.F(*backward)) / (2 * step))
            dy.append((self.h(*forward) - self.h(*backward)) / (2 * step))

        x, y = np.array(dx).T, np.array(dy).T
        return x[:, :nx], x[:, nx:], y[:, :nx], y[:, nx:]


def richardson(f: Callable[[float], float], h: float) -> float:
    """f'(0) to fourth order, from central differences at h and h / 2."""
    wide, narrow = (f(h) - f(-h)) / (2 * h), (f(h / 2) - f(-h / 2)) / h
    return (4 * narrow - wide) / 3


def directional_check(
    slopes: Sequence[float], curves: Sequence[Callable[[float], float]], h: float
) -> float:
    """Largest error of slopes, relative to the largest of the measured ones.

    Args:
        slopes: Slopes to check.
        curves: Functions f(t) whose derivatives at 0 are measured by differences.
        h: Step of the differences.
    """
    measured = np.array([richardson(f, h) for f in curves])
    return np.abs(np.array(slopes) - measured).max() / np.abs(measured).max()


def relative_error(value: Array, reference: Array) -> float:
    """Largest deviation, relative to the largest reference entry."""
    assert value.shape == reference.shape
    return np.abs(value - reference).max() / np.abs(reference).max()


def require_found(found: Any, true: Array, sigmas: float = 4.0) -> None:
    """Require that a fit converged without misfit, within some standard deviations of the truth."""
    assert found.converged, found.status
    assert not found.misfit, found.reasons
    assert (np.abs(found.theta - true) < sigmas * found.std).all()
