"""Time and memory to read and fit an hour of two joints at 1 kHz by the command line.

    python -m scripts.benchmarks benchmark_hour [--hours 1.0]

The 3.6 million samples are written as CSV first. The times of reading and fitting stand beside
the time that the engine needs to simulate all samples once on as many threads. The memory is the
largest of the process. The limits are 70 seconds and 1 GiB on two cores.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import mjfim
from mjfim.experiment.initial import multisine
from mjfim.experiment.system import System, simulate_system
from mjfim.output.archive import write_recording
from mjfim.parallel import cores
from mjfim.recordings.read import read_recording
from mjfim.records.trajectory import Recording
from scripts.benchmarks.child import ROOT, CommandRun, run_command

# Experiment of the two joints.
EXPERIMENT = ROOT / "models" / "two_joint_arm.toml"


@dataclass(frozen=True)
class Hour:
    """Measurements of one recording.

    Attributes:
        samples: Number of samples.
        size: Size of the file [MB].
        read: Time of reading [s].
        fitted: Time of the whole command [s].
        cpu: CPU time of the whole command [s].
        engine: Time of one simulation over all samples [s].
        steps: Number of MuJoCo steps of the fit.
        gigabytes: Largest memory of the process [GiB].
        wrong: Largest error of a parameter in formal standard deviations.
        within: Number of parameters whose interval holds the true value.
        parameters: Number of parameters.
    """

    samples: int
    size: float
    read: float
    fitted: float
    cpu: float
    engine: float
    steps: int
    gigabytes: float
    wrong: float
    within: int
    parameters: int


def played(system: System, seconds: float) -> Recording:
    """Simulate a recording under random multisines of a minute each, with noise on all outputs.

    Args:
        system: The system.
        seconds: Duration [s].

    Returns:
        The recording.
    """
    rng = np.random.default_rng(0)
    rate = system.experiment.rate

    # Controls.
    minute = np.arange(round(60.0 * rate)) / rate
    amplitude = np.array([8.0, 3.0])
    minutes = int(np.ceil(seconds / 60.0))
    parts = [amplitude * multisine(minute, 2, 0.1, 30, rng) for _ in range(minutes)]
    ctrl = np.concatenate(parts)[: round(seconds * rate)]

    still = np.tile(system.plant.initial_state(system.parameters.true), (len(ctrl) + 1, 1))
    return simulate_system(system, system.plant.trajectory(still, ctrl), rng)


def bare(system: System, samples: int) -> float:
    """Measure the time of the engine for a number of samples on all threads [s]."""
    count = system.plant.simulator.threads * 50
    steps = 2000
    starts = np.tile(system.plant.initial_state(system.theta), (count, 1))
    ctrl = np.zeros((count, steps, len(system.controls)))
    model = [system.plant.model(system.theta)]

    # The first call is not measured.
    system.plant.simulator.rollout(model, starts, ctrl)
    clock = time.perf_counter()
    system.plant.simulator.rollout(model, starts, ctrl)
    seconds = time.perf_counter() - clock
    return seconds / (count * steps) * samples


def write_hour(hours: float, file: Path) -> int:
    """Simulate a recording of the two joints and write it as CSV.

    Args:
        hours: Duration of the recording [h].
        file: The CSV file.

    Returns:
        Number of samples.
    """
    system = System.resolve(mjfim.Experiment.from_file(EXPERIMENT))
    recording = played(system, 3600.0 * hours)
    write_recording(file, recording, system)
    return len(recording.ctrl)


def fit_hour(log: Path, folder: Path) -> tuple[CommandRun, dict[str, Any]]:
    """Fit a recording of the two joints by the command line.

    Args:
        log: The recording.
        folder: Folder that receives the results.

    Returns:
        The command and its `estimate.json`.

    Raises:
        RuntimeError: There is no estimate.
    """
    run = run_command(["identify", str(EXPERIMENT), str(log), "-o", str(folder)])
    estimate = folder / "estimate.json"
    if not estimate.is_file():
        raise RuntimeError(run.messages)
    return run, json.loads(estimate.read_text(encoding="utf-8"))


def measured(hours: float) -> Hour:
    """Write, read and fit a recording.

    Args:
        hours: Duration of the recording [h].

    Returns:
        Measurements.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "hour.csv"
        samples = write_hour(hours, log)
        size = log.stat().st_size / 1e6

        system = System.resolve(mjfim.Experiment.from_file(EXPERIMENT))
        clock = time.perf_counter()
        read_recording(log, system.channels)
        read = time.perf_counter() - clock
        run, found = fit_hour(log, folder / "out")

    true = system.parameters.true
    error = (np.array(found["theta"]) - true) / np.array(found["std"])
    low, high = np.array(found["interval"], dtype=float).T
    inside = (low <= true) & (true <= high)
    return Hour(
        samples=samples,
        size=size,
        read=read,
        fitted=run.wall,
        cpu=run.processor,
        engine=bare(system, samples),
        steps=found["steps"],
        gigabytes=run.gigabytes,
        wrong=float(np.abs(error).max()),
        within=int(inside.sum()),
        parameters=len(true),
    )


def hour_table(hour: Hour) -> Table:
    """Make table (g), with one row."""
    title = "(g) an hour of two joints at 1 kHz, five parameters, CSV (limits: 70 s, 1 GiB)"
    table = Table(title=title, title_justify="left")
    headings = (
        "samples",
        "file",
        "read",
        "identify, all in",
        "CPU",
        "bare engine, once",
        "ratio",
        "steps",
        "memory",
        "truth inside",
    )
    for heading in headings:
        table.add_column(heading, justify="right")
    table.add_row(
        f"{hour.samples:,}",
        f"{hour.size:.0f} MB",
        f"{hour.read:.1f} s",
        f"{hour.fitted:.0f} s",
        f"{hour.cpu:.0f} s",
        f"{hour.engine:.1f} s",
        f"{hour.fitted / hour.engine:.1f}",
        f"{hour.steps / 1e6:.0f} M ({hour.steps / hour.samples:.0f} a sample)",
        f"{hour.gigabytes:.2f} GiB",
        f"{hour.within} of {hour.parameters}, worst {hour.wrong:.1f} σ",
    )
    return table


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hours", type=float, default=1.0)
    args = parser.parse_args()
    Console(width=160).print(hour_table(measured(args.hours)), f"{cores()} cores")
