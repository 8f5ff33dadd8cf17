"""How long the command line takes to start, and the first command of the README as a whole.

    python -m scripts.benchmarks start_up                     # this checkout, about a minute
    python -m scripts.benchmarks start_up --before COMMIT     # an earlier commit beside it

Each command runs several times in processes of its own; the runs of both versions alternate, and
the medians of the wall time and of the processor time are printed. The files of modules are
compiled before, as by an installation.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from mjfim.cli.main import ORDER
from scripts.benchmarks.checkouts import ROOT, CommandRun, earlier_checkout, run_command

# Goals of the wall time on two idle cores [s].
START_GOAL, FIRST_COMMAND_GOAL = 0.4, 2.5

# An experiment with a mistyped key, and the experiment of the README.
MISTYPED = 'model = "cart_pendulum.xml"\nhorizn = 4.0\n'
STUDY = "models/cart_pendulum.toml"


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command line that is timed.

    Attributes:
        name: What it is, in the table.
        words: Its words.
        code: Exit code with which it ends.
        goal: Wall time that it may take [s].
    """

    name: str
    words: tuple[str, ...]
    code: int
    goal: float = START_GOAL


def commands(folder: Path) -> list[Command]:
    """List the commands.

    Args:
        folder: Folder for what they read and write.
    """
    mistyped = folder / "mistyped.toml"
    mistyped.write_text(MISTYPED)
    return [
        Command(name="--help", words=("--help",), code=0),
        *(Command(name=f"{verb} --help", words=(verb, "--help"), code=0) for verb in ORDER),
        Command(name="check, a missing file", words=("check", "gone.toml"), code=2),
        Command(name="check, a mistyped key", words=("check", str(mistyped)), code=2),
        Command(
            name="first command of the README",
            words=("design", STUDY, "-o", str(folder / "out"), "--force"),
            code=0,
            goal=FIRST_COMMAND_GOAL,
        ),
    ]


def timed(checkout: Path, command: Command) -> CommandRun:
    """Run a command once.

    Args:
        checkout: Top folder of the version that runs.
        command: The command.

    Raises:
        RuntimeError: It ended with another exit code.
    """
    run = run_command(checkout, command.words)
    if run.code != command.code:
        raise RuntimeError(f"{command.name}: exit code {run.code}\n{run.messages}")
    return run


def measured(
    checkouts: Sequence[Path], command: Command, repeats: int
) -> list[tuple[float, float]]:
    """Time a command in several versions, in turn.

    Args:
        checkouts: Top folders of the versions.
        command: The command.
        repeats: Number of runs of each that count.

    Returns:
        Medians of the wall time and of the processor time of each version [s].
    """
    # The first run of each compiles modules.
    for checkout in checkouts:
        timed(checkout, command)

    runs: list[list[CommandRun]] = [[] for _ in checkouts]
    for _ in range(repeats):
        for found, checkout in zip(runs, checkouts, strict=True):
            found.append(timed(checkout, command))
    return [
        (
            statistics.median(run.wall for run in found),
            statistics.median(run.processor for run in found),
        )
        for found in runs
    ]


def main() -> int:
    """Print the times of all commands; return 1 where one takes longer than its goal."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--before", metavar="COMMIT", help="earlier commit to compare with")
    parser.add_argument("--repeats", type=int, default=5, help="runs of each command")
    options = parser.parse_args()

    names = [*([options.before] if options.before else []), "this checkout"]
    table = Table(title=f"Medians of {options.repeats} runs: wall time, processor time [s]")
    for heading in ("command", *names, "goal (wall)"):
        table.add_column(heading, justify="left" if heading == "command" else "right")

    is_reached = True
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        checkouts = [ROOT]
        if options.before:
            checkouts.insert(0, stack.enter_context(earlier_checkout(options.before)))
        for command in commands(folder):
            medians = measured(checkouts, command, options.repeats)
            cells = [f"{wall:.2f}, {processor:.2f}" for wall, processor in medians]
            table.add_row(command.name, *cells, f"{command.goal:g}")
            is_reached = is_reached and medians[-1][0] <= command.goal
    Console(width=100).print(table)
    return 0 if is_reached else 1


if __name__ == "__main__":
    raise SystemExit(main())
