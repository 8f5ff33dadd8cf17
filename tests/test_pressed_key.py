"""The benchmark that presses Ctrl-C: what counts as a fault, and what a command leaves behind."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from mjfim.interruption import NOTHING_SENTENCE
from scripts.benchmarks import pressed_key, scale
from scripts.benchmarks.pressed_key import Command, Press

HELP = Command(name="help", words=("--help",), data=("design.npz",))


def press(
    code: int = 1, missing: Sequence[str] = (), said: str = "", files: Sequence[str] = ()
) -> Press:
    """A press that a command has answered within a second."""
    return Press(
        moment=2.0, seconds=1.0, code=code, missing=tuple(missing), said=said, files=tuple(files)
    )


@pytest.mark.parametrize(
    ("found", "fault"),
    [
        (press(files=["design.npz"]), ""),
        (press(code=0, files=["design.npz"]), ""),
        (press(code=-2, files=["design.npz"]), "exit code -2"),
        (press(missing=["design.npz"]), "design.npz missing"),
        (press(missing=["design.npz"], said=NOTHING_SENTENCE), ""),
        (press(missing=["design.npz"], said=NOTHING_SENTENCE, files=["a"]), "design.npz missing"),
        (press(code=2, missing=["a", "b"]), "exit code 2; a, b missing"),
    ],
)
def test_faults_are_lost_data_and_unusual_exit_codes(found: Press, fault: str) -> None:
    assert found.fault == fault


def test_a_press_before_the_handler_is_a_fault_and_the_folder_is_removed(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "left.txt").write_text("")
    found = pressed_key.pressed(HELP, folder, 0.0)
    assert found is not None
    assert found.files == ("left.txt",)
    assert "design.npz missing" in found.fault
    assert not folder.exists()

    # The command ends before the key is pressed.
    folder.mkdir()
    assert pressed_key.pressed(HELP, folder, 60.0) is None
    assert not folder.exists()


def test_a_command_that_does_not_work_is_not_measured(tmp_path: Path) -> None:
    wrong = Command(name="wrong", words=("check", "gone.toml"), data=())
    with pytest.raises(RuntimeError, match=r"exit code 2: .*gone\.toml"):
        pressed_key.undisturbed_seconds(wrong, tmp_path / "out")


@pytest.mark.parametrize(
    ("found", "is_good"),
    [
        ([press(files=["a"]), press(missing=["a"], said=NOTHING_SENTENCE), None], True),
        ([press(files=["a"]), press(missing=["a"], said="first\nlast")], False),
        ([None, None], False),
    ],
)
def test_a_command_is_good_where_a_key_was_pressed_and_nothing_is_lost(
    found: list[Press | None],
    is_good: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    rest = iter(found)
    monkeypatch.setattr(scale, "commands", lambda inputs: [HELP])
    monkeypatch.setattr(scale, "undisturbed_seconds", lambda command, folder: 3.0)
    monkeypatch.setattr(scale, "pressed", lambda command, folder, moment: next(rest))
    assert scale.keys_pressed(None, len(found), seed=0) == is_good

    printed = capsys.readouterr().out
    excused = sum(each is not None and each.is_excused for each in found)
    assert f"({excused} empty)" in printed
    assert ("it said last: last" in printed) == any(each and each.fault for each in found)


def test_keys_are_pressed_while_a_command_runs() -> None:
    moments = pressed_key.moments(10.0, 50, np.random.default_rng(0))
    assert len(moments) == 50
    assert all(1.0 <= moment <= 9.5 for moment in moments)
