"""How many random cases a law is tried on."""

from __future__ import annotations

from hypothesis import settings


def examples(count: int) -> int:
    """``count`` in the full profile of `conftest`, with which `make test-all` runs, and a third of it in the quick one."""
    now, full = (settings.get_profile(name).max_examples for name in (settings.get_current_profile_name(), "full"))
    return max(1, count * min(now, full) // full)
