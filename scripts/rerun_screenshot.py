"""Save a picture of a Rerun recording, without a display.

    python scripts/rerun_screenshot.py design.rrd design.png --time 1.5

The viewer needs a Vulkan driver; on Debian, the software driver of `mesa-vulkan-drivers` is enough.
"""

from __future__ import annotations

import argparse
import socket
import sys
import time
from importlib.resources import files
from pathlib import Path

from rerun.experimental import ViewerClient

# Time that the viewer needs to load a recording and to arrange its views [s].
SETTLE = 3.0


def screenshot(rrd: Path, png: Path, time_s: float = 0.0, iteration: int | None = None) -> None:
    """Save the picture that the viewer shows.

    Args:
        rrd: Rerun recording.
        png: File to write.
        time_s: Simulated time [s].
        iteration: Iteration of the optimiser that is shown instead of a time.
    """
    # The path names the executable of the wheel, because PATH may lack this environment.
    viewer_path = str(files("rerun_cli") / "rerun")
    with ViewerClient.spawn(
        headless=True, port=_free_port(), executable_path=viewer_path
    ) as viewer:
        viewer.open(str(rrd.resolve()))
        if iteration is None:
            viewer.set_time(timeline="sim_time", duration=time_s, play_state="paused")
        else:
            viewer.set_time(timeline="iteration", sequence=iteration, play_state="paused")
        time.sleep(SETTLE)
        viewer.save_screenshot(str(png.resolve()))


def _free_port() -> int:
    """Return a port that is free."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


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
    args = parser.parse_args()
    try:
        screenshot(args.rrd, args.png, args.time, args.iteration)
    except ConnectionError as error:
        print(f"no viewer: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
