"""Make every output of mjfim for several robots, and a page that shows them.

    python -m scripts.gallery --models FOLDER --data FOLDER -o out/gallery --page docs/gallery.md

The command line is called as a user calls it. Pictures, what the terminal printed, screenshots of
`report.html` at the width of a desktop and of a phone, in light and in dark colours, and
screenshots of the Rerun files are collected per robot. Robots whose files are missing, and
screenshots for which no browser or no viewer can start, are left out with a sentence on stderr.

Recordings of own models and of first experiments are simulated with a robot whose parameters
differ from the model, so that an identified model differs from the nominal one. What the calls
printed is kept: `--reuse` makes the page again from the files of an earlier run.

`--models` is a folder with `menagerie_panda` and `menagerie_so_arm100` of the MuJoCo Menagerie, and
`--data` one with the logs `dfki_double_pendulum`.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import shutil
import sys
import textwrap
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import tomlkit
from PIL import Image

from mjfim.output.page import TERMS
from scripts.rerun_screenshot import Shot, screenshot
from scripts.verbs import call_verb

ROOT = Path(__file__).resolve().parent.parent

# Columns of the terminal.
COLUMNS = 80

# Longest time of one verb [s].
PATIENCE = 900.0

# Largest width of a picture on the page [pixels], and its number of colours.
PAGE_WIDTH, PAGE_COLOURS = 1000, 64

# Height of what the page shows of a long picture, such as a whole report, over its width.
SHOWN_HEIGHT = 1.9

# Relative difference of the simulated robots from their models.
ROBOT_DIFFERENCE = 0.1

# File with what the calls for a robot printed.
CALLS = "calls.json"

# Names of browsers with the DevTools protocol, the usual one first.
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")

# Time after which all plots of a report must stand [ms].
PATIENCE = 120_000

# Widths of the windows in which reports are looked at [pixels].
WINDOW_WIDTHS = {"desktop": 1280, "phone": 390}

# Colour schemes in which reports are looked at.
SCHEMES: tuple[Literal["light", "dark"], ...] = ("light", "dark")

# Moment of the simulated motion that Rerun shows [s].
SHOWN_TIME = 1.5

# What the pictures of the page show, by the begin of their names, in the order of the page. Other
# pictures are for looking at.
CAPTIONS = {
    "check": "Predicted and wanted σ of every parameter, and the correlations of the estimates",
    "pairs": "Joint uncertainty of the estimates of pairs of parameters",
    "worth": "What each sensor tells, and what limits cost",
    "accuracy_over_time": "σ of every parameter by the measurements up to each time",
    "accuracy": "Predicted, achieved and wanted σ of every parameter, and published values",
    "trajectories": "Motion and controls",
    "limits": "How much of each limit the design uses",
    "parameters": "Estimates with their 95 % intervals, relative to the nominal values",
    "fit": "Measured outputs, the identified and the nominal model, and the residuals",
    "held_out": "A recording that was not fitted, and its predictions",
    "predictions": "Errors of the predictions of what was not fitted, over the noise",
    "deciding_seconds": "Which seconds of the recordings decide each parameter",
    "residual_torque": "Torque of each joint that the model does not explain",
    "overview": "Scatter of the estimates of many simulated recordings, and the Cramér–Rao bound",
    "histogram_": "Estimates of one parameter in many simulated recordings",
    "compare": "The design beside other excitations with the same time",
    "playback": "Limits, errors and coverage of robots that differ from the model",
    "campaign": "σ and estimate of every parameter over the rounds",
    "report-desktop-light": "The beginning of `report.html`",
    "report-phone-dark": "The beginning of `report.html` on a phone, in dark colours",
    "rerun-design": "`design.rrd` in the viewer",
    "rerun-estimate": "`estimate.rrd` in the viewer",
}

# Code in HTML, for text in Markdown.
CODE = r"<code>\1</code>"

# Pictures that the page shows of one call only.
ONCE = "report-phone-dark"


@dataclass(frozen=True, kw_only=True)
class Step:
    """One call of the command line.

    Attributes:
        verb: The verb.
        words: Its arguments; `{experiment}`, the experiment with the `{robot}`'s values, and the
            folder `{out}` are filled in.
        folder: Folder of the results below that of the robot; None if the verb writes one file.
    """

    verb: str
    words: tuple[str, ...]
    folder: str | None = None


@dataclass(frozen=True, kw_only=True)
class Robot:
    """A robot of the gallery.

    Attributes:
        name: Short name, for folders.
        title: Title on the page.
        text: One sentence on what is shown.
        steps: Calls of the command line.
        experiment: Experiment file; None if `mjfim init` writes one for `model`.
        model: Model file for `mjfim init`.
        needs: Files that have to exist.
    """

    name: str
    title: str
    text: str
    steps: tuple[Step, ...]
    experiment: Path | None = None
    model: Path | None = None
    needs: tuple[Path, ...] = ()


@dataclass(kw_only=True)
class Shown:
    """Output of one call of the command line.

    Attributes:
        command: The command, with short paths.
        code: Exit code.
        seconds: Duration [s].
        terminal: What was printed on stdout; the messages on stderr where that is nothing.
        pictures: Pictures by name.
    """

    command: str
    code: int
    seconds: float
    terminal: str
    pictures: dict[str, Path] = field(default_factory=dict)


def _design_steps(*further: Step) -> tuple[Step, ...]:
    """The calls from a check to an estimate from a simulated recording."""
    return (
        Step(verb="check", words=("{experiment}", "-o", "{out}/check"), folder="check"),
        Step(verb="design", words=("{experiment}", "-o", "{out}/design"), folder="design"),
        Step(verb="simulate", words=("{robot}", "{out}/design", "-o", "{out}/recording.csv")),
        Step(
            verb="identify",
            words=("{experiment}", "{out}/recording.csv", "-o", "{out}/identify"),
            folder="identify",
        ),
        *further,
    )


def robots(models: Path, data: Path) -> tuple[Robot, ...]:
    """Return the robots of the gallery.

    Args:
        models: Folder of models of others.
        data: Folder of recordings of others.
    """
    own = ROOT / "models"
    panda = models / "menagerie_panda" / "panda_nohand_nomesh.xml"
    so_arm = models / "menagerie_so_arm100" / "so_arm100_nomesh.xml"
    logs = [data / "dfki_double_pendulum" / f"A0_0{i}.csv.gz" for i in range(3)]

    montecarlo = Step(
        verb="montecarlo",
        words=("{experiment}", "{out}/design", "-o", "{out}/montecarlo"),
        folder="montecarlo",
    )
    compare = Step(
        verb="compare",
        words=("{experiment}", "-o", "{out}/compare", "--seconds", "5"),
        folder="compare",
    )
    rehearse = Step(
        verb="rehearse",
        words=("{out}/design", "-o", "{out}/rehearse", "--robots", "300"),
        folder="rehearse",
    )
    campaign = Step(
        verb="campaign",
        words=("{experiment}", "-o", "{out}/campaign", "--wanted", "0.005", "--rounds", "4"),
        folder="campaign",
    )

    return (
        Robot(
            name="cart-pendulum",
            title="Cart-pendulum",
            text="The study of the paper: mass, length and damping of a pendulum on a cart.",
            experiment=own / "cart_pendulum.toml",
            steps=_design_steps(montecarlo, compare, rehearse, campaign),
        ),
        Robot(
            name="servo-arm",
            title="Servo arm",
            text="Two joints with position servos, and limits of position, velocity and force.",
            experiment=own / "servo_arm.toml",
            steps=_design_steps(montecarlo, rehearse),
        ),
        Robot(
            name="quadrotor",
            title="Quadrotor",
            text="A free body with four rotors.",
            experiment=own / "quadrotor.toml",
            steps=_design_steps(),
        ),
        Robot(
            name="panda",
            title="Panda",
            text="A seven-joint arm, with the experiment that `mjfim init` writes.",
            model=panda,
            needs=(panda,),
            steps=_design_steps(),
        ),
        Robot(
            name="so-arm100",
            title="SO-ARM100",
            text="A table-top arm with servos, with the experiment that `mjfim init` writes.",
            model=so_arm,
            needs=(so_arm,),
            steps=_design_steps(),
        ),
        Robot(
            name="dfki-double-pendulum",
            title="DFKI double pendulum",
            text="Three measured logs of a real double pendulum; the third one is predicted.",
            experiment=own / "dfki_double_pendulum.toml",
            needs=tuple(logs),
            steps=(
                Step(
                    verb="check",
                    words=("{experiment}", str(logs[0]), str(logs[1]), "-o", "{out}/check"),
                    folder="check",
                ),
                Step(
                    verb="identify",
                    words=(
                        "{experiment}",
                        *(str(log) for log in logs[:2]),
                        "--held-out",
                        str(logs[2]),
                        "-o",
                        "{out}/identify",
                    ),
                    folder="identify",
                ),
            ),
        ),
    )


# ---- calls


def show_robot(robot: Robot, folder: Path) -> Iterator[Shown]:
    """Make all calls for one robot, in turn.

    Args:
        robot: The robot.
        folder: Fresh folder for its files.

    Yields:
        What each call left behind.
    """
    folder.mkdir(parents=True)
    experiment = robot.experiment
    if experiment is None:
        experiment = folder / f"{robot.name}.toml"
        init = Step(verb="init", words=(str(robot.model), "-o", str(experiment)))
        yield _call(init, {}, folder.parent)

    values = {"experiment": experiment, "robot": experiment, "out": folder}
    for step in robot.steps:
        if step.verb == "simulate":
            values["robot"] = simulated_robot(experiment, folder)
        shown = _call(step, values, folder.parent)
        if step.folder is not None:
            shown.pictures = _pictures(folder / step.folder)
        yield shown


def simulated_robot(experiment: Path, folder: Path) -> Path:
    """Write an experiment whose robot differs from its model.

    Parameters without a prior or a stated true value differ by a share of their size, up and down
    in turn.

    Args:
        experiment: Experiment file.
        folder: Folder of the robot, with the result of a check.

    Returns:
        The file; `experiment` itself where all parameters have a stated value.
    """
    check = json.loads((folder / "check" / "check.json").read_text(encoding="utf-8"))
    rows = {row["name"]: row for row in check["parameters"]}
    stated = tomlkit.parse(experiment.read_text(encoding="utf-8"))
    tables: dict[str, Any] = stated["parameters"]
    open_ones = [name for name, table in tables.items() if not {"true", "prior"} & set(table)]
    if not open_ones:
        return experiment

    for i, name in enumerate(open_ones):
        change = ROBOT_DIFFERENCE * (-1) ** i
        tables[name]["true"] = float(f"{rows[name]['value'] + change * rows[name]['size']:.4g}")
    model = experiment.parent / str(stated["model"])
    stated["model"] = os.path.relpath(model, folder)
    robot = folder / f"{experiment.stem}_robot.toml"
    robot.write_text(tomlkit.dumps(stated), encoding="utf-8")
    return robot


def _call(step: Step, values: Mapping[str, Path], root: Path) -> Shown:
    """Call a verb as a user does; paths below `root` are shown relative to it."""
    words = [word.format(**values) if "{" in word else word for word in step.words]
    variables = {"PYTHONPATH": str(ROOT), "COLUMNS": str(COLUMNS)}
    begun = time.perf_counter()
    ended = call_verb([step.verb, *words], variables=variables, patience=PATIENCE)
    seconds = time.perf_counter() - begun

    command = shlex.join(["mjfim", step.verb, *(_short(word) for word in words)])
    print(f"{command}: exit code {ended.returncode}, {seconds:.0f} s", file=sys.stderr)
    printed = ended.stdout.rstrip() or (ended.stderr.rstrip() if ended.returncode else "")
    return Shown(
        command=command,
        code=ended.returncode,
        seconds=seconds,
        terminal=_without_long_paths(printed, root),
    )


def _short(word: str) -> str:
    """Return the last two parts of a path; other words as they are."""
    path = Path(word)
    return "/".join(path.parts[-2:]) if path.is_absolute() else word


def _without_long_paths(text: str, root: Path) -> str:
    """Return what was printed, without the folder of the results and that of this checkout."""
    return text.replace(f"{root}/", "").replace(f"{ROOT}/", "")


def keep_calls(calls: Sequence[Shown], folder: Path) -> None:
    """Write what the calls for a robot left behind into its folder."""
    kept = [asdict(call) for call in calls]
    for call in kept:
        named = call["pictures"].items()
        call["pictures"] = {name: path.relative_to(folder).as_posix() for name, path in named}
    (folder / CALLS).write_text(json.dumps(kept, indent=2), encoding="utf-8")


def kept_calls(folder: Path) -> list[Shown]:
    """Read what the calls for a robot left behind in an earlier run."""
    calls = [Shown(**call) for call in json.loads((folder / CALLS).read_text(encoding="utf-8"))]
    for call in calls:
        call.pictures = {name: folder / path for name, path in call.pictures.items()}
    return calls


# ---- pictures


def _pictures(folder: Path) -> dict[str, Path]:
    """Collect the pictures of a folder of results, with screenshots of its report and viewer."""
    pictures = {picture.stem: picture for picture in sorted(folder.glob("*.png"))}

    report = folder / "report.html"
    if report.is_file():
        pictures |= report_screenshots(report, folder / "screenshots")
    for recording in sorted(folder.glob("*.rrd")):
        picture = folder / "screenshots" / f"rerun-{recording.stem}.png"
        picture.parent.mkdir(exist_ok=True)
        try:
            screenshot(Shot(rrd=recording, time_s=SHOWN_TIME), picture)
        except ConnectionError as error:
            print(f"{recording}: no viewer: {error}", file=sys.stderr)
        else:
            pictures[picture.stem] = picture
    return pictures


def report_screenshots(report: Path, folder: Path) -> dict[str, Path]:
    """Save pictures of a whole report at several widths and in both colour schemes.

    Args:
        report: The report.
        folder: Folder for the pictures.

    Returns:
        The pictures by name; none where no browser can start.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        browser = None
    if browser is None:
        print(f"{report}: playwright and an installed browser are needed", file=sys.stderr)
        return {}

    folder.mkdir(exist_ok=True)
    pictures = {}
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        for window, width in WINDOW_WIDTHS.items():
            for scheme in SCHEMES:
                page = opened.new_page(
                    viewport={"width": width, "height": 800}, color_scheme=scheme
                )
                page.goto(report.resolve().as_uri())
                page.wait_for_selector("body[data-ready=yes]", timeout=PATIENCE)
                page.wait_for_timeout(500)
                picture = folder / f"report-{window}-{scheme}.png"
                page.screenshot(path=str(picture), full_page=True)
                pictures[picture.stem] = picture
                page.close()
        opened.close()
    return pictures


def for_page(picture: Path, target: Path) -> int:
    """Write a small copy of a picture; only the beginning of a long one.

    Args:
        picture: The picture.
        target: File to write.

    Returns:
        The width of the copy [pixels].
    """
    with Image.open(picture) as opened:
        image = opened.convert("RGB")
    if image.height > SHOWN_HEIGHT * image.width:
        image = image.crop((0, 0, image.width, int(SHOWN_HEIGHT * image.width)))
    image.thumbnail((PAGE_WIDTH, image.height))
    image.quantize(PAGE_COLOURS).save(target, optimize=True)
    return image.width


# ---- page


HEAD = """---
hide:
  - navigation
---

# Gallery

Every output of mjfim for several robots: what the terminal prints, the pictures, the beginning of
`report.html`, and the files of the viewer. The page is made by

<!-- not run: needs models and logs of others -->

```sh
python -m scripts.gallery --models FOLDER --data FOLDER \\
    -o out/gallery --page docs/gallery.md
```

The colours mean the same everywhere: {colours}
([words and colours](reference/words-and-colours.md)). Pictures of reports end where their first
screens end; the reports themselves have plots to hover and zoom.
"""

# What is said of the simulated recordings of a robot.
SIMULATED = (
    "Its recordings are simulated: the robot's parameters differ from the model by "
    f"{100 * ROBOT_DIFFERENCE:.0f} % of their sizes, unless they are known beforehand."
)


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

    *most, last = [f"{term.colour_name} for {term}" for term in TERMS]
    colours = f"{', '.join(most)} and {last}"
    parts = [
        "\n".join(textwrap.wrap(line, 100)) for line in HEAD.format(colours=colours).split("\n")
    ]
    parts.append(_contents(shown))
    once = True
    for robot, calls in shown:
        parts += [f"## {robot.title}", "", *textwrap.wrap(robot_text(robot, calls), 100), ""]
        for call in calls:
            parts += [_section(robot, call, images, once=once)]
            once &= ONCE not in call.pictures
    page.write_text("\n".join(parts), encoding="utf-8")


def robot_text(robot: Robot, calls: Sequence[Shown]) -> str:
    """Return the sentences below the name of a robot."""
    is_other = any("_robot.toml" in call.command for call in calls)
    return f"{robot.text} {SIMULATED}" if is_other else robot.text


def _contents(shown: Sequence[tuple[Robot, Sequence[Shown]]]) -> str:
    """Return a table with a link to every call of every robot."""
    lines = ["| robot | results |", "|---|---|"]
    for robot, calls in shown:
        links = [f"[{_verb(call)}](#{_anchor(robot, _verb(call))})" for call in calls]
        lines.append(f"| {robot.title} | {', '.join(links)} |")
    return "\n".join([*lines, ""])


def _verb(call: Shown) -> str:
    """Return the verb of a call."""
    return call.command.split()[1]


def _anchor(robot: Robot, verb: str) -> str:
    """Return the anchor of a section, as the documentation names it."""
    return f"{robot.title}-{verb}".lower().replace(" ", "-")


def terminal_block(call: Shown) -> str:
    """Return a command and what it printed, as a terminal of the usual width shows them."""
    # A command continues on the next line behind a backslash.
    command = textwrap.wrap(
        f"$ {call.command}",
        COLUMNS - 2,
        subsequent_indent="    ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    lines = [" \\\n".join(command)]
    for line in call.terminal.splitlines():
        indent = " " * (len(line) - len(line.lstrip()))
        lines += textwrap.wrap(line, COLUMNS, subsequent_indent=indent) or [""]
    return "\n".join(["```text", *lines, "```", ""])


def _section(robot: Robot, call: Shown, images: Path, *, once: bool) -> str:
    """Describe one call: the command, what the terminal printed, and the pictures.

    With `once`, the pictures are shown that the page has only once.
    """
    verb = _verb(call)
    lines = [f"### {robot.title}: {verb}", "", terminal_block(call)]
    if call.code == 1:
        lines += ["Exit code 1: the run is complete, and did not reach its goal.", ""]

    for start, caption in CAPTIONS.items():
        found = [name for name in call.pictures if _shows(name, start)]
        if not found or (start == ONCE and not once):
            continue

        target = images / f"{robot.name}-{verb}-{found[0]}.png"
        width = for_page(call.pictures[found[0]], target)
        alt = f"{robot.title}, {verb}: {caption.replace('`', '')}"
        more = f" (one of {len(found)})" if len(found) > 1 else ""
        lines += [
            '<figure markdown="span">',
            f'![{alt}](images/gallery/{target.name}){{ width="{width}" loading="lazy" }}',
            f"<figcaption>{re.sub('`(.+?)`', CODE, caption)}{more}</figcaption>",
            "</figure>",
            "",
        ]
    return "\n".join(lines)


def _shows(name: str, start: str) -> bool:
    """Return whether a picture is of a kind: its name is the kind's, perhaps with a number."""
    return (
        name == start
        or (name.startswith(start) and start.endswith("_"))
        or (name.removeprefix(f"{start}_").isdecimal() and name.startswith(start))
    )


def _new_calls(robot: Robot, folder: Path, parser: argparse.ArgumentParser) -> list[Shown]:
    """Make the calls for a robot; none if its files are missing."""
    missing = [path for path in robot.needs if not path.exists()]
    if missing:
        print(f"{robot.name}: left out, {missing[0]} does not exist", file=sys.stderr)
        return []
    if folder.exists():
        parser.error(f"{folder} exists; every robot needs a fresh folder")
    calls = list(show_robot(robot, folder))
    keep_calls(calls, folder)
    return calls


def main() -> int:
    """Make the gallery; exit code 1 if a call ended with misuse."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--models", type=Path, default=Path("../shared/models"))
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("-o", "--output", type=Path, default=Path("out/gallery"))
    parser.add_argument("--page", type=Path, help="page in Markdown to write")
    parser.add_argument("--only", nargs="+", metavar="ROBOT", help="names of robots")
    parser.add_argument("--reuse", action="store_true", help="use the files of an earlier run")
    options = parser.parse_args()

    found = []
    for robot in robots(options.models.resolve(), options.data.resolve()):
        folder = options.output.resolve() / robot.name
        if options.only and robot.name not in options.only:
            continue
        calls = kept_calls(folder) if options.reuse else _new_calls(robot, folder, parser)
        if calls:
            found.append((robot, calls))

    if options.page is not None:
        write_page(options.page, found)
    summary = {robot.name: {call.command: call.code for call in calls} for robot, calls in found}
    print(json.dumps(summary, indent=2))
    return 1 if any(call.code == 2 for _, calls in found for call in calls) else 0


if __name__ == "__main__":
    sys.exit(main())
