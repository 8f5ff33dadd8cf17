"""A fault while a picture or a page is drawn costs this file alone."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import pytest

from mjfim.errors import OutputError, UndrawnWarning
from mjfim.output import folders
from mjfim.output.manifest import write_optional
from mjfim.output.page import PictureFormat
from tests.support import results


def fail() -> Any:
    """A fault of the program."""
    raise ZeroDivisionError("division by zero")


def test_a_fault_is_one_sentence_and_an_error_of_tests() -> None:
    """It names the file and the fault, and says that the result stands."""
    with pytest.warns(UndrawnWarning) as told:
        write_optional("report.html", fail)
    (message,) = [str(warning.message) for warning in told]
    assert message.startswith("could not draw report.html, because of a fault in mjfim")
    assert "(ZeroDivisionError: division by zero); the result stands" in message

    # Where warnings are errors, the fault is the cause that the traceback shows.
    with pytest.raises(UndrawnWarning) as raised:
        write_optional("report.html", fail)
    assert isinstance(raised.value.__context__, ZeroDivisionError)


def test_files_that_may_not_be_written_remain_errors() -> None:
    """Neither a file of the user nor a full disk is a fault of the program."""

    def refuse() -> None:
        raise OutputError("report.html: your own")

    with pytest.raises(OutputError, match="your own"):
        write_optional("report.html", refuse)


def test_one_bad_picture_does_not_keep_the_others_away(
    tmp_path: Path, empty_figures: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The data and the other pictures of a folder are drawn."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        pictures: Any = {"first": fail, "second": lambda: None}
        folders.write_pictures(tmp_path, pictures, PictureFormat.PNG)
        monkeypatch.setattr(folders, "write_report", lambda *_, **__: fail())
        monkeypatch.setattr(folders, "pictures_of", lambda _: {"check": lambda: None})
        _, draw = folders.write_result(tmp_path, results.check())
        draw()

    drawn = {path.name for path in tmp_path.iterdir()}
    assert {"second.png", "check.json", "check.png"} <= drawn
    assert "first.png" not in drawn
    sentences = [str(warning.message).split(",")[0] for warning in told]
    assert sentences == ["could not draw first.png", "could not draw report.html"]
