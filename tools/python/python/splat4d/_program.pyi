"""Types of the program's commands."""

from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any

PROGRAM: Path

def missing() -> str | None: ...
def command(
    name: str,
    *arguments: str | PathLike[str],
    progress: Callable[[str], Any] | None = None,
    **options: Any,
) -> dict[str, Any]: ...
def reconstruct(
    frames: str | PathLike[str],
    output: str | PathLike[str],
    *,
    progress: Callable[[str], Any] | None = None,
    **options: Any,
) -> dict[str, Any]: ...
def train(
    dataset: str | PathLike[str],
    output: str | PathLike[str],
    *,
    progress: Callable[[str], Any] | None = None,
    **options: Any,
) -> dict[str, Any]: ...
def track(
    frames: str | PathLike[str],
    output: str | PathLike[str],
    *,
    progress: Callable[[str], Any] | None = None,
    **options: Any,
) -> dict[str, Any]: ...
def evaluate(
    estimate: str | PathLike[str],
    reference: str | PathLike[str],
    *,
    progress: Callable[[str], Any] | None = None,
    **options: Any,
) -> dict[str, Any]: ...
def synth(
    name: str,
    output: str | PathLike[str],
    *,
    progress: Callable[[str], Any] | None = None,
    **options: Any,
) -> dict[str, Any]: ...
def main() -> int: ...
