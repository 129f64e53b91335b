"""Tuning of glibc's malloc: small resident memory for long-running agents, fast reuse for a single command."""

from __future__ import annotations

import ctypes
import gc

_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # of glibc's mallopt
_MAX_ARENAS = 2  # glibc would make eight a core
_LARGE_BLOCK_BYTES = 128 * 1024  # glibc's own initial threshold, here kept from growing
_MAX_MMAP_THRESHOLD_BYTES = 32 * 1024 * 1024  # glibc's upper limit
_OBJECTS_PER_COLLECTION = 100_000  # instead of Python's 700
_NEVER_TRIM_BYTES = 1024**3  # more than any command frees


def limit_heap_growth(*, release_large_blocks: bool) -> bool:
    """Limit heap growth by fragmentation; call it before threads are started. False if the C library has no mallopt.

    glibc gives every thread an arena of its own, up to eight per core, and raises the mmap threshold each time that a
    large block is freed: the holes that the threads of the bus and a solver leave behind made a hub grow by some MB
    per hour. release_large_blocks: return every large block to the system as soon as it is freed, which costs a page
    fault for each 4 KiB of it: suitable for a process that solves every few seconds, not for one that handles 30
    images per second. Environment variables (MALLOC_ARENA_MAX, …) are overridden.
    """
    options = {_ARENA_MAX: _MAX_ARENAS}
    if release_large_blocks:
        options |= {_MMAP_THRESHOLD: _LARGE_BLOCK_BYTES, _TRIM_THRESHOLD: _LARGE_BLOCK_BYTES}
    return _set_options(options)


def retain_freed_memory() -> bool:
    """Keep freed memory in the heap for reuse, in a process that ends soon. False if the C library has no mallopt.

    Solvers allocate and free the same arrays of some 100 kB repeatedly. If each is requested from the system again,
    every 4 KiB cause a page fault and are zeroed, which took a fifth of the run time of `calibrate`. Python's search
    for reference cycles, of which imports and solvers make few, takes another thirtieth.
    """
    gc.set_threshold(_OBJECTS_PER_COLLECTION)
    return _set_options({_MMAP_THRESHOLD: _MAX_MMAP_THRESHOLD_BYTES, _TRIM_THRESHOLD: _NEVER_TRIM_BYTES})


def _set_options(options: dict[int, int]) -> bool:
    try:
        set_option = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # musl, macOS
        return False
    done = [bool(set_option(option, value)) for option, value in options.items()]
    return all(done)
