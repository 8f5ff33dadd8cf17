"""Odd words, encodings, files, names and disks, and two faults at once; all that is spoiled."""

from __future__ import annotations

import functools
import gzip
import json
import os
import re
import shutil
import tempfile
import tomllib
import zipfile
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.csv
import pyarrow.parquet
from rosbags.rosbag2 import StoragePlugin

from tests.fuzz.bad_inputs import (
    CHECK,
    DESIGN,
    DESIGN_VERBS,
    IDENTIFY,
    MONTECARLO,
    SIMULATE,
    WRITING_VERBS,
    Call,
    Rng,
    few_rows,
    in_format,
    odd_numbers,
    odd_times,
    pick,
    rows_of,
    spoil_bytes,
    spoiled_design,
    spoiled_experiment,
    spoiled_model,
    spoiled_recording,
)
from tests.support.ros2_bag import EPOCH, State, write

# Words of the command line.

# Outputs that are bad, unusual, or a file of the study.
OUTPUTS = (
    "file",
    "file/below",
    "study.toml",
    "design.npz",
    "cart_pendulum.xml",
    ".",
    "",
    " ",
    "[bold]x[/bold]",
    "[/]",
    "ünïcode/ö",
    "x" * 300,
    "a/b/c/d",
    "/dev/null/x",
    "/dev/full",
    "locked/x",
    "-",
    "--",
    "~",
    "a\nb",
    "%s{0}",
)

OPTION_VALUES = ("-1", "0", "1", "nan", "inf", "1e300", "abc", "", "1.5", "99999999999999999999")

COMPARE = ("compare", "study.toml", "-o", "out", "--seconds", "0.1")
OPTIONS = (
    (CHECK[:2], ("--threads", "--design", "--nonsense")),
    (DESIGN[:4], ("--threads", "--starts", "--shortest", "-x")),
    (SIMULATE, ("--seed", "--rate")),
    (IDENTIFY, ("--method", "--held-out", "--starts")),
    (MONTECARLO, ("--measure-rate", "--seed", "--trials")),
    (COMPARE, ("--methods", "--seconds")),
)

# Texts of `--executor` that name no executor.
EXECUTORS = (
    "",
    "local:",
    "local:0",
    "local:-1",
    "local:1.5",
    "local:" + "9" * 5000,
    "python:",
    "python:.a:make",
    "python:..:make",
    "python:json:loads",
    "python:os:nothing",
    "dask:",
    "dask:missing.json",
    "dask:study.toml",
    "dask://[::1",
    "dask:tcp://",
    "http://x",
    "\u2028",
)

# Calls with options whose values name nothing, and these values.
NOTHING = (
    ((*MONTECARLO, "--executor"), EXECUTORS),
    ((*IDENTIFY, "--executor"), EXECUTORS),
    ((*COMPARE, "--methods"), ("", ",", " ", " , ,")),
)

# Files that no verb can read.
PLACES = ("missing.toml", ".", "", "design.npz", "run.csv", "/dev/null", "study.toml/x", "x" * 5000)


def spoiled_words(rng: Rng, folder: Path) -> Call:
    """Give a bad value of an option, a bad file or output, or too few or too many words."""
    call, options = pick(rng, OPTIONS)
    words = list(call)
    hows = ("option", "option", "file", "output", "output", "dropped", "further", "nothing")
    how = pick(rng, hows)
    if how == "nothing":
        call, values = pick(rng, NOTHING)
        words = [*call, pick(rng, values)]
    elif how == "option":
        words += [pick(rng, options), pick(rng, OPTION_VALUES)]
    elif how == "output":
        (folder / "file").write_text("a file of the user\n", encoding="utf-8")
        (folder / "locked").mkdir(mode=0o500)
        words = [*pick(rng, WRITING_VERBS)[:-1], pick(rng, OUTPUTS)]
    elif how == "file":
        files = [i for i in range(1, len(words)) if "." in words[i]]
        words[pick(rng, files)] = pick(rng, PLACES)
    elif how == "dropped":
        del words[int(rng.integers(len(words)))]
    else:
        words.append(pick(rng, ("study.toml", "", "-", "--", "--json=1")))
    listed = " ".join(repr(word[:30]) for word in words)
    return Call(words=words, spoiled=f"words: {listed}", refused=how in ("dropped", "nothing"))


# Encodings and dialects.

# Texts by name, and whether each must be read, must be refused, or may be either.
Texts = dict[str, tuple[str, bool | None]]


def csv_texts(text: str) -> Texts:
    """A CSV in other dialects."""
    header, _, rows = text.partition("\n")
    clock = re.sub(r"^[^,]+", lambda t: f"12:00:{float(t[0]):09.6f}", rows, flags=re.MULTILINE)
    return {
        "CRLF": (text.replace("\n", "\r\n"), True),
        "CR": (text.replace("\n", "\r"), True),
        "semicolons": (text.replace(",", ";"), True),
        "decimal commas": (text.replace(",", ";").replace(".", ","), True),
        "tabs": (text.replace(",", "\t"), True),
        "spaces": (text.replace(",", " , "), True),
        "blank lines": (text.replace("\n", "\n\n"), True),
        "comments": ("# a comment\n" + text.replace("\n", "\n# a, b\n"), True),
        "delimiters at the ends": (text.replace("\n", ",\n"), True),
        "clock times": (f"{header}\n{clock}", True),
        "units": (f"{header}\ns{',' * header.count(',')}\n{rows}", True),
        "no header": (rows, False),
        "two headers": (f"{header}\n{text}", False),
        "an open quote": (text.replace("\n", '\n"', 3), None),
    }


def toml_texts(text: str) -> Texts:
    """An experiment file in other forms."""
    return {
        "CRLF": (text.replace("\n", "\r\n"), True),
        "CR": (text.replace("\n", "\r"), True),
        "another number": (text.replace("rate = 100.0", "rate = 0x64", 1), True),
        "a date": (text.replace("rate = 100.0", "rate = 2020-01-01", 1), False),
        "NUL": (text + "\0", False),
        "JSON": (json.dumps(tomllib.loads(text)), False),
        "a deep key": (text + ".".join("a" * 3000) + " = 1\n", False),
        "a deep table": (text + "x = " + "[" * 5000 + "]" * 5000 + "\n", False),
        "an endless text": (text + 'x = """', False),
    }


def encoded_text(rng: Rng, folder: Path) -> Call:
    """A log or an experiment file in another encoding or of another dialect."""
    is_log = rng.random() < 0.5
    file = folder / ("run.csv" if is_log else "study.toml")
    text = file.read_text(encoding="utf-8")
    if is_log:
        texts, codecs = csv_texts(text), {"utf-16": True, "utf-8-sig": True}
    else:
        text += "\n# ü\n"
        texts = toml_texts(text)
        codecs = {"utf-16": False, "utf-32": False, "latin-1": False, "utf-8-sig": True}
    how = pick(rng, (*texts, *codecs))
    changed, is_allowed = texts[how] if how in texts else (text, codecs[how])
    file.write_bytes(changed.encode(how if how in codecs else "utf-8"))
    words = IDENTIFY if is_log else pick(rng, (CHECK, SIMULATE))
    refused, accepted = is_allowed is False, is_allowed is True
    return Call(words=words, spoiled=f"{file.name}: {how}", refused=refused, accepted=accepted)


# Logs that count twice, bags, and files that are far too large.


def identify(*logs: str, held_out: str = "") -> list[str]:
    """Words of a fit to logs."""
    words = ["identify", "study.toml", *logs, "-o", "out", "--threads", "1"]
    return [*words, "--held-out", held_out] if held_out else words


def same_log_twice(rng: Rng, folder: Path) -> Call:
    """A log that counts twice: given twice, copied, converted, linked, or as its own held-out."""
    how = pick(rng, ("twice", "copied", "converted", "linked", "another path"))
    second = {"converted": "copy.npz", "another path": "./run.csv", "twice": "run.csv"}
    name = second.get(how, "copy.csv")
    if how == "copied":
        shutil.copy(folder / "run.csv", folder / name)
    elif how == "linked":
        (folder / name).symlink_to("run.csv")
    elif how == "converted":
        (folder / name).write_bytes(in_format(name, rows_of(folder)))
    is_held_out = rng.random() < 0.5
    words = identify("run.csv", held_out=name) if is_held_out else identify("run.csv", name)
    return Call(words=words, spoiled=f"the same log twice, {how}", refused=True)


# Table of an experiment file for logs in bags.
BAG = """
[recording.columns]
"qpos:slide" = "position:slide"
"qpos:hinge" = "position:hinge"
"qvel:slide" = "velocity:slide"
"qvel:hinge" = "velocity:hinge"
"ctrl:force" = "effort:slide"
"""


def spoiled_bag(rng: Rng, folder: Path) -> Call:
    """A ROS 2 bag of which something is spoiled."""
    rows, spoiled, refused = rows_of(folder), "intact", False
    if rng.random() < 0.5:
        spoiled, refused = pick(rng, (few_rows, odd_numbers, odd_times))(rng, rows)
    states = []
    for row in rows[1:]:
        given = dict(zip(rows[0], (float(cell or "nan") for cell in row), strict=True))
        stamp = EPOCH + round(1e9 * float(np.clip(np.nan_to_num(given["t"]), 0.0, 1e6)))
        position, velocity = (
            [given[f"{kind}:{name}"] for name in ("slide", "hinge")] for kind in ("qpos", "qvel")
        )
        effort = [given["ctrl:force"], 0.0]
        states.append(State(stamp, ("slide", "hinge"), position, velocity, effort))
    plugin = pick(rng, (StoragePlugin.SQLITE3, StoragePlugin.MCAP))
    bag = write(folder / "bag", plugin, {"/joints": states})
    files = list(bag.iterdir())
    if rng.random() < 0.4:
        file = pick(rng, files)
        content, how = spoil_bytes(rng, file.read_bytes())
        file.write_bytes(content)
        spoiled, refused = f"{file.name} {how}", False

    with (folder / "study.toml").open("a", encoding="utf-8") as experiment:
        experiment.write(BAG)
    place = pick(rng, ("bag", *(f"bag/{file.name}" for file in files if file.suffix != ".yaml")))
    refused &= spoiled.endswith(" rows")
    return Call(words=identify(place), spoiled=f"{place}: {spoiled}", refused=refused)


# Size of the array inside of a packed design that is far too large [bytes].
BOMB_SIZE = 1 << 28


@functools.cache
def _bomb() -> Path:
    """A design.npz that unpacks to a thousand times its size, made once in each process."""
    path = Path(tempfile.mkdtemp(dir=Path.cwd())) / "bomb.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("t.npy", "w", force_zip64=True) as stream,
    ):
        description = {"descr": "<f8", "fortran_order": False, "shape": (BOMB_SIZE // 8,)}
        np.lib.format.write_array_header_1_0(stream, description)
        for _ in range(BOMB_SIZE >> 22):
            stream.write(bytes(1 << 22))
    return path


def packed_bomb(rng: Rng, folder: Path) -> Call:
    """A design or a recording that unpacks to a thousand times its size, or that is very deep."""
    how = pick(rng, ("design.npz", "log.csv.gz", "log.json"))
    if how == "log.csv.gz":
        (folder / how).write_bytes(gzip.compress(bytes(BOMB_SIZE), 1))
    elif how == "log.json":
        (folder / how).write_text(pick(rng, ("[", '{"a":', '[{"t":')) * 200_000, encoding="utf-8")
    else:
        shutil.copy(_bomb(), folder / how)
    words = pick(rng, DESIGN_VERBS) if how == "design.npz" else identify(how)
    return Call(words=words, spoiled=f"a bomb {how}", refused=True)


# Rows of a log that is far too long, the memory of a call that reads it [bytes], and the time after
# which it is asked to stop [s].
LONG_ROWS, LONG_MEMORY, LONG_PATIENCE = 10_000_000, 8 << 30, 240.0


def long_log(rng: Rng, folder: Path) -> Call:
    """A log of ten million rows, of which a window of a second may be wanted."""
    header, *rows = rows_of(folder)
    cells = np.array([[float(cell or "nan") for cell in row] for row in rows]).round(3)
    columns = {name: np.resize(cells[:, i], LONG_ROWS) for i, name in enumerate(header)}
    columns["t"] = 0.01 * np.arange(LONG_ROWS)
    name = str(pick(rng, ("log.csv", "log.npz")))
    if name == "log.npz":
        np.savez(folder / name, **columns)
    else:
        pyarrow.csv.write_csv(pyarrow.table(columns), folder / name)
    spoiled = f"{name}: {LONG_ROWS} rows"
    if rng.random() < 0.5:
        spoiled += ", a window of 1 s"
        with (folder / "study.toml").open("a", encoding="utf-8") as file:
            file.write("\n[recording]\nwindow = [0.0, 1.0]\n")
    words = pick(rng, (identify(name), [*CHECK, name]))
    return Call(words=words, spoiled=spoiled, memory=LONG_MEMORY, patience=LONG_PATIENCE)


# Odd files, names and disks.

# Content of odd files; the number of triangles of the last one, a binary STL, is huge.
CONTENTS = {
    "empty": b"",
    "text": b"<mujoco>\n",
    "huge": bytes(80) + b"\xff\xff\xff\x7f" + bytes(50),
}


def put_odd(path: Path, how: str) -> None:
    """Put something odd at a free path, or nothing."""
    links = {"dangling link": "missing", "loop": path.name, "device": "/dev/zero", "link": "far"}
    if how == "folder":
        path.mkdir()
    elif how == "pipe":
        os.mkfifo(path)
    elif how in CONTENTS:
        path.write_bytes(CONTENTS[how])
    elif how in links:
        path.symlink_to(links[how])


def odd_file(rng: Rng, folder: Path) -> Call:
    """An input that is a link, a folder, a device or missing."""
    readers = {
        "study.toml": (CHECK, SIMULATE, IDENTIFY),
        "cart_pendulum.xml": (CHECK, SIMULATE, IDENTIFY),
        "cart_pendulum.csv": (CHECK,),
        "run.csv": (IDENTIFY,),
        "design.npz": (SIMULATE,),
    }
    name = pick(rng, tuple(readers))
    how = pick(rng, ("link", "dangling link", "loop", "folder", "device", "unreadable", "pipe"))
    (folder / name).rename(folder / "far")
    if how == "unreadable":
        shutil.copy(folder / "far", folder / name)
        (folder / name).chmod(0)
    put_odd(folder / name, how)
    words, refused = pick(rng, readers[name]), how not in ("link", "unreadable")
    return Call(words=words, spoiled=f"{name} is a {how}", refused=refused)


# Elements of a model that name a file %s, with endings of such files.
FILES_OF_MODELS = {
    '<include file="%s"/>': (".xml",),
    '<asset><mesh name="m" file="%s"/></asset>': (".stl", ".obj", ".msh"),
    '<asset><texture name="m" type="2d" file="%s"/></asset>': (".png",),
    '<asset><hfield name="m" size="1 1 1 1" file="%s"/></asset>': (".png",),
    '<asset><skin name="m" file="%s"/></asset>': (".skn",),
    '<asset><model name="m" file="%s"/></asset>': (".xml",),
}


def model_with_files(rng: Rng, folder: Path) -> Call:
    """A model with an included file, a mesh, an image or a skin that is missing or spoiled."""
    model = folder / "cart_pendulum.xml"
    element = pick(rng, tuple(FILES_OF_MODELS))
    how = pick(rng, ("missing", "empty", "folder", "itself", "device", "text", "huge"))
    name = model.name if how == "itself" else "part" + pick(rng, FILES_OF_MODELS[element])
    put_odd(folder / name, how)
    text = model.read_text(encoding="utf-8")
    spoiled = text.replace("<worldbody>", f"{element % name}<worldbody>", 1)
    model.write_text(spoiled, encoding="utf-8")
    words, refused = pick(rng, (CHECK, SIMULATE, IDENTIFY)), how != "itself"
    return Call(words=words, spoiled=f"model: {element % name} {how}", refused=refused)


# Names of files and folders that are odd, but allowed.
ODD_NAMES = (
    "a b",
    "[bold]x[/bold]",
    "[/]",
    "ünïcode ☃",
    "a\nb",
    "%s{0}",
    "-o",
    "*",
    "a'b\"c",
    "e\u0301",
    "$HOME",
    "back\\slash",
    "tab\there",
    "lines\u2028of\u0085Unicode",
    "\U0001d4b3",
    ".hidden",
    "x" * 200,
)


def odd_name(rng: Rng, folder: Path) -> Call:
    """Inputs and outputs with odd names; nothing else is wrong, so that they must work."""
    name = str(pick(rng, ODD_NAMES))
    if rng.random() < 0.5:
        name = name.replace("/", "_")
        shutil.move(folder / "study.toml", folder / f"{name}.toml")
        shutil.move(folder / "run.csv", folder / f"{name}.csv")
        words = ["identify", f"./{name}.toml", f"./{name}.csv", "-o", f"./{name} out"]
        return Call(words=words, spoiled=f"files {name[:20]!r}", accepted=True)

    files = list(folder.iterdir())
    (folder / name).mkdir(parents=True)
    for file in files:
        shutil.move(file, folder / name)
    words = ["identify", f"./{name}/study.toml", f"./{name}/run.csv", "-o", f"./{name}/out"]
    # MuJoCo takes a backslash for a separator.
    works = "\\" not in name
    return Call(words=words, spoiled=f"a folder {name[:20]!r}", accepted=works, refused=not works)


def odd_output(rng: Rng, folder: Path) -> Call:
    """An output that cannot be written, or that is something else."""
    how = pick(rng, ("text", "dangling link", "link", "loop", "system", "pipe"))
    place = pick(rng, ("/sys/results", "/proc/results")) if how == "system" else "results"
    (folder / "far").mkdir()
    put_odd(folder / "results", how)
    words = [*pick(rng, WRITING_VERBS[1:3])[:-1], place]
    return Call(words=words, spoiled=f"output: {how}", fails=how not in ("dangling link", "link"))


def hostile_system(rng: Rng, folder: Path) -> Call:
    """A home folder in which nothing can be written, or a disk that is full after some bytes."""
    if rng.random() < 0.5:
        words = pick(rng, (SIMULATE, IDENTIFY, CHECK))
        return Call(words=words, spoiled="no home", accepted=True, has_home=False)
    words = pick(rng, (SIMULATE, IDENTIFY, DESIGN, MONTECARLO))
    room = int(rng.choice([0, 100, 4000, 30_000, 100_000]))
    return Call(words=words, spoiled=f"room of {room} bytes", room=room, fails=room <= 4000)


def no_permission(rng: Rng, folder: Path) -> Call:
    """A user who may not write here, may not read an input, or has a home that is read-only."""
    results = folder / "out"
    forbidden = {
        "home": folder / "home",
        "current folder": folder,
        "results": results,
        "input": folder / str(pick(rng, ("study.toml", "cart_pendulum.xml"))),
    }
    how = pick(rng, ("nothing", *forbidden))
    words = pick(rng, (IDENTIFY, CHECK, (*CHECK, "run.csv", "-o", "out"), DESIGN, MONTECARLO))
    if how in ("home", "results"):
        forbidden[how].mkdir()
    fails = how == "input" or (how in ("current folder", "results") and "-o" in words)
    return Call(
        words=words,
        spoiled=f"no permission: {how}",
        forbidden=(forbidden[how],) if how in forbidden else (),
        has_home=how != "home",
        fails=fails,
        accepted=not fails,
    )


def two_faults(rng: Rng, folder: Path) -> Call:
    """Spoil two files; a refusal of one may hide the other."""
    first = pick(rng, (spoiled_experiment, spoiled_model))(rng, folder)
    try:
        second = pick(rng, (spoiled_recording, spoiled_design, spoiled_model))(rng, folder)
    except (ValueError, SyntaxError):
        # A file that is spoiled already cannot be spoiled in every way.
        return first
    words = pick(rng, (first, second)).words
    return Call(words=words, spoiled=f"{first.spoiled}; {second.spoiled}")


# What is spoiled, with the share of the cases.
SPOILERS = {
    spoiled_experiment: 0.2,
    spoiled_model: 0.12,
    spoiled_recording: 0.16,
    spoiled_design: 0.07,
    spoiled_words: 0.08,
    encoded_text: 0.06,
    same_log_twice: 0.03,
    spoiled_bag: 0.04,
    packed_bomb: 0.02,
    odd_file: 0.03,
    model_with_files: 0.05,
    odd_name: 0.02,
    odd_output: 0.03,
    hostile_system: 0.01,
    two_faults: 0.08,
}


def bad_input(rng: Rng, folder: Path) -> Call:
    """Spoil the valid study in a folder.

    Args:
        rng: Random numbers.
        folder: Folder with the files of the study; some of them are changed.

    Returns:
        The call that has to cope with it.
    """
    chosen = rng.choice(len(SPOILERS), p=[*SPOILERS.values()])
    return [*SPOILERS][int(chosen)](rng, folder)
