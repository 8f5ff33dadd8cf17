"""Columns of numbers from files of every format that is read. Nothing that a file holds is executed or unpickled."""

from __future__ import annotations
