"""Columns of numbers from files of every supported format.

No content of a file is executed or unpickled.
"""

from __future__ import annotations
