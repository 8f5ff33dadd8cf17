"""What the tasks of a worker have in common, made by the first of them and kept for the others."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class KeptPerThread(threading.local, Generic[T]):
    """Objects by key, each of which is used by one thread only.

    A worker process does one task after the other; a worker of several threads, as of Dask, has
    objects of each thread.

    Args:
        count: Number of objects that a thread keeps; those that were not used for the longest time
            are forgotten.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._objects: OrderedDict[str, T] = OrderedDict()

    def get(self, key: str, make: Callable[[], T]) -> T:
        """Return the object of a key, made where this thread does not have it.

        Args:
            key: Text that identifies the object, such as a hash.
            make: Makes it.
        """
        if key not in self._objects:
            self._objects[key] = make()
        self._objects.move_to_end(key)
        while len(self._objects) > self._count:
            self._objects.popitem(last=False)
        return self._objects[key]
