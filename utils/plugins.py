"""Plug-ins by import path: `module:name` names an object of a module outside this repository.

Gymnasium names its environments in the same way. A planner, an object set, a depth noise, a reward
or a term of one that is given as `module:name` needs no entry in a registry. The module must be
importable: from the folder that a script is started in (`utils.runs.run_script`), from
`PYTHONPATH` or as an installed package. Only a config or a command line may name one: what a
checkpoint or another file of data names is not imported (`utils.config.load_foreign`). This module
knows nothing about what is loaded.
"""

from __future__ import annotations

import importlib
import re
import traceback
from collections.abc import Iterator
from typing import Any

from utils.errors import UserError, did_you_mean, one_line

IMPORT_PATH = r"^[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*(\.[A-Za-z_]\w*)*$"
# A list of policies, and the planners in a table of them: here `ppo:FILE.pt` is a checkpoint.
POLICY_KEYS = ("evaluate.policies", "transfer.policies[2]")

_loaded: set[str] = set()


def loaded_modules() -> list[str]:
    """The modules of all plug-ins that this process has loaded."""
    return sorted(_loaded)


def is_import_path(name: str) -> bool:
    """Whether `name` has the form `module:name`; it need not exist. `ppo:model.pt` has it too."""
    return re.fullmatch(IMPORT_PATH, name) is not None


def names_code(key: str, name: str) -> bool:
    """Whether a text at a dotted key of a config would run code that is named by it: an import path
    (a Gymnasium id `MODULE:ID` is one), or a policy that is unpickled."""
    if key == "rl.env_id":
        return ":" in name
    if key in POLICY_KEYS and name.startswith("ppo:"):
        return False
    return name.startswith("sb3:") or is_import_path(name)


def code_named_in(values: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Dotted key and text of all that would run code in the plain data of a config; the terms of a
    reward are keys of a mapping. In a list of lists, such as a table, [COLUMN] ends the key."""
    if isinstance(values, dict):
        for name, value in values.items():
            if isinstance(name, str) and names_code(key, name):
                yield key, name
            yield from code_named_in(value, f"{key}.{name}" if key else str(name))
    elif isinstance(values, list | tuple):
        for value in values:
            if isinstance(value, list | tuple):
                for column, entry in enumerate(value):
                    yield from code_named_in(entry, f"{key}[{column}]")
            else:
                yield from code_named_in(value, key)
    elif isinstance(values, str) and names_code(key, values):
        yield key, values


def load_plugin(path: str, what: str, must_be_callable: bool = True) -> Any:
    """The object that `path`, of the form `module:name`, names.

    path: dotted module, colon, name; the name may be dotted, as `module:Class.method`.
    what: the purpose in the error message, such as the config key "evaluate.policies".
    must_be_callable: refuse what cannot be called.
    Raises UserError, in one sentence, for a path of another form, a module that does not exist or
    fails while it is imported, a missing name, and an object that cannot be called.
    """
    if not is_import_path(path):
        raise UserError(
            f"{what}: got {path!r}, expected an import path module:name such as my_module:plan"
        )
    module_name, _, name = path.partition(":")
    module = _import(module_name, path, what)
    _loaded.add(module_name)
    found: Any = module
    for part in name.split("."):
        if not hasattr(found, part):
            public = [known for known in dir(found) if not known.startswith("_")]
            raise UserError(
                f"{what}: {path!r} cannot be loaded: {getattr(found, '__name__', module_name)} has "
                f"no {part!r}{did_you_mean(part, public) or '; check the name after the colon'}"
            )
        found = getattr(found, part)
    if must_be_callable and not callable(found):
        raise UserError(
            f"{what}: {path!r} is a {type(found).__name__}, expected something that can be called"
        )
    return found


def _import(module_name: str, path: str, what: str) -> Any:
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        missing = error.name or module_name
        if module_name == missing or module_name.startswith(f"{missing}."):
            raise UserError(
                f"{what}: {path!r} cannot be loaded: there is no module {missing!r}; start in the "
                "folder that holds it, or add that folder to PYTHONPATH"
            ) from error
        raise _failed(error, path, what) from error
    except Exception as error:  # whatever the module's own code raises is its author's to fix
        raise _failed(error, path, what) from error


def _failed(error: Exception, path: str, what: str) -> UserError:
    last = traceback.extract_tb(error.__traceback__)[-1]
    reason = one_line(error)
    return UserError(
        f"{what}: {path!r} cannot be loaded: its module raised {type(error).__name__}: {reason} "
        f"({last.filename}, line {last.lineno}); correct the module"
    )
