"""Parts of the message of an error."""

from __future__ import annotations


def unsaid(parts: str, message: str) -> list[str]:
    """Those of the parts, which ` … ` separates, that a message does not contain."""
    return [part for part in parts.split(" … ") if part not in message]
