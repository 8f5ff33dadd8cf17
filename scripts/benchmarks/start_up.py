"""How long the command line takes to start, and the first command of the README as a whole.

    python -m scripts.benchmarks start_up       # about a minute

Each command runs several times in processes of its own; the medians of the wall time and of the
processor time are printed. The files of modules are compiled before, as by an installation.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from mjfim.cli.main import ORDER
from scripts.benchmarks.child import run_command

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


def measured(command: Command, repeats: int) -> tuple[float, float]:
    """Medians of the wall time and of the processor time of several runs of a command [s].

    Raises:
        RuntimeError: It ended with another exit code.
    """
    # The first run compiles modules.
    runs = [run_command(command.words) for _ in range(repeats + 1)][1:]
    for run in runs:
        if run.code != command.code:
            raise RuntimeError(f"{command.name}: exit code {run.code}\n{run.messages}")
    return (
        statistics.median(run.wall for run in runs),
        statistics.median(run.processor for run in runs),
    )


def main() -> int:
    """Print the times of all commands; return 1 where one takes longer than its goal."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--repeats", type=int, default=5, help="runs of each command")
    options = parser.parse_args()

    table = Table(title=f"Medians of {options.repeats} runs [s]")
    for heading in ("command", "wall time", "processor time", "goal (wall)"):
        table.add_column(heading, justify="left" if heading == "command" else "right")

    is_reached = True
    with tempfile.TemporaryDirectory() as name:
        for command in commands(Path(name)):
            wall, processor = measured(command, options.repeats)
            table.add_row(command.name, f"{wall:.2f}", f"{processor:.2f}", f"{command.goal:g}")
            is_reached = is_reached and wall <= command.goal
    Console(width=100).print(table)
    return 0 if is_reached else 1


if __name__ == "__main__":
    raise SystemExit(main())
