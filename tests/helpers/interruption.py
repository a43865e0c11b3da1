"""A real Ctrl-C in the middle of a training."""

from __future__ import annotations

import signal
from collections.abc import Callable

import pytest


def interrupt_after(
    patch: pytest.MonkeyPatch, owner: type, method: str, reached: Callable[[object], bool]
) -> None:
    """Raise SIGINT as soon as `reached(trainer)` holds after a call of the trainer's method."""
    original = getattr(owner, method)

    def interrupted(trainer, *arguments):
        done = original(trainer, *arguments)
        if reached(trainer):
            signal.raise_signal(signal.SIGINT)
        return done

    patch.setattr(owner, method, interrupted)
