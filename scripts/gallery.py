"""Make every output of mjfim for several robots, and a page that shows them.

    python -m scripts.gallery --models FOLDER --data FOLDER -o out/gallery --page docs/gallery.md

The command line is called as a user calls it. Pictures, what the terminal printed, screenshots of
`report.html` at the width of a desktop and of a phone, in light and in dark colours, and
screenshots of the Rerun files are collected per robot. Robots whose files are missing, and
screenshots for which no browser or no viewer can start, are left out with a sentence on stderr.

`--models` is a folder with `menagerie_panda` and `menagerie_so_arm100` of the MuJoCo Menagerie, and
`--data` one with the logs `dfki_double_pendulum`.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from PIL import Image

from scripts.rerun_screenshot import every_tab, screenshot
from scripts.verbs import call_verb

ROOT = Path(__file__).resolve().parent.parent

# Columns of the terminal.
COLUMNS = 80

# Longest time of one verb [s].
PATIENCE = 900.0

# Largest width of a picture on the page [pixels], and its number of colours.
PAGE_WIDTH, PAGE_COLOURS = 1200, 128

# Names of browsers with the DevTools protocol, the usual one first.
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")

# Widths of the windows in which reports are looked at [pixels].
WINDOW_WIDTHS = {"desktop": 1280, "phone": 390}

# Colour schemes in which reports are looked at.
SCHEMES: tuple[Literal["light", "dark"], ...] = ("light", "dark")

# Moment of the simulated motion that Rerun shows [s].
SHOWN_TIME = 1.5

# Sizes of the window in which all tabs of Rerun recordings are looked at [pixels].
VIEWER_SIZES = ((1280, 800), (1920, 1080))

# Screenshots of the whole report that the page shows; the others are for looking at.
PAGE_SCREENSHOTS = ("report-desktop-light",)


@dataclass(frozen=True, kw_only=True)
class Step:
    """One call of the command line.

    Attributes:
        verb: The verb.
        words: Its arguments; `{experiment}`, `{out}` and the names of files are filled in.
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
    """What one call left behind.

    Attributes:
        command: The command, with short paths.
        code: Exit code.
        seconds: Duration [s].
        terminal: What was printed on stdout, then the messages on stderr.
        pictures: Pictures by title.
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
        Step(verb="simulate", words=("{experiment}", "{out}/design", "-o", "{out}/recording.csv")),
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
    robustness = Step(
        verb="robustness",
        words=("{experiment}", "{out}/design", "-o", "{out}/robustness", "--runs", "40"),
        folder="robustness",
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
            steps=_design_steps(montecarlo, compare, robustness, campaign),
        ),
        Robot(
            name="servo-arm",
            title="Servo arm",
            text="Two joints with position servos, and limits of position, velocity and force.",
            experiment=own / "servo_arm.toml",
            steps=_design_steps(montecarlo, robustness),
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
        yield _call(Step(verb="init", words=(str(robot.model), "-o", str(experiment))), {})

    values = {"experiment": str(experiment), "out": str(folder)}
    for step in robot.steps:
        shown = _call(step, values)
        if step.folder is not None:
            shown.pictures = _pictures(folder / step.folder)
        yield shown


def _call(step: Step, values: dict[str, str]) -> Shown:
    """Call a verb as a user does."""
    words = [word.format(**values) if "{" in word else word for word in step.words]
    variables = {"PYTHONPATH": str(ROOT), "COLUMNS": str(COLUMNS)}
    begun = time.perf_counter()
    ended = call_verb([step.verb, *words], variables=variables, patience=PATIENCE)
    seconds = time.perf_counter() - begun

    command = " ".join(["mjfim", step.verb, *(_short(word) for word in words)])
    print(f"{command}: exit code {ended.returncode}, {seconds:.0f} s", file=sys.stderr)
    return Shown(
        command=command,
        code=ended.returncode,
        seconds=seconds,
        terminal=_without_long_paths(ended.stdout.rstrip()),
    )


def _short(word: str) -> str:
    """Return the last two parts of a path; other words as they are."""
    path = Path(word)
    return "/".join(path.parts[-2:]) if path.is_absolute() else word


def _without_long_paths(text: str) -> str:
    """Return what was printed, without the folder of this checkout."""
    return text.replace(f"{ROOT}/", "")


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
            screenshot(recording, picture, SHOWN_TIME)
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
                page.wait_for_timeout(1000)
                picture = folder / f"report-{window}-{scheme}.png"
                page.screenshot(path=str(picture), full_page=True)
                pictures[picture.stem] = picture
                page.close()
        opened.close()
    return pictures


def for_page(picture: Path, target: Path) -> None:
    """Write a small copy of a picture.

    Args:
        picture: The picture.
        target: File to write.
    """
    with Image.open(picture) as opened:
        image = opened.convert("RGB")
    image.thumbnail((PAGE_WIDTH, 10 * PAGE_WIDTH))
    image.quantize(PAGE_COLOURS).save(target, optimize=True)


def save_every_tab(folder: Path) -> None:
    """Save pictures of all tabs of the Rerun files of a robot, beside its other screenshots.

    Args:
        folder: Folder of the robot.
    """
    for recording in sorted(folder.glob("*/*.rrd")):
        for size in VIEWER_SIZES:
            try:
                every_tab(recording, recording.parent / "screenshots", SHOWN_TIME, size=size)
            except ConnectionError as error:
                print(f"{recording}: no viewer: {error}", file=sys.stderr)


# ---- page


HEAD = """# Gallery

Every output of mjfim for six robots, made by

```sh
python -m scripts.gallery --models FOLDER --data FOLDER -o out/gallery --page docs/gallery.md
```

The colours mean the same everywhere: blue is the initial trajectory, red the designed one, orange
the nominal model, teal what was measured, purple what was identified. `report.html` shows the same
results with plots to hover and zoom; here are pictures of it.
"""


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
        parts.append(f"## {robot.title}\n\n{robot.text}\n")
        parts += [_section(robot, call, images) for call in calls]
    page.write_text("\n".join(parts), encoding="utf-8")


def _section(robot: Robot, call: Shown, images: Path) -> str:
    """Describe one call: the command, what the terminal printed, and the pictures."""
    verb = call.command.split()[1]
    lines = [f"### {robot.title}: {verb}", "", "```text", f"$ {call.command}"]
    lines += [call.terminal] if call.terminal else []
    lines += ["```", ""]

    for name, picture in call.pictures.items():
        if name.startswith("report-") and name not in PAGE_SCREENSHOTS:
            continue
        target = images / f"{robot.name}-{verb}-{name}.png"
        for_page(picture, target)
        lines += [f"![{robot.title}, {verb}: {name}](images/gallery/{target.name})", ""]
    return "\n".join(lines)


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
    parser.add_argument(
        "--every-tab",
        action="store_true",
        help="also save every tab of the Rerun files at two sizes, which takes a while",
    )
    options = parser.parse_args()

    found = []
    for robot in robots(options.models.resolve(), options.data.resolve()):
        missing = [path for path in robot.needs if not path.exists()]
        if missing:
            print(f"{robot.name}: left out, {missing[0]} does not exist", file=sys.stderr)
            continue
        if options.only and robot.name not in options.only:
            continue

        folder = options.output.resolve() / robot.name
        if folder.exists():
            parser.error(f"{folder} exists; every robot needs a fresh folder")
        found.append((robot, list(show_robot(robot, folder))))
        if options.every_tab:
            save_every_tab(folder)

    if options.page is not None:
        write_page(options.page, found)
    summary = {robot.name: {call.command: call.code for call in calls} for robot, calls in found}
    print(json.dumps(summary, indent=2))
    return 1 if any(call.code == 2 for _, calls in found for call in calls) else 0


if __name__ == "__main__":
    sys.exit(main())
