"""Another process that is inside a context while a test looks on."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from utils.runs import REPOSITORY


@contextmanager
def another_process_within(imports: str, context: str, argument: Path) -> Iterator[str]:
    """Until the end of this context another process is inside the one that `context` makes; yields
    what that one binds, as text.

    imports: lines of Python. context: an expression, in which `argument` is a Path.
    """
    code = (
        f"import sys\nfrom pathlib import Path\n{imports}\nargument = Path(sys.argv[1])\n"
        f"with {context} as bound:\n    print(bound, flush=True)\n    input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(argument)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        text=True, cwd=REPOSITORY,
    ) as other:  # fmt: skip
        assert other.stdout is not None
        try:
            yield other.stdout.readline().strip()
        finally:
            other.kill()
