"""Programs built once, a bench for every test; skipped where the tools are not installed."""

import functools
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from intelhex import IntelHex
from msgspec.structs import replace

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path.insert(0, str(ROOT))

from firmware.rig import build as builder  # noqa: E402 - the checkout is no installed package
from firmware.rig.boards import Setup  # noqa: E402
from gateway.flashing import boards  # noqa: E402
from tests.firmware.harness import Bench, MakeRig  # noqa: E402

NODE_OPTIONS = {"clock_ppm", "program", "noise"}
"""Options of a node; others are those of the bench."""


@pytest.fixture(scope="session")
def build() -> Callable[..., Path]:
    if missing := builder.missing_tools():
        pytest.skip(f"{', '.join(missing)} not found: apt-get install {builder.PACKAGES}")
    return functools.cache(builder.build)


@pytest.fixture(scope="session")
def programs(build: Callable[..., Path]) -> Path:
    return build()


@pytest.fixture
def changed(
    build: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., Path]:
    """Make folders of the built programs with other settings, as `mavgate flash` writes them."""

    def change(radio: str = "nrf24", **settings: Any) -> Path:
        folder = tmp_path_factory.mktemp("programs")
        for name in builder.PROGRAMS:
            image = IntelHex(str(build(radio=radio) / f"{name}.hex"))
            block, pipe = boards.block_of(image), {}
            if vehicle_id := settings.get("vehicle_id"):
                pipe = {"radio_pipe": boards.default_pipe(block.program, vehicle_id)}
            other = replace(block.settings, **pipe, **settings)
            (folder / f"{name}.hex").write_bytes(boards.with_settings(image, other))
            shutil.copy(build(radio=radio) / f"{name}.elf", folder)
        return folder

    return change


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


@pytest.fixture
def imu_rig(bench: Callable[..., Bench]) -> MakeRig:
    """Make benches with an IMU node that have run for some seconds."""
    return lambda seconds=0.0, **options: _with_node(bench, "imu_node", seconds, options)


@pytest.fixture
def gps_rig(bench: Callable[..., Bench]) -> MakeRig:
    """Make benches with a GPS node that have run for some seconds."""
    return lambda seconds=0.0, **options: _with_node(bench, "gps_node", seconds, options)


def _with_node(
    bench: Callable[..., Bench], kind: str, seconds: float, options: dict[str, Any]
) -> tuple[Bench, Any]:
    of_node = {name: options.pop(name) for name in NODE_OPTIONS & options.keys()}
    rig = bench(**options)
    node = getattr(rig, kind)(**of_node)
    rig.run(seconds)
    return rig, node
