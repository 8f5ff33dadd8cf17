"""Pictures of Rerun recordings for the gallery, without a display.

The viewer needs a Vulkan driver; on Debian, the software driver of `mesa-vulkan-drivers` is enough.
"""

from __future__ import annotations

import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path

from rerun.experimental import ViewerClient

from mjfim.arrays import record

# Time that the viewer needs to load a recording and to arrange its views, and longest time that it
# needs to start [s].
SETTLE, START = 3.0, 20.0

# Width and height of the window [pixels].
SIZE = (1920, 1080)


@record
class Shot:
    """View of a recording in a picture.

    Attributes:
        rrd: Rerun recording.
        time_s: Simulated time [s].
    """

    rrd: Path
    time_s: float = 0.0


def screenshot(shot: Shot, png: Path) -> None:
    """Save the picture that the viewer shows.

    Args:
        shot: What the picture shows.
        png: File to write.

    Raises:
        ConnectionError: No viewer can start.
    """
    with _viewer(shot) as viewer:
        _save(viewer, shot, png)


def _save(viewer: ViewerClient, shot: Shot, picture: Path) -> None:
    """Save what the viewer shows at the time."""
    viewer.set_time(timeline="sim_time", duration=shot.time_s, play_state="paused")
    time.sleep(SETTLE)
    viewer.save_screenshot(str(picture.resolve()))


@contextmanager
def _viewer(shot: Shot) -> Iterator[ViewerClient]:
    """Start a viewer without a window, and open the recording in it."""
    # The path names the executable of the wheel, because PATH may lack this environment.
    port = _free_port()
    command = [str(files("rerun_cli") / "rerun"), "--headless", "--port", str(port)]
    command += ["--window-size", f"{SIZE[0]}x{SIZE[1]}"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        viewer = _connected(process, port)
        viewer.open(str(shot.rrd.resolve()))
        time.sleep(SETTLE)
        yield viewer
    finally:
        process.terminate()
        process.wait()


def _connected(process: subprocess.Popen[bytes], port: int) -> ViewerClient:
    """Connect to a viewer as soon as it answers; ConnectionError where it ends before."""
    begin = time.monotonic()
    while process.poll() is None and time.monotonic() - begin < START:
        try:
            viewer = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            viewer.get_state()
        except (ConnectionError, RuntimeError):
            time.sleep(0.2)
        else:
            return viewer
    raise ConnectionError("the Rerun viewer does not start; it needs a Vulkan driver")


def _free_port() -> int:
    """Return a port that is free."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
