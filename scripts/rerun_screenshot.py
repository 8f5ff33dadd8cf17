"""Save a picture of a Rerun recording, without a display.

    python scripts/rerun_screenshot.py design.rrd design.png --time 1.5
    python scripts/rerun_screenshot.py design.rrd search.png --iteration 10 --tab iterates \
        --size 1280x800

The viewer needs a Vulkan driver; on Debian, the software driver of `mesa-vulkan-drivers` is enough.
"""

from __future__ import annotations

import argparse
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path

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
        if iteration is None:
            viewer.set_time(timeline="sim_time", duration=time_s, play_state="paused")
        else:
            viewer.set_time(timeline="iteration", sequence=iteration, play_state="paused")
        time.sleep(SETTLE)
        viewer.save_screenshot(str(png.resolve()))


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
            shown = parts.get(f"/{child}", {})
            name = (shown.get("ContainerBlueprint") or shown.get("ViewBlueprint") or {}).get(
                "display_name"
            )
            if container.get("container_kind") == "Tabs" and name in names:
                parts[path]["ContainerBlueprint"]["active_tab"] = child
    viewer.set_blueprint(parts, store_id=found.store_id)


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
    parser.add_argument("png", type=Path)
    parser.add_argument("--time", type=float, default=0.0, help="simulated time [s]")
    parser.add_argument(
        "--iteration", type=int, help="show the timeline `iteration` at this number instead"
    )
    parser.add_argument("--size", type=_size, default=SIZE, help="such as 1280x800 [pixels]")
    parser.add_argument(
        "--tab", action="append", default=[], help="tab to open; may be given several times"
    )
    args = parser.parse_args()
    try:
        screenshot(
            args.rrd, args.png, args.time, args.iteration, size=args.size, tabs=tuple(args.tab)
        )
    except ConnectionError as error:
        print(f"no viewer: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
