"""Large values that tasks hold by their hash, so that a worker process need not get them each time.

A task is sent without the value. A process that does not have it yet says so in place of a result;
the task is then sent again together with the value, which the process keeps. This needs nothing of
an executor but `submit`.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar
from weakref import WeakValueDictionary

T = TypeVar("T")
Order = TypeVar("Order")

# Size of the values that a process keeps [bytes]. Those that were not used for the longest time are
# sent again when a task needs them.
KEPT_BYTES = 256 * 2**20


class AbsentValueError(Exception):
    """A task needs shared values that its process has not received.

    Attributes:
        digests: Hashes of the values.
    """

    def __init__(self, *digests: str) -> None:
        super().__init__(*digests)
        self.digests = digests


class SharedValue(Generic[T]):
    """A value that is pickled as its hash.

    Args:
        digest: Hash of the value; equal for equal values only.
        value: The value, which can be pickled and is never changed.
        size: About the memory that the value takes [bytes].

    Attributes:
        digest: The hash.
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

        Args:
            digest: Hash of the value; equal for equal values only.
            value: The value, which can be pickled and is never changed.
            size: About the memory that the value takes [bytes].
        """
        own: SharedValue[T] | None = _owned.get(digest)
        return cls(digest, value, size) if own is None else own

    @property
    def value(self) -> T:
        """The value.

        Raises:
            AbsentValueError: This process has not received it.
        """
        if self._value:
            return self._value[0]

        found: T = _received.get(self.digest)
        return found

    def to_send(self) -> T:
        """The value on its way to a worker, which does not have it."""
        return self.value

    @property
    def is_here(self) -> bool:
        """True where this process has the value."""
        return bool(self._value) or _received.has(self.digest)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str, int]]:
        """Pickle the hash alone, with the size."""
        return _referenced, (self.digest, self.size)


@dataclass(frozen=True, kw_only=True, eq=False)
class SentValue:
    """A value on its way to a worker, and in its memory.

    Attributes:
        value: The value.
        size: About the memory that it takes [bytes].
    """

    value: Any
    size: int


class _ReceivedValues:
    """The latest values that this process has received. Its threads share them."""

    def __init__(self) -> None:
        """Start without any value."""
        self._lock = threading.Lock()
        self._values: OrderedDict[str, SentValue] = OrderedDict()

    def put(self, values: Mapping[str, SentValue]) -> None:
        """Keep values, and forget others that were not used for the longest time."""
        with self._lock:
            for digest, value in values.items():
                self._values[digest] = value
                self._values.move_to_end(digest)

            # The values of one task are kept together, however large they are.
            while len(self._values) > len(values) and self._size > KEPT_BYTES:
                self._values.popitem(last=False)

    def has(self, digest: str) -> bool:
        """Check whether a value is here, and count that as a use of it."""
        if digest in _of_task.values:
            return True
        with self._lock:
            if digest in self._values:
                self._values.move_to_end(digest)
            return digest in self._values

    def get(self, digest: str) -> Any:
        """Return a value; AbsentValueError where it was not received, or forgotten since."""
        if digest in _of_task.values:
            return _of_task.values[digest].value
        with self._lock:
            if digest not in self._values:
                raise AbsentValueError(digest)
            self._values.move_to_end(digest)
            return self._values[digest].value

    @property
    def _size(self) -> int:
        """Size of all values [bytes]."""
        return sum(sent.size for sent in self._values.values())


class _TaskValues(threading.local):
    """Values that came with the task of this thread; tasks of other threads cannot replace them."""

    def __init__(self) -> None:
        """Start without any value."""
        self.values: Mapping[str, SentValue] = {}

    @contextmanager
    def held(self, values: Mapping[str, SentValue]) -> Iterator[None]:
        """Hold values while a task of this thread runs."""
        before, self.values = self.values, values
        try:
            yield
        finally:
            self.values = before


_of_task = _TaskValues()

# Values that this process has made and still uses, and values that it has received.
_owned: WeakValueDictionary[str, SharedValue[Any]] = WeakValueDictionary()
_received = _ReceivedValues()


def require_values(values: Iterable[SharedValue[Any]]) -> None:
    """Check that values are here, so that all absent ones are sent together.

    Args:
        values: The values.

    Raises:
        AbsentValueError: This process has not received all of them.
    """
    absent = [shared.digest for shared in values if not shared.is_here]
    if absent:
        raise AbsentValueError(*absent)


def keep_value(shared: SharedValue[T], value: T) -> None:
    """Keep a value in a worker that has made it itself instead of receiving it.

    Args:
        shared: The reference to the value.
        value: The value.
    """
    _received.put({shared.digest: SentValue(value=value, size=shared.size)})


def owned_value(digest: str) -> SentValue:
    """Return a value that this process has made, to send it to a worker.

    Args:
        digest: Its hash.

    Raises:
        AbsentValueError: This process did not make it, or does not have it any more.
    """
    shared = _owned.get(digest)
    if shared is None:
        raise AbsentValueError(digest)
    return SentValue(value=shared.to_send(), size=shared.size)


@dataclass(frozen=True, kw_only=True)
class AbsentValue:
    """Answer of a worker that lacks shared values, in place of a result.

    Attributes:
        digests: Hashes of the values.
    """

    digests: tuple[str, ...]


def attempt(
    function: Callable[[Order], T], values: Mapping[str, SentValue], order: Order
) -> T | AbsentValue:
    """Carry out an order in a worker, if the values are there that it needs.

    An error would be the other way to say that one is absent, but Dask prints the errors of tasks.

    Args:
        function: Carries out the order.
        values: Values by their hash, which this process keeps from now on.
        order: The order.

    Returns:
        The result of the order, or which values it needs.
    """
    _received.put(values)
    try:
        with _of_task.held(values):
            return function(order)
    except AbsentValueError as error:
        return AbsentValue(digests=error.digests)


def _referenced(digest: str, size: int) -> SharedValue[Any]:
    """Make the reference to a value: the value itself in the process that made it."""
    own = _owned.get(digest)
    if own is not None:
        return own

    reference: SharedValue[Any] = SharedValue.__new__(SharedValue)
    reference.digest = digest
    reference.size = size
    reference._value = ()
    return reference
