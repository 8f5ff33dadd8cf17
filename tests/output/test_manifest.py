"""Manifests of folders, the rule for existing files, and locks."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from mjfim.errors import OutputError
from mjfim.files import remove_earlier_result, replacing
from mjfim.output.manifest import (
    FOLDER_LOCK,
    MANIFEST,
    OutputGuard,
    claimed,
    holder,
    locked,
)


def write(path: Path, text: str, *inputs: Path, force: bool = False) -> None:
    """Write a result as a run with these inputs does."""
    guard = OutputGuard(inputs, force=force)
    guard.check([path])
    with claimed(path.parent, guard, exclusive=True), replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def contents(folder: Path) -> dict[str, bytes]:
    """Contents of the files of a folder by their names."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_result_is_replaced_until_the_user_edits_it(tmp_path: Path) -> None:
    """After an edit it is the user's; --force makes it a result again."""
    file = tmp_path / "out" / "a.txt"
    write(file, "first")
    write(file, "second")

    file.write_text("edited", encoding="utf-8")
    with pytest.raises(OutputError, match=r"a\.txt: changed after mjfim wrote it; .*--force"):
        write(file, "third")
    assert file.read_text(encoding="utf-8") == "edited"

    write(file, "third", force=True)
    write(file, "fourth")
    assert file.read_text(encoding="utf-8") == "fourth"


def test_files_that_are_not_listed_are_the_users(tmp_path: Path) -> None:
    """The message lists them, and names --force; without a manifest and with an unusable one."""
    files = [tmp_path / f"{i}.txt" for i in range(8)]
    for file in files:
        file.write_text("mine", encoding="utf-8")

    for manifest in ("", "{", "[]", '{"files": 3}'):
        if manifest:
            (tmp_path / MANIFEST).write_text(manifest, encoding="utf-8")
        with pytest.raises(OutputError, match=r"0\.txt, 1.*4\.txt and 3 more: not listed.*--force"):
            OutputGuard([], force=False).check(files)
    OutputGuard([], force=True).check(files)


def test_folders_and_devices_are_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "a.txt").mkdir()
    for place in (tmp_path / "a.txt", Path(os.devnull)):
        with pytest.raises(OutputError, match=f"{place.name}: is not a file"):
            OutputGuard([], force=True).check([place])


@pytest.mark.parametrize("link", ["same", "symlink", "hardlink", "spelling"])
def test_an_input_is_never_replaced(link: str, tmp_path: Path) -> None:
    """Neither with --force nor under another name of the same file."""
    source = tmp_path / "source.txt"
    source.write_text("mine", encoding="utf-8")
    (tmp_path / "x").mkdir()
    target = tmp_path / {"same": "source.txt", "spelling": "x/../source.txt"}.get(
        link, "result.txt"
    )
    if link == "symlink":
        target.symlink_to(source)
    if link == "hardlink":
        os.link(source, target)

    for force in (False, True):
        with pytest.raises(OutputError, match=r"would replace .*source\.txt, which is an input"):
            write(target, "new", source, force=force)
    assert source.read_text(encoding="utf-8") == "mine"


def test_a_file_that_appears_during_the_run_is_kept(tmp_path: Path) -> None:
    guard = OutputGuard([], force=False)
    guard.check([tmp_path / "a.txt"])
    (tmp_path / "a.txt").write_text("mine", encoding="utf-8")
    with (
        claimed(tmp_path, guard, exclusive=True),
        pytest.raises(OutputError, match="not listed"),
        replacing(tmp_path / "a.txt"),
    ):
        pass
    assert contents(tmp_path) == {"a.txt": b"mine"}


def test_only_earlier_results_are_removed(tmp_path: Path) -> None:
    """Neither the user's files, nor inputs, nor anything without a rule."""
    names = ("result", "changed", "input", "unknown")
    for name in names[:3]:
        write(tmp_path / name, "text")
    for name in ("changed", "unknown"):
        (tmp_path / name).write_text("mine", encoding="utf-8")

    remove_earlier_result(tmp_path / "result")
    assert (tmp_path / "result").exists()
    with claimed(tmp_path, OutputGuard([tmp_path / "input"], force=True), exclusive=True):
        for name in names:
            remove_earlier_result(tmp_path / name)
    assert contents(tmp_path).keys() == {MANIFEST, *names[1:]}


def test_a_run_that_is_killed_while_it_writes_leaves_no_strange_file(tmp_path: Path) -> None:
    """Between the entry and the new file, the old file is still known; afterwards the new one."""
    file, new = tmp_path / "a.txt", tmp_path / "new"
    write(file, "old")
    new.write_text("new", encoding="utf-8")
    guard = OutputGuard([], force=False)
    guard.before_replacing(new, file)
    guard.check([file])
    new.replace(file)
    guard.check([file])


def test_the_manifest_has_one_entry_per_file(tmp_path: Path) -> None:
    """Runs of several verbs keep each other's entries; no temporary file and no lock remains."""
    for name in ("a.txt", "b.txt", "a.txt"):
        write(tmp_path / name, name)
    found = contents(tmp_path)
    entries = json.loads(found[MANIFEST])["files"]
    assert {name: [entry["size"] for entry in each] for name, each in entries.items()} == {
        "a.txt": [5],
        "b.txt": [5],
    }
    assert found.keys() == {MANIFEST, *entries}


def test_a_folder_that_cannot_be_created_is_named(tmp_path: Path) -> None:
    """A file has the name of one of the folders above it."""
    (tmp_path / "file").write_text("mine", encoding="utf-8")
    folder = tmp_path / "file" / "out"
    with (
        pytest.raises(OutputError, match=r"out: this folder cannot be created: .*another one"),
        claimed(folder, OutputGuard([], force=False), exclusive=True),
    ):
        pytest.fail("the context is not entered")
    assert (tmp_path / "file").read_text(encoding="utf-8") == "mine"


def test_a_second_run_is_kept_out_of_a_folder(tmp_path: Path) -> None:
    """The message names the folder and the process; the first run is not disturbed."""
    guard, folder = OutputGuard([], force=True), tmp_path / "out"
    said = rf"out: another run .*process {os.getpid()}, since 20\d\d-"
    with claimed(folder, guard, exclusive=True):
        for _ in range(2):
            with pytest.raises(OutputError, match=said), claimed(folder, guard, exclusive=True):
                pass
        assert (folder / FOLDER_LOCK).is_file()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["1 2026-01-01", "", "1", "who knows"])
def test_the_lock_of_a_killed_run_is_taken_over(text: str, tmp_path: Path) -> None:
    """Its file remains, but the operating system has given the lock back."""
    lock = tmp_path / FOLDER_LOCK
    lock.write_text(text, encoding="utf-8")
    assert holder(lock) == ("process 1, since 2026-01-01" if " 2" in text else "another process")
    with locked(lock) as is_mine:
        assert is_mine
        assert holder(lock).startswith(f"process {os.getpid()}, since ")
        with locked(lock, patience=0.05) as is_mine_too:
            assert not is_mine_too
    assert list(tmp_path.iterdir()) == []
