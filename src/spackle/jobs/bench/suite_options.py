"""The choices of `spackle bench --suite`, and which of them cannot be."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

import torch

from spackle.bases.sharp.base import check_windows
from spackle.errors import InputError, check_name
from spackle.evaluation.setup import BASE, split_words
from spackle.evaluation.suite.scenes import SIDE
from spackle.evaluation.suite.tables import TITLES
from spackle.jobs.bench.options import MAX_RUNS
from spackle.jobs.options import PredictOptions, check_base_options

SIDES = (64, 8192)


@dataclasses.dataclass(frozen=True)
class SuiteOptions:
    """The choices of `spackle bench --suite`."""

    only: Sequence[str] = ()  # sections; none: all of them
    runs: int = 5
    base_runs: int = 1  # of SHARP
    base: PredictOptions = BASE  # of SHARP's sections, the residual's weights, the device
    sharp: bool = False  # its sections were asked for
    compiled: bool = False  # time the networks through torch.compile, too
    windows: Sequence[int] = ()  # time SHARP with so many at once, too
    side: int = SIDE  # pixels along the synthetic scenes

    @property
    def sections(self) -> list[str]:
        """Those that are wanted, in order."""
        return [name for name in TITLES if not self.only or name in self.only]

    @property
    def gpu_problem(self) -> str | None:
        """Why no GPU is looked at, or None."""
        if self.base.device == "cpu":
            return "--device cpu"
        return None if torch.cuda.is_available() else "no GPU"


def check_suite_options(options: SuiteOptions) -> None:
    """InputError for an option that cannot be used."""
    for name in options.only:
        check_name("--only", name, tuple(TITLES))
    for option, value, most in (("--runs", options.runs, MAX_RUNS), ("--base-runs", options.base_runs, MAX_RUNS)):
        if not 1 <= value <= most:
            raise InputError(f"{option} must be between 1 and {most}, got {value}")
    if not (SIDES[0] <= options.side <= SIDES[1] and options.side % 2 == 0):
        raise InputError(f"--side must be an even number between {SIDES[0]} and {SIDES[1]}, got {options.side}")
    if options.windows and not options.sharp:
        raise InputError("--windows is of SHARP, which is not timed: give -c FILE or --base sharp, or leave it out")
    for windows in options.windows:
        check_windows("--windows", windows, False)
    if options.base.device not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device {options.base.device}: unknown device; use auto, cpu or cuda")
    if options.base.device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: PyTorch sees no NVIDIA GPU on this machine; use --device cpu")
    if options.base.base != "sharp":
        raise InputError(f"--base {options.base.base}: the suite times no other base than sharp: leave the option out")
    residual = options.base.residual_file
    if residual is not None and not residual.is_file():
        raise InputError(f"--residual {residual}: no such file: check the name")
    if options.sharp:
        check_base_options(options.base)
        checkpoint = options.base.checkpoint
        if checkpoint is not None and not checkpoint.is_file():
            raise InputError(f"-c {checkpoint}: no such file: check the name")


def suite_options(
    base: PredictOptions,
    given: Collection[str],
    only: str | None,
    runs: int,
    base_runs: int | None,
    compiled: bool,
    windows: str | None,
    side: int | None,
) -> SuiteOptions:
    """The command line's choices; SHARP is timed where `given` names it or its weights."""
    return SuiteOptions(
        only=() if only is None else split_words(only),
        runs=runs,
        base_runs=1 if base_runs is None else base_runs,
        base=base,
        sharp=bool({"--base", "--checkpoint"} & set(given)),
        compiled=compiled,
        windows=() if windows is None else _whole_numbers("--windows", windows),
        side=SIDE if side is None else side,
    )


def _whole_numbers(option: str, words: str) -> tuple[int, ...]:
    try:
        return tuple(int(word) for word in split_words(words))
    except ValueError:
        raise InputError(f"{option} {words}: give whole numbers with commas between them") from None


def check_choice(suite: bool, given: Collection[str]) -> None:
    """InputError where neither a dataset nor the suite was asked for, or options of both.

    Args:
        suite: whether --suite was given.
        given: the options that were given, by their long names.
    """
    of_dataset = ("--dataset", "--root", "--limit", "--disparity")
    of_suite = ("--only", "--compile", "--windows", "--side")
    if not suite and (missing := [name for name in of_dataset[:2] if name not in given]):
        raise InputError(f"{' and '.join(missing)} missing: give --dataset NAME --root DIR, or --suite")
    for name in of_dataset if suite else of_suite:
        if name in given:
            raise InputError(f"{name} is {'not for --suite' if suite else 'for --suite alone'}: leave one of them out")
