"""Passes over the data that a fit of a rail with dry friction takes, counted by their reason.

    python -m scripts.benchmarks rail [--seconds 24.8] [--seed 0]

A carriage on a rail of one axis is logged at 1 kHz. The simulated robot has friction that rises at
low speed, cogging and an asymmetry, which the model lacks. Mass, viscous damping, dry friction and
stiffness are fitted over segments of one second, and the noise is estimated. A pass is one
simulation of the whole log; the limits are 150 passes, and 12 seconds of the processors (6 seconds
on two cores). The column "before" has what was counted when this script was written.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

import mjfim
from mjfim.experiment.system import System
from mjfim.identification.identify import identify_system
from mjfim.plant.batch import BatchSimulator
from mjfim.records.estimate import Estimate
from mjfim.records.recording import Recording
from mjfim.signals import multisine

# The rail. Values of the model, and those of the robot.
RAIL = """<mujoco model="rail">
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="carriage">
      <inertial pos="0 0 0" mass="{mass}" diaginertia="0.01 0.01 0.01"/>
      <joint name="x" type="slide" axis="1 0 0" damping="{damping}" frictionloss="{friction}"
             stiffness="{stiffness}"/>
      <geom type="box" size="0.1 0.1 0.1" mass="0" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="x" gear="10"/></actuator>
</mujoco>
"""
MODEL = {"mass": 2.0, "damping": 6.0, "friction": 4.0, "stiffness": 4.0}
ROBOT = {"mass": 2.4, "damping": 7.0, "friction": 5.0, "stiffness": 3.0}

# Parameters of the fit: their paths and largest values.
PARAMETERS = {
    "mass": ("body/carriage:mass", 50.0),
    "damping": ("joint/x:damping", 100.0),
    "friction": ("joint/x:frictionloss", 100.0),
    "stiffness": ("joint/x:stiffness", 100.0),
}

# Standard deviations of the readings [m, m/s].
NOISE = {"qpos:x": 1e-4, "qvel:x": 5e-3}

# Samples per second, and length of the segments [s].
RATE = 1000.0
SEGMENTS = 1.0

# Limits of the passes, and of the time of the processors [s].
MOST_PASSES = 150.0
MOST_SECONDS = 12.0

# Functions that call for simulations, from the innermost one outwards, with the reason.
REASONS = {
    "over_roughness": "verification",
    "predict_unfitted": "folds",
    "find_missing_terms": "suspects",
    "flipped_signs": "suspects",
    "_unseen_directions": "what is determined",
    "best_start": "starts",
    "start_from_segments": "starts",
    "solve": "main search",
}
WITH_ESTIMATED_NOISE = "noise estimated"
REWEIGHTING = "re-weighting"
OTHER = "other"

# Passes of the same fit by their reason, when this script was written.
BEFORE: dict[str, float] = {
    "re-weighting": 615.0,
    "main search": 297.0,
    "starts": 60.0,
    "folds": 57.1,
    "what is determined": 26.0,
    "suspects": 9.4,
    "other": 5.4,
}


@dataclass(frozen=True, kw_only=True)
class Passes:
    """Effort of one fit.

    Attributes:
        by_reason: Passes over the data by their reason.
        steps: Engine steps.
        seconds: Time of the processors [s].
        estimate: The estimate.
    """

    by_reason: dict[str, float]
    steps: int
    seconds: float
    estimate: Estimate


def log(seconds: float, rng: np.random.Generator) -> Recording:
    """Play a multisine on the robot, which a weak spring in the controller keeps on the rail.

    Args:
        seconds: Duration [s].
        rng: Source of random numbers.
    """
    model = mujoco.MjModel.from_xml_string(RAIL.format(**ROBOT))
    data = mujoco.MjData(model)
    count = round(seconds * RATE)
    t = np.arange(count + 1) / RATE
    push = 3.2 * multisine(t[:-1], 1, 0.2, 25, rng)[:, 0]

    ctrl = np.zeros((count, 1))
    y = np.zeros((count + 1, 2))
    for k in range(count):
        ctrl[k, 0] = np.clip(push[k] - 3.0 * data.qpos[0], -5.0, 5.0)
        data.ctrl[:] = ctrl[k]
        data.qfrc_applied[0] = _unmodelled_force(float(data.qpos[0]), float(data.qvel[0]))
        mujoco.mj_step(model, data)
        y[k + 1] = data.qpos[0], data.qvel[0]

    y += np.array(list(NOISE.values())) * rng.standard_normal(y.shape)
    return Recording(t=t, ctrl=ctrl, y=y, outputs=tuple(NOISE), name="rail")


def _unmodelled_force(position: float, velocity: float) -> float:
    """Force that the model lacks [N]: friction at low speed, cogging and an asymmetry."""
    slow = -0.5 * np.tanh(velocity / 0.02) * np.exp(-((velocity / 0.05) ** 2))
    cogging = -0.1 * np.sin(2.0 * np.pi * position / 0.03)
    return float(slow + cogging - 0.1 * (velocity > 0.0))


def rail(folder: Path) -> System:
    """The system as a user states it."""
    (folder / "rail.xml").write_text(RAIL.format(**MODEL), encoding="utf-8")
    experiment = mjfim.Experiment(
        model="rail.xml",
        directory=folder,
        rate=RATE,
        parameters={
            name: {"target": path, "bounds": [0.0, most]}
            for name, (path, most) in PARAMETERS.items()
        },
        noise=NOISE,
        fit={"noise": "estimated", "segments": SEGMENTS},
    )
    return System.resolve(experiment)


@contextmanager
def counted() -> Iterator[Counter[str]]:
    """Count the engine steps of all simulations by their reason."""
    counts: Counter[str] = Counter()
    original = BatchSimulator.rollout

    def rollout(
        self: BatchSimulator, models: Any, start: Any, ctrl: Any, *more: Any, **options: Any
    ) -> Any:
        """Simulate, and count the steps."""
        counts[_reason()] += len(ctrl) * ctrl.shape[1] * self.substeps
        return original(self, models, start, ctrl, *more, **options)

    with patch.object(BatchSimulator, "rollout", rollout):
        yield counts


def _reason() -> str:
    """The reason of a simulation, from the functions that call for it."""
    frame = sys._getframe(2)
    reweights = False
    while frame.f_back is not None:
        reweights |= WITH_ESTIMATED_NOISE in str(frame.f_locals.get("phase", ""))
        reason = REASONS.get(frame.f_code.co_name)
        if reason is not None:
            return REWEIGHTING if reason == REASONS["solve"] and reweights else reason
        frame = frame.f_back
    return OTHER


def passes(seconds: float, seed: int) -> Passes:
    """Fit the rail, and count.

    Args:
        seconds: Duration of the log [s].
        seed: Seed of the log.
    """
    recording = log(seconds, np.random.default_rng(seed))
    with tempfile.TemporaryDirectory() as folder, counted() as counts:
        system = rail(Path(folder))
        clock = time.process_time()
        estimate = identify_system(system, [recording])
        spent = time.process_time() - clock
    return Passes(
        by_reason={reason: steps / len(recording.ctrl) for reason, steps in counts.items()},
        steps=sum(counts.values()),
        seconds=spent,
        estimate=estimate,
    )


def table_of(found: Passes) -> Table:
    """Passes by their reason, beside those before they were reduced."""
    table = Table(title="Passes over the log of a rail", title_justify="left")
    for heading in ("reason", "before", "now"):
        table.add_column(heading, justify="left" if heading == "reason" else "right")
    reasons = sorted({*BEFORE, *found.by_reason}, key=lambda each: -BEFORE.get(each, 0.0))
    for reason in reasons:
        before, now = BEFORE.get(reason, 0.0), found.by_reason.get(reason, 0.0)
        table.add_row(reason, f"{before:.1f}", f"{now:.1f}")
    table.add_section()
    total = sum(found.by_reason.values())
    table.add_row("all", f"{sum(BEFORE.values()):.1f}", f"{total:.1f}")
    return table


def main() -> int:
    """Print the passes; return 1 where there are more than the limit."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=24.8)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()

    found = passes(args.seconds, args.seed)
    total = sum(found.by_reason.values())
    console = Console(width=100)
    console.print(table_of(found))
    console.print(
        f"{found.steps:,} engine steps, {found.seconds:.1f} s of the processors (at most "
        f"{MOST_PASSES:g} passes and {MOST_SECONDS:g} s wanted)"
    )
    console.print(found.estimate.status)
    return 0 if total <= MOST_PASSES and found.seconds <= MOST_SECONDS else 1


if __name__ == "__main__":
    raise SystemExit(main())
