"""The process that draws a film and encodes it, see `mjfim.output.video.rendering`."""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.output.video.encoding import ENCODERS, SMALLEST_STEP, Frames
from mjfim.output.video.frame import FrameLayout
from mjfim.output.video.picture import QUALITIES, Image, PaintedRobot, Painter, Quality
from mjfim.output.video.process import PATIENCE

# Frames that are drawn to measure how long one takes; before the first one, shaders are compiled.
MEASURED_FRAMES = 2

# Step between the frames up to which a film looks smooth.
SMOOTH_STEP = 2


class Drawing:
    """Draws the frames of a film."""

    def __init__(
        self,
        model: mujoco.MjModel,
        job: dict[str, Any],
        arrays: dict[str, Array],
        quality: Quality,
    ) -> None:
        """Open a context and prepare the layout.

        Args:
            model: The model.
            job: Settings and words of the film.
            arrays: Its arrays.
            quality: How well to draw.
        """
        self._arrays = arrays
        self._painter = Painter(model, job, arrays["offset"], quality)
        self._robots = [[PaintedRobot.of(track) for track in view] for view in job["views"]]
        self._layout = FrameLayout(job)

    def image(self, k: int) -> Image:
        """Draw a frame.

        Args:
            k: Number of the frame.

        Returns:
            (height, width, 3) picture of bytes.
        """
        pictures = []
        for i, robots in enumerate(self._robots):
            positions = [self._arrays[f"qpos_{i}_{j}"][k] for j in range(len(robots))]
            target = self._arrays[f"target_{i}"][k]
            trail = self._arrays[f"trail_{i}"]
            pictures.append(self._painter.picture(robots, positions, target, trail))
        return self._layout.image(pictures, float(self._arrays["t"][k]))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a frame [pixels]."""
        return self._layout.width, self._layout.height

    def seconds_per_frame(self) -> float:
        """Measure how long a frame takes [s], see `counted_seconds`."""
        self.image(0)
        last = len(self._arrays["t"]) - 1

        clocks = (time.perf_counter, time.process_time)
        begun = [clock() for clock in clocks]
        for k in range(MEASURED_FRAMES):
            self.image(last * k // MEASURED_FRAMES)
        wall, processor = (clock() - start for clock, start in zip(clocks, begun, strict=True))
        return counted_seconds(wall, processor) / MEASURED_FRAMES

    def close(self) -> None:
        """Close the context."""
        self._painter.close()


def counted_seconds(wall: float, processor: float) -> float:
    """Count the time of drawing that does not depend on what else the computer does.

    Time in which other programs use the processor does not count, nor that of several processors
    which draw together. Waiting for a graphics card looks like the former, so that at least the
    share counts with which the film ends while somebody waits for it.

    Args:
        wall: Time that has passed [s].
        processor: Time of all processors together [s].

    Returns:
        The time that counts [s].
    """
    return max(min(wall, processor), wall / PATIENCE)


def main() -> None:
    """Draw the film of a folder, and write the video and the result there.

    The name of the folder is the first line of standard input, which ends before where there is no
    film.
    """
    line = sys.stdin.readline()
    if not line:
        return

    folder = Path(json.loads(line))
    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    with np.load(folder / "film.npz") as stored:
        arrays = dict(stored)
    model = mujoco.MjModel.from_binary_path(str(folder / "model.mjb"))

    # Without a context there is no result, so that another kind of context is tried.
    Drawing(model, job, arrays, QUALITIES[-1]).close()
    try:
        result = film(folder, model, job, arrays)
    except Exception as error:
        result = {"reason": f"drawing it failed: {type(error).__name__}: {error}"}

    # The result is complete when it has its name.
    temporary = folder / "result.tmp"
    temporary.write_text(json.dumps(result), encoding="utf-8")
    temporary.replace(folder / "result.json")


def film(
    folder: Path, model: mujoco.MjModel, job: dict[str, Any], arrays: dict[str, Array]
) -> dict[str, Any]:
    """Draw and encode the frames for which there is time.

    Args:
        folder: Folder of the video.
        model: The model.
        job: Settings of the film.
        arrays: Its arrays.

    Returns:
        Size and rate, or the reason why there is no video.
    """
    kind, rate, frames = job["kind"], float(job["rate"]), len(arrays["t"])

    # A slow computer draws less well, and then every second or third frame, and so on.
    for quality in QUALITIES:
        drawing = Drawing(model, job, arrays, quality)
        seconds = frames * drawing.seconds_per_frame()
        step = max(math.ceil(seconds / float(job["seconds"])), SMALLEST_STEP[kind])
        if step <= SMOOTH_STEP or quality == QUALITIES[-1]:
            break
        drawing.close()

    if rate / step < float(job["fewest_frames"]):
        text = f"drawing it takes about {seconds:.0f} s here, for which --video FILE.mp4 waits"
        return {"reason": text}

    chosen = range(0, frames, step)
    width, height = drawing.size
    ENCODERS[kind](
        folder / f"film.{kind}",
        Frames(
            images=(drawing.image(k) for k in chosen),
            count=len(chosen),
            rate=rate / step,
            width=width,
            height=height,
            max_bytes=int(job["max_bytes"]),
        ),
    )
    return {"width": width, "height": height, "rate": rate / step}
