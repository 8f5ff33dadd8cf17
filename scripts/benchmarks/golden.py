"""Golden results: what a user gets from command lines, to compare two versions of the package.

    python -m scripts.benchmarks golden run OUT.json                # about 20 minutes
    python -m scripts.benchmarks golden run OUT.json --tree PATH    # of the mjfim in PATH
    python -m scripts.benchmarks golden compare A.json B.json

`run` stores for each case of `golden_cases` the exit codes, the error, the names of the files, the
numbers and states of all JSON files (J, θ, σ, intervals, margins, verdicts, engine steps), and the
seconds of the processors. `compare` prints the cases that differ.
"""

from __future__ import annotations

import json
import shlex
import shutil
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage
from typing import Any

import numpy as np
import tomlkit

from scripts.benchmarks.child import ROOT, SHARED, options_of
from scripts.benchmarks.golden_cases import CASES
from scripts.verbs import call_verb

# Times differ between runs; states are the only texts that are compared.
TIMES = frozenset({"seconds", "times", "wall", "elapsed", "created"})
STATES = frozenset({"status", "level", "state", "found_by", "method", "schema_version"})

# More numbers in one list are a trajectory.
MOST = 24


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
    (folder / new).write_text(tomlkit.dumps(experiment))
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


def run_case(text: str, tree: Path) -> dict[str, Any]:
    """Run the command lines of a case in a new folder, and return what a user gets."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copytree(ROOT / "models", folder, dirs_exist_ok=True)
        (folder / "shared").symlink_to(SHARED)

        codes, errors, found = [], [], dict[str, Any]()
        begun = sum(getrusage(RUSAGE_CHILDREN)[:2])
        for line in text.split(" ; "):
            words = [edited(word, folder) for word in shlex.split(line)]
            variables = {"PYTHONPATH": str(tree), "MPLBACKEND": "Agg", "COLUMNS": "120"}
            ended = call_verb(words, variables=variables, patience=3600.0, folder=folder)
            codes.append(ended.returncode)
            if ended.returncode:
                errors.append(" ".join(ended.stderr.strip().splitlines())[-200:])
            if ended.stdout[:1] in ("{", "["):
                found |= dict(numbers(json.loads(ended.stdout)))
        used = sum(getrusage(RUSAGE_CHILDREN)[:2]) - begun
        for path in sorted(folder.glob("*/[!.]*.json")):
            try:
                found |= dict(numbers(json.loads(path.read_text()), path.parent.name))
            except json.JSONDecodeError as error:
                found[f"{path.name} {error}"] = False
        found |= {"codes": str(codes), "error": " ".join(errors)}
        found |= {f"file {path.name}": True for path in folder.glob("o/[!.]*")}
        return {"found": found, "cpu": used}


def differences(old: dict[str, Any], new: dict[str, Any], tolerance: float) -> list[str]:
    """What differs between two results of a case, in lines."""
    lines = []
    for sign, keys in (("−", old.keys() - new.keys()), ("+", new.keys() - old.keys())):
        lines += [f"{len(keys)} values {sign} {' '.join(sorted(keys)[:4])}"] * bool(keys)

    changed: list[tuple[float, str]] = []
    for key in old.keys() & new.keys():
        a, b = old[key], new[key]
        if a == b or (a != a and b != b):
            continue
        is_text = isinstance(a, str | bool) or isinstance(b, str | bool)
        ratio = np.inf if is_text else abs(a - b) / max(abs(a), abs(b), 1e-9)
        if not ratio <= tolerance:
            changed.append((float(ratio), f"   {key} {a} → {b}"))
    if changed:
        lines.append(f"{len(changed)} of {len(old)} values changed, the most:")
        lines += [text for _, text in sorted(changed, reverse=True)[:5]]
    return lines


def main() -> int:
    """Run the cases, or compare two files of results; the exit code is 1 if any case differs."""
    parser = options_of(__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    run = verbs.add_parser("run")
    run.add_argument("out", type=Path)
    run.add_argument("--tree", type=Path, default=ROOT, help="folder that holds the package")
    run.add_argument("--only", default="", help="cases whose names hold this text")
    compare = verbs.add_parser("compare")
    compare.add_argument("old", type=Path)
    compare.add_argument("new", type=Path)
    compare.add_argument("--tolerance", type=float, default=1e-6, help="relative difference")
    args = parser.parse_args()

    if args.verb == "run":
        results = json.loads(args.out.read_text()) if args.out.exists() else {}
        for name in (name for name in CASES if args.only in name):
            results[name] = case = run_case(CASES[name], args.tree.resolve())
            print(f"{name:20s} {case['found']['codes']} {case['cpu']:.1f} s", flush=True)
            args.out.write_text(json.dumps(results, indent=1))
        return 0

    old, new = (json.loads(path.read_text()) for path in (args.old, args.new))
    differing = 0
    for name in [name for name in old if name in new]:
        found = differences(old[name]["found"], new[name]["found"], args.tolerance)
        differing += bool(found)
        cost = " → ".join(f"{each[name]['cpu']:.1f} s" for each in (old, new))
        print(f"{name:20s} {cost}  {'' if found else 'equal'}")
        print("".join(f"    {line}\n" for line in found), end="")
    print(f"{differing} of {len(old.keys() & new.keys())} cases differ")
    return int(differing > 0)
