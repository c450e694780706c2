"""Programs built once, a bench for every test; skipped where the tools are not installed."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path.insert(0, str(ROOT))

from firmware.rig import build as builder  # noqa: E402 - the checkout is no installed package
from firmware.rig.boards import Setup  # noqa: E402
from tests.firmware.harness import Bench  # noqa: E402


@pytest.fixture(scope="session")
def build() -> Callable[..., Path]:
    if missing := builder.missing_tools():
        pytest.skip(f"{', '.join(missing)} not found: apt-get install {builder.PACKAGES}")
    return builder.build


@pytest.fixture(scope="session")
def programs(build: Callable[..., Path]) -> Path:
    return build()


@pytest.fixture
def bench(programs: Path) -> Iterator[Callable[..., Bench]]:
    """Make benches: boards on one time line, their frames decoded."""
    made: list[Bench] = []

    def make(receiver: str = "receiver", **setup: Any) -> Bench:
        made.append(Bench(Setup(**{"build": programs, **setup}), receiver))
        return made[-1]

    yield make
    for one in made:
        one.close()
