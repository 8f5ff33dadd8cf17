"""Python code in a new process, in which BLAS has one thread from the start."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from scripts.benchmarks.checkouts import ROOT

# Beginning of the line of stdout that holds the result.
MARK = "RESULT "

# First lines of the process. The benchmarks are those of this folder. The package comes from a
# stated folder, which alone stays in the search path, because worker processes inherit the path.
IMPORTS = """
import sys
sys.path.insert(0, {root!r})
import scripts.benchmarks
sys.path.remove({root!r})
sys.path.insert(0, {package!r})
import mjfim
"""

# Calls a function of `scripts.benchmarks.measurements` by its name.
CALL = """
import json
from scripts.benchmarks import measurements
found = getattr(measurements, sys.argv[1])(**json.loads(sys.argv[2]))
"""


def run_in_subprocess(code: str, *arguments: object, package: Path = ROOT) -> Any:
    """Run code in a new process and return the value of its variable `found` as JSON can hold it.

    Args:
        code: Python code; it can import `scripts.benchmarks` and assigns `found`.
        *arguments: Arguments of the process, `sys.argv[1:]`.
        package: Folder from which `mjfim` is imported. The benchmarks are those of this folder in
            any case, so that the same code measures both packages.

    Returns:
        The value; None, with a message on stderr, where the code fails, for instance because a
        library is missing.
    """
    first = IMPORTS.format(package=str(package), root=str(ROOT))
    last = f"import json; print({MARK!r} + json.dumps(found))"
    command = [sys.executable, "-c", f"{first}\n{code}\n{last}\n", *(str(a) for a in arguments)]

    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(package)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)

    line = next((text for text in done.stdout.splitlines() if text.startswith(MARK)), None)
    if done.returncode != 0 or line is None:
        reason = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        print(f"left out: {reason}", file=sys.stderr)
        return None

    return json.loads(line.removeprefix(MARK))


def measure_in_subprocess(name: str, package: Path = ROOT, **arguments: Any) -> Any:
    """Call a function of `scripts.benchmarks.measurements` in a new process.

    Args:
        name: Name of the function.
        package: Folder from which `mjfim` is imported.
        **arguments: Arguments of the function that JSON can hold.

    Returns:
        What it returns, or None as `run_in_subprocess`.
    """
    return run_in_subprocess(CALL, name, json.dumps(arguments), package=package)
