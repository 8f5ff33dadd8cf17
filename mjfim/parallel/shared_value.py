"""Large values that tasks hold by their hash, and objects that a worker makes once and keeps.

A worker process need not get a value each time. A task that needs a value which its process does
not have fails with AbsentValueError; `attempt` turns that into an answer, and `dispatch` sends the
task again, together with the value.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Any, Generic, TypeVar
from weakref import WeakValueDictionary

T = TypeVar("T")
Order = TypeVar("Order")

# A value on its way to a worker and in its memory, and about its size [bytes].
SentValue = tuple[Any, int]

# Size of the values that a process keeps [bytes]. Those that were not used for the longest time are
# sent again when a task needs them.
KEPT_BYTES = 2**30


class AbsentValueError(Exception):
    """A task needs shared values that its process has not received: the hashes."""

    def __init__(self, *digests: str) -> None:
        super().__init__(*digests)
        self.digests = digests


class SharedValue(Generic[T]):
    """A value that is pickled as its hash.

    Args:
        digest: Hash of the value; equal for equal values only.
        value: The value, which can be pickled and is never changed.
        size: About the memory that the value takes [bytes].
    """

    def __init__(self, digest: str, value: T, size: int = 0) -> None:
        self.digest = digest
        self.size = size
        self._value: tuple[T, ...] = (value,)
        _owned[digest] = self

    @classmethod
    def of(cls, digest: str, value: T, size: int = 0) -> SharedValue[T]:
        """Return the value of a hash that this process has made already, or else make it.

        Two of them would not be found by the same hash any more after one of them is deleted.
        """
        own = _owned.get(digest)
        return cls(digest, value, size) if own is None else own

    @property
    def value(self) -> T:
        """The value; AbsentValueError in a process that has received the hash only."""
        if self._value:
            return self._value[0]
        found: T = _received.get(self.digest)
        return found

    def to_send(self) -> T:
        """The value on its way to a worker, which does not have it."""
        return self.value

    @property
    def is_here(self) -> bool:
        """True where this process has the value; it counts as a use of it."""
        try:
            self.value  # noqa: B018
        except AbsentValueError:
            return False
        return True

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str, int]]:
        """Pickle the hash alone, with the size."""
        return _referenced, (self.digest, self.size)


class _ReceivedValues:
    """The latest values that this process has received. Its threads share them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._values: OrderedDict[str, SentValue] = OrderedDict()

    def put(self, values: Mapping[str, SentValue]) -> None:
        """Keep values, and forget others that were not used for the longest time."""
        with self._lock:
            for digest, value in values.items():
                self._values[digest] = value
                self._values.move_to_end(digest)

            # The values of one task are kept together, however large they are.
            size = sum(taken for _, taken in self._values.values())
            while len(self._values) > len(values) and size > KEPT_BYTES:
                size -= self._values.popitem(last=False)[1][1]

    def get(self, digest: str) -> Any:
        """Return a value; AbsentValueError where it was not received, or forgotten since."""
        with self._lock:
            if digest not in self._values:
                raise AbsentValueError(digest)
            self._values.move_to_end(digest)
            return self._values[digest][0]


# Values that this process has made and still uses, and values that it has received.
_owned: WeakValueDictionary[str, SharedValue[Any]] = WeakValueDictionary()
_received = _ReceivedValues()


def require_values(values: Iterable[SharedValue[Any]]) -> None:
    """Check that values are here, so that all absent ones are sent together."""
    absent = [shared.digest for shared in values if not shared.is_here]
    if absent:
        raise AbsentValueError(*absent)


def owned_value(digest: str) -> SentValue:
    """Return a value that this process has made, to send it to a worker."""
    shared = _owned.get(digest)
    if shared is None:
        raise AbsentValueError(digest)
    return shared.to_send(), shared.size


def attempt(
    function: Callable[[Order], T], values: Mapping[str, SentValue], order: Order
) -> tuple[tuple[T, ...], tuple[str, ...]]:
    """Carry out an order in a worker: the result, or the hashes of values that are absent.

    An error would be the other way to say that one is absent, but Dask prints the errors of tasks.
    """
    _received.put(values)
    try:
        return (function(order),), ()
    except AbsentValueError as error:
        return (), error.digests


def _referenced(digest: str, size: int) -> SharedValue[Any]:
    """Make the reference to a value: the value itself in the process that made it."""
    own = _owned.get(digest)
    if own is not None:
        return own
    reference = SharedValue.__new__(SharedValue)
    reference.digest = digest
    reference.size = size
    reference._value = ()
    return reference


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
