"""How the C library keeps a process's memory: lean where it runs for months, at hand where it is one command."""

from __future__ import annotations

import ctypes
from contextlib import suppress

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # of glibc's mallopt
_ARENAS = 2
_LARGE = 128 * 1024
_LARGEST = 32 * 1024 * 1024  # glibc takes no more for a block's size
_ALL = 1024**3


def steady_heap(*, give_back: bool) -> bool:
    """Keep the heap from growing by fragments; call it before there are threads. False where the C library can't.

    glibc gives every thread an arena of its own, up to eight a core, and raises the size from which on a block is the
    system's again each time that a large one is freed: the holes that the threads of the bus and a solver leave behind
    made a hub grow by some MB an hour. give_back: hand every large block back as soon as it is freed, which costs
    a fresh page for each 4 KiB of it: right for what solves every few seconds, not for what handles a picture 30 times
    a second. What the environment says (MALLOC_ARENA_MAX, …) is overruled.
    """
    try:
        set_option = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # musl, macOS
        return False
    done = bool(set_option(_ARENA_MAX, _ARENAS))
    if give_back:
        done = bool(set_option(_MMAP_THRESHOLD, _LARGE)) and bool(set_option(_TRIM_THRESHOLD, _LARGE)) and done
    return done


def keep_heap() -> bool:
    """Keep what is freed for the next one who asks, in a process that ends soon. False where the C library can't.

    Solvers make and free the same arrays of some 100 kB again and again; asked back from the system each time, every
    4 KiB of them are a fault and are zeroed: a fifth of what `calibrate` took.
    """
    try:
        set_option = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # musl, macOS
        return False
    return bool(set_option(_MMAP_THRESHOLD, _LARGEST)) and bool(set_option(_TRIM_THRESHOLD, _ALL))


def trim() -> None:
    """Give free pages back to the system, also those between blocks that are in use; about a millisecond."""
    with suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)
