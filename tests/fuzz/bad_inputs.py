"""Bad inputs: a valid study of which one thing, or two, are spoiled at random."""

from __future__ import annotations

import functools
import gzip
import io
import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pyarrow
import pyarrow.csv
import pyarrow.parquet
import scipy.io

Rng = np.random.Generator
Key = tuple[Any, ...]
Rows = list[list[str]]
Tables = dict[str, Any]

# What was spoiled, in words, and whether nothing but a refusal is right.
Spoiled = tuple[str, bool]

# Calls of verbs with the files of the study.
CHECK = ("check", "study.toml", "--threads", "1")
DESIGN = ("design", "study.toml", "-o", "out", "--threads", "1")
SIMULATE = ("simulate", "study.toml", "design.npz", "-o", "new.csv")
IDENTIFY = ("identify", "study.toml", "run.csv", "-o", "out", "--threads", "1")
MONTECARLO = ("montecarlo", "study.toml", "design.npz", "--trials", "2", "-o", "out")
REPLAY = ("replay", "design.npz", "--experiment", "study.toml", "--save", "new.rrd")
EXPERIMENT_VERBS = (CHECK, DESIGN, SIMULATE, SIMULATE, IDENTIFY)
DESIGN_VERBS = (SIMULATE, (*CHECK, "--design", "design.npz"), MONTECARLO, REPLAY)
WRITING_VERBS = (
    SIMULATE,
    (*CHECK, "-o", "out"),
    (*IDENTIFY[:3], *IDENTIFY[5:], "-o", "out"),
    REPLAY,
    MONTECARLO,
)

# Numbers that no key expects.
EXTREMES = (
    1e300,
    -1e300,
    5e-324,
    float("nan"),
    float("inf"),
    float("-inf"),
    0,
    -1,
    -1e-9,
    1e18,
    10**18,
    10**30,
    -(10**18),
    1e-300,
)

# Values of a type that a number does not have.
WRONG_TYPES = ("text", "", "1.0", True, [], [1.0], ["x"], {}, {"x": 1.0})

# A long text and a long list, a list inside a list and so on, and a large table.
HUGE = (
    "x" * 100_000,
    [0.5] * 20_000,
    functools.reduce(lambda inner, _: [inner], range(200), []),
    {f"k{i}": 1.0 for i in range(5000)},
)

# Tables whose keys are names that the user or the model chooses.
TABLES_BY_NAME = ("parameters", "noise", "position", "velocity", "control", "tracking", "columns")

# Tables that the study of the paper does not state, so that their keys are spoiled too.
FURTHER_TABLES = {
    "limits": {
        "position": {"slide": [-2.0, 2.0]},
        "velocity": 30.0,
        "control": {"force": [-5.0, 5.0]},
        "control_rate": 1000.0,
        "enforce": True,
    },
    "boundary": {"start": "given", "end": "free", "position": 0.01, "velocity": 0.02},
    "fit": {
        "segments": 0.5,
        "start": "stated",
        "loss": "huber",
        "loss_scale": 3.0,
        "noise": "stated",
        "starts": 1,
        "max_iterations": 10,
        "bootstrap": 20,
        "blocks": 0.1,
        "seed": 0,
    },
    "nuisance": {"initial": 0.01, "bias": 0.01, "delay": 0.01},
    "recording": {"time": "t", "time_unit": "s", "gap": 0.1, "window": [0.0, 0.9]},
    "robust": {"over": "mean", "samples": 2, "seed": 0},
}


@dataclass(kw_only=True)
class Call:
    """A call of the command line.

    Attributes:
        words: Its words.
        spoiled: What was spoiled, in words.
        refused: True if nothing but a refusal (exit code 2) is right.
        fails: True if exit code 0 is wrong.
        accepted: True if a refusal is wrong.
        room: Largest size of a file that can be written [bytes]; None for no limit.
        has_home: False where the home folder cannot be used; it is `home` where that exists.
        forbidden: Folders in which the call may not write, and files that it may not read.
        memory: Memory that the call may use [bytes]; None for that of the suite.
        patience: Time after which the call is asked to stop, in place of an end of the case [s].
    """

    words: Sequence[str]
    spoiled: str
    refused: bool = False
    fails: bool = False
    accepted: bool = False
    room: int | None = None
    has_home: bool = True
    forbidden: tuple[Path, ...] = ()
    memory: int | None = None
    patience: float | None = None


def toml_of(value: Any) -> str:
    """A value as TOML, tables inline."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, Mapping):
        inside = ", ".join(f"{json.dumps(k)} = {toml_of(v)}" for k, v in value.items())
        return f"{{ {inside} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(toml_of(item) for item in value)}]"
    return repr(value)


def write_toml(path: Path, tables: Mapping[str, Any]) -> None:
    """Write an experiment file, one line per key of the top level."""
    lines = [f"{json.dumps(key)} = {toml_of(value)}\n" for key, value in tables.items()]
    path.write_text("".join(lines), encoding="utf-8")


def leaves(value: Any, path: Key = ()) -> list[Key]:
    """Paths of everything inside a value: tables, items of lists and leaves."""
    if isinstance(value, dict):
        items = list(value.items())
    elif isinstance(value, list):
        items = list(enumerate(value))
    else:
        items = []
    found = [(*path, key) for key, _ in items]
    for key, inner in items:
        found += leaves(inner, (*path, key))
    return found


def at(value: Any, path: Key) -> Any:
    for key in path:
        value = value[key]
    return value


def pick(rng: Rng, choices: Any) -> Any:
    """One of several things of any type."""
    return choices[int(rng.integers(len(choices)))]


def spoil_bytes(rng: Rng, content: bytes) -> tuple[bytes, str]:
    """Spoil the content of a file without a look at what it says."""
    place = int(rng.integers(max(len(content), 1)))
    flipped = bytearray(content)
    for i in rng.integers(len(content), size=5).tolist():
        flipped[i] ^= int(rng.integers(1, 256))
    results = {
        "cut": content[:place],
        "flipped": bytes(flipped),
        "empty": b"",
        "not UTF-8": content[:place] + b"\xff\xfe\x80" + content[place:],
        "NUL": content[:place] + b"\x00" + content[place:],
        "repeated": content + content,
        "random": rng.bytes(2000),
    }
    name = pick(rng, tuple(results))
    return results[name], f"bytes {name}"


# The experiment file.


def spoiled_experiment(rng: Rng, folder: Path) -> Call:
    """Spoil the experiment file, and give it to a verb."""
    file = folder / "study.toml"
    tables = tomllib.loads(file.read_text(encoding="utf-8"))
    for name, table in FURTHER_TABLES.items():
        if rng.random() < 0.4:
            tables[name] = json.loads(json.dumps(table))
    write_toml(file, tables)

    spoil = pick(rng, (None, None, _remove, _rename, *(_replace,) * 5))
    if spoil is not None:
        spoiled, refused = spoil(rng, tables)
        write_toml(file, tables)
    elif rng.random() < 0.5:
        content, spoiled = spoil_bytes(rng, file.read_bytes())
        file.write_bytes(content)
        refused = False
    else:
        lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
        line = pick(rng, lines)
        file.write_text("".join([*lines, line]), encoding="utf-8")
        spoiled, refused = f"{line.split(' =')[0]} stated twice", True
    words = pick(rng, EXPERIMENT_VERBS)
    return Call(words=words, spoiled=f"experiment: {spoiled}", refused=refused)


def _remove(rng: Rng, tables: Tables) -> Spoiled:
    """Remove a key."""
    path = pick(rng, leaves(tables))
    del at(tables, path[:-1])[path[-1]]
    return f"{path} removed", path in (("model",), ("rate",), ("parameters",))


def _rename(rng: Rng, tables: Tables) -> Spoiled:
    """Rename a key."""
    path = pick(rng, [p for p in leaves(tables) if isinstance(p[-1], str)])
    table = at(tables, path[:-1])
    new = pick(rng, (f"{path[-1]}s", path[-1].upper(), "", " ", "ü", "x" * 2000))
    table[new] = table.pop(path[-1])
    by_name = len(path) > 1 and path[-2] in TABLES_BY_NAME
    return f"{path} renamed to {new[:20]!r}", not by_name and new != path[-1]


def _replace(rng: Rng, tables: Tables) -> Spoiled:
    """Replace a number by an extreme one, or a value by one of another type or a huge one."""
    values = pick(rng, (EXTREMES, EXTREMES, WRONG_TYPES, WRONG_TYPES, HUGE))
    paths = leaves(tables)
    numbers = [path for path in paths if type(at(tables, path)) in (int, float)]
    path, value = pick(rng, numbers if values is EXTREMES else paths), pick(rng, values)
    at(tables, path[:-1])[path[-1]] = value
    refused = value != value or (path in numbers and isinstance(value, str | bool))
    return f"{path} = {repr(value)[:30]}", refused


# The model.

MODEL_VALUES = (
    "nan",
    "inf",
    "1e300",
    "-1e300",
    "5e-324",
    "0",
    "-1",
    "",
    "text",
    "1 2 3 4 5 6 7 8 9",
    "99999999999999999999",
    "../../x",
)

# Attributes of the model that take part in its motion.
MOVING = ("mass", "timestep", "damping", "gravity", "qpos", "diaginertia")


URDF = """<robot name="r"><link name="base"/><link name="arm"><inertial><origin xyz="0.1 0 0"/>
<mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>
</link><joint name="slide" type="revolute"><parent link="base"/><child link="arm"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="5" velocity="5"/></joint></robot>"""


def spoiled_model(rng: Rng, folder: Path) -> Call:
    """Spoil the MJCF, or give a URDF, which lacks what the experiment names."""
    file = folder / "cart_pendulum.xml"
    text, refused = file.read_text(encoding="utf-8"), False
    is_urdf = rng.random() < 0.1
    if is_urdf:
        text, file = URDF, folder / "robot.urdf"
        experiment = folder / "study.toml"
        stated = experiment.read_text(encoding="utf-8").replace("cart_pendulum.xml", file.name)
        experiment.write_text(stated, encoding="utf-8")
    if rng.random() < 0.2:
        content, spoiled = spoil_bytes(rng, text.encode())
    else:
        tree = ElementTree.fromstring(text)
        spoil = pick(rng, (_set_attribute, _set_attribute, _set_attribute, _change_element))
        spoiled, refused = spoil(rng, tree)
        content = ElementTree.tostring(tree)
    if not is_urdf and rng.random() < 0.2:
        (folder / "inner.xml").write_bytes(content)
        content, spoiled = b'<mujoco><include file="inner.xml"/></mujoco>', f"included, {spoiled}"
    file.write_bytes(content)
    words = pick(rng, EXPERIMENT_VERBS)
    return Call(words=words, spoiled=f"{file.name}: {spoiled}", refused=refused or is_urdf)


def _set_attribute(rng: Rng, tree: ElementTree.Element) -> Spoiled:
    """Give an attribute a bad value, or remove it."""
    element = pick(rng, [e for e in tree.iter() if e.attrib])
    name = pick(rng, sorted(element.attrib))
    if rng.random() < 0.15:
        del element.attrib[name]
        return f"{element.tag} without {name}", False
    value = pick(rng, MODEL_VALUES)
    element.set(name, value)
    return f"{element.tag} {name}={value!r}", value == "nan" and name in MOVING


def _change_element(rng: Rng, tree: ElementTree.Element) -> Spoiled:
    """Remove, double, rename or multiply an element, or nest it deeply."""
    parents = [e for e in tree.iter() if len(e)]
    parent = pick(rng, parents)
    child = pick(rng, list(parent))
    name = pick(rng, ("removed", "doubled", "renamed", "emptied", "nested", "included"))
    if name == "removed":
        parent.remove(child)
    elif name == "doubled":
        parent.append(child)
    elif name == "renamed":
        child.tag = "nonsense"
    elif name == "emptied":
        child.clear()
    elif name == "nested":
        for _ in range(300):
            inner = ElementTree.Element(child.tag)
            inner.append(child)
            child = inner
        parent.append(child)
    else:
        parent.append(ElementTree.Element("include", {"file": "cart_pendulum.xml"}))
    return f"{child.tag} {name}", False


# Recordings.


def spoiled_recording(rng: Rng, folder: Path) -> Call:
    """Spoil the recording, in one of the formats that are read."""
    rows = rows_of(folder)
    spoil = pick(
        rng,
        (
            *(_ragged, _bad_cell, _bad_cell, _columns, _columns, odd_times, few_rows, _booleans),
            *(odd_numbers, odd_numbers, None, None),
        ),
    )
    spoiled, refused = ("intact", False) if spoil is None else spoil(rng, rows)
    names = ["log.csv", "log.csv", "log.csv.gz"]
    if len({len(row) for row in rows}) == 1:
        names.append("log.parquet")
        # The names of the columns of other formats differ.
        names += ["log.npz", "log.json"] if len(set(rows[0])) == len(rows[0]) else []
    if spoil is None:
        names += ["log.npy", "log.mat", "log.jsonl"]
    name = pick(rng, names)
    content, is_spoiled = in_format(name, rows), spoil is None and rng.random() < 0.5
    if is_spoiled:
        content, spoiled = spoil_bytes(rng, content)
        refused = spoiled in ("bytes empty", "bytes random")
    (folder / name).write_bytes(content)

    words = (*IDENTIFY[:2], name, *IDENTIFY[3:]) if rng.random() < 0.9 else (*CHECK, name)
    accepted = spoil is None and not is_spoiled
    spoiled = f"recording {name}: {spoiled}"
    return Call(words=words, spoiled=spoiled, refused=refused, accepted=accepted)


def rows_of(folder: Path) -> Rows:
    """The header and the rows of the recording of the study."""
    lines = (folder / "run.csv").read_text(encoding="utf-8").splitlines()
    return [[cell.strip('"') for cell in line.split(",")] for line in lines]


def in_format(name: str, rows: Rows) -> bytes:
    """A table in the format of a file name."""
    text = "\n".join(",".join(row) for row in rows) + "\n"
    if name.endswith(".csv"):
        return text.encode()
    if name.endswith(".gz"):
        return gzip.compress(text.encode(), mtime=0)

    header, stream = rows[0], io.BytesIO()
    columns = [_column([row[i] for row in rows[1:]]) for i in range(len(header))]
    named = {key or "x": np.array(column) for key, column in zip(header, columns, strict=True)}
    if name.endswith(".npz"):
        np.savez(stream, **named)
    elif name.endswith(".npy"):
        np.save(stream, np.rec.fromarrays(columns, names=header))
    elif name.endswith(".mat"):
        scipy.io.savemat(stream, named)
    elif name.endswith(".parquet"):
        table = pyarrow.Table.from_arrays([*map(pyarrow.array, columns)], names=header)
        pyarrow.parquet.write_table(table, stream)
    else:
        records = [dict(zip(header, row, strict=True)) for row in zip(*columns, strict=True)]
        if name.endswith(".jsonl"):
            return "\n".join(map(json.dumps, records)).encode()
        return json.dumps(records).encode()
    return stream.getvalue()


def _column(cells: list[str]) -> list[Any]:
    """Cells as numbers, booleans or text; an empty cell is NaN."""
    if set(cells) <= {"true", "false"}:
        return [cell == "true" for cell in cells]
    try:
        return [float(cell or "nan") for cell in cells]
    except ValueError:
        return cells


def _ragged(rng: Rng, rows: Rows) -> Spoiled:
    """Make a row longer or shorter."""
    i = int(rng.integers(1, len(rows)))
    if rng.random() < 0.5:
        rows[i].append("1.0")
    else:
        rows[i].pop()
    return f"row {i} has {len(rows[i])} fields", True


def _bad_cell(rng: Rng, rows: Rows) -> Spoiled:
    """Spoil one field."""
    i, j = int(rng.integers(1, len(rows))), int(rng.integers(len(rows[0])))
    values = ("nan", "", "text", "1e300", "-1e300", "inf", "1,5", "1 2", "=1+1", "9" * 5000)
    rows[i][j] = pick(rng, values)
    refused = rows[i][j] in ("text", "1 2", "=1+1")
    return f"row {i}, column {rows[0][j]}: {rows[i][j][:20]!r}", refused


def _columns(rng: Rng, rows: Rows) -> Spoiled:
    """Remove, double, rename or swap columns."""
    j = int(rng.integers(len(rows[0])))
    title = rows[0][j]
    name = pick(rng, ("removed", "doubled", "renamed", "emptied", "unnamed", "many"))
    for i, row in enumerate(rows):
        if name == "removed":
            del row[j]
        elif name == "doubled":
            row.append(row[j])
        elif name == "emptied" and i:
            row[j] = ""
        elif name == "many":
            row += [f"c{k}" if i == 0 else "0.0" for k in range(2000)]
    if name == "renamed":
        rows[0][j] = "nonsense"
    elif name == "unnamed":
        rows[0][j] = ""
    necessary = title == "t" or title.startswith("ctrl:")
    refused = name == "doubled" or (name in ("removed", "renamed", "unnamed") and necessary)
    return f"column {title} {name}", refused


def odd_times(rng: Rng, rows: Rows) -> Spoiled:
    """Spoil the times."""
    times = [float(row[0]) for row in rows[1:]]
    changed = {
        "shuffled": rng.permutation(times).tolist(),
        "equal": [1.0] * len(times),
        "reversed": times[::-1],
        "negative": [-t for t in times],
        "huge": [1e300 * t for t in times],
        "a gap": [t + 100.0 * (t > 0.5) for t in times],
        "text": [f"12:00:{t}" for t in times],
        "tiny": [5e-324 * k for k in range(len(times))],
    }
    name = pick(rng, tuple(changed))
    for row, value in zip(rows[1:], changed[name], strict=True):
        row[0] = str(value)
    return f"times {name}", name in ("equal", "text")


def few_rows(rng: Rng, rows: Rows) -> Spoiled:
    count = int(rng.integers(4))
    del rows[1 + count :]
    return f"{count} rows", count < 2


def _booleans(rng: Rng, rows: Rows) -> Spoiled:
    """Make a column one of truth values."""
    j = int(rng.integers(1, len(rows[0])))
    for row in rows[1:]:
        row[j] = str(bool(rng.random() < 0.5)).lower()
    # A control may be switched on and off; a measurement is a number.
    return f"column {rows[0][j]} of truth values", not rows[0][j].startswith("ctrl:")


def odd_numbers(rng: Rng, rows: Rows) -> Spoiled:
    """Write an odd number into some rows of a column or of all columns."""
    count = len(rows[0])
    columns = [int(rng.integers(count))] if rng.random() < 0.7 else list(range(count))
    value = pick(rng, ("inf", "-inf", "nan", "1e300", "1e-300", "1e160", "0"))
    share, certain = rng.choice([0.01, 0.3, 1.0]), int(rng.integers(1, len(rows) - 1))
    for i, row in enumerate(rows[1:], start=1):
        for j in columns:
            if i == certain or rng.random() < share:
                row[j] = value
    necessary = any(rows[0][j] in ("t", "ctrl:force") for j in columns)
    return f"{value} in {len(columns)} columns", value.endswith("inf") and necessary


# Designs.


def spoiled_design(rng: Rng, folder: Path) -> Call:
    """Spoil the design.npz."""
    file = folder / "design.npz"
    if rng.random() < 0.3:
        content, spoiled = spoil_bytes(rng, file.read_bytes())
        file.write_bytes(content)
        refused = spoiled in ("bytes empty", "bytes random")
    else:
        spoiled, refused = _spoil_array(rng, file)

    words = pick(rng, DESIGN_VERBS)
    return Call(words=words, spoiled=f"design: {spoiled}", refused=refused)


def _spoil_array(rng: Rng, file: Path) -> Spoiled:
    with np.load(file, allow_pickle=False) as loaded:
        arrays = {name: loaded[name] for name in loaded.files}
    name = pick(rng, ["t", "qpos", "qvel", "ctrl", *sorted(arrays)])
    array = arrays[name]
    changes = {
        "shorter": array[:-1] if array.ndim else array,
        "flat": array.ravel()[:1],
        "NaN": np.full(array.shape, np.nan),
        "infinite": np.full(array.shape, np.inf),
        "text": np.full(array.shape, "text"),
        "pickle": np.array([{"a": 1}], dtype=object),
        "equal": np.zeros(array.shape),
        "reversed": array[::-1] if array.ndim else array,
    }
    how = pick(rng, ("removed", "npy", *changes))
    if how == "npy":
        with file.open("wb") as stream:
            np.save(stream, np.zeros(3))
        return "npy under the name npz", True
    if how == "removed":
        del arrays[name]
    else:
        arrays[name] = changes[how]
    np.savez(file, **arrays)

    necessary = name in ("t", "qpos", "ctrl")
    always = ("removed", "shorter", "flat", "NaN", "infinite", "text", "pickle")
    refused = necessary and (how in always or (name == "t" and how in ("equal", "reversed")))
    return f"array {name} {how}", refused
