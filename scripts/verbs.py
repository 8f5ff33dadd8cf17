"""Calls of the command line, as a user makes them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path


def call_verb(
    words: Sequence[str],
    *,
    variables: Mapping[str, str],
    patience: float,
    folder: Path | None = None,
) -> subprocess.CompletedProcess[str]:
    """Call `python -m mjfim`, and keep what it prints.

    Args:
        words: The verb and its arguments.
        variables: Variables of the environment, besides those of this process.
        patience: Longest duration [s].
        folder: Folder in which it runs; default: that of this process.

    Raises:
        subprocess.TimeoutExpired: It does not end in time.
    """
    return subprocess.run(
        [sys.executable, "-m", "mjfim", *words],
        cwd=folder,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=patience,
        check=False,
    )
