"""Work in a process of its own, where BLAS is single-threaded from the start and numbers come back as JSON."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

MARK = "ASIDE "


def aside(code: str, *arguments: object) -> Any:
    """What `found` is after the code has run, as JSON; None, with a word on stderr, where it fails (a library is missing).

    code: Python; modules of this folder can be imported, the arguments are `sys.argv[1:]`
    """
    here = str(Path(__file__).resolve().parent)
    whole = f"import sys; sys.path.insert(0, {here!r})\n{code}\nimport json; print({MARK!r} + json.dumps(found))\n"
    command = [sys.executable, "-c", whole, *(str(a) for a in arguments)]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    line = next((text for text in done.stdout.splitlines() if text.startswith(MARK)), None)
    if done.returncode != 0 or line is None:
        print(f"peers are left out: {done.stderr.strip().splitlines()[-1:]}", file=sys.stderr)
        return None
    return json.loads(line.removeprefix(MARK))
