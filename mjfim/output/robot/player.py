"""Play a design on a robot, and record what it measures.

This file needs Python 3.10 and NumPy only, and it carries the design; `mjfim export DESIGN --to
player` writes it. Give it two functions of your robot, for example in a file `my_robot.py`:

    def read_state():
        return {"qpos:hinge": 0.1, "qvel:hinge": 0.0}  # what you measure, by name

    def send_control(u):
        ...  # u: (nu,) array, in the order of the actuators; hold it until the next call

    def stop():
        ...  # optional: what makes the robot safe at the end, after Ctrl-C and after an error

Then run it, or import it and call `play(read_state, send_control)`:

    python play.py                            # what the design needs
    python play.py my_robot.py -o recording.csv
    python play.py my_robot.py -o recording.csv --feedback

With feedback the control is `u = u_ref + K (x_ref - x)`, otherwise `u = u_ref`. Use feedback where
small errors grow along the motion, and leave it out where position servos correct them already, or
where measurements are noisy or late: see `GAINS` below.

`mjfim identify EXPERIMENT recording.csv -o fit` reads the recording.
"""

import argparse
import csv
import math
import os
import runpy
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

import numpy as np

# What `read_state` may return: numbers by name, or all positions, then all velocities.
Reading = Mapping[str, float] | Sequence[float] | np.ndarray

# Largest deviation of a position from the first one of the plan before the motion begins, as a
# fraction of the range of its planned motion.
START_TOLERANCE = 0.5

# Deviation that the noise of a measurement explains, in standard deviations.
START_SIGMA = 6.0

# Excess of a planned control beyond its limit that rounding explains, as a fraction of the range.
ROUNDING = 1e-6

# Signals that end the motion: Ctrl-C, and a request of the system.
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class PlayError(ValueError):
    """The design cannot be played as it was asked for."""


@dataclass
class Plan:
    """The design that this file carries.

    Attributes:
        controls: Names of the nu controls.
        names: Names of the state: nq positions, nv velocities, na activations.
        sizes: nq, nv, na.
        scalars: Pairs (address in qpos, address in qvel) of slides, hinges and translations.
        quaternions: Pairs (address in qpos, address in qvel) of ball and free joints.
        t: (M+1,) times of the rows [s].
        states: (M+1, nq+nv+na) planned states.
        ctrl: (M, nu) controls, each held until the next row.
        gain: (M, nu, 2 nv + na) gains K.
        lower: (nu,) smallest controls.
        upper: (nu,) largest controls.
        sigma: (nq+nv+na,) standard deviations of measured states; 0 where they are not stated.
        safe: (nu,) controls that are sent at the end; NaN holds the last control.
    """

    controls: list[str]
    names: list[str]
    sizes: tuple[int, int, int]
    scalars: list[tuple[int, int]]
    quaternions: list[tuple[int, int]]
    t: np.ndarray
    states: np.ndarray
    ctrl: np.ndarray
    gain: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    sigma: np.ndarray
    safe: np.ndarray

    @classmethod
    def of(cls, settings: Mapping[str, Any], rows: Sequence[str]) -> "Plan":
        """Read the plan.

        Args:
            settings: Names, sizes and limits.
            rows: Lines of design.csv; the last one is the final state, without a control.

        Raises:
            PlayError: A planned control is beyond its limits.
        """
        table = list(csv.DictReader(rows))
        controls, names = settings["controls"], settings["state"]
        gains = [f"gain:{u}:{x}" for u in controls for x in settings["deviation"]]
        played = table[:-1]
        plan = cls(
            controls=controls,
            names=names,
            sizes=tuple(settings["sizes"]),
            scalars=[(q, v) for q, v in settings["scalars"]],
            quaternions=[(q, v) for q, v in settings["quaternions"]],
            t=_numbers(table, ["t"])[:, 0],
            states=_numbers(table, names),
            ctrl=_numbers(played, [f"ctrl:{name}" for name in controls]),
            gain=_numbers(played, gains).reshape(len(played), len(controls), -1),
            lower=_with_default(settings["lower"], -math.inf),
            upper=_with_default(settings["upper"], math.inf),
            sigma=_with_default(settings["sigma"], 0.0),
            safe=_with_default(settings["safe"], math.nan),
        )
        plan._check_limits()
        return plan

    @property
    def period(self) -> float:
        """Time from row to row [s]."""
        return float(self.t[-1] - self.t[0]) / len(self.ctrl)

    def measured(self, reading: Reading) -> dict[str, float]:
        """Measured values by name.

        Args:
            reading: What `read_state` returned.

        Raises:
            PlayError: A name is unknown, or there are too few or too many numbers.
        """
        if not isinstance(reading, Mapping):
            moving = self.names[: self.sizes[0] + self.sizes[1]]
            values = [float(value) for value in reading]
            if len(values) != len(moving):
                raise PlayError(
                    f"read_state returned {len(values)} numbers; expected {len(moving)}, which "
                    f"are {', '.join(moving)}; or return a dict with the names of what is measured"
                )
            return dict(zip(moving, values, strict=True))

        for name in reading:
            if name.startswith(("qpos:", "qvel:", "act:")) and name not in self.names:
                raise PlayError(
                    f"read_state returned {name!r}, which is not in the model; its states are "
                    f"{', '.join(self.names)}"
                )
        return {name: float(value) for name, value in reading.items()}

    def deviation(self, row: int, measured: Mapping[str, float]) -> np.ndarray:
        """(2 nv + na,) planned minus measured state; zero where nothing is measured.

        Rotations are rotation vectors in the frame of the measured body.

        Args:
            row: Row of the plan.
            measured: What the robot measured, by name.
        """
        planned = self.states[row]
        state = np.array([measured.get(name, math.nan) for name in self.names])
        for q, _ in self.quaternions:
            if not np.isfinite(state[q : q + 4]).all():
                state[q : q + 4] = planned[q : q + 4]
        state = np.where(np.isfinite(state), state, planned)

        nq, nv, _ = self.sizes
        difference = planned - state
        move = np.zeros(nv)
        for q, v in self.scalars:
            move[v] = difference[q]
        for q, v in self.quaternions:
            move[v : v + 3] = rotation_vector(planned[q : q + 4], state[q : q + 4])
        return np.concatenate([move, difference[nq:]])

    def control(self, row: int, measured: Mapping[str, float], feedback: bool) -> np.ndarray:
        """(nu,) control of a row, before it is clipped to its limits.

        Args:
            row: Row of the plan.
            measured: What the robot measured, by name.
            feedback: Whether the gains are used.
        """
        control = self.ctrl[row]
        if feedback:
            control = control + self.gain[row] @ self.deviation(row, measured)
        if not np.isfinite(control).all():
            raise PlayError(f"the control of row {row + 1} is not finite: {control}")
        return np.asarray(control)

    def check_start(self, measured: Mapping[str, float], tolerance: float) -> None:
        """Refuse to begin where the robot is far from the start of the plan.

        Args:
            measured: What the robot measured, by name.
            tolerance: Largest deviation, as a fraction of the range of the planned motion.

        Raises:
            PlayError: A slide, a hinge or a translation is too far away.
        """
        for q, _ in self.scalars:
            name, motion = self.names[q], self.states[:, q]
            off = abs(measured.get(name, math.nan) - motion[0])
            allowed = tolerance * np.ptp(motion) + START_SIGMA * self.sigma[q]
            if off > allowed > 0.0:
                raise PlayError(
                    f"{name} is {measured[name]:g}, but the design begins at {motion[0]:g}; bring "
                    "the robot to the start first, or call play with a larger start_tolerance"
                )

    def _check_limits(self) -> None:
        """Refuse a plan whose control is beyond its limits."""
        reach = self.upper - self.lower
        slack = np.where(np.isfinite(reach), ROUNDING * reach, 0.0)
        beyond = (self.ctrl < self.lower - slack) | (self.ctrl > self.upper + slack)
        if beyond.any():
            row, i = np.argwhere(beyond)[0]
            raise PlayError(
                f"the planned control {self.controls[i]} is {self.ctrl[row, i]:g} at "
                f"{self.t[row]:g} s, outside {self.lower[i]:g} to {self.upper[i]:g}"
            )


@dataclass
class Report:
    """Account of a design that was played.

    Attributes:
        rows: Number of controls that were sent.
        skipped: Number of rows that were left out, because the computer was late.
        clipped: Number of controls that were clipped to their limits.
        latest: Largest delay of a row [s].
        interrupted: Whether the motion ended early.
        output: File with the recording; empty where too little was recorded.
    """

    rows: int = 0
    skipped: int = 0
    clipped: int = 0
    latest: float = 0.0
    interrupted: bool = False
    output: str = ""


@dataclass
class Log:
    """The rows of the recording.

    Attributes:
        controls: Names of the controls.
        rows: Time [s], control and measurements of each row; the last row has no control.
    """

    controls: list[str]
    rows: list[tuple[float, np.ndarray, dict[str, float]]] = field(default_factory=list)

    def write(self, path: str) -> None:
        """Write the recording as CSV: under another name first, so that it is whole.

        Args:
            path: File to write.
        """
        measured = list(dict.fromkeys(name for _, _, found in self.rows for name in found))
        header = ["t", *(f"ctrl:{name}" for name in self.controls), *measured]
        with open(f"{path}.part", "w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream)
            writer.writerow(header)
            for t, control, found in self.rows:
                values = [t, *control.tolist(), *(found.get(name, math.nan) for name in measured)]
                writer.writerow(["" if math.isnan(value) else repr(value) for value in values])
        os.replace(f"{path}.part", path)


class StopRequest:
    """The wish to end early, by Ctrl-C or a signal; a second Ctrl-C ends at once."""

    def __init__(self) -> None:
        """Begin without a wish."""
        self.wanted = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "StopRequest":
        """Listen to the signals; Python permits this in the main thread only."""
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._ask) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        """Restore what the signals did before."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        """Note the wish."""
        if self.wanted:
            raise KeyboardInterrupt
        self.wanted = True


def play(
    read_state: Callable[[], Reading],
    send_control: Callable[[np.ndarray], object],
    *,
    output: str = "recording.csv",
    feedback: bool = False,
    stop: Callable[[], object] | None = None,
    start_tolerance: float = START_TOLERANCE,
    clock: Callable[[], float] = time.perf_counter,
    sleep: Callable[[float], object] = time.sleep,
) -> Report:
    """Play the design and record it.

    Each row is sent at its own time after the start, so that delays do not add up. Rows whose time
    has passed are left out. Controls are clipped to their limits. At the end, after Ctrl-C and
    after an error, `stop` is called and the recording is written.

    Args:
        read_state: Returns what the robot measures: a dict with the names of the model
            (`qpos:<joint>`, `qvel:<joint>`, sensors), or all positions, then all velocities.
        send_control: Sends the controls (nu,), which hold until the next call.
        output: CSV file to write; it must not exist.
        feedback: Whether the gains are used.
        stop: Makes the robot safe; default: sends 0 to motors, and the last command to servos.
        start_tolerance: Largest deviation from the start of the design, as a fraction of the range
            of the planned motion of each coordinate.
        clock: Returns the time [s].
        sleep: Waits for some seconds.

    Returns:
        What was played.

    Raises:
        FileExistsError: The output exists.
        PlayError: The robot is not at the start, or a number cannot be used.
    """
    if os.path.exists(output):
        raise FileExistsError(f"{output} exists; choose another name for the recording")

    plan = Plan.of(SETTINGS, ROWS)
    plan.check_start(plan.measured(read_state()), start_tolerance)
    report, log = Report(), Log(controls=plan.controls)

    with StopRequest() as request:
        try:
            for row, now in _rows_in_time(plan, report, clock, sleep):
                if request.wanted:
                    report.interrupted = True
                    break

                measured = plan.measured(read_state())
                if row == len(plan.ctrl):
                    log.rows.append((now, np.full(len(plan.controls), math.nan), measured))
                    break

                wanted = plan.control(row, measured, feedback)
                control = np.clip(wanted, plan.lower, plan.upper)
                send_control(control)
                log.rows.append((now, control, measured))
                report.rows += 1
                report.clipped += int((control != wanted).any())
        finally:
            try:
                _end(plan, log, send_control, stop)
            finally:
                if len(log.rows) > 1:
                    log.write(output)
                    report.output = output
    return report


def _rows_in_time(
    plan: Plan, report: Report, clock: Callable[[], float], sleep: Callable[[float], object]
) -> Iterator[tuple[int, float]]:
    """Wait for the time of each row; leave out rows whose time has passed.

    Yields:
        Row and time since the start [s]. The last row is the end of the motion, which has no
        control.
    """
    begin, row, end = clock(), 0, len(plan.ctrl)
    while row < end:
        now = _wait(begin + plan.t[row], clock, sleep) - begin
        report.latest = max(report.latest, now - plan.t[row])
        yield row, now

        due = min(int((clock() - begin) / plan.period), end)
        report.skipped += max(due - row - 1, 0)
        row = max(row + 1, due)

    yield end, _wait(begin + plan.t[end], clock, sleep) - begin


def _wait(deadline: float, clock: Callable[[], float], sleep: Callable[[float], object]) -> float:
    """Wait for a time of the clock [s]; return the time."""
    remaining = deadline - clock()
    if remaining > 0.0:
        sleep(remaining)
    return clock()


def _end(
    plan: Plan,
    log: Log,
    send_control: Callable[[np.ndarray], object],
    stop: Callable[[], object] | None,
) -> None:
    """Make the robot safe, if anything was sent to it."""
    sent = [control for _, control, _ in log.rows if np.isfinite(control).all()]
    if stop is not None:
        stop()
    elif sent:
        send_control(np.where(np.isnan(plan.safe), sent[-1], plan.safe))


def rotation_vector(planned: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """(3,) rotation from a measured to a planned orientation, in the measured frame [rad].

    Args:
        planned: (4,) quaternion, w first.
        measured: (4,) quaternion, w first.
    """
    w = float(measured @ planned)
    axis = measured[0] * planned[1:] - planned[0] * measured[1:]
    axis = axis - np.cross(measured[1:], planned[1:])

    # Both signs of a quaternion are one orientation; the shorter way is taken.
    sine = float(np.linalg.norm(axis))
    if sine == 0.0:
        return np.zeros(3)
    angle = 2.0 * math.atan2(sine, abs(w))
    return np.asarray(math.copysign(angle, w) / sine * axis)


def _numbers(table: Sequence[Mapping[str, str]], names: Sequence[str]) -> np.ndarray:
    """(rows, len(names)) numbers of some columns."""
    values = [[float(row[name]) for name in names] for row in table]
    return np.array(values).reshape(len(table), len(names))


def _with_default(values: Sequence[float | None], default: float) -> np.ndarray:
    """(n,) numbers, with a default in place of None."""
    return np.array([default if value is None else value for value in values], dtype=float)


def describe(plan: Plan) -> str:
    """Describe in words what a design needs."""
    lines = [
        f"design {SETTINGS['name']}: {plan.t[-1]:g} s, {len(plan.ctrl)} rows at "
        f"{1.0 / plan.period:g} Hz",
        f"states for read_state: {', '.join(plan.names)}",
        "start: "
        + ", ".join(f"{n} = {x:g}" for n, x in zip(plan.names, plan.states[0], strict=True)),
    ]
    for i, name in enumerate(plan.controls):
        planned = plan.ctrl[:, i]
        lines.append(
            f"control {name}: {planned.min():g} to {planned.max():g}, limits {plan.lower[i]:g} to "
            f"{plan.upper[i]:g}"
        )
    return "\n".join([*lines, "", GAINS])


def main(words: Sequence[str] | None = None) -> int:
    """Play the design with the functions of a file, or say what it needs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("robot", nargs="?", help="file with read_state and send_control")
    parser.add_argument("-o", "--output", default="recording.csv", help="recording to write")
    parser.add_argument("--feedback", action="store_true", help="use the gains")
    options = parser.parse_args(words)
    if options.robot is None:
        print(describe(Plan.of(SETTINGS, ROWS)))
        return 0

    functions = runpy.run_path(options.robot)
    for name in ("read_state", "send_control"):
        if name not in functions:
            parser.error(f"{options.robot} has no function {name}")
    try:
        report = play(
            functions["read_state"],
            functions["send_control"],
            output=options.output,
            feedback=options.feedback,
            stop=functions.get("stop"),
        )
    except (FileExistsError, PlayError) as error:
        parser.error(str(error))

    print(
        f"sent {report.rows} rows, {report.skipped} left out, {report.clipped} clipped; latest row "
        f"{1000.0 * report.latest:.1f} ms late; wrote {report.output or 'nothing'}"
    )
    return 1 if report.interrupted else 0


# ---- the design, which `mjfim export` writes

GAINS = ""
SETTINGS: dict[str, Any] = {}
ROWS: list[str] = []

# ---- end of the design

if __name__ == "__main__":
    raise SystemExit(main())
