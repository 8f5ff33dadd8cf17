"""Golden results: what a user gets from command lines, to compare two versions of the package.

    python -m scripts.benchmarks golden run OUT.json                # about 20 minutes
    python -m scripts.benchmarks golden run OUT.json --tree PATH    # of the mjfim in PATH
    python -m scripts.benchmarks golden run OUT.json --models PATH  # with these experiment files
    python -m scripts.benchmarks golden compare A.json B.json

`run` stores for each case of `golden_cases` the exit codes, the error, the names of the files, the
numbers and states of all JSON files (J, θ, σ, intervals, margins, verdicts, engine steps), the
seconds of the processors and the largest memory. `compare` prints the cases that differ.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from scripts.benchmarks.child import ROOT, options_of
from scripts.benchmarks.golden_cases import CASES

# Times differ between runs; states are the only texts that are compared.
TIMES = frozenset({"seconds", "times", "wall", "elapsed", "created"})
STATES = frozenset({"status", "level", "state", "found_by", "method", "schema_version"})

# More numbers in one list are a trajectory.
MOST = 24


def written_toml(value: Any) -> str:
    """A value of an experiment file in one line."""
    if isinstance(value, dict):
        return (
            "{" + ", ".join(f"{json.dumps(k)} = {written_toml(v)}" for k, v in value.items()) + "}"
        )
    if isinstance(value, list):
        return "[" + ", ".join(map(written_toml, value)) + "]"
    return json.dumps(value)


def edited(word: str, folder: Path) -> str:
    """Write the experiment file that a word with `+` asks for, and return its name."""
    name, *changes = word.split("+")
    if not changes or not (folder / f"{name}.toml").exists():
        return word

    experiment = tomllib.loads((folder / f"{name}.toml").read_text())
    for change in changes:
        keys, _, text = change.partition("=")
        *tables, last = keys.split(".")
        table = experiment
        for key in tables:
            table = table.setdefault(key, {})
        try:
            table[last] = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            table[last] = text.replace("~", " ")

    new = f"{name}_{len(list(folder.glob('*.toml')))}.toml"
    lines = (f"{json.dumps(k)} = {written_toml(v)}\n" for k, v in experiment.items())
    (folder / new).write_text("".join(lines))
    return new


def numbers(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Numbers, truths and states in a JSON value, with their paths."""
    key = path.rpartition("/")[2]
    if isinstance(value, dict):
        for name, inner in value.items():
            if name not in TIMES:
                yield from numbers(inner, f"{path}/{name}")
    elif isinstance(value, list):
        if np.size(np.array(value, dtype=object)) <= MOST:
            for index, inner in enumerate(value):
                name = inner.get("name", index) if isinstance(inner, dict) else index
                yield from numbers(inner, f"{path}/{name}")
    elif isinstance(value, bool | int | float) or (key in STATES and isinstance(value, str)):
        yield path, value


def processor_seconds(pid: int) -> float:
    """Processor time of a running process and its children, from Linux; infinite at its end."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except FileNotFoundError:
        return 0.0
    if fields[0] == "Z" and not children:
        return float("inf")
    own = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return own + sum(t for t in map(processor_seconds, map(int, children)) if t < float("inf"))


def run_line(words: list[str], folder: Path, tree: Path) -> dict[str, Any]:
    """Run one command line in a folder, and measure it."""
    order, _, limit = words[0].partition("=") if words[0].startswith("@") else ("", "", "")
    words = [edited(word, folder) for word in (words[1:] if order else words)]
    with (folder / "stdout").open("w") as out, (folder / "stderr").open("w") as error:
        process = subprocess.Popen(
            [sys.executable, "-m", "mjfim", *words],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(tree), "MPLBACKEND": "Agg", "COLUMNS": "120"},
            stdout=out,
            stderr=error,
        )
        if order:
            while processor_seconds(process.pid) < float(limit):
                time.sleep(0.05)
            process.send_signal(signal.SIGINT if order == "@stop" else signal.SIGKILL)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)

    printed = (folder / "stdout").read_text()
    message = (folder / "stderr").read_text().strip().splitlines()
    return {
        "code": process.returncode,
        "error": " ".join(message)[-200:] if process.returncode else "",
        "numbers": dict(numbers(json.loads(printed))) if printed[:1] in ("{", "[") else {},
        "cpu": used.ru_utime + used.ru_stime,
        "memory": used.ru_maxrss / 2**10,
    }


def run_case(text: str, tree: Path, models: Path, shared: Path) -> dict[str, Any]:
    """Run the command lines of a case in a new folder, and return what a user gets."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(models, folder, dirs_exist_ok=True)
        (folder / "shared").symlink_to(shared)

        lines = [run_line(shlex.split(line), folder, tree) for line in text.split(" ; ")]
        found = {key: value for line in lines for key, value in line["numbers"].items()}
        for path in sorted(folder.glob("*/[!.]*.json")):
            try:
                found |= dict(numbers(json.loads(path.read_text()), path.parent.name))
            except json.JSONDecodeError as error:
                found[f"{path.name} {error}"] = False
        return {
            "codes": [line["code"] for line in lines],
            "error": " ".join(line["error"] for line in lines).strip(),
            "files": sorted(path.name for path in folder.glob("o/[!.]*")),
            "numbers": found,
            "cpu": sum(line["cpu"] for line in lines),
            "memory": max(line["memory"] for line in lines),
        }


def differences(old: dict[str, Any], new: dict[str, Any], tolerance: float) -> list[str]:
    """What differs between two results of a case, in lines."""
    lines = [
        f"{key}: {old[key]} → {new[key]}" for key in ("codes", "error") if old[key] != new[key]
    ]
    for sign, one, other in (("−", old, new), ("+", new, old)):
        gone = sorted(set(one["files"]) - set(other["files"]))
        keys = sorted({key for key in one["numbers"] if key not in other["numbers"]})
        lines += [f"files {sign} {' '.join(gone)}"] * bool(gone)
        lines += [f"{len(keys)} values {sign} {' '.join(keys[:4])}"] * bool(keys)

    changed: list[tuple[float, str]] = []
    for key in old["numbers"].keys() & new["numbers"].keys():
        a, b = old["numbers"][key], new["numbers"][key]
        if a == b or (isinstance(a, float) and a != a and b != b):
            continue
        is_number = not isinstance(a, str | bool) and not isinstance(b, str | bool)
        ratio = abs(a - b) / max(abs(a), abs(b), 1e-9) if is_number else np.inf
        if not ratio <= tolerance:
            changed.append((float(ratio), f"{key} {a} → {b}"))
    changed.sort(reverse=True)
    if changed:
        lines.append(f"{len(changed)} of {len(old['numbers'])} values changed, the most:")
        lines += [f"   {text}" for _, text in changed[:5]]
    return lines


def main() -> int:
    """Run the cases, or compare two files of results; the exit code is 1 if any case differs."""
    parser = options_of(__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    run = verbs.add_parser("run")
    run.add_argument("out", type=Path)
    run.add_argument("--tree", type=Path, default=ROOT, help="folder that holds the package")
    run.add_argument("--models", type=Path, default=ROOT / "models")
    run.add_argument("--shared", type=Path, default=ROOT.parent / "shared")
    run.add_argument("--only", default="", help="cases whose names hold this text")
    compare = verbs.add_parser("compare")
    compare.add_argument("old", type=Path)
    compare.add_argument("new", type=Path)
    compare.add_argument("--tolerance", type=float, default=1e-6, help="relative difference")
    args = parser.parse_args()

    if args.verb == "run":
        results = json.loads(args.out.read_text()) if args.out.exists() else {}
        for name in (name for name in CASES if args.only in name):
            places = (args.tree.resolve(), args.models.resolve(), args.shared.resolve())
            results[name] = run_case(CASES[name], *places)
            print(f"{name:20s} {results[name]['codes']} {results[name]['cpu']:.1f} s", flush=True)
            args.out.write_text(json.dumps(results, indent=1))
        return 0

    old, new = (json.loads(path.read_text()) for path in (args.old, args.new))
    differing = 0
    for name in [name for name in old if name in new]:
        found = differences(old[name], new[name], args.tolerance)
        differing += bool(found)
        cost = " → ".join(f"{r[name]['cpu']:.1f} s {r[name]['memory']:.0f} MiB" for r in (old, new))
        print(f"{name:20s} {cost}  {'' if found else 'equal'}")
        print("".join(f"    {line}\n" for line in found), end="")
    print(f"{differing} of {len(old.keys() & new.keys())} cases differ")
    return int(differing > 0)
