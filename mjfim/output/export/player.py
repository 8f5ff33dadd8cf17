"""Play a design on a robot, and record what it measures.

This program needs Python 3.10 and NumPy only; `mjfim export DESIGN --to player` writes it. Put the
functions of your robot into a file of yours, as in the class `Robot` below but without the class:

    python play.py                                # says what the design needs
    python play.py my_robot.py -o recording.csv   # plays it and records
    python play.py my_robot.py -o recording.csv --feedback

With feedback the control is `u = u_ref + K (x_ref - x)`, otherwise `u = u_ref`. Each row is sent at
its own time after the start; rows whose time has passed are left out. The design is at the end.
`mjfim identify EXPERIMENT recording.csv -o fit` reads the recording.
"""

import csv
import json
import os
import runpy
import signal
import sys
import time
from math import nan
from types import SimpleNamespace
from typing import Any

import numpy as np

# Largest deviation from the start of the design, as a share of the range of each coordinate.
START_TOLERANCE = 0.5


class Robot:
    """A robot that rests at the start of the design; put yours in its place."""

    def read_state(self) -> dict[str, float]:
        """Return what is measured, by the names in STATE; the rest counts as not measured."""
        return dict(zip(STATE, X[0].tolist(), strict=True))

    def send_control(self, u: np.ndarray) -> None:
        """Send the controls (nu,), in the order of CONTROLS; they hold until the next call."""

    def stop(self) -> None:
        """Make the robot safe at the end, after Ctrl-C and after an error; may be left out."""


def play(robot: Any, output: str = "recording.csv", feedback: bool = False) -> str:
    """Play the design and record it; return what was done in a sentence.

    Without `robot.stop`, motors get the control 0 at the end, and servos keep the last command.
    """
    if os.path.exists(output):
        raise FileExistsError(f"{output} exists; choose another name for the recording")
    check_start(measured(robot))
    log = []
    row, clipped, begin = 0, 0, time.perf_counter()
    control = np.full(len(CONTROLS), nan)
    try:
        while row < COUNT:
            time.sleep(max(T[row, 0] - (time.perf_counter() - begin), 0.0))
            now, found = time.perf_counter() - begin, measured(robot)
            gain = K[row].reshape(len(CONTROLS), -1)
            wanted = U[row] + (gain @ deviation(X[row], found) if feedback else 0.0)
            if not np.isfinite(wanted).all():
                raise ValueError(f"the control of row {row + 1} is not finite: {wanted}")
            control = np.clip(wanted, LOWER, UPPER)
            robot.send_control(control)
            log.append((now, control, found))
            clipped += int((control != wanted).any())
            row = max(row + 1, int((time.perf_counter() - begin) * COUNT / END))
        time.sleep(max(END - (time.perf_counter() - begin), 0.0))
        log.append((time.perf_counter() - begin, np.full(len(CONTROLS), nan), measured(robot)))
    finally:
        try:
            if hasattr(robot, "stop"):
                robot.stop()
            elif log:
                robot.send_control(np.where(np.isnan(SAFE), control, SAFE))
        finally:
            write(output, log)
    sent = len(log) - 1
    return f"sent {sent} rows, {COUNT - sent} left out, {clipped} clipped; wrote {output}"


def measured(robot: Any) -> dict[str, float]:
    """What the robot measures, by names that are in the model."""
    found = {name: float(value) for name, value in robot.read_state().items()}
    for name in found:
        if name.startswith(("qpos:", "qvel:", "act:")) and name not in STATE:
            raise ValueError(f"{name!r} is not in the model; its states are {', '.join(STATE)}")
    return found


def check_start(found: dict[str, float]) -> None:
    """Refuse to begin where the robot is far from the start of the design."""
    for q, _ in DESIGN["scalars"]:
        name, motion = STATE[q], X[:, q]
        allowed = START_TOLERANCE * np.ptp(motion) + 6.0 * DESIGN["sigma"][q]
        if abs(found.get(name, nan) - motion[0]) > allowed > 0.0:
            raise ValueError(
                f"{name} is {found[name]:g}, but the design begins at {motion[0]:g}; bring the "
                "robot to the start first, or raise START_TOLERANCE"
            )


def deviation(planned: np.ndarray, found: dict[str, float]) -> np.ndarray:
    """(2 nv + na,) planned minus measured state; zero where nothing is measured."""
    state = np.array([found.get(name, nan) for name in STATE])
    state = np.where(np.isfinite(state), state, planned)
    nq, nv = DESIGN["sizes"]
    move = np.zeros(nv)
    for q, v in DESIGN["scalars"]:
        move[v] = planned[q] - state[q]
    for q, v in DESIGN["quaternions"]:
        # The rotation vector in the frame of the measured body, along the shorter way.
        p, m = planned[q : q + 4], state[q : q + 4]
        axis = m[0] * p[1:] - p[0] * m[1:] - np.cross(m[1:], p[1:])
        sine, cosine = np.linalg.norm(axis), m @ p
        angle = np.copysign(2.0 * np.arctan2(sine, abs(cosine)), cosine)
        move[v : v + 3] = axis * (angle / sine if sine else 0.0)
    return np.concatenate([move, (planned - state)[nq:]])


def write(output: str, log: list[tuple[float, np.ndarray, dict[str, float]]]) -> None:
    """Write the recording: times, controls, and what was measured at each of them."""
    names = list(dict.fromkeys(name for _, _, found in log for name in found))
    with open(output, "x", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["t", *(f"ctrl:{name}" for name in CONTROLS), *names])
        for now, control, found in log:
            values = [now, *control.tolist(), *(found.get(name, nan) for name in names)]
            table.writerow(["" if np.isnan(value) else repr(value) for value in values])


# The design: names of the state (nq positions, nv velocities, na activations) and of the nu
# controls; places in positions and velocities of scalars, and of rotations in space; noise of the
# measured state; limits of the controls, and their values at the end (NaN keeps the last one). A
# row holds time, state, controls and gains; the last one has no control.
DESIGN: dict[str, Any] = json.loads(r"""{}""")
STATE, CONTROLS = DESIGN["state"], DESIGN["controls"]
LOWER, UPPER, SAFE = (np.array(DESIGN[key]) for key in ("lower", "upper", "safe"))
T, X, U, K = np.split(np.array(DESIGN["rows"]), np.cumsum([1, len(STATE), len(CONTROLS)]), axis=1)
COUNT, END = len(T) - 1, float(T[-1, 0])

if __name__ == "__main__":
    words = [word for word in sys.argv[1:] if word not in ("-o", "--feedback")]
    if words:
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends as Ctrl-C does
        mine = SimpleNamespace(**runpy.run_path(words[0]))
        output = words[1] if len(words) > 1 else "recording.csv"
        print(play(mine, output, feedback="--feedback" in sys.argv))
    else:
        print(f"design {DESIGN['name']}: {END:g} s, {COUNT} rows at {COUNT / END:g} Hz; start:")
        print(dict(zip(STATE, X[0].tolist(), strict=True)))
        print(f"limits of {', '.join(CONTROLS)}: {LOWER} to {UPPER}\n\n{DESIGN['gains']}")
