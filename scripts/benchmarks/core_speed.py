"""Speed of a core while something else runs, measured by small pieces of work of the engine.

The speed of a core depends on what the other cores do, and on a shared computer on what its other
users do. Seconds that were measured at different times can therefore not be compared. A probe is a
process that simulates for some milliseconds, waits, and begins again. Its engine steps per second
of CPU time are the speed of a core meanwhile. Seconds times this speed are an amount of work, which
does not depend on when it was done.

    python -m scripts.benchmarks.core_speed FILE     # the probe, which runs until it is ended
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import mujoco
import numpy as np

from mjfim.atomic_io import replacing

# Engine steps of one piece of work, and the wait after it [s]. A probe takes about 3 % of a core.
STEPS, WAIT = 3_000, 1.0

MODEL = Path(__file__).resolve().parents[2] / "models" / "cart_pendulum.xml"


class CoreSpeed:
    """Speed of a core during a period, which is known at its end.

    Args:
        probe: Number of the process that measures it.

    Attributes:
        probe: Number of the process that measures it.
        steps_per_second: Engine steps per second of CPU time; NaN where there was no time for any.
    """

    def __init__(self, probe: int) -> None:
        self.probe = probe
        self.steps_per_second = float("nan")


@contextmanager
def core_speed() -> Iterator[CoreSpeed]:
    """Measure the speed of a core meanwhile.

    Yields:
        The speed, which is known when the block has ended.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "speed.json"
        probe = subprocess.Popen([sys.executable, "-m", "scripts.benchmarks.core_speed", str(path)])
        found = CoreSpeed(probe.pid)
        try:
            yield found
            if probe.poll() is not None:
                raise RuntimeError("the process that measures the speed of a core has ended")
        finally:
            probe.kill()
            probe.wait()
        if path.exists():
            total = json.loads(path.read_text())
            found.steps_per_second = total["steps"] / max(total["seconds"], 1e-3)


def at_speed(seconds: float, speed: float, wanted: float) -> float:
    """Time that work takes at another speed of the core [s].

    Args:
        seconds: Time that it took [s].
        speed: Speed at which it was done [steps/s]; NaN if it is not known.
        wanted: The other speed [steps/s]; NaN if it is not known.

    Returns:
        The time; that which it took if a speed is not known.
    """
    ratio = speed / wanted
    return seconds * ratio if np.isfinite(ratio) else seconds


def main() -> None:
    """Simulate small pieces until this process is ended, and keep the sums in a file."""
    path = Path(sys.argv[1])
    model = mujoco.MjModel.from_xml_path(str(MODEL))
    data = mujoco.MjData(model)
    steps, seconds = 0, 0.0
    while True:
        begun = time.process_time()
        mujoco.mj_step(model, data, nstep=STEPS)
        seconds += time.process_time() - begun
        steps += STEPS

        with replacing(path) as unfinished:
            unfinished.write_text(json.dumps({"steps": steps, "seconds": seconds}))
        time.sleep(WAIT)


if __name__ == "__main__":
    main()
