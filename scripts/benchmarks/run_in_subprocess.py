"""Python code in a new process, in which BLAS has one thread from the start."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

# The top folder of the repository, from which the benchmarks are imported.
ROOT = Path(__file__).resolve().parents[2]

# Beginning of the line of stdout that holds the result.
MARK = "RESULT "


def run_in_subprocess(code: str, *arguments: object) -> Any:
    """Run code in a new process and return the value of its variable `found` as JSON can hold it.

    Args:
        code: Python code; it can import `scripts.benchmarks` and assigns `found`.
        *arguments: Arguments of the process, `sys.argv[1:]`.

    Returns:
        The value; None, with a message on stderr, where the code fails because a library is
        missing.
    """
    first = f"import sys; sys.path.insert(0, {str(ROOT)!r})"
    last = f"import json; print({MARK!r} + json.dumps(found))"
    command = [sys.executable, "-c", f"{first}\n{code}\n{last}\n", *(str(a) for a in arguments)]

    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)

    line = next((text for text in done.stdout.splitlines() if text.startswith(MARK)), None)
    if done.returncode != 0 or line is None:
        print(f"peers are left out: {done.stderr.strip().splitlines()[-1:]}", file=sys.stderr)
        return None

    return json.loads(line.removeprefix(MARK))
