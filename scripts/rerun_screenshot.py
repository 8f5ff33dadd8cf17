"""Pictures of Rerun recordings for the gallery, without a display.

The viewer needs a Vulkan driver; on Debian, the software driver of `mesa-vulkan-drivers` is enough.
"""

from __future__ import annotations

import re
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from rerun.experimental import ViewerClient

# Time that the viewer needs to load a recording and to arrange its views, and longest time that it
# needs to start [s].
SETTLE, START = 3.0, 20.0

# Width and height of the window [pixels].
SIZE = (1920, 1080)


@dataclass(frozen=True, kw_only=True)
class Shot:
    """View of a recording in a picture.

    Attributes:
        rrd: Rerun recording.
        time_s: Simulated time [s].
        size: Width and height of the window [pixels].
    """

    rrd: Path
    time_s: float = 0.0
    size: tuple[int, int] = SIZE


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


def every_tab(shot: Shot, folder: Path) -> list[Path]:
    """Save a picture of each tab, also of those that are not open at first.

    Args:
        shot: What the pictures show.
        folder: Folder for the pictures, which are named after the recording, the size and the tab.

    Returns:
        The pictures.

    Raises:
        ConnectionError: No viewer can start.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pictures = []
    with _viewer(shot) as viewer:
        for tabs in _paths_of_tabs(viewer.get_blueprint().blueprint):
            found = viewer.get_blueprint()
            for container, tab in tabs:
                found.blueprint[container]["ContainerBlueprint"]["active_tab"] = tab
            viewer.set_blueprint(found.blueprint, store_id=found.store_id)
            time.sleep(SETTLE)

            width, height = shot.size
            words = [_name(found.blueprint, tab) for _, tab in tabs]
            name = "-".join([f"{shot.rrd.stem}-{width}x{height}", *words])
            plain_name = re.sub(r"[^\w.]+", "-", name)
            picture = folder / f"{plain_name}.png"
            _save(viewer, shot, picture)
            pictures.append(picture)
    return pictures


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
    command += ["--window-size", f"{shot.size[0]}x{shot.size[1]}"]
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


def _name(parts: Mapping[str, Any], child: str) -> str:
    """Name of a container or a view."""
    shown = parts.get(f"/{child}", {})
    named = shown.get("ContainerBlueprint") or shown.get("ViewBlueprint") or {}
    return str(named.get("display_name", ""))


def _paths_of_tabs(parts: Mapping[str, Any]) -> list[list[tuple[str, str]]]:
    """Containers with tabs, and the tab to open in each, for every tab of a blueprint.

    A tab that has tabs itself stands there once for each of them.
    """
    tabs = {
        path: content["ContainerBlueprint"].get("contents", ())
        for path, content in parts.items()
        if content.get("ContainerBlueprint", {}).get("container_kind") == "Tabs"
    }
    inner = {f"/{child}" for children in tabs.values() for child in children}
    paths = []
    for path, children in tabs.items():
        for child in children if path not in inner else ():
            below = tabs.get(f"/{child}", ())
            paths += [[(path, child), (f"/{child}", each)] for each in below]
            paths += [] if below else [[(path, child)]]
    return paths


def _free_port() -> int:
    """Return a port that is free."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
