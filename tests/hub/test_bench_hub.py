"""Command lines of the routers that the benchmark compares."""

import pytest

from tools.bench_hub import ROUTERS, router


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (
            f"nice -n 5 /opt/routerd {ROUTERS['mavlink-router']}",
            "nice -n 5 /opt/routerd -t 0 -e 127.0.0.1:14560 -e 127.0.0.1:14561 127.0.0.1:14550",
        ),
        ("r in={in} {out}", "r in=14550 14560 14561"),
        ("r --to {out} --from {in}", "r --to 14560 --to 14561 --from 14550"),
    ],
)
def test_command_of_a_router_names_all_ports(command: str, expected: str) -> None:
    assert router(command)(14550, [14560, 14561]) == expected.split()
