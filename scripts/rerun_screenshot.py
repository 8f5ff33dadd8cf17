"""Save a picture of a Rerun recording, without a display.

    python scripts/rerun_screenshot.py design.rrd design.png --time 1.5
    python scripts/rerun_screenshot.py design.rrd search.png --iteration 10 --tab iterates \
        --size 1280x800
    python scripts/rerun_screenshot.py design.rrd pictures --every-tab --size 1280x800

The viewer needs a Vulkan driver; on Debian, the software driver of `mesa-vulkan-drivers` is enough.
"""

from __future__ import annotations

import argparse
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

from rerun.experimental import ViewerClient

# Time that the viewer needs to load a recording and to arrange its views, and longest time that it
# needs to start [s].
SETTLE, START = 3.0, 20.0

# Width and height of the window [pixels].
SIZE = (1920, 1080)


def screenshot(
    rrd: Path,
    png: Path,
    time_s: float = 0.0,
    iteration: int | None = None,
    *,
    size: tuple[int, int] = SIZE,
    tabs: Sequence[str] = (),
) -> None:
    """Save the picture that the viewer shows.

    Args:
        rrd: Rerun recording.
        png: File to write.
        time_s: Simulated time [s].
        iteration: Iteration of the optimiser that is shown instead of a time.
        size: Width and height of the window [pixels].
        tabs: Names of the tabs that are opened, such as "limits" or "overlay".

    Raises:
        ConnectionError: No viewer can start.
    """
    with _viewer(size) as viewer:
        viewer.open(str(rrd.resolve()))
        time.sleep(SETTLE)
        if tabs:
            _open_tabs(viewer, tabs)
        _go_to(viewer, time_s, iteration)
        time.sleep(SETTLE)
        viewer.save_screenshot(str(png.resolve()))


def every_tab(
    rrd: Path,
    folder: Path,
    time_s: float = 0.0,
    iteration: int | None = None,
    *,
    size: tuple[int, int] = SIZE,
) -> list[Path]:
    """Save a picture of each tab, also of those that are not open at first.

    Args:
        rrd: Rerun recording.
        folder: Folder for the pictures, which are named after the recording, the size and the tab.
        time_s: Simulated time [s].
        iteration: Iteration of the optimiser that is shown instead of a time.
        size: Width and height of the window [pixels].

    Returns:
        The pictures.

    Raises:
        ConnectionError: No viewer can start.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pictures = []
    with _viewer(size) as viewer:
        viewer.open(str(rrd.resolve()))
        time.sleep(SETTLE)
        for tabs in _paths_of_tabs(viewer.get_blueprint().blueprint):
            found = viewer.get_blueprint()
            for container, tab in tabs:
                found.blueprint[container]["ContainerBlueprint"]["active_tab"] = tab
            viewer.set_blueprint(found.blueprint, store_id=found.store_id)
            time.sleep(SETTLE)
            _go_to(viewer, time_s, iteration)
            time.sleep(SETTLE)

            words = [_name(found.blueprint, tab) for _, tab in tabs]
            name = "-".join([f"{rrd.stem}-{size[0]}x{size[1]}", *words])
            plain_name = re.sub(r"[^\w.]+", "-", name)
            picture = folder / f"{plain_name}.png"
            viewer.save_screenshot(str(picture.resolve()))
            pictures.append(picture)
    return pictures


def _go_to(viewer: ViewerClient, time_s: float, iteration: int | None) -> None:
    """Show a simulated time [s], or an iteration."""
    if iteration is None:
        viewer.set_time(timeline="sim_time", duration=time_s, play_state="paused")
    else:
        viewer.set_time(timeline="iteration", sequence=iteration, play_state="paused")


@contextmanager
def _viewer(size: tuple[int, int]) -> Iterator[ViewerClient]:
    """Start a viewer without a window, whose pictures have a size [pixels]."""
    # The path names the executable of the wheel, because PATH may lack this environment.
    port = _free_port()
    command = [str(files("rerun_cli") / "rerun"), "--headless", "--port", str(port)]
    command += ["--window-size", f"{size[0]}x{size[1]}"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield _connected(process, port)
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


def _open_tabs(viewer: ViewerClient, names: Sequence[str]) -> None:
    """Open tabs by their names, in every container that has a tab with one of them."""
    found = viewer.get_blueprint()
    parts = found.blueprint
    for path, content in parts.items():
        container = content.get("ContainerBlueprint", {})
        for child in container.get("contents", ()):
            if container.get("container_kind") == "Tabs" and _name(parts, child) in names:
                parts[path]["ContainerBlueprint"]["active_tab"] = child
    viewer.set_blueprint(parts, store_id=found.store_id)


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


def _size(text: str) -> tuple[int, int]:
    """Width and height that are stated as `1280x800`."""
    width, height = (int(number) for number in text.split("x"))
    return width, height


def main() -> int:
    """Run the command line; return exit code 2 where no viewer can start."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rrd", type=Path)
    parser.add_argument("png", type=Path, help="file to write; with --every-tab a folder")
    parser.add_argument("--time", type=float, default=0.0, help="simulated time [s]")
    parser.add_argument(
        "--iteration", type=int, help="show the timeline `iteration` at this number instead"
    )
    parser.add_argument("--size", type=_size, default=SIZE, help="such as 1280x800 [pixels]")
    parser.add_argument(
        "--tab", action="append", default=[], help="tab to open; may be given several times"
    )
    parser.add_argument("--every-tab", action="store_true", help="save a picture of every tab")
    args = parser.parse_args()
    try:
        if args.every_tab:
            every_tab(args.rrd, args.png, args.time, args.iteration, size=args.size)
            return 0
        screenshot(
            args.rrd, args.png, args.time, args.iteration, size=args.size, tabs=tuple(args.tab)
        )
    except ConnectionError as error:
        print(f"no viewer: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
