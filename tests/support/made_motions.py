"""Hand-made designs, estimates and models that Rerun files are written of."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mjfim.records.design import (
    Design,
    Evaluation,
    IterateMotions,
    LimitUsage,
    StartResult,
    Status,
    iterate_motion,
)
from mjfim.records.estimate import Estimate
from mjfim.records.trajectory import Recording, Trajectory
from tests.support.made_records import bare_estimate, falling, make_row, plain_labels
from tests.support.paths import ROOT, SHARED_MODELS

MODELS = {
    "cart": ROOT / "models" / "cart_pendulum.xml",
    "quadrotor": ROOT / "models" / "quadrotor.xml",
    "release": ROOT / "models" / "free_pendulum.xml",
    "acrobot": SHARED_MODELS / "dmc_acrobot" / "acrobot.xml",
    "panda": SHARED_MODELS / "menagerie_panda" / "panda_nomesh.xml",
    "panda without geoms": SHARED_MODELS / "menagerie_panda" / "panda_nohand_nomesh.xml",
}

ZOO = """
<mujoco model="zoo">
  <asset>
    <mesh name="tetrahedron" vertex="0 0 0  .4 0 0  0 .4 0  0 0 .4"/>
    <hfield name="hills" nrow="3" ncol="4" size=".6 .4 .3 .05"
      elevation="0 0 0 0  0 1 0 0  0 0 0 .5"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 .1" pos="0 0 -1"/>
    <geom name="hills" type="hfield" hfield="hills" pos="0 1 0"/>
    <body name="floating"><freejoint name="float"/><geom type="box" size=".1 .2 .3"/></body>
    <body name="a/b c" pos="1 0 0">
      <joint name="ball" type="ball"/>
      <geom name="limb" type="capsule" fromto="0 0 0 .3 0 .4" size=".05"/>
      <geom name="egg" type="ellipsoid" size=".1 .2 .05"/>
      <body pos=".3 0 .4"><joint axis="0 1 0"/><geom type="cylinder" size=".1 .2"/></body>
    </body>
    <body name="rock" pos="2 0 0">
      <joint type="slide"/><geom name="rock" type="mesh" mesh="tetrahedron"/>
    </body>
    <body name="bare" pos="3 0 0">
      <joint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <body name="tip" pos="0 .3 .5"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>
    </body>
    <body name="fixed" pos="0 -1 0"><geom type="sphere" size=".1"/></body>
  </worldbody>
</mujoco>
"""


def load(name: str) -> mujoco.MjModel:
    """Load a model by its short name; skip the test if the shared models are absent."""
    if name == "zoo":
        return mujoco.MjModel.from_xml_string(ZOO)
    if not MODELS[name].is_file():
        pytest.skip(f"{MODELS[name].name} is not in this checkout's neighbourhood")
    return mujoco.MjModel.from_xml_path(str(MODELS[name]))


def simulated(model: mujoco.MjModel, amplitude: float, samples: int = 40) -> Trajectory:
    """Simulate sine controls from the first keyframe, one engine step per sample."""
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    t = np.arange(samples + 1) * model.opt.timestep
    ctrl = data.ctrl + amplitude * np.sin(2.0 * t[:, None] * np.ones(model.nu))
    rows = []
    for u in ctrl:
        rows.append(np.concatenate([data.qpos, data.qvel, data.act]))
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
    qpos, qvel, act = np.split(np.array(rows), [model.nq, model.nq + model.nv], axis=1)
    return Trajectory(t=t, qpos=qpos, qvel=qvel, act=act, ctrl=ctrl[:-1])


def evaluated(model: mujoco.MjModel, trajectory: Trajectory, gain: float) -> Evaluation:
    """Make an evaluation of two parameters with smooth sensitivities and growing information."""
    nx, t = 2 * model.nv + model.na, trajectory.t
    psi = gain * np.sin(t)[:, None, None] * np.arange(1.0, 2 * nx + 1).reshape(1, nx, 2)
    std = np.array([0.5, 0.25]) / gain
    return Evaluation(
        trajectory=trajectory,
        gain=np.zeros((trajectory.samples, model.nu, nx)),
        sensitivity=psi,
        information=gain * np.eye(2),
        eigenvalues=gain * np.ones(2),
        std=std,
        std_over_time=falling(std, t),
        criterion=1.0 / gain,
        cost=2.0 / gain,
    )


def designed(model: mujoco.MjModel) -> Design:
    """Make a design by hand: a small and a large control, three iterations."""
    history = tuple(
        make_row(
            iteration=k,
            cost=2.0 / 4**k,
            min_eigenvalue=4.0**k,
            slope=0.1**k,
            gamma=0.5,
            seconds=0.1 * k,
            steps=100 * k,
        )
        for k in range(3)
    )
    initial, final = simulated(model, 0.5), simulated(model, 2.0)
    iterates = [(k, iterate_motion(simulated(model, 0.5 + 0.75 * k))) for k in range(3)]
    return Design(
        motions=IterateMotions.of([(k, motion) for k, motion in iterates if motion]),
        usage=(
            LimitUsage(
                kind="position",
                name="slide",
                t=final.t,
                share=final.qpos[:, 0] / 1.5,
                lower=-1.5,
                upper=1.5,
            ),
        ),
        status=Status.MAX_ITERATIONS,
        parameters=("mass", "gear/ratio"),
        labels=plain_labels(("mass", "gear/ratio")),
        theta=np.array([2.0, 1.0]),
        initial=evaluated(model, initial, 1.0),
        final=evaluated(model, final, 16.0),
        history=history,
        slope=0.01,
        steps=200,
        seconds=0.2,
        limits={"position": -0.1, "control": 2.0},
        warnings=("the two parameters are nearly confounded",),
        found_by="multisine 2",
        starts=(
            StartResult(name="initial", cost=9.0, status=Status.STALLED, iterations=5),
            StartResult(name="multisine 2", cost=0.125, status=Status.CONVERGED, iterations=3),
        ),
    )


def estimated(model: mujoco.MjModel, trajectory: Trajectory) -> Estimate:
    """Make an estimate from two recordings by hand; one sample of one output is missing."""
    outputs = ("qpos:slide", "hinge_angle")
    predicted = trajectory.qpos[:, :2]
    y = predicted + 0.01
    y[3, 0] = np.nan
    recordings = tuple(
        Recording(t=trajectory.t, ctrl=trajectory.ctrl, y=y, outputs=outputs, name=f"run {k}")
        for k in range(2)
    )
    return bare_estimate(
        ("mass", "gear/ratio"),
        np.array([2.0, 1.0]),
        np.array([0.1, 0.2]),
        initial_theta=np.array([2.5, 1.4]),
        chi2=500.0,
        dof=80,
        status="the residuals no longer fall",
        misfit=True,
        residual_rms=dict.fromkeys(outputs, 0.01),
        at_bound=("mass",),
        predicted=(predicted, predicted),
        recordings=recordings,
    )
