"""Run one benchmark by name, from the top folder of the repository.

python -m scripts.benchmarks                        # the names
python -m scripts.benchmarks benchmark --quick      # one benchmark with its options
"""

from __future__ import annotations

import importlib
import sys

# The benchmarks, each with the question that it answers.
BENCHMARKS = {
    "golden": "what does a user get from 70 command lines, and what has changed since?",
    "benchmark": "where does the time of a design go?",
    "anytime": "is the design better than its baselines at every budget?",
    "arms_table": "is the design of two arms better than Fourier series in equal time?",
    "mjx_oracle": "do the derivatives agree with those of MJX by automatic differentiation?",
    "starts": "how often do fits find the optimum from starts wrong by factors of 3 to 10?",
    "prove_identification": "do the 95 % intervals hold the true values?",
    "selection": "does `identify --select` find the term that a model lacks, and no other?",
    "arm_logs": "do closed-loop logs of arms give base parameters and torques within intervals?",
    "so101": "how well does a fit predict a real arm of six servos, beside published sets?",
    "go2": "how well does each half of a log of a real Go2 predict the other half?",
    "wrong_model": "is a design still good on robots that have what the model lacks?",
    "promise": "does the promised accuracy come true, and do two logs give one answer?",
    "measured_data": "how well are measured data of other groups predicted, with added terms?",
}


def main() -> int:
    """Run the benchmark that the first argument names; return its exit code."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in BENCHMARKS:
        print("usage: python -m scripts.benchmarks NAME [OPTIONS]\n", file=sys.stderr)
        for each, question in BENCHMARKS.items():
            print(f"  {each:20s} {question}", file=sys.stderr)
        return 2

    # The benchmark parses the remaining arguments itself.
    sys.argv = [f"python -m scripts.benchmarks {name}", *sys.argv[2:]]
    module = importlib.import_module(f"scripts.benchmarks.{name}")
    return int(module.main() or 0)


if __name__ == "__main__":
    raise SystemExit(main())
