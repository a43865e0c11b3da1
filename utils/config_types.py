"""What the sections of the configuration are made of: their base, and types that several share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

OBJECT_SETS = ("box", "primitives", "random_urdfs")


def _object_set(value: str) -> str:
    if value not in OBJECT_SETS and not Path(value).expanduser().is_dir():
        raise ValueError("no such object set or folder")
    return value


def no_repeats(values: tuple) -> tuple:
    """A validator of lists in which every entry stands once."""
    if len(set(values)) != len(values):
        raise ValueError("an entry is repeated")
    return values


Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(gt=0, le=1)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Pixels = Annotated[int, Field(ge=16, le=4096)]
Name = Annotated[str, Field(min_length=1)]
# What a type alone cannot tell is put in `description`, which error messages quote.
ObjectSet = Annotated[
    str,
    AfterValidator(_object_set),
    Field(description=f"one of {', '.join(OBJECT_SETS)}, or an existing folder"),
]
Scenario = Literal["isolated", "packed", "pile"]
ScoredScenario = Literal[
    "isolated", "packed", "pile", "static", "moved", "moving_5cm", "moving_10cm", "turning_5cm",
    "turning_10cm", "crossing_5cm", "miscalibrated", "latency",
]  # fmt: skip
Controller = Literal["open_loop", "pbvs", "ibvs", "hybrid"]
Mount = Literal["overhead", "wrist"]
# YAML has lists where frozen objects hold tuples, hence strict=False; the items stay strict.
Vector2 = Annotated[tuple[float, float], Field(strict=False)]
Vector3 = Annotated[tuple[float, float, float], Field(strict=False)]
JointVector = Annotated[tuple[float, float, float, float, float, float, float], Field(strict=False)]
Several = Field(min_length=1, strict=False)


class Section(BaseModel):
    """Base of every section: no unknown keys, no silent conversions, no changes, no NaN."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)
