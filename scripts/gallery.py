"""Make the page of the gallery: what mjfim prints and draws for several robots.

    python -m scripts.gallery            # writes docs/gallery.md and its pictures
    python -m scripts.gallery --check    # compares the numbers of the page with those of today

The command line is called as a user calls it. Recordings are simulated with a robot whose
parameters differ from the model, or are logs of a real SO-101. A design ends after a stated number
of iterations or where it has converged, so that its numbers do not depend on the speed of the
computer.

The folder `shared` beside the repository holds `models/so101` and the logs `data/sage_so101`.
"""

from __future__ import annotations

import csv
import gzip
import json
import os
import re
import shlex
import shutil
import sys
import tempfile
import textwrap
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from PIL import Image

from mjfim.output.plots.pictures import kind_of_picture
from scripts.benchmarks import child
from scripts.benchmarks.child import ROOT, SHARED, options_of
from scripts.benchmarks.so101 import JOINTS, read_motion
from scripts.verbs import call_verb

PAGE = ROOT / "docs" / "gallery.md"

# Columns of the terminal, and longest time of one verb [s].
COLUMNS, PATIENCE = 80, 3600.0

# Largest width of a picture on the page [pixels], and its number of colours.
PAGE_WIDTH, PAGE_COLOURS = 1000, 64

# Relative difference of the simulated robots from their models.
ROBOT_DIFFERENCE = 0.1

# Number of rows of a log of the SO-101 that are fitted, 50 a second.
LOG_ROWS = 500

# What the pictures of the page show, by their names, in the order of the page.
CAPTIONS = {
    "check": "σ of each parameter, and correlations",
    "accuracy_over_time": "σ over the time of the experiment",
    "accuracy": "Predicted, achieved and wanted σ",
    "trajectories": "Motion and controls",
    "limits": "Use of the limits",
    "rehearsal": "Robots that differ from the model",
    "worth": "Value of each sensor, price of each limit",
    "valley": "Two robots that look alike",
    "parameters": "Estimates with 95 % intervals",
    "fit": "Measured, identified and nominal motion",
    "held_out": "Prediction of a held-out recording",
    "predictions": "Errors of predictions",
    "deciding_seconds": "Seconds that decide each parameter",
    "residual_torque": "Unexplained torque",
    "pairs": "Uncertainty of pairs",
    "overview": "Scatter of estimates, and Cramér–Rao bound",
    "histogram": "Estimates of one parameter",
    "compare": "Methods in equal time",
    "campaign": "σ over the rounds",
}

# Numbers of a text, and their exponents in small digits.
NUMBERS = re.compile(r"\d[\d.]*(?:e[-+]?\d+)?|[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+")

# Largest difference of a number of the page that is no difference of versions, relative, and in
# units of its last digit: kernels of linear algebra round differently.
TOLERANCE, LAST_DIGIT = 0.01, 1.001


@dataclass(frozen=True, kw_only=True)
class Robot:
    """A robot of the gallery.

    Attributes:
        title: Title on the page.
        text: What is shown.
        source: Experiment file, or the model for which `mjfim init` writes one.
        steps: Calls of the command line: the verb and its arguments. `{experiment}`, the experiment
            with the `{robot}`'s values, and the folder `{out}` are filled in.
        quick: Number of the first calls that take so little time that `--check` makes them again.
        iterations: Number of iterations of a design for an experiment of `init`; 0 for none.
        log: Folder of a measured log, which the calls find as `{out}/log.csv`; empty for none.
    """

    title: str
    text: str
    source: str
    steps: tuple[str, ...]
    quick: int = 1
    iterations: int = 0
    log: str = ""

    @property
    def name(self) -> str:
        """Short name, for folders."""
        return self.title.lower().replace(" ", "-")


@dataclass(kw_only=True)
class Shown:
    """Output of one call of the command line.

    Attributes:
        command: The command, with short paths.
        code: Exit code.
        terminal: What was printed on stdout; the messages on stderr where that is nothing.
        pictures: Pictures by name.
    """

    command: str
    code: int
    terminal: str
    pictures: dict[str, Path] = field(default_factory=dict)

    @property
    def verb(self) -> str:
        """The verb of the call."""
        return self.command.split()[1]


STEPS = (
    "check {experiment} -o {out}/check",
    "design {experiment} -o {out}/design",
    "simulate {robot} {out}/design -o {out}/log.csv",
    "identify {experiment} {out}/log.csv --predicted {out}/design -o {out}/identify",
)

ROBOTS = (
    Robot(
        title="Cart-pendulum",
        text="The study of the paper, without limits.",
        source="models/cart_pendulum.toml",
        steps=(
            *STEPS,
            "montecarlo {experiment} {out}/design -o {out}/montecarlo",
            "compare {experiment} --seconds 5 -o {out}/compare",
            "campaign {experiment} --wanted 0.005 --rounds 3 -o {out}/campaign",
        ),
        quick=len(STEPS),
    ),
    Robot(
        title="Servo arm",
        text="Four joints with position servos. The simulated robot is 10 % off the model.",
        source="models/servo_arm.toml",
        steps=STEPS,
    ),
    Robot(
        title="SO-101",
        text="The experiment of `mjfim init`, 10 iterations. The robot is 10 % off the model.",
        source="shared/models/so101/so101_nomesh.xml",
        iterations=10,
        steps=STEPS,
    ),
    Robot(
        title="Measured SO-101",
        text="A chirp of a real SO-101, and the published model.",
        source="shared/models/so101/so101_nomesh.xml",
        log="shared/data/sage_so101/chirp_sweep",
        steps=("identify {experiment} {out}/log.csv -o {out}/identify",),
        quick=0,
    ),
)


# ---- calls


def show_robot(robot: Robot, root: Path, *, is_quick: bool = False) -> Iterator[Shown]:
    """Make the calls for one robot, in turn.

    Args:
        robot: The robot.
        root: Folder in which the calls are made.
        is_quick: Whether only quick calls are made.

    Yields:
        What each call left behind.
    """
    steps = robot.steps[: robot.quick if is_quick else None]
    if not steps:
        return
    (root / robot.name).mkdir()
    experiment = robot.source
    if experiment.endswith(".xml"):
        experiment = f"{robot.name}/experiment.toml"
        yield _call(["init", robot.source, "-o", experiment], root)
        if robot.iterations:
            # A design ends after this number, whatever time it takes.
            stated = tomlkit.parse((root / experiment).read_text(encoding="utf-8"))
            descent: dict[str, Any] = stated.setdefault("descent", {})
            descent.update(max_iterations=robot.iterations, seconds=PATIENCE)
            (root / experiment).write_text(tomlkit.dumps(stated), encoding="utf-8")
    if robot.log:
        write_log(root / robot.log, root / robot.name / "log.csv")
    for step in steps:
        values = {"experiment": experiment, "out": robot.name}
        if "{robot}" in step:
            values["robot"] = simulated_robot(root, experiment, robot.name)
        yield _call([word.format(**values) for word in step.split()], root)


def simulated_robot(root: Path, experiment: str, out: str) -> str:
    """Write an experiment whose robot differs from its model.

    Parameters without a prior or a stated true value differ by a share of their size, up and down
    in turn.

    Args:
        root: Folder in which the calls are made.
        experiment: Experiment file.
        out: Folder of the robot, with the result of a check.

    Returns:
        The file; `experiment` itself where all parameters have a stated value.
    """
    check = json.loads((root / out / "check" / "check.json").read_text(encoding="utf-8"))
    rows = {row["name"]: row for row in check["parameters"]}
    stated = tomlkit.parse((root / experiment).read_text(encoding="utf-8"))
    tables: dict[str, Any] = stated["parameters"]
    open_ones = [name for name, table in tables.items() if not {"true", "prior"} & set(table)]
    if not open_ones:
        return experiment

    for i, name in enumerate(open_ones):
        change = ROBOT_DIFFERENCE * (-1) ** i
        tables[name]["true"] = float(f"{rows[name]['value'] + change * rows[name]['size']:.4g}")
    stated["model"] = os.path.relpath((root / experiment).parent / str(stated["model"]), root / out)
    robot = f"{out}/robot.toml"
    (root / robot).write_text(tomlkit.dumps(stated), encoding="utf-8")
    return robot


def write_log(source: Path, target: Path) -> None:
    """Write the beginning of a log of the SO-101 as CSV: commands and measured angles [rad].

    Args:
        source: Folder of the log, with a JSON array of all joints in each row.
        target: The CSV file.
    """
    with gzip.open(source / "state_motor.csv.gz", "rt", encoding="utf-8") as opened:
        stamps = np.array([float(row["timestamp"]) for row in csv.DictReader(opened)])
    seconds, motion = 1e-6 * (stamps - stamps[0]), read_motion(source)
    names = ["t", *(f"{kind}:{joint}" for kind in ("ctrl", "qpos") for joint in JOINTS)]
    child.write_log(target, names, seconds[:LOG_ROWS], motion[:LOG_ROWS])


def _call(words: Sequence[str], root: Path) -> Shown:
    """Call a verb as a user does, and collect what it printed and drew."""
    variables = {"PYTHONPATH": str(ROOT), "COLUMNS": str(COLUMNS)}
    begun = time.perf_counter()
    ended = call_verb(words, variables=variables, patience=PATIENCE, folder=root)
    command = shlex.join(["mjfim", *words])
    seconds = time.perf_counter() - begun
    print(f"{command}: exit code {ended.returncode}, {seconds:.0f} s", file=sys.stderr)
    return Shown(
        command=command,
        code=ended.returncode,
        terminal=ended.stdout.rstrip() or (ended.stderr.rstrip() if ended.returncode else ""),
        pictures={file.stem: file for file in sorted((root / words[-1]).glob("*.png"))},
    )


# ---- page


HEAD = """---
hide:
  - navigation
---

# Gallery

All pictures of several robots. Open "Terminal" for the command and its text. Every result also has
an interactive `report.html`. `python -m scripts.gallery` makes this page.

Colours: blue initial, red designed, orange nominal, teal measured, purple identified.

"""

FOLD = '<details markdown="1"><summary>Terminal</summary>'


def write_page(page: Path, shown: Sequence[tuple[Robot, Sequence[Shown]]]) -> None:
    """Write the page, and small copies of its pictures beside it.

    Args:
        page: The page, in Markdown.
        shown: The robots with their calls.
    """
    images = page.parent / "images" / "gallery"
    if images.exists():
        shutil.rmtree(images)
    images.mkdir(parents=True)

    parts = [HEAD]
    for robot, calls in shown:
        parts += [f"## {robot.title}", "", robot.text, ""]
        parts += [_section(robot, call, images) for call in calls]
    page.write_text("\n".join(parts), encoding="utf-8")


def command_of(call: Shown) -> str:
    """Return the command of a call as a terminal of the usual width shows it."""
    # A command continues on the next line behind a backslash.
    lines = textwrap.wrap(
        f"$ {call.command}",
        COLUMNS - 2,
        subsequent_indent="    ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    return " \\\n".join(lines)


def _section(robot: Robot, call: Shown, images: Path) -> str:
    """Describe one call: the command, what the terminal printed, and the pictures."""
    lines = [f"### {robot.title}: {call.verb}", "", FOLD, "", "```text", command_of(call)]
    for line in call.terminal.splitlines():
        indent = " " * (len(line) - len(line.lstrip()))
        lines += textwrap.wrap(line, COLUMNS, subsequent_indent=indent) or [""]
    lines += ["```", "", *(["Exit code 1."] if call.code else []), "</details>", ""]

    # Of several pictures of a kind, such as one for each recording, the first one is shown.
    for kind, caption in CAPTIONS.items():
        found = [file for name, file in call.pictures.items() if kind_of_picture(name) == kind]
        if not found:
            continue
        target = images / f"{robot.name}-{call.verb}-{kind}.png"
        with Image.open(found[0]) as opened:
            image = opened.convert("RGB")
        image.thumbnail((PAGE_WIDTH, image.height))
        image.quantize(PAGE_COLOURS).save(target, optimize=True)
        lines += [
            '<figure markdown="span">',
            f'![{caption}](images/gallery/{target.name}){{ width="{image.width}" loading="lazy" }}',
            f"<figcaption>{caption}</figcaption>",
            "</figure>",
            "",
        ]
    return "\n".join(lines)


def differences(page: str, call: Shown) -> list[str]:
    """Say which numbers of a page differ from those that a call prints.

    Args:
        page: Text of the page.
        call: The call.
    """
    _, found, rest = page.partition(f"```text\n{command_of(call)}\n")
    if not found:
        return [f"{call.command}: is not on the page"]
    shown, printed = (NUMBERS.findall(text) for text in (rest.partition("```")[0], call.terminal))
    if len(shown) != len(printed):
        return [f"{call.command}: {len(shown)} numbers on the page, {len(printed)} are printed"]
    pairs = zip(shown, printed, strict=True)
    return [f"{call.command}: {old} is now {new}" for old, new in pairs if not _is_same(old, new)]


def _is_same(old: str, new: str) -> bool:
    """Return whether two printed numbers differ by no more than kernels of linear algebra do."""
    if old == new or not old[0].isascii() or not new[0].isascii():
        return old == new
    mantissa, _, power = old.partition("e")
    digit = 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))
    return abs(float(new) - float(old)) <= TOLERANCE * abs(float(old)) + LAST_DIGIT * digit


def main() -> int:
    """Make the gallery, or compare its numbers; exit code 1 if a call fails or they differ."""
    parser = options_of(__doc__)
    parser.add_argument("--check", action="store_true", help="compare the numbers of the page")
    options = parser.parse_args()

    page = PAGE.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as name:
        root, shown = Path(name), []
        (root / "models").symlink_to(ROOT / "models")
        (root / "shared").symlink_to(SHARED)
        for robot in ROBOTS:
            missing = [path for path in (robot.source, robot.log) if not (root / path).exists()]
            if missing and not options.check:
                parser.error(f"there is no {missing[0]} beside the repository")
            if not missing:
                shown.append((robot, list(show_robot(robot, root, is_quick=options.check))))
        calls = [call for _, calls in shown for call in calls]
        faults = [
            f"{call.command}: exit code {call.code}" for call in calls if call.code not in (0, 1)
        ]
        if options.check:
            faults += [sentence for call in calls for sentence in differences(page, call)]
        elif not faults:
            write_page(PAGE, shown)
    for fault in faults:
        print(fault, file=sys.stderr)
    if faults and options.check:
        print(f"{PAGE} is stale: make it again with `python -m scripts.gallery`", file=sys.stderr)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
