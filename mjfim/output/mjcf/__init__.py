"""Changes to numbers of the user's MJCF text that leave every other byte as it is."""

from __future__ import annotations
