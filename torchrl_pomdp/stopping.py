"""Work in threads that can be told to stop: Ctrl-C reaches the main thread alone, which would wait for the others to end."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["Stopped", "check_stopped", "watched", "watching"]

_OF_THREAD = threading.local()


class Stopped(BaseException):
    """This thread was told to stop."""


def watched() -> tuple[threading.Event, ...]:
    """The events that tell this thread to stop."""
    events: tuple[threading.Event, ...] = getattr(_OF_THREAD, "events", ())
    return events


@contextmanager
def watching(*events: threading.Event) -> Iterator[None]:
    """Let these events tell this thread to stop.

    Examples:
        >>> stop = threading.Event()
        >>> with watching(stop):
        ...     check_stopped()
        ...     stop.set()
        ...     check_stopped()
        Traceback (most recent call last):
        torchrl_pomdp.stopping.Stopped
    """
    before = watched()
    _OF_THREAD.events = events
    try:
        yield
    finally:
        _OF_THREAD.events = before


def check_stopped() -> None:
    """Raise :class:`Stopped` if this thread was told to stop; called wherever long work comes by again and again."""
    if any(event.is_set() for event in watched()):
        raise Stopped
