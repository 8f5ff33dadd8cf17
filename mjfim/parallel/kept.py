"""Objects that are made once and kept for later use, the latest ones of them."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

T = TypeVar("T")


class Kept(Generic[T]):
    """Objects by key. Those that were not used for the longest time are forgotten.

    Args:
        count: Number of objects that are kept.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._objects: OrderedDict[Hashable, T] = OrderedDict()

    def __len__(self) -> int:
        """Number of objects that are kept now."""
        return len(self._objects)

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the object of a key, made where it is not kept.

        Args:
            key: What identifies the object, such as a hash.
            make: Makes it.
        """
        if key not in self._objects:
            self._objects[key] = make()
        self._objects.move_to_end(key)
        while len(self._objects) > self._count:
            self._objects.popitem(last=False)
        return self._objects[key]


class KeptPerThread(threading.local, Kept[T]):
    """Objects that the tasks of a worker share, made by the first of them.

    A worker process does one task after the other; a worker of several threads, as of Dask, has
    objects of each thread.

    Args:
        count: Number of objects that each thread keeps.
    """
