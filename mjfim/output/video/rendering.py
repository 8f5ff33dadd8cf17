"""Draws a film with MuJoCo's renderer, in a process of its own.

A renderer needs a context of OpenGL. Which kind the computer has is known only after one was
opened, and a faulty driver can end or block the process that tries it. So another process opens it,
draws and encodes; this one waits for the file, for a limited time.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.budget import StopToken
from mjfim.output.video.film import FRAME_RATE, Film, speed_text
from mjfim.output.video.process import PATIENCE, back_ends, process_for
from mjfim.output.video.record import MEDIA_TYPES, Format, NoVideoError, Video, require_encoder

# Names of the files that the two processes exchange.
MODEL_FILE, ARRAYS_FILE, JOB_FILE, RESULT_FILE = "model.mjb", "film.npz", "job.json", "result.json"

# Time that the other process may need beside drawing: to start, to open a context, and to write
# the end of the file [s].
START_SECONDS = 20.0

# Period at which this process looks whether the drawing has to end [s].
POLL_INTERVAL = 0.1

# Reasons why there is no video. They are complete parts of a sentence.
NO_RENDERER = "MuJoCo can draw nothing on this computer, because it has no usable OpenGL"
NO_RENDERER_ON_LINUX = f"{NO_RENDERER}; the packages libegl1 and libgl1-mesa-dri are enough"


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How much a video may cost.

    Attributes:
        seconds: Time for drawing [s]. A slower computer draws fewer frames per second.
        fewest_frames: Frames per second of the film below which there is none.
        max_bytes: Largest size of an mp4 file.
    """

    seconds: float
    fewest_frames: float = 7.0
    max_bytes: int = 2_000_000


# Effort of a video that the user asks for, and of one that is added to a report.
WANTED = Effort(seconds=60.0, fewest_frames=0.0)
ADDED = Effort(seconds=1.0)


def render(
    film: Film, kind: Format, effort: Effort = WANTED, stop: StopToken | None = None
) -> Video:
    """Draw a film.

    Args:
        film: The film.
        kind: Format of the video.
        effort: What it may cost.
        stop: Ends the drawing early.

    Returns:
        The video.

    Raises:
        NoVideoError: Nothing can be drawn here, or not in time, or the drawing was ended.
    """
    require_encoder(kind)
    try:
        with tempfile.TemporaryDirectory(prefix="mjfim-video-") as name:
            folder = Path(name)
            _write_job(folder, film, kind, effort)
            result = _drawn(folder, effort, stop or StopToken())
            data = (folder / f"film.{kind}").read_bytes()
    except OSError as error:
        raise NoVideoError(f"its temporary files cannot be written ({error})") from None

    return Video(
        data=data,
        media_type=MEDIA_TYPES[kind],
        caption=film.caption,
        width=result["width"],
        height=result["height"],
    )


def _write_job(folder: Path, film: Film, kind: Format, effort: Effort) -> None:
    """Write what the other process reads."""
    mujoco.mj_saveModel(film.model, str(folder / MODEL_FILE), None)

    arrays: dict[str, Any] = {"t": film.t, "offset": film.camera.offset}
    views = []
    for k, view in enumerate(film.views):
        arrays[f"target_{k}"], arrays[f"trail_{k}"] = view.target, view.trail
        tracks = []
        for j, track in enumerate(view.tracks):
            arrays[f"qpos_{k}_{j}"] = track.qpos
            tracks.append(
                {
                    "word": track.word,
                    "colour": track.colour,
                    "tint": track.tint,
                    "opacity": track.opacity,
                }
            )
        views.append(tracks)
    np.savez(folder / ARRAYS_FILE, **arrays)

    job = {
        "views": views,
        "width": film.camera.size[0],
        "height": film.camera.size[1],
        "field_of_view": film.camera.field_of_view,
        "floor": film.camera.floor,
        "spacing": film.camera.spacing,
        "remark": speed_text(film.speed),
        "kind": kind,
        "rate": FRAME_RATE,
        "seconds": effort.seconds,
        "fewest_frames": effort.fewest_frames,
        "max_bytes": effort.max_bytes,
    }
    (folder / JOB_FILE).write_text(json.dumps(job), encoding="utf-8")


def _drawn(folder: Path, effort: Effort, stop: StopToken) -> dict[str, Any]:
    """Let another process draw the film, with the first kind of context that works here."""
    deadline = time.monotonic() + START_SECONDS + PATIENCE * effort.seconds
    for back_end in back_ends():
        _run(folder, back_end, deadline, stop)

        # A process that found no context leaves no result.
        found = folder / RESULT_FILE
        if found.is_file():
            result: dict[str, Any] = json.loads(found.read_text(encoding="utf-8"))
            if "reason" in result:
                raise NoVideoError(result["reason"])
            return result

    stated = os.environ.get("MUJOCO_GL")
    if stated:
        raise NoVideoError(f"MuJoCo can draw nothing with the variable MUJOCO_GL={stated}")
    raise NoVideoError(NO_RENDERER_ON_LINUX if platform.system() == "Linux" else NO_RENDERER)


def _run(folder: Path, back_end: str, deadline: float, stop: StopToken) -> None:
    """Run the other process to its end, or end it when the time is over or at a request."""
    seconds = deadline - time.monotonic()
    if seconds <= 0.0:
        raise NoVideoError("drawing took too long")

    with process_for(folder, back_end) as process:
        try:
            while not _has_ended(process):
                if stop.requested:
                    raise NoVideoError("drawing was ended")
                if time.monotonic() > deadline:
                    raise NoVideoError(f"drawing did not end within {seconds:.0f} s")
        finally:
            process.kill()


def _has_ended(process: subprocess.Popen[bytes]) -> bool:
    """Wait a while for the end of a process."""
    with suppress(subprocess.TimeoutExpired):
        process.wait(timeout=POLL_INTERVAL)
    return process.returncode is not None
