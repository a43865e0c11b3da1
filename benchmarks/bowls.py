"""The bowls of `primitives` as an object set: evaluate.object_sets=benchmarks.bowls:bowls

Their walls lean by 15 to 49 degrees from the vertical, and friction holds to between 22 and 45. A
third of them has no antipodal contacts for fingers from straight above; a hand that leans finds
some.
"""

from __future__ import annotations

from envs.objects import ObjectError, ObjectPart, ObjectSet, PrimitiveSet, SetSettings


def bowls(settings: SetSettings) -> ObjectSet:
    """Those of the settings' split. Raises ObjectError where it has none."""
    whole = PrimitiveSet(settings)
    kinds = [whole.families[index % len(whole.families)] for index in whole.indices]
    found = [number for number, kind in enumerate(kinds) if kind == "bowl"]
    if not found:
        raise ObjectError(f"objects.split={settings.split}: has no bowls; use train or test")
    return ObjectPart(whole, found)
