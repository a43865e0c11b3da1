"""How often a fault was tried, and what became of it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Tally:
    """One row of docs/reliability.md.

    tried: how often the fault happened. survived: how often the program did what it should: go on
    within its limits, or end with one sentence and leave what was there. lost: results, files or
    rounds that were gone or changed afterwards. note: what else was measured.
    """

    fault: str
    tried: int = 0
    survived: int = 0
    lost: int = 0
    note: str = ""

    def add(self, survived: bool, lost: int = 0) -> None:
        """Count one more try."""
        self.tried += 1
        self.survived += survived
        self.lost += lost
