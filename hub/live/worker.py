"""The solver in a process of its own: the loop that serves the bus never waits for it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress

from hub.live.solver import SolverAnswer, SolverJob, run_job

_BUDGET_S = 60.0
"""CPU [s] for one job that is not large, and of more as its load says: twice what those of a street take."""
_IDLE_SHARE = 0.01  # of a core: one that computes had 0.13 beside twenty cameras on two cores, one that hangs has none
_MEMORY_BYTES = 3 << 30  # of the solver's process
_NICENESS = 5  # below the hub's own
_PARENT_CHECK_S = 1.0  # s: a solver without its hub ends
_THREAD_LIMITS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


class WorkerSolver:
    """Solves jobs in one worker process, which is ended and replaced when it exceeds its budget or dies.

    budget_s: CPU [s] that a job may take, or the time that it may do nothing.
    """

    def __init__(self, budget_s: float = _BUDGET_S) -> None:
        self._budget_s = budget_s
        self._pool: ProcessPoolExecutor | None = None
        self._pid: Future[int] | None = None
        self._job: tuple[int, float, Future[SolverAnswer]] | None = None
        self._share = 1.0  # of the budget that the job has
        self._spent_s = self._spent_before_s = self._looked = 0.0  # CPU of the worker at the last look, before the job
        self.restarts = 0

    @property
    def busy(self) -> bool:
        """Whether a job is under way."""
        return self._job is not None

    def submit(self, job: SolverJob, now: float) -> None:
        """Hand a job over; a worker is started where none runs."""
        try:
            future = self._started().submit(run_job, job)
        except BrokenProcessPool:  # it died after its last job
            self._end()
            future = self._started().submit(run_job, job)
        self._job = job.number, now, future
        self._share = job.load
        self._looked, self._spent_s = now, self._cpu_s()
        self._spent_before_s = self._spent_s

    def poll(self, now: float) -> SolverAnswer | None:
        """The answer, once; a failure where the worker died or was ended for exceeding its budget."""
        if self._job is None:
            return None
        number, since, future = self._job
        if future.done():
            self._job = None
            try:
                return future.result()
            except BrokenProcessPool:
                self._end()
                return SolverAnswer(number, reason="the solver's process ended", failed=True)
            except Exception as error:  # noqa: BLE001 - whatever a job raised there is a failed job here
                return SolverAnswer(number, reason=f"the solver failed: {type(error).__name__}: {error}", failed=True)
        if now - since <= self._share * self._budget_s or self._works(now):
            return None
        self._job = None
        self._end()
        return SolverAnswer(
            number, reason=f"no answer within {self._share * self._budget_s:g} s", failed=True, cpu_s=now - since
        )

    def _works(self, now: float) -> bool:
        """Whether a job that takes long is within its CPU and gets some: a busy machine is no reason to end it."""
        spent = self._cpu_s()
        within = spent - self._spent_before_s <= self._share * self._budget_s
        if not within or now - self._looked <= self._budget_s:
            return within
        idle = spent - self._spent_s < _IDLE_SHARE * (now - self._looked)
        self._looked, self._spent_s = now, spent
        return not idle

    def _cpu_s(self) -> float:
        """CPU [s] of the worker so far; 0 while it starts and where it cannot be told: then wall time decides."""
        with suppress(AttributeError, OSError, BrokenProcessPool):  # another system, or a worker that has died
            if self._pid is not None and self._pid.done():
                return time.clock_gettime((~self._pid.result() << 3) | 2)  # Linux' number of that clock
        return 0.0

    def close(self) -> None:
        """End the worker; a job under way is given up."""
        self._job = None
        self._end()

    def _started(self) -> ProcessPoolExecutor:
        if self._pool is None:
            for name in _THREAD_LIMITS:  # before the worker loads numpy; more threads double the CPU and gain nothing
                os.environ.setdefault(name, "1")
            self._pool = ProcessPoolExecutor(
                1,
                mp_context=multiprocessing.get_context("spawn"),
                initializer=_prepare_worker,
                initargs=(os.getpid(),),
            )
            self._pid = self._pool.submit(os.getpid)
        return self._pool

    def _end(self) -> None:
        """Kill the worker; the next job starts another one."""
        pool, pid, self._pool, self._pid = self._pool, self._pid, None, None
        if pool is None:
            return
        self.restarts += 1
        with suppress(Exception):
            if pid is not None and pid.done():
                os.kill(pid.result(), signal.SIGKILL)
        pool.shutdown(wait=False, cancel_futures=True)


def _prepare_worker(parent: int) -> None:
    """Bound the worker's memory, let the bus go first, and end with the parent, also where that was killed."""
    with suppress(ImportError, OSError, ValueError):  # not on every system
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (_MEMORY_BYTES, _MEMORY_BYTES))
    with suppress(OSError, AttributeError):
        os.nice(_NICENESS)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the hub, which ends its worker

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_PARENT_CHECK_S)
        os._exit(0)

    threading.Thread(target=watch, name="parent", daemon=True).start()
