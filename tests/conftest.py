"""What all tests share: how many examples the property tests try (`make fuzz` tries many more)."""

from __future__ import annotations

import os

# One thread a process, as the command itself has it; must stand before numpy is loaded.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from hypothesis import settings  # noqa: E402

settings.register_profile("fuzz", max_examples=1000, deadline=None)
