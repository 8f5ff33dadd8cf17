"""The native Rerun viewer as a separate process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from mjfim.errors import MjfimError, RecordingError

# Time after which a viewer that still runs counts as started [s].
START_SECONDS = 3.0


def show(path: Path) -> None:
    """Open the native viewer on a recording and return; the viewer stays open.

    Args:
        path: The recording.

    Raises:
        RecordingError: There is no such file.
        MjfimError: The viewer cannot start.
    """
    if not Path(path).is_file():
        raise RecordingError(f"there is no Rerun recording at {str(path)!r}")

    # With -P, Python does not look for the viewer in the current folder.
    command = [sys.executable, "-P", "-m", "rerun", "--new", str(path)]
    viewer = subprocess.Popen(command, start_new_session=True)
    try:
        code = viewer.wait(timeout=START_SECONDS)
    except subprocess.TimeoutExpired:
        return

    if code:
        raise MjfimError(
            f"the Rerun viewer ended with code {code}; it needs a display; the complete recording "
            f"is in {str(path)!r}"
        )
