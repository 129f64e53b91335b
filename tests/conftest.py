"""What all tests share: how many examples the property tests try (`make fuzz` tries many more), without time limits."""

from __future__ import annotations

import os
import tempfile

# Hubs keep their answers in the user's state folder where they have no other: not in that of who runs the tests.
os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="syncline-state-")
# One thread a process, as the command itself has it; must stand before numpy is loaded.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

from hypothesis import settings  # noqa: E402

settings.register_profile("default", deadline=None)
settings.register_profile("fuzz", max_examples=1000, deadline=None)
settings.load_profile("default")
