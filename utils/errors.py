"""Errors that are the user's to fix, told in one sentence.

This module knows nothing about what went wrong; it only fixes how it is said.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class UserError(ValueError):
    """Bad input that its author can repair; the message says what, where, and what to do.

    Scripts print it as one line without a traceback, see `utils.config.run_script`.
    """


def did_you_mean(value: object, known: Iterable[str]) -> str:
    """'; did you mean X?' with the nearest known name, or '' when nothing is near."""
    near = difflib.get_close_matches(str(value), list(known), n=1, cutoff=0.6)
    return f"; did you mean {near[0]}?" if near else ""


def unknown_choice(where: str, value: object, known: Iterable[str]) -> UserError:
    """The error for a name that is none of `known`, e.g. a planner's name in a config."""
    known = sorted(known)
    return UserError(
        f"{where}: got {value!r}, expected one of {', '.join(known)}{did_you_mean(value, known)}"
    )
