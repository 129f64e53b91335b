"""What all tests share: how many examples the property tests try (`make fuzz` tries many more)."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("fuzz", max_examples=1000, deadline=None)
