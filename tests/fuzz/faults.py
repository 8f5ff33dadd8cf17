"""Further bad inputs: certain nonsense, two faults at once, bags, odd files, names and disks.

They are a kind of their own, so that the seeds of `bad_inputs` keep their meaning.
"""

from __future__ import annotations

import functools
import gzip
import json
import os
import shutil
import tempfile
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.csv
import pyarrow.parquet

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
    in_format,
    pick,
    rows_of,
    spoil_bytes,
    spoiled_design,
    spoiled_experiment,
    spoiled_model,
    spoiled_recording,
    write_toml,
)

# Size of the array inside of a packed design that is far too large [bytes].
BOMB_SIZE = 1 << 28

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


def fault(rng: Rng, folder: Path) -> Call:
    """Spoil the valid study in a folder.

    Args:
        rng: Random numbers.
        folder: Folder with the files of the study.

    Returns:
        The call that has to cope with it.
    """
    shares = np.array([share for _, share in FAULTS])
    chosen = FAULTS[int(rng.choice(len(FAULTS), p=shares / shares.sum()))][0]
    return chosen(rng, folder)


def log_columns(folder: Path) -> dict[str, list[float]]:
    """The columns of the recording of the study."""
    header, *rows = rows_of(folder)
    return {name: [float(row[i] or "nan") for row in rows] for i, name in enumerate(header)}


def identify(*logs: str, held_out: str = "") -> list[str]:
    """Words of a fit to logs."""
    words = ["identify", "study.toml", *logs, "-o", "out", "--threads", "1"]
    return [*words, "--held-out", held_out] if held_out else words


# Certain nonsense, which must be refused.


def infinite_number_in_model(rng: Rng, folder: Path) -> Call:
    """A mass or an inertia that is not a finite number, also in a file that is included."""
    file = folder / "cart_pendulum.xml"
    number = pick(rng, ("nan", "NaN", "-nan"))
    changes = (
        ('mass="2"', f'mass="{number}"'),
        ('diaginertia="0.01 0.01 0.01"', f'diaginertia="0.01 {number} 0.01"'),
        ('mass="0"/>', f'density="{number}"/>'),
        ('damping="1"', f'damping="{number}"'),
    )
    old, new = pick(rng, changes)
    spoiled, what = file.read_text(encoding="utf-8").replace(old, new, 1), new
    if rng.random() < 0.4:
        what += " in an included file"
        (folder / "inner.xml").write_text(spoiled, encoding="utf-8")
        spoiled = '<mujoco><include file="inner.xml"/></mujoco>'
    file.write_text(spoiled, encoding="utf-8")
    words = pick(rng, (CHECK, SIMULATE, IDENTIFY))
    return Call(words=words, spoiled=f"model: {what}", refused=True)


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
    place = "held-out" if is_held_out else "second"
    return Call(words=words, spoiled=f"the same log as {place}, {how}", refused=True)


@functools.cache
def _bomb() -> Path:
    """A design.npz that unpacks to a thousand times its size, made once in each process."""
    path = Path(tempfile.mkdtemp(dir=Path.cwd())) / "bomb.npz"
    header = np.lib.format
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("t.npy", "w", force_zip64=True) as stream,
    ):
        description = {"descr": "<f8", "fortran_order": False, "shape": (BOMB_SIZE // 8,)}
        header.write_array_header_1_0(stream, description)
        for _ in range(BOMB_SIZE >> 22):
            stream.write(bytes(1 << 22))
    return path


def packed_bomb(rng: Rng, folder: Path) -> Call:
    """A design or a recording that unpacks to a thousand times its size, or that is very deep."""
    if rng.random() < 0.5:
        name = str(pick(rng, ("log.csv.gz", "log.json", "log.npz")))
        if name == "log.csv.gz":
            (folder / name).write_bytes(gzip.compress(bytes(BOMB_SIZE), 1))
        elif name == "log.json":
            inner = pick(rng, ("[", '{"a":', '[{"t":'))
            (folder / name).write_text(inner * 200_000, encoding="utf-8")
        else:
            with zipfile.ZipFile(folder / name, "w", zipfile.ZIP_DEFLATED) as archive:
                for i in range(20_000):
                    archive.writestr(f"{i}.npy", b"")
        return Call(words=identify(name), spoiled=f"a bomb {name}", refused=True)
    words = pick(rng, (*DESIGN_VERBS, identify("design.npz")))
    shutil.copy(_bomb(), folder / "design.npz")
    return Call(words=words, spoiled="a packed bomb", refused=True)


# Two faults.


def two_faults(rng: Rng, folder: Path) -> Call:
    """Spoil two files; a refusal of one may hide the other."""
    first = pick(rng, (spoiled_experiment, spoiled_model))
    second = pick(rng, (spoiled_recording, spoiled_design, spoiled_model))
    one, other = first(rng, folder), None
    try:
        other = second(rng, folder)
    except (ValueError, SyntaxError):
        # A file that is spoiled already cannot be spoiled in every way.
        return one
    call = other if rng.random() < 0.7 else one
    call.spoiled = f"{one.spoiled}; {other.spoiled}"
    call.refused = False
    return call


# Recordings.


def encoded_log(rng: Rng, folder: Path) -> Call:
    """A CSV in another encoding or of another dialect."""
    file = folder / "run.csv"
    text = file.read_text(encoding="utf-8")
    columns = log_columns(folder)
    lines = text.splitlines()
    clock = [
        f"12:00:{t:09.6f}{line[line.index(',') :]}"
        for t, line in zip(columns["t"], lines[1:], strict=True)
    ]
    changes: dict[str, Callable[[], bytes]] = {
        "UTF-16": lambda: text.encode("utf-16"),
        "UTF-8 with a mark": lambda: text.encode("utf-8-sig"),
        "CRLF": lambda: text.replace("\n", "\r\n").encode(),
        "CR": lambda: text.replace("\n", "\r").encode(),
        "semicolons": lambda: text.replace(",", ";").encode(),
        "decimal commas": lambda: text.replace(",", ";").replace(".", ",").encode(),
        "tabs": lambda: text.replace(",", "\t").encode(),
        "blank lines": lambda: text.replace("\n", "\n\n").encode(),
        "a comment": lambda: b"# a comment\n" + text.encode(),
        "comments": lambda: text.replace("\n", "\n# a, b\n").encode(),
        "delimiters at the ends": lambda: text.replace("\n", ",\n").encode(),
        "clock times": lambda: "\n".join([lines[0], *clock]).encode(),
        "units": lambda: "\n".join(
            [lines[0], "s" + "," * lines[0].count(","), *lines[1:]]
        ).encode(),
        "no header": lambda: text.partition("\n")[2].encode(),
        "two headers": lambda: (text.partition("\n")[0] + "\n" + text).encode(),
        "spaces": lambda: text.replace(",", " , ").encode(),
        "an open quote": lambda: text.replace("\n", '\n"', 3).encode(),
    }
    how = pick(rng, tuple(changes))
    refused = how in ("no header", "two headers")
    file.write_bytes(changes[how]())
    accepted = not refused and how != "an open quote"
    return Call(words=IDENTIFY, spoiled=f"CSV: {how}", refused=refused, accepted=accepted)


def spoiled_bag(rng: Rng, folder: Path) -> Call:
    """A ROS 2 bag of which something is spoiled."""
    try:
        from rosbags.rosbag2 import StoragePlugin

        from tests.support.ros2_bag import EPOCH, State, write
    except ImportError:
        return same_log_twice(rng, folder)

    columns = log_columns(folder)
    how = pick(
        rng, ("bytes", "metadata", "no metadata", "no messages", "values", "joints", "valid")
    )
    states = []
    for i, t in enumerate(columns["t"]):
        position = [columns[f"qpos:{name}"][i] for name in ("slide", "hinge")]
        velocity = [columns[f"qvel:{name}"][i] for name in ("slide", "hinge")]
        effort = [columns["ctrl:force"][i], 0.0]
        names = ["slide", "hinge"]
        if how == "values" and rng.random() < 0.1:
            position[int(rng.integers(2))] = float(pick(rng, ("nan", "inf", "1e300")))
        if how == "joints" and rng.random() < 0.1:
            names, position = pick(rng, ((["slide"], position), (names, position[:1]), ([], [])))
        numbers = [np.nan_to_num(part, posinf=np.inf) for part in (velocity, effort)]
        states.append(State(EPOCH + round(1e9 * t), names, position, *numbers))
    plugin = pick(rng, (StoragePlugin.SQLITE3, StoragePlugin.MCAP))
    bag = write(folder / "bag", plugin, {"/joints": [] if how == "no messages" else states})

    file = next(path for path in bag.iterdir() if path.suffix in (".mcap", ".db3"))
    if how == "bytes":
        content, how = spoil_bytes(rng, file.read_bytes())
        file.write_bytes(content)
    elif how == "metadata":
        content, how = spoil_bytes(rng, (bag / "metadata.yaml").read_bytes())
        (bag / "metadata.yaml").write_bytes(content)
        how = f"metadata {how}"
    elif how == "no metadata":
        (bag / "metadata.yaml").unlink()
    _name_columns_of_bag(folder)
    place = "bag" if rng.random() < 0.5 else f"bag/{file.name}"
    refused = how in ("no messages", "bytes empty", "bytes random")
    return Call(words=identify(place), spoiled=f"{file.suffix}: {how}", refused=refused)


def _name_columns_of_bag(folder: Path) -> None:
    """State in the experiment file which columns of a bag are which."""
    file = folder / "study.toml"
    tables = tomllib.loads(file.read_text(encoding="utf-8"))
    names = ("slide", "hinge")
    columns = {f"qpos:{name}": f"position:{name}" for name in names}
    columns |= {f"qvel:{name}": f"velocity:{name}" for name in names}
    tables["recording"] = {"columns": {**columns, "ctrl:force": "effort:slide"}}
    write_toml(file, tables)


# Experiment files and models.


def encoded_experiment(rng: Rng, folder: Path) -> Call:
    """An experiment file in another encoding."""
    file = folder / "study.toml"
    text = file.read_text(encoding="utf-8") + "\n# ü\n"
    changes: dict[str, Callable[[], bytes]] = {
        "UTF-16": lambda: text.encode("utf-16"),
        "UTF-32": lambda: text.encode("utf-32"),
        "latin-1": lambda: text.encode("latin-1"),
        "UTF-8 with a mark": lambda: text.encode("utf-8-sig"),
        "CRLF": lambda: text.replace("\n", "\r\n").encode(),
        "CR": lambda: text.replace("\n", "\r").encode(),
        "NUL": lambda: text.encode() + b"\0",
        "a surrogate": lambda: text.encode() + b"\xed\xa0\x80",
        "JSON": lambda: json.dumps(tomllib.loads(text)).encode(),
        "a deep key": lambda: (text + ".".join("a" * 3000) + " = 1\n").encode(),
        "a deep table": lambda: (text + "x = " + "[" * 5000 + "]" * 5000 + "\n").encode(),
        "an endless text": lambda: (text + 'x = """').encode(),
        "a date": lambda: text.replace("rate = 100.0", "rate = 2020-01-01", 1).encode(),
        "another number": lambda: text.replace("rate = 100.0", "rate = 0x64", 1).encode(),
    }
    how = pick(rng, tuple(changes))
    file.write_bytes(changes[how]())
    allowed = ("UTF-8 with a mark", "CRLF", "CR", "another number")
    words = pick(rng, (CHECK, SIMULATE))
    return Call(words=words, spoiled=f"TOML: {how}", refused=how not in allowed)


# Models with files of their own; %s is the name of the file.
FILES_OF_MODELS = {
    "include": '<mujoco><include file="%s"/></mujoco>',
    "mesh": '<asset><mesh name="m" file="%s"/></asset>',
    "texture": '<asset><texture name="m" type="2d" file="%s"/></asset>',
    "height field": '<asset><hfield name="m" size="1 1 1 1" file="%s"/></asset>',
    "skin": '<asset><skin name="m" file="%s"/></asset>',
    "attached model": '<asset><model name="m" file="%s"/></asset>',
}


def model_with_files(rng: Rng, folder: Path) -> Call:
    """A model with an included file, a mesh, an image or a skin that is missing or spoiled."""
    model = folder / "cart_pendulum.xml"
    text = model.read_text(encoding="utf-8")
    what = pick(rng, tuple(FILES_OF_MODELS))
    endings = {"mesh": (".stl", ".obj", ".msh"), "skin": (".skn",), "texture": (".png",)}
    name = "part" + pick(rng, endings.get(what, (".png",) if what == "height field" else (".xml",)))
    part = folder / name
    how = pick(rng, ("missing", "empty", "random", "folder", "itself", "device", "text", "huge"))
    if how == "empty":
        part.write_bytes(b"")
    elif how == "random":
        part.write_bytes(rng.bytes(3000))
    elif how == "folder":
        part.mkdir()
    elif how == "itself":
        name = model.name
    elif how == "device":
        part.symlink_to("/dev/zero" if Path("/dev/zero").exists() else "missing")
    elif how == "text":
        part.write_text("<mujoco>\n", encoding="utf-8")
    elif how == "huge":
        # The number of triangles of a binary STL, far more than follow.
        part.write_bytes(bytes(80) + b"\xff\xff\xff\x7f" + bytes(50))
    element = FILES_OF_MODELS[what] % name
    if what == "include":
        (folder / "whole.xml").write_text(text, encoding="utf-8")
        element = f'<include file="{name}"/>'
    model.write_text(text.replace("<worldbody>", f"{element}<worldbody>", 1), encoding="utf-8")
    words = pick(rng, (CHECK, SIMULATE, IDENTIFY))
    refused = how not in ("itself",)
    return Call(words=words, spoiled=f"model: {what} {name} {how}", refused=refused)


URDF = """<robot name="r"><link name="base"/><link name="arm"><inertial><origin xyz="0.1 0 0"/>
<mass value="{mass}"/><inertia ixx="{inertia}" ixy="0" ixz="0" iyy="{inertia}" iyz="0"
izz="{inertia}"/></inertial>{visual}</link><joint name="{joint}" type="{kind}"><parent link="base"/>
<child link="{child}"/><axis xyz="{axis}"/><limit lower="-1" upper="1" effort="5" velocity="5"/>
</joint></robot>"""


def urdf_model(rng: Rng, folder: Path) -> Call:
    """A URDF as the model; it lacks what the experiment names, so that it must be refused."""
    values = {
        "mass": "1",
        "inertia": "0.01",
        "visual": "",
        "joint": "slide",
        "kind": "revolute",
        "child": "arm",
        "axis": "0 1 0",
    }
    spoiled = {
        "mass": ("-1", "nan", "", "0", "1e400"),
        "inertia": ("-1", "nan", "0", "1e300"),
        "visual": ('<visual><geometry><mesh filename="package://x/y.stl"/></geometry></visual>',),
        "joint": ("", "é", "a/b"),
        "kind": ("planar", "nonsense", ""),
        "child": ("missing", "base"),
        "axis": ("0 0 0", "x", "1 2"),
    }
    key = pick(rng, ("none", *spoiled))
    if key != "none":
        values[key] = pick(rng, spoiled[key])
    (folder / "robot.urdf").write_text(URDF.format(**values), encoding="utf-8")
    file = folder / "study.toml"
    text = file.read_text(encoding="utf-8").replace("cart_pendulum.xml", "robot.urdf")
    file.write_text(text, encoding="utf-8")
    return Call(words=CHECK, spoiled=f"URDF: {key} {values.get(key, '')!r}", refused=True)


# Files, folders and disks.


def odd_name(rng: Rng, folder: Path) -> Call:
    """Inputs and outputs with odd names; nothing else is wrong, so that they must work."""
    name = str(pick(rng, ODD_NAMES))
    is_folder = rng.random() < 0.5
    name = name if is_folder else name.replace("/", "_")
    place = folder / name if is_folder else folder
    place.mkdir(parents=True, exist_ok=True)
    prefix = f"./{name}/" if is_folder else "./"
    if is_folder:
        for file in [path for path in folder.iterdir() if path.is_file()]:
            shutil.move(file, place)
        words = ["identify", f"{prefix}study.toml", f"{prefix}run.csv", "-o", f"{prefix}out"]
        # MuJoCo takes a backslash for a separator.
        works = "\\" not in name
        return Call(
            words=words, spoiled=f"a folder {name[:20]!r}", accepted=works, refused=not works
        )

    shutil.move(folder / "study.toml", folder / f"{name}.toml")
    shutil.move(folder / "run.csv", folder / f"{name}.csv")
    words = ["identify", f"./{name}.toml", f"./{name}.csv", "-o", f"./{name} out"]
    return Call(words=words, spoiled=f"files {name[:20]!r}", accepted=True)


def odd_file(rng: Rng, folder: Path) -> Call:
    """An input that is a link, a folder, a device or missing."""
    name = str(pick(rng, ("study.toml", "cart_pendulum.xml", "cart_pendulum.csv", "run.csv")))
    name = str(pick(rng, (name, "design.npz")))
    file = folder / name
    how = pick(rng, ("link", "dangling link", "loop", "folder", "device", "unreadable", "pipe"))
    (folder / "far").mkdir()
    target = folder / "far" / name
    shutil.move(file, target)
    links = {"link": f"far/{name}", "dangling link": "missing", "loop": name, "device": "/dev/zero"}
    if how == "folder":
        file.mkdir()
    elif how == "pipe" and hasattr(os, "mkfifo"):
        os.mkfifo(file)
    elif how == "unreadable":
        shutil.copy(target, file)
        file.chmod(0)
    else:
        file.symlink_to(links.get(how, "missing"))

    readers = {
        "design.npz": (SIMULATE,),
        "run.csv": (IDENTIFY,),
        "cart_pendulum.csv": (CHECK,),
    }
    words = pick(rng, readers.get(name, (CHECK, SIMULATE, IDENTIFY)))
    refused = how not in ("link", "unreadable")
    return Call(words=words, spoiled=f"{name} is a {how}", refused=refused)


def odd_output(rng: Rng, folder: Path) -> Call:
    """An output that cannot be written, or that is something else."""
    how = pick(rng, ("file", "link to a file", "link to nothing", "link", "loop", "system", "pipe"))
    place = folder / "results"
    output = "results"
    if how == "file":
        place.write_text("of the user\n", encoding="utf-8")
    elif how == "system":
        output = "/sys/results" if rng.random() < 0.5 else "/proc/results"
    elif how == "pipe" and hasattr(os, "mkfifo"):
        os.mkfifo(place)
    elif how == "link":
        (folder / "far").mkdir()
        place.symlink_to("far")
    else:
        target = {"link to a file": "run.csv", "link to nothing": "missing"}.get(how, "results")
        place.symlink_to(target)
    words = pick(rng, WRITING_VERBS[1:3])
    fails = how in ("file", "link to a file", "loop", "system", "pipe")
    return Call(words=[*words[:-1], output], spoiled=f"output: {how}", fails=fails)


def no_home(rng: Rng, folder: Path) -> Call:
    """A home folder in which nothing can be written; nothing else is wrong."""
    words = pick(rng, (SIMULATE, IDENTIFY, CHECK))
    return Call(words=words, spoiled="no home", accepted=True, has_home=False)


def no_permission(rng: Rng, folder: Path) -> Call:
    """A user who may not write here, may not read an input, or has a home that is read-only."""
    how = pick(rng, ("nothing", "home", "current folder", "results", "input"))
    results = folder / "out"
    forbidden = {
        "home": folder / "home",
        "current folder": folder,
        "results": results,
        "input": folder / str(pick(rng, ("study.toml", "cart_pendulum.xml"))),
    }
    words = pick(rng, (IDENTIFY, CHECK, (*CHECK, "run.csv", "-o", "out"), DESIGN, MONTECARLO))
    if how == "home":
        (folder / "home").mkdir()
    if how == "results":
        results.mkdir()
    fails = how == "input" or (how in ("current folder", "results") and "-o" in words)
    return Call(
        words=words,
        spoiled=f"no permission: {how}",
        forbidden=(forbidden[how],) if how in forbidden else (),
        has_home=how != "home",
        fails=fails,
        accepted=not fails,
    )


# Rows of a log that is far too long, the memory of a call that reads it [bytes], and the time after
# which it is asked to stop [s].
LONG_ROWS, LONG_MEMORY, LONG_PATIENCE = 10_000_000, 8 << 30, 240.0


def long_log(rng: Rng, folder: Path) -> Call:
    """A log of ten million rows, of which a window of a second may be wanted."""
    columns = {}
    for name, column in log_columns(folder).items():
        columns[name] = np.resize(np.round(column, 3), LONG_ROWS)
    step = columns["t"][1] - columns["t"][0]
    columns["t"] = step * np.arange(LONG_ROWS)
    name = str(pick(rng, ("log.csv", "log.npz", "log.parquet")))
    if name == "log.npz":
        np.savez(folder / name, **columns)
    elif name == "log.csv":
        pyarrow.csv.write_csv(pyarrow.table(columns), folder / name)
    else:
        pyarrow.parquet.write_table(pyarrow.table(columns), folder / name)
    has_window = rng.random() < 0.5
    if has_window:
        with (folder / "study.toml").open("a", encoding="utf-8") as file:
            file.write("\n[recording]\nwindow = [0.0, 1.0]\n")
    words = pick(rng, (identify(name), [*CHECK, name]))
    spoiled = f"{name}: {LONG_ROWS} rows{', a window of 1 s' if has_window else ''}"
    return Call(words=words, spoiled=spoiled, memory=LONG_MEMORY, patience=LONG_PATIENCE)


def full_disk(rng: Rng, folder: Path) -> Call:
    """A disk that is full after some bytes of a file."""
    words = pick(rng, (SIMULATE, IDENTIFY, DESIGN, MONTECARLO))
    room = int(rng.choice([0, 100, 4000, 30_000, 100_000]))
    spoiled = f"files of at most {room} bytes"
    return Call(words=words, spoiled=spoiled, room=room, fails=room <= 4000)


# What is spoiled, with the share of the cases.
FAULTS: tuple[tuple[Callable[[Rng, Path], Call], float], ...] = (
    (infinite_number_in_model, 0.05),
    (same_log_twice, 0.05),
    (packed_bomb, 0.04),
    (no_home, 0.02),
    (two_faults, 0.17),
    (encoded_log, 0.06),
    (spoiled_bag, 0.07),
    (encoded_experiment, 0.06),
    (model_with_files, 0.08),
    (urdf_model, 0.03),
    (odd_name, 0.04),
    (odd_file, 0.05),
    (odd_output, 0.05),
    (full_disk, 0.02),
)
