"""The names at the top of the package."""

from __future__ import annotations

import pydoc

import pytest

import mjfim


def test_all_public_names_exist() -> None:
    for name in mjfim.__all__:
        assert getattr(mjfim, name) is not None


def test_help_describes_the_public_names_only() -> None:
    text = pydoc.render_doc(mjfim, renderer=pydoc.plaintext)
    assert "optimal experiment design" in text
    assert [name for name in mjfim.__all__ if name not in text] == []
    assert [name for name in ("import_module", "MODULES") if name in text] == []


def test_an_unknown_name_is_an_ordinary_error() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'desing'$"):
        getattr(mjfim, "desing")  # noqa: B009 - the name does not exist
