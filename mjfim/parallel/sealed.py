"""Values as bytes on their way between the processes of one program.

Only what a process of this program has sealed is opened: never the content of a file, which may
come from others and could hold code.
"""

from __future__ import annotations

import pickle
from typing import Any


def sealed(value: Any) -> bytes:
    """Return a value as bytes.

    Args:
        value: The value, which can be pickled.
    """
    return pickle.dumps(value, pickle.HIGHEST_PROTOCOL)


def opened(data: bytes) -> Any:
    """Return the value of bytes that `sealed` has made in a process of this program.

    Args:
        data: The bytes.
    """
    return pickle.loads(data)
