"""Logs as other programs write them: each format and each fault, with exact values.

The headers are those of PlotJuggler, `rostopic echo -p`, UR RTDE, MATLAB, LabVIEW, Excel, NumPy,
pandas, Isaac Lab and SAGE.
"""

from __future__ import annotations

import gzip
import io
import struct
import tomllib
import zipfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
import scipy.io
from numpy.typing import NDArray

from mjfim.errors import RecordingError, RecordingWarning
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.model.coordinates import measurable_columns
from mjfim.recordings.channels import Channels
from mjfim.recordings.formats import read_columns
from mjfim.recordings.proposal import proposed_recording
from mjfim.recordings.read import LogSummary, read_log
from mjfim.recordings.section import RecordingSpec
from mjfim.records.trajectory import Recording

Array = NDArray[np.float64]

M = 200
T = np.arange(M) * 0.01
Q = np.round(0.5 * np.sin(3.0 * T), 6)
U = np.round(np.cos(2.0 * T), 6)

# The time at which a log was recorded [ns].
EPOCH = 1_714_564_800_000_000_123

PENDULUM = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.1" limited="true" range="-1 1"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""

# A recording, and the summary of the log from which it was read.
Logged = tuple[Recording, LogSummary]
Read = Callable[..., Logged]


def rows(*columns: Iterable[Any], head: str = "", between: str = ",", end: str = "\n") -> str:
    """Text of a table: a header and a line for each row."""
    lines = (between.join(str(cell) for cell in row) for row in zip(*columns, strict=True))
    return end.join([*([head] if head else []), *lines, ""])


def commas(column: Array) -> list[str]:
    """Numbers with decimal commas."""
    return [str(float(x)).replace(".", ",") for x in column]


def stamps(zone: str = "") -> list[str]:
    """Times of a calendar (ISO 8601), which pass midnight."""
    begin = np.datetime64("2024-05-01T23:59:59.500000")
    return [f"{begin + np.timedelta64(round(1e6 * t), 'us')}{zone}" for t in T]


NAMED = {"qpos:hinge": "q", "ctrl:motor": "u"}
BY_PLACE = {"time": "[0]", "columns": {"qpos:hinge": "[1]", "ctrl:motor": "[2]"}}
DEGREES = np.degrees(Q)
ROSTOPIC = (
    "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.name0,"
    "field.position0,field.effort0"
)

SAGE = "type,timestamp,positions"

TWO_UNITS = rows(T, DEGREES, Q, U, head="t,q [deg],q [rad],u")
WRONG_UNIT = rows(T, DEGREES, U, head="t,q [deg/s],u")

# Texts of logs with the columns t, q and u.
NAMED_TEXTS: dict[str, str] = {
    "semicolon": rows(T, Q, U, head="t;q;u", between=";"),
    "decimal comma": rows(*map(commas, (T, Q, U)), head="sep=;\r\nt;q;u", between=";", end="\r\n"),
    "tab": rows(*map(commas, (T, Q, U)), head="t\tq\tu", between="\t"),
    "quoted decimal comma": rows(*([f'"{x}"' for x in commas(c)] for c in (T, Q, U)), head="t,q,u"),
    "commented header (NumPy)": rows(T, Q, U, head="# robot 3\n# t q u", between=" "),
    "comments before the header": rows(
        T, Q, U, head="# robot: xl330\n% 100 Hz, indoors\n// run 3\n\nt,q,u"
    ),
    "comments between rows": rows(T, Q, U, head="t,q,u").replace(
        "\n0.5,", "\n# gripper, closed\n0.5,"
    )
    + "# a long end\n" * 10_000,
    "units in the header": rows(1e3 * T, DEGREES, 1e3 * U, head="t [ms],q (deg),u [mNm]"),
    "row of units": rows(T, DEGREES, U, ["run"] * M, head="t;q;u;mode\ns;°;N·m;-", between=";"),
    "spaces around names": rows(T, Q, U, head=" t , q ,u ", between=" , "),
    "delimiter at the ends": rows(T, Q, U, [""] * M, head="t;q;u", between=";"),
    "index (pandas)": rows(range(M), T, Q, U, head=",t,q,u"),
    "calendar": rows(stamps(), Q, U, head="t,q,u"),
    "calendar with a zone": rows(stamps("Z"), Q, U, head="t,q,u"),
    "clock that passes midnight": rows((s[11:] for s in stamps()), Q, U, head="t,q,u"),
    "clock with a comma": rows(
        (s[11:].replace(".", ",") for s in stamps()), Q, U, head="t;q;u", between=";"
    ),
}

# Text of a log, and the table [recording] that reads it.
TEXTS: dict[str, tuple[str, dict[str, Any]]] = {
    **{case: (text, {"columns": NAMED}) for case, text in NAMED_TEXTS.items()},
    "aligned spaces without a header (MATLAB -ascii)": (
        "".join(f"  {t: .7e}  {q: .16e}  {u: .16e}\n" for t, q, u in zip(T, Q, U, strict=True)),
        BY_PLACE,
    ),
    "rostopic echo -p": (
        rows(
            [EPOCH + 10_000_000 * i for i in range(M)],
            range(M),
            [EPOCH + 10_000_000 * i for i in range(M)],
            ["base"] * M,
            ["hinge"] * M,
            Q,
            U,
            head=ROSTOPIC,
        ),
        {
            "time": "%time",
            "time_unit": "ns",
            "columns": {"qpos:hinge": "field.position0", "ctrl:motor": "field.effort0"},
        },
    ),
    **{
        f"a sign beside the unit of a title, {scale:.2g}": (
            rows(T, -DEGREES, U, head="t,q [deg],u"),
            {"columns": NAMED | {"qpos:hinge": {"column": "q", "scale": scale}}},
        )
        for scale in (-1.0, -np.pi / 180.0)
    },
    **{
        f"columns that differ in their units alone, {title}": (
            TWO_UNITS,
            {"columns": NAMED | {"qpos:hinge": title}},
        )
        for title in ("q [deg]", "q [rad]")
    },
    "a unit stated beside a wrong title": (
        WRONG_UNIT,
        {"columns": NAMED | {"qpos:hinge": {"column": "q", "unit": "deg"}}},
    ),
}


@pytest.fixture
def read(tmp_path: Path) -> Read:
    """Read a file of the pendulum by a table [recording]."""

    def run(name: str, content: bytes | None = None, **recording: Any) -> Logged:
        path = tmp_path / name
        if content is not None:
            path.write_bytes(content)
        (tmp_path / "pendulum.xml").write_text(PENDULUM, encoding="utf-8")
        experiment = Experiment(
            model="pendulum.xml",
            rate=100.0,
            horizon=1.0,
            parameters={"damping": {"target": "joint/hinge:damping"}},
            noise={"state": 0.01},
            recording=recording,
            directory=tmp_path,
        )
        return read_log(path, System.resolve(experiment).channels)

    return run


def is_whole(log: Logged, tolerance: float = 0.0) -> bool:
    """Whether a log has the times, positions and controls of the pendulum."""
    recording = log[0]
    return (
        recording.outputs == ("qpos:hinge",)
        and np.allclose(recording.t, T, rtol=0, atol=1e-9)
        and np.allclose(recording.y[:, 0], Q, rtol=tolerance, atol=0)
        and np.allclose(recording.ctrl[:, 0], U[:-1], rtol=tolerance, atol=0)
    )


@pytest.mark.parametrize("case", TEXTS)
@pytest.mark.parametrize("ending", [".csv", ".txt.gz"])
def test_text(case: str, ending: str, read: Read) -> None:
    text, recording = TEXTS[case]
    content = text.encode()
    packed = gzip.compress(content, mtime=0) if ending.endswith(".gz") else content
    assert is_whole(read(f"log{ending}", packed, **recording), tolerance=1e-14)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
def test_encodings(encoding: str, read: Read) -> None:
    text = rows(T, DEGREES, U, head="t;q [°];u", between=";")
    mark = "\ufeff" if encoding.endswith(("le", "be")) else ""
    content = f"{mark}{text}".encode(encoding)
    assert is_whole(read("log.csv", content, columns=NAMED), tolerance=1e-14)


def test_tables_of_one_clock(tmp_path: Path, read: Read) -> None:
    """A folder with a table of commands and one of states, as SAGE writes it."""
    folder = tmp_path / "chirp"
    folder.mkdir()
    stamp = 1e6 * T + 4.956964403390884
    for name, text in {
        "control": rows(["CONTROL"] * M, stamp, (f'"[{u}]"' for u in U), head=SAGE),
        "state_motor": rows(["STATE"] * M, stamp, (f'"[{q}, 7]"' for q in Q), head=SAGE),
        "event": rows(["EVENT"] * 2, [0, 7e6], ["START", "STOP"], head="type,timestamp,event"),
    }.items():
        (folder / f"{name}.csv.gz").write_bytes(gzip.compress(text.encode(), mtime=0))
    (folder / "joint_list.md").write_text("hinge", encoding="utf-8")
    with pytest.raises(RecordingError, match="column 't' is missing") as refused:
        read("chirp")
    proposed = tomllib.loads(str(refused.value).partition("\n")[2])["recording"]
    command = {"ctrl:motor": "control:positions[0]"}
    assert proposed == {"time": "timestamp", "time_unit": "us", "columns": command}
    columns = {**command, "qpos:hinge": "state_motor:positions[0]"}
    assert is_whole(read("chirp", **{**proposed, "columns": columns}))


# ---- what is left out


def sparse_rows(*topics: tuple[Array, Array]) -> str:
    """One row for each message of some topics, sorted by time; other cells are empty."""
    found = sorted(
        (t, i, value)
        for i, (times, values) in enumerate(topics)
        for t, value in zip(times.tolist(), values.tolist(), strict=True)
    )
    cells = [[value if j == i else "" for _, j, value in found] for i in range(len(topics))]
    return rows([t for t, _, _ in found], *cells, head=HEAD)


PLOTJUGGLER = {
    "time": "__time",
    "columns": {
        "qpos:hinge": "/joint_states/hinge/position",
        "ctrl:motor": "/command/data[0]",
    },
}
HEAD = "__time,/joint_states/hinge/position,/command/data[0]"


def test_messages_of_one_time_are_one_row(read: Read) -> None:
    """PlotJuggler: one topic in each row, also where their times are equal."""
    text = sparse_rows((T, Q), (T, U))
    assert text.count("\n") == 2 * M + 1
    log = read("log.csv", text.encode(), **PLOTJUGGLER)
    assert is_whole(log) and log[1].dropped == 0


def test_a_topic_that_begins_later(read: Read) -> None:
    """Rows before the first command are left out and counted, if it is one period late at most."""
    text = sparse_rows((T, Q), (T[::2] + 0.013, U[::2]))
    with pytest.warns(
        RecordingWarning, match=r"rows left out: 2 before the first value of a control"
    ):
        log = read("log.csv", text.encode(), **PLOTJUGGLER)
    recording = log[0]
    assert (recording.ctrl[0, 0], log[1].dropped) == (U[0], 2)
    assert np.array_equal(recording.y[np.isfinite(recording.y)], Q[2:])
    assert recording.t[np.isfinite(recording.y[:, 0])][0] == pytest.approx(0.02 - 0.013)

    late = sparse_rows((T, Q), (T[::2] + 0.053, U[::2]))
    with pytest.raises(
        RecordingError, match=r"no value in the first row; it begins 0\.053 s later"
    ):
        read("log.csv", late.encode(), **PLOTJUGGLER)


@pytest.mark.parametrize(
    "changes",
    [{7: T[6]}, {7: T[5] + 0.001}, {7: 1e3}, {7: T[6], 150: T[20]}],
    ids=["repeated", "too early", "too late", "two of them"],
)
def test_a_few_stamps_out_of_order(changes: dict[int, float], read: Read) -> None:
    t, left = np.array(T), [*changes]
    t[left] = [*changes.values()]
    text = rows(t, Q, U, head="t,q,u")
    said = rf"log\.csv: rows left out: {len(left)} whose time"
    with pytest.warns(RecordingWarning, match=said):
        log = read("log.csv", text.encode(), columns=NAMED)
    assert log[1].dropped == len(left)
    found = log[0]
    assert np.array_equal([found.t, found.y[:, 0]], np.delete([T, Q], left, axis=1))
    assert np.array_equal(found.ctrl[:, 0], np.delete(U[:-1], left))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (WRONG_UNIT, r"title of column 'q' says deg/s, but 'qpos:hinge' is in rad"),
        (TWO_UNITS, r"'q' is missing; found: t, q \[deg\], q \[rad\], u"),
    ],
)
def test_titles_whose_unit_is_not_clear(text: str, said: str, read: Read) -> None:
    with pytest.raises(RecordingError, match=said):
        read("log.csv", text.encode(), columns=NAMED)


WORDS = ("NaN", ".nan", "", "None", "-nan(ind)", "--", " NaN", "  ", "NaN ")


@pytest.mark.parametrize("word", WORDS)
def test_missing_numbers(word: str, read: Read) -> None:
    text = rows(T, [word if i == 50 else q for i, q in enumerate(Q)], U, head="t,q,u")
    recording = read("log.csv", text.encode(), columns=NAMED)[0]
    assert np.flatnonzero(np.isnan(recording.y[:, 0])).tolist() == [50]


# ---- other formats


def test_stamps_of_parquet_and_npz(tmp_path: Path, read: Read) -> None:
    """Times of a calendar as pandas and NumPy keep them."""
    times = np.array(stamps(), dtype="datetime64[ns]")
    table = pyarrow.table({"t": times, "q": Q, "u": U})
    pyarrow.parquet.write_table(table, tmp_path / "log.parquet")
    np.savez(tmp_path / "log.npz", t=times, q=Q, u=U)
    for name in ("log.parquet", "log.npz"):
        assert is_whole(read(name, columns=NAMED))


@pytest.mark.parametrize("structure", [False, True])
def test_matlab(structure: bool, tmp_path: Path, read: Read) -> None:
    """Columns and rows of numbers, matrices that lie on their side, and structures."""
    contents = {"t": T[:, None], "q": np.array([Q, 7 + Q]), "u": U[None, :], "note": "run 3"}
    scipy.io.savemat(tmp_path / "log.mat", {"run": contents} if structure else contents)
    prefix = "run." if structure else ""
    columns = {"qpos:hinge": f"{prefix}q[0]", "ctrl:motor": f"{prefix}u"}
    assert is_whole(read("log.mat", time=f"{prefix}t", columns=columns))


def test_matlab_hdf5_is_refused(read: Read) -> None:
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    with pytest.raises(RecordingError, match=r"log\.mat: not a readable MATLAB .*'-v7'"):
        read("log.mat", head + bytes(512), columns=NAMED)


def test_npy(tmp_path: Path, read: Read) -> None:
    """A matrix has columns by place; no object is unpickled."""
    np.save(tmp_path / "log.npy", np.column_stack([T, Q, U]))
    assert is_whole(read("log.npy", **BY_PLACE))
    np.save(tmp_path / "log.npy", np.array([{}]), allow_pickle=True)
    with pytest.raises(RecordingError, match=r"log\.npy: not a readable array"):
        read("log.npy", columns=NAMED)


# ---- tables of tensors


def text(value: str) -> bytes:
    """A text in a pickle."""
    return b"X" + struct.pack("<I", len(value.encode())) + value.encode()


def number(value: int) -> bytes:
    """An integer in a pickle."""
    return b"J" + struct.pack("<i", value)


def tensor(key: str, shape: Sequence[int], strides: Sequence[int], offset: int = 0) -> bytes:
    """A tensor in a pickle, as torch 2 writes it."""
    storage = text("storage") + b"ctorch\nDoubleStorage\n" + text(key) + text("cpu") + number(9999)
    return (
        b"ctorch._utils\n_rebuild_tensor_v2\n((" + storage + b"tQ" + number(offset)
        + b"(" + b"".join(map(number, shape)) + b"t("
        + b"".join(map(number, strides)) + b"t\x89ccollections\nOrderedDict\n)RtR"
    )  # fmt: skip


def torch_archive(table: bytes, packed: int = zipfile.ZIP_STORED) -> bytes:
    """An archive of a table of tensors whose storages are T, and the columns of Q and U."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", packed) as archive:
        archive.writestr("traj_0/data.pkl", b"\x80\x02" + table + b".")
        archive.writestr("traj_0/byteorder", b"little")
        archive.writestr("traj_0/data/0", T.tobytes())
        archive.writestr("traj_0/data/1", np.column_stack([Q, U]).tobytes())
    return stream.getvalue()


TENSORS = {"time": "time", "columns": {"qpos:hinge": "dof_pos[0]", "ctrl:motor": "torque"}}
TIME = text("time") + tensor("0", [M], [1])


def test_tensors(read: Read) -> None:
    """Columns of a matrix, and a vector that is every second number of a storage."""
    table = b"}(" + TIME
    table += text("dof_pos") + tensor("1", [M, 2], [2, 1])
    table += text("torque") + tensor("1", [M], [2], offset=1) + b"u"
    assert is_whole(read("log.pt", torch_archive(table), **TENSORS))


def table_of(value: bytes) -> bytes:
    """A table of the time and one further value."""
    return b"}(" + TIME + text("x") + value + b"u"


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (table_of(b"cos\nmkdir\n" + text("sprung") + b"\x85R"), "os.mkdir"),
        (table_of(b"cbuiltins\neval\n" + text("1") + b"\x85R"), "eval"),
        (table_of(tensor("0", [M + 1], [1])), "larger than its storage"),
        (table_of(tensor("0", [M], [1], 1)), "larger than its storage"),
        (table_of(tensor("0", [M], [1], -1)), "larger than its"),
        (table_of(tensor("0", [1 << 30], [0])), "larger than its"),
        (table_of(tensor("7", [M], [1])), "no item named"),
        (b"}(" + TIME + b"\x81u", "instruction NEWOBJ"),
        (b"Ru", "a value is missing"),
        (b"}(" + text("x")[:3], "not enough data"),
        (b"packed", "packed"),
    ],
)
def test_hostile_tensors(
    table: bytes,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    read: Read,
) -> None:
    """Nothing of the file is called, and no memory outside of its numbers is read."""
    monkeypatch.chdir(tmp_path)
    packed = zipfile.ZIP_DEFLATED if table == b"packed" else zipfile.ZIP_STORED
    with pytest.raises(RecordingError, match=rf"log\.pt: not a table of tensors.*{said}"):
        read("log.pt", torch_archive(table, packed), **TENSORS)
    assert not (tmp_path / "sprung").exists()


def test_a_memo_far_away(read: Read) -> None:
    """A place of a memo beyond all memory costs nothing."""
    table = b"}r\xff\xff\xff\x7f(" + TIME + b"u"
    with pytest.raises(RecordingError, match=r"column 'torque' is missing; found: time"):
        read("log.pt", torch_archive(table), **TENSORS)


# ---- what is proposed

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body>
      <joint name="arm_shoulder" axis="0 1 0" damping="0.1" range="-1 1" limited="true"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.5"/>
      <body pos="0 0 -0.3">
        <joint name="arm_elbow" axis="0 1 0" damping="0.1" range="-1 1" limited="true"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.5"/>
        <site name="tip" pos="0 0 -0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
  <sensor><force name="cell" site="tip"/></sensor>
</mujoco>
"""
SERVOS = """
    <position name="shoulder" joint="arm_shoulder" kp="9"/>
    <position name="elbow" joint="arm_elbow" kp="9"/>
"""
MOTORS = SERVOS.replace("position", "motor").replace(' kp="9"', "")
P = np.round(0.3 * np.cos(4.0 * T), 6)
V = np.gradient(Q, T)


def proposal(columns: dict[str, Any], actuators: str, folder: Path) -> dict[str, Any]:
    """Tables that are proposed for a log of the arm, read from their TOML."""
    np.savez(folder / "log.npz", **columns)
    model = mujoco.MjModel.from_xml_string(ARM.format(actuators=actuators))
    channels = Channels(
        model=model,
        controls=("shoulder", "elbow"),
        laws=None,
        outputs=measurable_columns(model),
        sigma=np.zeros(0),
        spec=RecordingSpec(),
        source="arm.toml",
    )
    table = read_columns(folder / "log.npz", channels.spec)
    return tomllib.loads(proposed_recording(table, channels))["recording"]


def named(*columns: str | dict[str, str], kinds: str = "ctrl qpos") -> dict[str, Any]:
    """A mapping of the columns of the shoulder and of the elbow, one pair for each kind."""
    prefix = {"ctrl": "ctrl:", "qpos": "qpos:arm_", "qvel": "qvel:arm_"}
    names = [f"{prefix[kind]}{joint}" for kind in kinds.split() for joint in ("shoulder", "elbow")]
    return dict(zip(names, columns, strict=True))


DEG = {"unit": "deg"}
LEROBOT = ["action:shoulder.pos", "action:elbow.pos"]
PROPOSALS: dict[str, tuple[dict[str, Any], str, dict[str, Any]]] = {
    "names": (
        {"time": T, "tau_elbow": P, "tau_shoulder": U, "elbowPosition": P, "shoulderPosition": Q},
        MOTORS,
        {
            "time": "time",
            "columns": named("tau_shoulder", "tau_elbow", "shoulderPosition", "elbowPosition"),
        },
    ),
    "order from 0 (UR RTDE)": (
        {
            "timestamp": T,
            "target_q_0": P,
            "target_q_1": Q,
            "actual_q_0": Q,
            "actual_q_1": P,
            "actual_qd_0": V,
            "actual_qd_1": V,
            "target_moment_0": U,
            "target_moment_1": P,
        },
        MOTORS,
        {
            "time": "timestamp",
            "columns": named(
                "target_moment_0",
                "target_moment_1",
                "actual_qd_0",
                "actual_qd_1",
                "actual_q_0",
                "actual_q_1",
                kinds="ctrl qvel qpos",
            ),
        },
    ),
    "matrices of a servo robot (Isaac Lab)": (
        {"time": T, "des_dof_pos": np.column_stack([P, Q]), "dof_pos": np.column_stack([Q, P])},
        SERVOS,
        {
            "time": "time",
            "columns": named("des_dof_pos[0]", "des_dof_pos[1]", "dof_pos[0]", "dof_pos[1]"),
        },
    ),
    "degrees and milliseconds (LeRobot)": (
        {
            "timestamp": 1e3 * T,
            "observation.state:shoulder.pos": 57.3 * Q,
            "observation.state:elbow.pos": 57.3 * P,
            "action:shoulder.pos": 57.3 * Q,
            "action:elbow.pos": 57.3 * P,
        },
        SERVOS,
        {
            "time": "timestamp",
            "time_unit": "ms",
            "columns": named(
                *({"column": name, **DEG} for name in LEROBOT),
                *(
                    {"column": f"observation.state:{joint}.pos", **DEG}
                    for joint in ("shoulder", "elbow")
                ),
            ),
        },
    ),
    "a sensor, no command": (
        {"t": T, "cell[0]": P, "q1": Q, "q2": P, "goal_q1": Q, "goal_q2": P},
        MOTORS,
        {"time": "t", "columns": named("q1", "q2", kinds="qpos") | {"cell[0]": "cell[0]"}},
    ),
    "nothing that fits": ({"x": Q, "y": P, "z": V}, MOTORS, {"columns": {}}),
}


@pytest.mark.parametrize("case", PROPOSALS)
def test_proposals(case: str, tmp_path: Path) -> None:
    columns, actuators, expected = PROPOSALS[case]
    assert proposal(columns, actuators, tmp_path) == expected


def test_a_proposal_reads_the_log(read: Read) -> None:
    """What the message of a log that does not fit proposes, pasted as it is, reads the log."""
    text, _ = TEXTS["rostopic echo -p"]
    with pytest.raises(RecordingError, match="column 't' is missing") as refused:
        read("log.csv", text.encode())
    pasted = str(refused.value).partition("\n")[2]
    assert is_whole(read("log.csv", **tomllib.loads(pasted)["recording"]), tolerance=1e-14)
