"""The user's MJCF text with single numbers changed, everything else to the byte as it was."""

from __future__ import annotations
