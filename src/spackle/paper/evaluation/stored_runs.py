"""What the files of an evaluation or a benchmark must hold, checked when they are read.

Whoever makes tables of results may have got their files from somebody else, or edited them.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter, model_validator

from spackle.paper.evaluation.case import SecondViews
from spackle.paper.evaluation.measurements import (
    NOTE_PREFIX,
    PROBLEM_METRIC,
    REMARK_METRIC,
    Measurement,
)
from spackle.paper.evaluation.options import Protocol

TEXT_METRICS = (PROBLEM_METRIC, REMARK_METRIC)  # whose values are texts, as those of notes are


class _Stored(BaseModel):
    """An object of a file, which may have more fields: they are shown, or compared as a whole."""

    model_config = ConfigDict(frozen=True, extra="allow", strict=True)


class StoredBase(_Stored):
    """The base of a run."""

    name: str
    says: str
    weights: Any  # a digest, or several by name; None without weights
    device: str | None = None  # of benchmarks


class StoredResidual(_Stored):
    """The residual network of a run."""

    weights: Literal["initial", "shipped", "given"]
    sha256: str | None
    precision: str | None


class StoredHardware(_Stored):
    """The machine of a benchmark."""

    cpu: str
    cores: int | None
    threads: int
    gpu: str = ""


class StoredAbout(_Stored):
    """What did not determine the results of an evaluation; empty for benchmarks."""

    metrics: dict[str, str] = Field(default_factory=dict)


class StoredConfig(_Stored):
    """The content of config.json that evaluations and benchmarks share."""

    title: str
    about_scenes: str = ""
    methods: Annotated[list[str], Field(min_length=1)]
    base: StoredBase
    residual: StoredResidual
    device: str
    side: int | None
    disparities: list[FiniteFloat] | None
    about: StoredAbout


class EvaluationConfig(StoredConfig):
    """The content of config.json of an evaluation."""

    kind: Literal["evaluate"]
    protocol: Protocol
    second_views: SecondViews | None

    @model_validator(mode="after")
    def _check_views(self) -> EvaluationConfig:
        """ValueError if it is not said which views were rendered."""
        is_near_view = self.protocol == "near-view"
        if (self.second_views if is_near_view else self.disparities) is None:
            raise ValueError(f"no views of the protocol {self.protocol}")
        return self


class BenchConfig(StoredConfig):
    """The content of config.json of a benchmark."""

    kind: Literal["bench"]
    protocol: Literal["bench"]
    disparities: list[FiniteFloat]
    runs: int
    base_runs: int
    hardware: StoredHardware
    versions: dict[str, str]


class StoredRow(_Stored):
    """A line of rows.jsonl: the fields of a `Measurement`."""

    model_config = ConfigDict(extra="forbid")

    dataset: str
    image: str
    setting: str
    view: str
    method: str
    metric: str
    value: FiniteFloat | str | None

    @model_validator(mode="after")
    def _check_value(self) -> StoredRow:
        """ValueError for a text in place of a number."""
        may_be_text = self.metric in TEXT_METRICS or self.metric.startswith(NOTE_PREFIX)
        if isinstance(self.value, str) and not may_be_text:
            raise ValueError(f"the value of {self.metric[:40]!a} is no number")
        return self


_AnyConfig = Annotated[EvaluationConfig | BenchConfig, Field(discriminator="kind")]
_CONFIGS: TypeAdapter[EvaluationConfig | BenchConfig] = TypeAdapter(_AnyConfig)


def check_config(content: dict[str, Any]) -> None:
    """Raise a ValueError unless the content of config.json is that of a run."""
    _CONFIGS.validate_python(content)


def read_row(line: str) -> Measurement:
    """The measurement of a line of rows.jsonl; ValueError if it is none."""
    return Measurement(**StoredRow.model_validate_json(line).model_dump())
