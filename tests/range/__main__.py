"""Run the matrix by hand: `python -m tests.range --plant arm --mass 1e-6 1 1e6`."""

from __future__ import annotations

import argparse
from itertools import product

from tests.range.cells import VERBS, Cell, run
from tests.range.plants import INTEGRATORS, PLANTS, Setting


def main() -> None:
    """Run all combinations of the options, and print how each verb ended."""
    parser = argparse.ArgumentParser(prog="python -m tests.range", description=main.__doc__)
    parser.add_argument("--plant", nargs="+", choices=list(PLANTS), default=list(PLANTS))
    parser.add_argument("--verb", nargs="+", choices=list(VERBS), default=list(VERBS))
    parser.add_argument("--integrator", nargs="+", choices=INTEGRATORS, default=["RK4"])
    for name, default in (("timestep", 0.005), ("mass", 1.0), ("ratio", 1.0), ("horizon", 2.0)):
        parser.add_argument(f"--{name}", nargs="+", type=float, default=[default])
    parser.add_argument("--rate", nargs="+", type=float, default=[None])
    options = vars(parser.parse_args())

    plants, verbs = options.pop("plant"), tuple(options.pop("verb"))
    counts = {"works": 0, "said": 0, "WRONG": 0}
    for plant, *values in product(plants, *options.values()):
        setting = Setting(**dict(zip(options, values, strict=True)))
        cell = run(Cell(plant=plant, setting=setting, verbs=verbs))
        print(cell, flush=True)
        for verdict in cell.verdicts:
            counts[verdict.word] += 1
            detail = f"({verdict.seconds:.1f} s) {verdict.detail}"
            print(f"    {verdict.verb} {verdict.word} {detail}", flush=True)
    print(", ".join(f"{count} {word}" for word, count in counts.items()))


if __name__ == "__main__":
    main()
