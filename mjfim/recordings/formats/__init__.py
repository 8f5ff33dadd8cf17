"""Readers of columns of numbers from files of all supported formats.

No content of a file is executed or unpickled.
"""

from __future__ import annotations
