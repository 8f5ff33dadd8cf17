"""Observations at engine steps within the samples, against plain loops around mj_step, and their
derivatives.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.excitation.limits.constraints import constraint_set_of
from mjfim.excitation.limits.limits import derivative_substeps_of
from mjfim.excitation.task import DesignTask
from mjfim.plant.batch import SubstepObservations
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES, SHARED_ORIGIN
from tests.support.limits import FLOATING, floating_task
from tests.support.numerics import Array, Loop, relative_error

# kinds, names in the order of the observations
SHOWN = [
    ("position", "shoulder"),
    ("position", "elbow"),
    ("velocity", "shoulder"),
    ("acceleration", "shoulder"),
    ("acceleration", "elbow"),
    ("force", "thrust"),
    ("force", "shoulder"),
    ("force", "elbow"),
    ("joint_force", "shoulder"),
]


def forces_of(data: Any) -> list[float]:
    """The forces of SHOWN."""
    drives = [data.actuator(name).force[0] for name in ("thrust", "shoulder", "elbow")]
    return [*drives, data.joint("shoulder").qfrc_actuator[0]]


def forward_forces(model: Any, data: Any) -> list[float]:
    """The forces at a state, by `mj_forward`."""
    forward = mujoco.MjData(model)
    for name in ("qpos", "qvel", "act", "ctrl"):
        getattr(forward, name)[:] = getattr(data, name)
    mujoco.mj_forward(model, forward)
    return forces_of(forward)


def played_with_forces(model: Any, state: Array, ctrl: Array, substeps: int) -> tuple[Array, Array]:
    """Values that SHOWN names at every engine step, and the forces about these steps.

    Returns:
        (N, substeps, 9) values, and (N, substeps + 1, 4) forces by `mj_forward` at the beginning of
        every engine step and at the end of the sample, all under the control of the sample.
    """
    data, rows, forces = mujoco.MjData(model), [], []
    data.qpos[:], data.qvel[:], data.act[:] = np.split(state, [model.nq, model.nq + model.nv])
    joints = [data.joint(name) for name in ("shoulder", "elbow")]
    dofs = [model.joint(joint.name).dofadr[0] for joint in joints]
    for held in ctrl:
        data.ctrl[:] = held
        for _ in range(substeps):
            forces.append(forward_forces(model, data))
            before = data.qvel.copy()
            mujoco.mj_step(model, data)
            change = (data.qvel - before)[dofs] / model.opt.timestep
            angles = [joint.qpos[0] for joint in joints]
            rows.append([*angles, joints[0].qvel[0], *change, *forces_of(data)])
        forces.append(forward_forces(model, data))
    shape = (len(ctrl), substeps, len(SHOWN))
    return np.reshape(rows, shape), np.reshape(forces, (len(ctrl), substeps + 1, 4))


def observations_of(task: DesignTask) -> SubstepObservations:
    """Quantities that the limits of the experiment observe."""
    constraints = constraint_set_of(task)
    assert constraints.substeps.kinds == tuple(kind for kind, _ in SHOWN)
    return constraints.observations


@pytest.mark.parametrize(
    ("substeps", "expected"),
    [(1, (1,)), (2, (1, 2)), (5, (1, 2, 3, 5)), (20, (1, 2, 4, 9, 20)), (100, (1, 3, 10, 32, 100))],
)
def test_derivatives_are_taken_at_the_first_the_last_and_some_inner_engine_steps(
    substeps: int, expected: tuple[int, ...]
) -> None:
    assert derivative_substeps_of(substeps) == expected


@pytest.mark.parametrize("integrator", ["implicitfast", "Euler", "RK4"])
@pytest.mark.parametrize("lifted", [False, True], ids=["as it is", "without clamps"])
def test_observations_agree_with_plain_steps_at_every_engine_step(
    lifted: bool, integrator: str, tmp_path: Path
) -> None:
    task = floating_task(tmp_path, integrator)
    plant, text = task.plant, FLOATING.format(integrator=integrator)
    if lifted:
        plant = task.relaxed().plant
        text = re.sub(r'\b(actuatorfrcrange|forcerange)="[^"]*"', "", text)
    model = mujoco.MjModel.from_xml_string(text)
    trajectory, observed = plant.observe(task.theta, task.control, observations_of(task))
    assert_array_equal(trajectory.state, plant.simulate(task.theta, task.control).state)
    wanted, forces = played_with_forces(
        model, task.plant.initial_state(task.theta), task.control, task.system.grid.substeps
    )
    further, observed = observed[:, 5:], observed[:, :5]
    assert observed.shape == wanted.shape == (30, 5, len(SHOWN))
    # With RK4 there are rows for the beginning of every step; the last row is the sample's end.
    steps = [0, 1, 2, 3, 4, 5] if integrator == "RK4" else [5]
    assert_allclose(further[..., 5:], forces[:, steps], rtol=1e-9, atol=1e-9)
    assert_array_equal(further[..., :5], observed[:, np.minimum(steps, 4), :5])
    for i, (kind, name) in enumerate(SHOWN):
        assert relative_error(observed[..., i], wanted[..., i]) < 1e-9, (kind, name)
    # the clamps act, where they are
    forces, torques = wanted[..., SHOWN.index(("force", "elbow"))], wanted[..., -1]
    assert (np.abs(forces).max() == 0.7) is not lifted
    assert (np.abs(torques).max() == 0.9) is not lifted


def differences(
    task: DesignTask, sample: int, observations: SubstepObservations, step: float = 1e-6
) -> Array:
    """(S, 9, nx+nu) central differences of plain loops over one sample of the lifted plant.

    The last row has the forces at the beginning of the sample with RK4, and otherwise those at its
    end.
    """
    plant, u, substeps = task.plant, task.control[sample], task.system.grid.substeps
    model, x = plant.model(task.theta), task.initial.state[sample]
    loop, nx, columns = Loop(model, substeps), task.space.nx, []
    rows = np.array(observations.derivative_substeps) - 1
    edge = 0 if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 else -1
    for e in step * np.eye(nx + len(u)):
        ends = []
        for move in (e, -e):
            ctrl = (u + move[nx:])[None]
            values, forces = played_with_forces(model, loop.plus(x, move[:nx]), ctrl, substeps)
            chosen = values[0, rows]
            ends.append([*chosen, np.append(chosen[edge, :5], forces[0, edge])])
        columns.append(np.subtract(*ends) / (2 * step))
    return np.stack(columns, axis=-1)


def assert_slopes(
    found: Array, task: DesignTask, observations: SubstepObservations, tolerance: float
) -> None:
    """Derivatives (N, S, 9, nx+nu) of every kind at some samples."""
    for sample in (0, 11, 29):
        wanted = differences(task, sample, observations)
        for i, shown in enumerate(SHOWN):
            assert relative_error(found[sample, :, i], wanted[:, i]) < tolerance, (sample, shown)


@pytest.mark.parametrize("integrator", ["implicitfast", "RK4"])
def test_derivatives_of_observations_are_differences_of_independent_simulations(
    integrator: str, tmp_path: Path
) -> None:
    task = floating_task(tmp_path, integrator).relaxed()
    observations = observations_of(task)
    A, B, slopes = task.plant.derivatives.observation_jacobians(
        task.theta, task.initial, observations
    )
    assert slopes.shape == (30, len(observations.derivative_substeps) + 1, len(SHOWN), 20)
    assert_slopes(slopes, task, observations, 1e-3)
    exact = task.plant.derivatives.jacobians(task.theta, task.initial)
    assert relative_error(A, exact[0]) < 1e-5
    assert relative_error(B, exact[1]) < 1e-3


def test_differences_from_a_shared_origin_agree_with_central_ones_to_a_hundredth(
    tmp_path: Path,
) -> None:
    """One-sided differences need less than 0.4 of the engine steps."""
    task = floating_task(tmp_path).relaxed()
    observations, derivatives = observations_of(task), task.plant.derivatives
    psi = derivatives.sensitivity(task.theta, task.initial).psi
    given = (task.theta, task.initial, psi, np.array([[1.0, 0.3], [-0.2, 0.9], [0.0, -1.0]]))
    begun = task.plant.simulator.steps
    draft = derivatives.bilinear(*given, SHARED_ORIGIN, observations)
    spent, begun = task.plant.simulator.steps - begun, task.plant.simulator.steps
    careful = derivatives.bilinear(*given, CENTRAL_DIFFERENCES, observations)
    assert_slopes(careful.observation_jacobian, task, observations, 2e-3)
    assert spent < 0.4 * (task.plant.simulator.steps - begun)
    for name in ("A", "B", "C", "D", "observation_jacobian"):
        if getattr(careful, name).any():
            assert relative_error(getattr(draft, name), getattr(careful, name)) < 1e-2, name
        else:
            assert not getattr(draft, name).any()
    for r in range(3):
        assert relative_error(draft.F_mixed[r], careful.F_mixed[r]) < 1e-2, r
    assert (draft.h_mixed is None) == (careful.h_mixed is None)
