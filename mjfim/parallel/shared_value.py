"""Large values that tasks hold by their hash, so that a worker process need not get them each time.

A task is sent without the value. A process that does not have it yet says so in place of a result;
the task is then sent again together with the value, which the process keeps. This needs nothing of
an executor but `submit`.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar
from weakref import WeakValueDictionary

T = TypeVar("T")
Order = TypeVar("Order")

# Number of values that a process keeps. Those that were not used for the longest time are sent
# again when a task needs them.
KEPT_VALUES = 16


class AbsentValueError(Exception):
    """A task needs a shared value that its process has not received.

    Attributes:
        digest: Hash of the value.
    """

    def __init__(self, digest: str) -> None:
        super().__init__(digest)
        self.digest = digest


class SharedValue(Generic[T]):
    """A value that is pickled as its hash.

    Args:
        digest: Hash of the value; equal for equal values only.
        value: The value, which can be pickled and is never changed.

    Attributes:
        digest: The hash.
    """

    def __init__(self, digest: str, value: T) -> None:
        self.digest = digest
        self._value: tuple[T, ...] = (value,)
        _owned[digest] = self

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

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str]]:
        """Pickle the hash alone."""
        return _referenced, (self.digest,)


class _ReceivedValues:
    """The latest values that this process has received. Its threads share them."""

    def __init__(self) -> None:
        """Start without any value."""
        self._lock = threading.Lock()
        self._values: OrderedDict[str, Any] = OrderedDict()

    def put(self, digest: str, value: object) -> None:
        """Keep a value, and forget the one that was not used for the longest time."""
        with self._lock:
            self._values[digest] = value
            self._values.move_to_end(digest)
            while len(self._values) > KEPT_VALUES:
                self._values.popitem(last=False)

    def get(self, digest: str) -> Any:
        """Return a value; AbsentValueError where it was not received, or forgotten since."""
        with self._lock:
            if digest not in self._values:
                raise AbsentValueError(digest)
            self._values.move_to_end(digest)
            return self._values[digest]


# Values that this process has made and still uses, and values that it has received.
_owned: WeakValueDictionary[str, SharedValue[Any]] = WeakValueDictionary()
_received = _ReceivedValues()


def owned_value(digest: str) -> Any:
    """Return a value that this process has made, to send it to a worker.

    Args:
        digest: Its hash.

    Raises:
        AbsentValueError: This process did not make it, or does not have it any more.
    """
    shared = _owned.get(digest)
    if shared is None:
        raise AbsentValueError(digest)
    return shared.value


@dataclass(frozen=True, kw_only=True)
class AbsentValue:
    """What a worker returns in place of a result where a value is absent.

    Attributes:
        digest: Hash of the value.
    """

    digest: str


def attempt(
    function: Callable[[Order], T], values: Mapping[str, Any], order: Order
) -> T | AbsentValue:
    """Carry out an order in a worker, if the values are there that it needs.

    An error would be the other way to say that one is absent, but Dask prints the errors of tasks.

    Args:
        function: Carries out the order.
        values: Values by their hash, which this process keeps from now on.
        order: The order.

    Returns:
        The result of the order, or which value it needs.
    """
    for digest, value in values.items():
        _received.put(digest, value)

    try:
        return function(order)
    except AbsentValueError as error:
        return AbsentValue(digest=error.digest)


def _referenced(digest: str) -> SharedValue[Any]:
    """Make the reference to a value: the value itself in the process that made it."""
    own = _owned.get(digest)
    if own is not None:
        return own

    reference: SharedValue[Any] = SharedValue.__new__(SharedValue)
    reference.digest = digest
    reference._value = ()
    return reference
