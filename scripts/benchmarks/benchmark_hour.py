"""An hour of two joints at 1 kHz: 3.6 million samples are written as CSV, read and fitted by the
command line.

    python -m scripts.benchmarks benchmark_hour [--hours 1.0] [--seed 0]

Says how long reading and fitting took, beside the bare engine time of one rollout over all samples
on as many threads, and how much memory the process had at most. The limits are 6 minutes and 3 GiB
on two cores.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import mjfim
from mjfim.experiment.system import System
from mjfim.output.archive import write_recording
from mjfim.parallel import cores
from mjfim.records.recording import Recording
from mjfim.signals import multisine

ROOT = Path(__file__).resolve().parents[2]
EXPERIMENT = ROOT / "models" / "two_joint_arm.toml"
READ = """
import sys, time
clock = time.perf_counter()
from pathlib import Path
import mjfim
from mjfim.recordings.read import read_recording
from mjfim.experiment.system import System
system = System.resolve(mjfim.Experiment.from_file(sys.argv[1]))
clock = time.perf_counter()
read_recording(Path(sys.argv[2]), system.channels)
print(time.perf_counter() - clock)
"""


@dataclass(frozen=True)
class Hour:
    """What was measured. engine: seconds of one rollout over all samples;  gigabytes: of the fit's
    process at most

    wrong: largest error of a parameter in formal standard deviations;  steps: MuJoCo steps of the
    fit
    """

    samples: int
    size: float
    read: float
    fitted: float
    engine: float
    steps: int
    gigabytes: float
    wrong: float
    within: int
    parameters: int


def played(system: System, seconds: float, seed: int) -> Recording:
    """A simulated log: random multisines of a minute each, noise on everything measured."""
    rng = np.random.default_rng(seed)
    rate = system.experiment.rate
    minute = np.arange(round(60.0 * rate)) / rate
    amplitude = np.array([8.0, 3.0])
    parts = [
        amplitude * multisine(minute, 2, 0.1, 30, rng) for _ in range(int(np.ceil(seconds / 60.0)))
    ]
    ctrl = np.concatenate(parts)[: round(seconds * rate)]
    theta, states = (
        system.parameters.true,
        [system.plant.initial_state(system.parameters.true)[None]],
    )
    for first in range(0, len(ctrl), 100_000):
        model = [system.plant.model(theta)]
        out = system.plant.simulator.rollout(
            model, states[-1][-1:], ctrl[None, first : first + 100_000]
        )
        states.append(out.states[0, 1:])
    y = system.plant.outputs(np.concatenate(states), None)
    y += system.noise.sample(len(y), rng)
    return Recording(
        t=np.arange(len(y)) / rate, ctrl=ctrl, y=y, outputs=system.outputs.names, name="hour"
    )


def bare(system: System, samples: int) -> float:
    """Seconds that the engine takes for so many steps on all threads."""
    count = system.plant.simulator.threads * 50
    steps = 2000
    starts = np.tile(system.plant.initial_state(system.theta), (count, 1))
    ctrl = np.zeros((count, steps, len(system.controls)))
    model = [system.plant.model(system.theta)]
    system.plant.simulator.rollout(model, starts, ctrl)
    clock = time.perf_counter()
    system.plant.simulator.rollout(model, starts, ctrl)
    return (time.perf_counter() - clock) / (count * steps) * samples


def measured(hours: float, seed: int) -> Hour:
    """Write, read and fit."""
    system = System.resolve(mjfim.Experiment.from_file(EXPERIMENT))
    recording = played(system, 3600.0 * hours, seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "hour.csv"
        write_recording(log, recording, system)
        size, samples = log.stat().st_size / 1e6, len(recording.ctrl)
        del recording
        read = float(
            subprocess.check_output(
                [sys.executable, "-c", READ, str(EXPERIMENT), str(log)], text=True
            )
        )
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
        clock = time.perf_counter()
        command = [
            sys.executable,
            "-m",
            "mjfim",
            "identify",
            str(EXPERIMENT),
            str(log),
            "-o",
            str(folder / "out"),
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        fitted = time.perf_counter() - clock
        peak = max(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, before) / 2**20
        if not (folder / "out" / "estimate.json").is_file():
            raise SystemExit(done.stderr)
        found = json.loads((folder / "out" / "estimate.json").read_text(encoding="utf-8"))
    theta, true = np.array(found["theta"]), system.parameters.true
    inside = np.array(
        [low <= value <= high for (low, high), value in zip(found["interval"], true, strict=True)]
    )
    wrong = float(np.abs((theta - true) / np.array(found["std"])).max())
    engine = bare(system, samples)
    return Hour(
        samples,
        size,
        read,
        fitted,
        engine,
        found["steps"],
        peak,
        wrong,
        int(inside.sum()),
        len(true),
    )


def hour_table(hour: Hour) -> Table:
    """One row."""
    table = Table(
        title="(g) an hour of two joints at 1 kHz, five parameters, CSV (limits: 360 s, 3 GiB)",
        title_justify="left",
    )
    for heading in (
        "samples",
        "file",
        "read",
        "identify, all in",
        "bare engine, once",
        "ratio",
        "steps",
        "memory",
        "truth inside",
    ):
        table.add_column(heading, justify="right")
    table.add_row(
        f"{hour.samples:,}",
        f"{hour.size:.0f} MB",
        f"{hour.read:.1f} s",
        f"{hour.fitted:.0f} s",
        f"{hour.engine:.1f} s",
        f"{hour.fitted / hour.engine:.1f}",
        f"{hour.steps / 1e6:.0f} M ({hour.steps / hour.samples:.0f} a sample)",
        f"{hour.gigabytes:.2f} GiB",
        f"{hour.within} of {hour.parameters}, worst {hour.wrong:.1f} σ",
    )
    return table


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    Console(width=160).print(hour_table(measured(args.hours, args.seed)), f"{cores()} cores")
