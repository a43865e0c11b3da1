"""Where a program's time goes: seconds by name, and the rest as overhead."""

from __future__ import annotations

import time
from collections import defaultdict
from types import TracebackType


class Stopwatch:
    """Sums up seconds spent in `with watch("simulation"): ...`, by name; not to be nested.

    Everything since `start` that is not inside such a block counts as overhead.
    """

    OVERHEAD = "overhead"

    def __init__(self):
        self.start()

    def start(self) -> None:
        """Forget everything and begin anew."""
        self._spent: defaultdict[str, float] = defaultdict(float)
        self._begun = time.perf_counter()

    def __call__(self, name: str) -> Stopwatch:
        self._name = name
        return self

    def __enter__(self) -> None:
        self._since = time.perf_counter()

    def __exit__(
        self, kind: type | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._spent[self._name] += time.perf_counter() - self._since

    def seconds(self) -> dict[str, float]:
        """Seconds by name, the overhead last; they sum up to the time since `start`."""
        total = time.perf_counter() - self._begun
        return dict(self._spent) | {self.OVERHEAD: total - sum(self._spent.values())}
