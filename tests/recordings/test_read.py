"""Logs as recordings: formula, units, counters, windows, gaps; the message of every refusal; logs
of real robots.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from mjfim.errors import ExperimentError, RecordingError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.output.archive import write_table
from mjfim.recordings.read import LogSummary, RowReader, read_log, read_recording
from mjfim.records.trajectory import Recording
from tests.support.closed_loop import arm_experiment

Array = NDArray[np.float64]
# A recording, and the summary of the log from which it was read.
Logged = tuple[Recording, LogSummary]
Read = Callable[..., Logged]

ARM = """
<mujoco>
  <option timestep="0.001"/>
  <worldbody>
    <body name="cart">
      <joint name="rail" type="slide" axis="1 0 0"/>
      <geom size="0.05" mass="1"/>
      <body name="arm">
        <joint name="pin" axis="0 1 0"/>
        <joint name="stop" axis="1 0 0" range="-60 90"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.3" mass="0.5"/>
        <site name="tip" pos="0 0 -0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="rail"/>
    <motor name="turn" joint="pin"/>
  </actuator>
  <sensor>
    <jointpos name="encoder" joint="pin"/>
    <jointvel name="ruler" joint="rail"/>
    <gyro name="gyro" site="tip"/>
    <force name="cell" site="tip"/>
    <actuatorpos name="motor" actuator="turn"/>
  </sensor>
</mujoco>
"""
NOISE = {"state": 0.01, "encoder": 0.01, "ruler": 0.01, "gyro": 0.01, "cell": 0.1, "motor": 0.1}
M = 400
T = np.arange(M) * 0.005
CTRL = {"ctrl:push": np.cos(T), "ctrl:turn": np.sin(3.0 * T)}


def task_of(folder: Path, recording: Mapping[str, Any]) -> DesignTask:
    """The arm on its cart, with this [recording] table."""
    (folder / "arm.xml").write_text(ARM, encoding="utf-8")
    mass = {"mass": {"target": "body/arm:mass"}}
    start = {"control": {"kind": "sine"}}
    experiment = Experiment(
        model="arm.xml",
        rate=100.0,
        horizon=1.0,
        initial=start,
        parameters=mass,
        noise=NOISE,
        recording=recording,
        directory=folder,
        source="study.toml",
    )
    return DesignTask.resolve(experiment)


@pytest.fixture
def read(tmp_path: Path) -> Read:
    """Write columns as CSV and read them by a [recording] table; the time and the controls are
    added unless `bare`.
    """

    def run(columns: Mapping[str, Any], /, bare: bool = False, **recording: Any) -> Logged:
        path = tmp_path / "lab.csv"
        write_table(path, dict(columns) if bare else {"t": T, **CTRL, **columns})
        return read_log(path, task_of(tmp_path, recording).system.channels)

    return run


def column(logged: Logged, name: str) -> Array:
    """Values of a measured column or of a control, by its name."""
    if name in CTRL:
        return logged[0].ctrl[:, [*CTRL].index(name)]
    return logged[0].y[:, logged[0].outputs.index(name)]


def wave(amplitude: float = 1.0, frequency: float = 2.0) -> Array:
    """(M,) sine of an amplitude and a frequency [rad/s]."""
    return amplitude * np.sin(frequency * T)


# ---- units


@pytest.mark.parametrize(
    ("name", "unit", "factor"),
    [
        ("qpos:pin", "deg", np.pi / 180),
        ("qvel:pin", "deg/s", np.pi / 180),
        ("qvel:pin", "rpm", 2 * np.pi / 60),
        ("qpos:rail", "mm", 1e-3),
        ("qvel:rail", "mm/s", 1e-3),
        ("encoder", "deg", np.pi / 180),
        ("ruler", "mm/s", 1e-3),
        ("gyro[1]", "rpm", 2 * np.pi / 60),
        ("motor", "deg", np.pi / 180),
        ("ctrl:turn", "deg", np.pi / 180),
    ],
)
def test_units(name: str, unit: str, factor: float, read: Read) -> None:
    columns = {"qvel:stop": "raw", name: {"column": "raw", "unit": unit}}
    found = column(read({"raw": wave(7.0)}, columns=columns), name)
    assert np.allclose(found, factor * wave(7.0)[: len(found)], rtol=1e-14, atol=0)


@pytest.mark.parametrize(
    ("name", "source", "said"),
    [
        ("qpos:rail", {"unit": "deg"}, r"qpos:rail\.unit: unknown unit 'deg'.*valid: cm, m, mm"),
        (
            "qpos:pin",
            {"unit": "deg/s"},
            r"qpos:pin\.unit: unknown unit 'deg/s'.*valid: deg, rad, rev;",
        ),
        ("qvel:pin", {"unit": "m/s"}, r"valid: deg/s, rad/s, rev/s, rpm"),
        ("ruler", {"unit": "rpm"}, r"ruler\.unit: .*valid: m/s, mm/s"),
        ("cell[0]", {"unit": "m"}, r"cell\[0\]\.unit: .*valid: none; use scale for any other unit"),
        ("qpos:rail", {"unwrap": True}, r"qpos:rail\.unwrap: only an angle"),
        ("qpos:pinn", {}, r": unknown column 'qpos:pinn' \(did you mean 'qpos:pin'\?\)"),
        ("ctrl:twist", {}, r"unknown column 'ctrl:twist'.*ctrl:turn"),
        ("qpos:pin", 0.5, "qpos:pin: a number is the value of a constant control"),
        ("ctrl:pull", 0.5, "unknown column 'ctrl:pull'"),
    ],
)
def test_columns_that_do_not_fit_the_model(
    name: str, source: dict[str, Any] | float, said: str, read: Read
) -> None:
    """The rules are checked before the file is read; the message names the experiment's key."""
    stated = {"column": "raw", **source} if isinstance(source, dict) else source
    with pytest.raises(ExperimentError, match=rf"study\.toml: recording\.columns.*{said}"):
        read({"raw": wave()}, columns={name: stated})


def test_signed(read: Read) -> None:
    """Unsigned numbers are read as two's complement; negative numbers stay."""
    raw = np.resize([-7.0, 32768.0, 65535.0, 3.0], M)
    columns = {"motor": {"column": "raw", "signed": 16}}
    logged = read({"raw": raw}, columns=columns)
    assert column(logged, "motor")[:4].tolist() == [-7.0, -32768.0, -1.0, 3.0]
    for wrong in (65536.0, -32769.0, 1.5):
        raw[9] = wrong
        said = rf"column 'raw' holds {wrong:g} in data row 10, which is not an integer"
        with pytest.raises(RecordingError, match=said):
            read({"raw": raw}, columns=columns)


# ---- time


@pytest.mark.parametrize(("unit", "factor"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_time_units(unit: str, factor: float, read: Read) -> None:
    """Irregular times are kept and begin at zero, also times since 1970."""
    rng = np.random.default_rng(1)
    t = T + rng.uniform(-1e-3, 1e-3, M)
    logged = read(
        {"stamp": (t + 1000.0) * factor, "qpos:pin": wave()}, time="stamp", time_unit=unit
    )
    assert np.allclose(logged[0].t, t - t[0], rtol=0, atol=1e-9)
    assert logged[0].t[0] == 0.0


def test_window(read: Read) -> None:
    """Rows from begin to end are read, time begins at zero, and a control is held from before the
    window.
    """
    ctrl = np.where(np.arange(M) % 3 == 0, np.arange(M, dtype=float), np.nan)
    columns = {"qpos:pin": wave(), "ctrl:push": ctrl}
    logged = read({**columns, "t": T + 5.0}, window=(0.52, 1.0))
    r = logged[0]
    assert (len(r.t), r.t[0], logged[1].dropped) == (97, 0.0, M - 97)
    assert np.allclose(r.t, T[:97], rtol=0, atol=1e-12)
    assert np.array_equal(column(logged, "qpos:pin"), wave()[104:201])
    assert r.ctrl[:4, 0].tolist() == [102.0, 105.0, 105.0, 105.0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t[:2], r"too few rows \(2\)"),
        (lambda t: t[:0], r"too few rows \(0\)"),
        (lambda t: np.where(t == t[7], np.nan, t), "holds NaN in data row 8"),
        (lambda t: np.where(t == t[7], np.inf, t), "holds an infinite time in data row 8"),
        (lambda t: np.floor(t * 50) / 50, r"in data row 2: .*\(a duplicate, one of 3\d\d\)"),
        (
            lambda t: np.mod(t, 1.2),
            r"in data row 241: 1\.195 s, then 0 s \(the clock restarted or wrapped around\)",
        ),
        (
            lambda t: np.where((t * 200).round() % 50 == 7, t - 0.012, t),
            r"in data row 8: 0\.03 s, then 0\.023 s \(rows out of order\)",
        ),
        (lambda t: 1e3 * t, r'median step is 5 s, .* should it be recording\.time_unit = "ms"\?'),
        (lambda t: 1e6 * t, r'recording\.time_unit = "us"\?'),
        (lambda t: 1e9 * t, r'recording\.time_unit = "ns"\?'),
        (
            lambda t: 5e-324 * np.arange(len(t)),
            r'median step is 4\.94066e-324 s.*time_unit = "s"\?',
        ),
        (
            lambda t: t + 0.2 * (t > t[99]),
            r"a gap of 0\.205 s after data row 100 \(0\.495 s .*longer than 0\.1 s",
        ),
    ],
)
def test_clocks_that_are_wrong(change: Callable[[Array], Array], said: str, read: Read) -> None:
    t = change(T)
    columns = {"t": t, **{n: c[: len(t)] for n, c in CTRL.items()}, "qpos:pin": wave()[: len(t)]}
    with pytest.raises(RecordingError, match=rf"lab\.csv: column 't'.*{said}"):
        read(columns, bare=True)


# ---- columns


def test_controls_are_held(read: Read) -> None:
    """A control is held for less than the gap; the last row needs none."""
    u = hole(hole(COUNT, 10, 40), M - 5, M)
    found = column(read({"qpos:pin": wave(), "ctrl:push": u}, gap=0.2), "ctrl:push")
    assert found[9:41].tolist() == [9.0] * 31 + [40.0]
    assert found[-3:].tolist() == [394.0] * 3
    late = read({"qpos:pin": wave(), "ctrl:push": hole(COUNT, M - 21, M)}, gap=0.1025)
    assert column(late, "ctrl:push")[-1] == M - 22
    begun = read({"qpos:pin": wave(), "ctrl:push": hole(COUNT, 0, 4)}, window=(0.02, 1.0))
    assert column(begun, "ctrl:push")[0] == 4.0


def hole(values: Array, begin: int, end: int) -> Array:
    """Values of which some are empty."""
    found = np.array(values)
    found[begin:end] = np.nan
    return found


def test_a_joint_may_rest_where_its_reference_rests(tmp_path: Path) -> None:
    """Its encoder shows one number then; where the reference moves, the channel is dead."""
    system = System.resolve(arm_experiment({"shoulder": {"kp": 60.0, "kd": 4.0}}))
    columns = {
        "t": np.arange(M) / 500.0,
        "ctrl:elbow": wave(),
        "reference:shoulder": np.full(M, 0.3),
        "qpos:shoulder": np.full(M, 0.29),
    }
    log = tmp_path / "log.csv"

    def written() -> Array:
        rows = np.transpose([*columns.values()])
        np.savetxt(log, rows, "%.9g", ",", header=",".join(columns), comments="")
        return read_recording(log, system.channels).y

    assert np.ptp(written()) == 0.0
    columns["reference:shoulder"] = wave()
    with pytest.raises(RecordingError, match="dead channel"):
        written()


COUNT = np.arange(M, dtype=float)
EMPTY = np.full(M, np.nan)

# Position and velocity of one motion, with a coarse resolution and with noise.
COARSE = np.round((1.0 - np.cos(2.0 * T)) / 1e-3) * 1e-3
ROUGH = 2.0 * np.sin(2.0 * T) + 0.1 * np.random.default_rng(4).standard_normal(M)
REST = np.random.default_rng(5).standard_normal((2, M)) * [[2e-3], [0.5]]
DEAD = {"enc": np.full(M, 1.5), "q": wave()}
BOTH = {"encoder": "enc", "qpos:pin": "q"}
LATE = T + 0.2 * (COUNT > 99)
RADIANS = {"column": "qpos:stop", "unit": "rad"}
BY_KP = {"column": "ctrl:turn", "multiply_by": ["kp"]}

# Columns and the table [recording] of logs that are read as they are.
SOUND: list[tuple[dict[str, Array], dict[str, Any]]] = [
    ({"t": LATE}, {"gap": 0.3}),
    # Five steps of a slow log are always bridged.
    ({"t": 0.05 * COUNT + 0.15 * (COUNT > 199)}, {}),
    # Regularly empty fields are no gaps, however slow the column is.
    ({"encoder": np.where(COUNT % 50 == 3, wave(), np.nan)}, {"gap": 0.02}),
    ({"qpos:pin": hole(wave(), 100, 115)}, {}),
    ({"qpos:pin": hole(wave(), 100, 160)}, {"gap": 0.5}),
    ({"qpos:pin": hole(wave(), 0, 30)}, {"gap": 0.5}),
    ({"encoder": np.where(COUNT % 50 == 0, 1.5, np.nan), "ctrl:push": 0.0 * T}, {}),
    ({"qpos:pin": COARSE, "qvel:pin": ROUGH}, {}),
    # At rest the ratio of position and velocity is random.
    ({"qpos:pin": REST[0], "qvel:pin": REST[1]}, {}),
    ({"qpos:rail": 57.3 * COARSE, "qvel:rail": ROUGH}, {}),
    *(({"qpos:stop": q, "qvel:stop": wave()}, {}) for q in (wave(4.0, 6.0), wave(700.0, 0.25))),
    # A stated unit is right.
    ({"qpos:stop": wave(50.0, 6.0)}, {"columns": {"qpos:stop": RADIANS}}),
    (
        {"qpos:pin": np.degrees(COARSE), "qvel:pin": ROUGH},
        {"columns": {"qpos:pin": {"column": "qpos:pin", "unit": "rad"}, "qvel:pin": "qvel:pin"}},
    ),
]

# Columns and the table [recording] of logs that are refused, and the message.
REFUSED: list[tuple[dict[str, Array], dict[str, Any], str]] = [
    ({}, {"window": (7.0, 8.0)}, r"recording\.window: no row between 7 and 8 s; .* 1\.995 s"),
    (
        {"qpos:pin": hole(wave(), 100, 160)},
        {},
        r"'qpos:pin' is empty .*from 0\.495 to 0\.8 s; gaps longer than 0\.1 s are not bridged",
    ),
    ({"qpos:pin": hole(wave(), 0, 30)}, {}, "from 0 to 0.15 s"),
    ({"qpos:pin": hole(wave(), 360, M)}, {}, "to 1.995 s"),
    (
        {"ctrl:push": hole(COUNT, 10, 40)},
        {},
        r"'ctrl:push'.* empty for 0\.15 s until 0\.195 s; a control is not held longer than 0\.1 s",
    ),
    ({"ctrl:push": hole(COUNT, 0, 4)}, {}, r"'ctrl:push'.*first row; it begins 0\.02 s later"),
    ({"ctrl:push": EMPTY}, {}, "it holds no number"),
    (DEAD, {"columns": BOTH}, "column 'enc' is 1.5 in all of its 400 rows, which suggests a dead"),
    ({"encoder": EMPTY}, {}, "column 'encoder' holds no number; remove it"),
    *(
        ({name: np.where(COUNT == 11, value, 2.0)}, {"columns": {"ctrl:turn": BY_KP}}, said)
        for name in ("qpos:pin", "ctrl:push", "kp")
        for value, said in (
            (np.inf, f"column '{name}' is inf in data row 12"),
            (-1e300, rf"column '{name}' is -1e\+300 in data row 12"),
        )
    ),
    *(
        ({}, {"columns": {"qpos:pin": source}}, said)
        for name, said in (("lost", "'lost' is missing; found: .*note"), ("note", "is not numeric"))
        for source in (name, {"column": "qpos:pin", "multiply_by": [name]})
    ),
    (
        {"qpos:pin": np.degrees(COARSE), "qvel:pin": ROUGH},
        {},
        r"5\d\.\d times .* 'qpos:pin' is probably in deg: state unit = \"deg\"",
    ),
    (
        {"qpos:pin": COARSE, "qvel:pin": np.degrees(ROUGH)},
        {},
        r"0\.017.* 'qvel:pin' is probably in deg/s: state unit = \"deg/s\"",
    ),
    (
        {"qpos:stop": wave(50.0, 6.0)},
        {},
        r"'qpos:stop' ranges from -\d+.* from -1\.047\d* to 1\.57\d* rad; .*in deg",
    ),
]


@pytest.mark.parametrize(("columns", "recording"), SOUND)
def test_sound_logs(columns: dict[str, Array], recording: dict[str, Any], read: Read) -> None:
    """Every row is read, and what is empty stays empty."""
    logged = read({"qpos:pin": wave(), **columns}, **recording)
    assert len(logged[0].t) == M
    for name in {*columns} & {*logged[0].outputs}:
        assert_array_equal(column(logged, name), columns[name])


@pytest.mark.parametrize(("columns", "recording", "said"), REFUSED)
def test_refused_logs(
    columns: dict[str, Array], recording: dict[str, Any], said: str, read: Read
) -> None:
    given = {"qpos:pin": wave(), "kp": COUNT, "note": np.array(["x"] * M), **columns}
    with pytest.raises(RecordingError, match=said):
        read(given, **recording)


def test_a_control_may_be_a_constant_that_no_column_holds(read: Read) -> None:
    """A swing-down with the motors off, for example; a column of the same name is not read."""
    off = {"ctrl:push": 0, "ctrl:turn": 0.25}
    alone = read({"t": T, "qpos:pin": wave()}, bare=True, columns=off)
    beside = read({"qpos:pin": wave()}, columns=off)
    for logged in (alone, beside):
        assert np.array_equal(logged[0].ctrl, np.tile([0.0, 0.25], (M - 1, 1)))
        assert [each.name for each in logged[1].columns] == ["qpos:pin"]
    said = r"column 'ctrl:push' is missing.*constant, state the value: \"ctrl:push\" = 0\.0\. "
    with pytest.raises(RecordingError, match=said):
        read({"t": T, "qpos:pin": wave(), "ctrl:turn": T}, bare=True)


# ---- the summary


def test_summary(read: Read) -> None:
    t = T + 0.02 * (COUNT > 99)
    q = np.round(wave(1.0, 3.0) / 0.01) * 0.01
    q[:40:4] = np.nan
    summary = read({"t": t, "q": q}, columns={"qpos:pin": "q"}, window=(0.0, 1.5))[1]
    assert (summary.rows, summary.dropped) == (297, M - 297)
    found = (summary.rate, summary.duration, summary.longest_step, summary.jitter_std)
    assert found == pytest.approx((200.0, 1.5, 0.025, 0.02 * np.sqrt(1 / 296 - 1 / 296**2)))
    push, turn, pin = summary.columns
    assert (push.name, turn.name, pin.name) == ("ctrl:push", "ctrl:turn", "qpos:pin")
    assert (pin.source, pin.resolution) == ("q", pytest.approx(0.01))
    assert (pin.minimum, pin.maximum) == (np.nanmin(q[:297]), np.nanmax(q[:297]))
    assert pin.empty_share == pytest.approx(10 / 297)


# ---- archives of arrays


def test_design_archives_are_recordings(tmp_path: Path) -> None:
    """Matrices are in the order of the model's joints and actuators, with one control less than
    states.
    """
    path = tmp_path / "d.npz"
    qpos, ctrl = np.split(np.random.default_rng(0).standard_normal((M, 5)), [3], axis=1)
    np.savez(path, t=T, qpos=qpos, ctrl=ctrl[1:], gain=np.zeros((M - 1, 2, 6)))
    recording = read_log(path, task_of(tmp_path, {}).system.channels)[0]
    assert_array_equal(recording.ctrl, ctrl[1:])
    assert recording.outputs == ("qpos:rail", "qpos:pin", "qpos:stop")
    assert_array_equal(recording.y, qpos)


# ---- logs of other programs


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        (
            {"Time": T},
            r"column 't' is missing; found: Time\. .* study\.toml\. .*:\n  \[recording\]\n"
            r"  time = \"Time\"\n",
        ),
        (
            {"t": T, "Push": CTRL["ctrl:push"], "turn": CTRL["ctrl:turn"]},
            r"'ctrl:push' is missing; found: t, Push, turn.*"
            r"\n  \[recording\.columns\]\n  \"ctrl:push\" = \"Push\"",
        ),
        (
            {"t": T, "x": CTRL["ctrl:push"]},
            r"\n  # \"ctrl:push\" = 0\.0  # no column found",
        ),
        (
            {"t": T, **CTRL, "PIN": CTRL["ctrl:turn"]},
            r"no measured column; .*\n  \"qpos:pin\" = \"PIN\"",
        ),
    ],
)
def test_columns_of_other_programs_are_proposed(
    columns: dict[str, Any], said: str, read: Read
) -> None:
    with pytest.raises(RecordingError, match=rf"(?s){said}"):
        read(columns, bare=True)


# ---- rows of a stream


def test_rows_are_read_as_files_are(read: Read, tmp_path: Path) -> None:
    """Units, counters, turns, factors, empty cells and the window, a few rows at a time."""
    counts, raw = hole(np.rint(wave(9000.0)), 50, 53), np.rint(wave(300.0))
    on, push = (T < 1.0).astype(float), np.where(COUNT % 3 == 0, COUNT, np.nan)
    columns = {
        "stamp": 1e6 * (T + 1000.0),
        "counts": np.mod(counts, 4096),
        "angle": np.rad2deg(np.mod(wave(9.0), 2.0 * np.pi)),
        "speed": wave(3.0),
        "on": on,
        "kp": 9.0 + COUNT,
        "raw": np.mod(raw, 2**16),
        "push": push,
    }
    factors = {"scale": -2.0, "offset": 0.5, "multiply_by": ["on", "kp"]}
    recording = {
        "time": "stamp",
        "time_unit": "us",
        "window": (0.0, 1.5),
        "columns": {
            "ctrl:push": "push",
            "ctrl:turn": 0.5,
            "encoder": {"column": "counts", "period": 4096.0, "scale": 1e-3},
            "qpos:pin": {"column": "angle", "unit": "deg", "unwrap": True},
            "qvel:rail": {"column": "speed", "unit": "mm/s", **factors},
            "motor": {"column": "raw", "signed": 16, "scale": 0.01},
        },
    }
    expected = {
        "encoder": 1e-3 * counts,
        "qpos:pin": wave(9.0),
        "qvel:rail": (-2e-3 * wave(3.0) + 0.5) * on * (9.0 + COUNT),
        "motor": 0.01 * raw,
    }
    logged = read(columns, bare=True, **recording)
    channels = task_of(tmp_path, recording).system.channels
    header, *lines = (tmp_path / "lab.csv").read_text(encoding="utf-8").splitlines()
    reader = RowReader(header, channels, "stdin")
    rows = [row for row in map(reader.row, lines) if row is not None]
    t, ctrl, y = map(np.array, zip(*rows, strict=True))
    whole, count = logged[0], len(t)
    assert len(whole.t) == count == 301
    held = np.column_stack([COUNT - COUNT % 3, np.full(M, 0.5)])
    for times, controls in ((whole.t, whole.ctrl), (t - t[0], ctrl[:-1])):
        assert_allclose(times, T[:count], rtol=0, atol=1e-9)
        assert_allclose(controls, held[: count - 1])
    assert {*expected} == {*whole.outputs}
    for name, values in expected.items():
        for found in (column(logged, name), y[:, channels.outputs.index(name)]):
            assert_allclose(found, values[:count], rtol=0, atol=1e-9)
    assert np.isnan(y[:, channels.outputs.index("ruler")]).all()


def reader_of(folder: Path, header: str = "t,ctrl:push,ctrl:turn,qpos:pin,note") -> RowReader:
    """A reader of rows with a column of text."""
    return RowReader(header, task_of(folder, {}).system.channels, "stdin")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("0.1,1,2,3", "4 cells, but line 1 has 5"),
        ("0.1,1,2,three,", "column 'qpos:pin': 'three' is no measured number"),
        ("0.1,1,2,1e300,", "column 'qpos:pin': '1e300' is no measured number"),
    ],
)
def test_a_faulty_row(line: str, said: str, tmp_path: Path) -> None:
    reader = reader_of(tmp_path)
    assert reader.row("0,1,2,3,begin") is not None
    with pytest.raises(RecordingError, match=re.escape(said)):
        reader.row(line)
    # A control is held, and what was not measured is unknown.
    t, ctrl, outputs = reader.row("0.2,,,,end") or (0.0, [], [])
    assert (t, ctrl) == (0.2, [1.0, 2.0]) and np.isnan(outputs).all()


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ("t,ctrl:push,ctrl:turn,qpos:pni", "did you mean 'qpos:pin'"),
        ("t,ctrl:push,qpos:pin", "column 'ctrl:turn' is missing"),
        ("time,ctrl:push,ctrl:turn,qpos:pin", "column 't' is missing"),
        ("t,ctrl:push,ctrl:turn,qpos:pin,t", "line 1: two columns have the same name"),
    ],
)
def test_a_wrong_header(header: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=re.escape(said)):
        reader_of(tmp_path, header)
