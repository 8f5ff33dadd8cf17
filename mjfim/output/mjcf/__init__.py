"""Changes to numbers of the user's MJCF text that leave every other byte unchanged."""

from __future__ import annotations
