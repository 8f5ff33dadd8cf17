"""Play a design on a robot: a template to copy and change.

    python scripts/play_design.py out/design.csv --model models/cart_pendulum.xml

The loop sends every row of design.csv at its time to `send`. Here `send` belongs to a simulated
robot; replace it by the interface of yours. The log that is written can be identified with `mjfim
identify`.
"""

from __future__ import annotations

import argparse
import csv
import time
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np


class SimulatedRobot:
    """A robot that is simulated by MuJoCo: replace it by the interface of your robot."""

    def __init__(self, model: Path, first: dict[str, float]) -> None:
        """Put the robot into the state of the first row of the design."""
        self.model = mujoco.MjModel.from_xml_path(str(model))
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = columns(first, "qpos:")
        self.data.qvel[:] = columns(first, "qvel:")
        if self.model.na:
            self.data.act[:] = columns(first, "act:")

    def send(self, row: dict[str, float], seconds: float) -> None:
        """Apply the controls of a row, and hold them for some seconds."""
        self.data.ctrl[:] = columns(row, "ctrl:")
        mujoco.mj_step(self.model, self.data, round(seconds / self.model.opt.timestep))


def columns(row: dict[str, float], prefix: str) -> np.ndarray:
    """Return the values of all columns whose name begins with a prefix, in their order."""
    return np.array([value for name, value in row.items() if name.startswith(prefix)])


def read_rows(path: Path) -> list[dict[str, float]]:
    """Read the rows of design.csv; the last one has a final state and no control."""
    with path.open(newline="", encoding="utf-8") as stream:
        rows = csv.DictReader(stream)
        return [{name: float(text or "nan") for name, text in row.items()} for row in rows]


def main() -> int:
    """Play the design and write the controls that were sent and the states that were measured."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("design", type=Path, help="design.csv of a design")
    parser.add_argument("--model", type=Path, required=True, help="MJCF of the simulated robot")
    parser.add_argument("-o", "--output", type=Path, default=Path("recording.csv"))
    parser.add_argument("--real-time", action="store_true", help="wait for the time of each row")
    args = parser.parse_args()
    if args.output.exists():
        parser.error(f"{args.output} exists; choose another name for the log with -o")

    rows = read_rows(args.design)
    robot = SimulatedRobot(args.model, rows[0])
    begin = time.monotonic()
    log = []

    for row, following in pairwise(rows):
        # A real controller waits for the time of the row; a simulation need not.
        if args.real_time:
            time.sleep(max(begin + row["t"] - time.monotonic(), 0.0))

        # Log the state before the control acts, and the control that was really sent.
        log.append([row["t"], *robot.data.qpos, *robot.data.qvel, *columns(row, "ctrl:")])
        robot.send(row, following["t"] - row["t"])

    # The last row holds the final state; the control before it stays.
    log.append([rows[-1]["t"], *robot.data.qpos, *robot.data.qvel, *columns(rows[-2], "ctrl:")])

    names = [name for name in rows[0] if name.startswith(("qpos:", "qvel:", "ctrl:"))]
    header = ["t", *sorted(names, key=lambda name: ("qpos:", "qvel:", "ctrl:").index(name[:5]))]

    # A log that was not written to its end must not be taken for a whole one.
    temporary = args.output.with_name(f"{args.output.name}.part")
    with temporary.open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream).writerows([header, *log])
    temporary.replace(args.output)
    print(f"wrote {args.output}: {len(log)} rows")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
