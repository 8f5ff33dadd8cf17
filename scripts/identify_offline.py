"""Identify parameters from a recording by the Python interface: a template to copy and change.

    python scripts/identify_offline.py models/cart_pendulum.toml recording.csv

A recording in the format of mjfim has a column `t`, one column `ctrl:<actuator>` for each actuator,
and the measured columns (`qpos:<joint>`, `qvel:<joint>` or the name of a sensor). The table
`[recording]` of the experiment maps the columns of any other log. `mjfim simulate` writes a
recording to try it.

The identified model is written beside the recording. A file identified.xml that is there and that
mjfim did not write is replaced with --force only, and inputs never.
"""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path

import mjfim
from mjfim.errors import InterruptedByUserError, MjfimError, NoResultError
from mjfim.parallel.budget import INTERRUPTED_CODE, NOTHING_SENTENCE, SIGNALS, Interruption


def main() -> int:
    """Fit, print the estimates, and write the identified model beside the recording."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("experiment", type=Path)
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument("--force", action="store_true", help="replace your own identified.xml")
    args = parser.parse_args()

    def announce(sentence: str) -> None:
        """Show what Ctrl-C does."""
        print(f"{parser.prog}: {sentence}", file=sys.stderr)

    # Ctrl-C ends the fit with its best result so far, which is written.
    try:
        with Interruption(announce) as interruption:
            code = identify(args.experiment, args.recordings, force=args.force)
        return INTERRUPTED_CODE if interruption.presses else code
    except (InterruptedByUserError, NoResultError):
        announce(NOTHING_SENTENCE)
        return INTERRUPTED_CODE
    except MjfimError as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 2


def identify(experiment: Path, files: list[Path], *, force: bool) -> int:
    """Identify from recordings, and return the exit code."""
    # These imports take a second, in which Ctrl-C is handled already.
    from mjfim.experiment.packing import input_files
    from mjfim.experiment.system import System
    from mjfim.identification.identify import identify_system
    from mjfim.output.export.mjcf import write_identified
    from mjfim.output.manifest import OutputGuard, claimed
    from mjfim.recordings.read import read_recording

    # The experiment file says what is unknown, where to start, and how noisy each output is.
    system = System.resolve(mjfim.Experiment.from_file(experiment))
    recordings = [read_recording(path, system.channels) for path in files]

    # Refuse before the work to replace an input, or a file that mjfim did not write.
    target = files[0].with_name("identified.xml")
    guard = OutputGuard(input_files(system.experiment, files), force=force)
    guard.check([target])

    # Weighted least squares in MuJoCo over all recordings at once.
    estimate = identify_system(system, recordings)

    # The 95 % intervals also hold for residuals that are not white noise.
    rows = zip(estimate.parameters, estimate.theta, estimate.interval, system.units, strict=True)
    for name, value, (low, high), unit in rows:
        print(f"{name:>12s} = {value:.5g} ({low:.5g} ... {high:.5g}) {unit}")
    print(f"chi2 / dof = {estimate.chi2 / estimate.dof:.3f}; {estimate.status}")
    for warning in estimate.warnings:
        print(f"warning: {warning}")

    # Write the model with the estimated values.
    with claimed(target.parent, guard, exclusive=False):
        remarks = write_identified(target, system, estimate.theta, estimate)
    print("; ".join([f"wrote {target}", *remarks]))
    return 0 if estimate.verdict.ok else 1


if __name__ == "__main__":
    exit_code = main()

    # The result is written; signals while Python ends change nothing.
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    raise SystemExit(exit_code)
