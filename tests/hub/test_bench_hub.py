"""Command lines of the forwarders that the hub is compared with, as in their manuals."""

from tools.bench_hub import mavlink_router, mavproxy


def test_mavlink_router() -> None:
    build = mavlink_router("nice -n 5 /opt/mavlink-routerd")
    assert build(14550, [14560, 14561]) == [
        *("nice", "-n", "5", "/opt/mavlink-routerd"),
        *("-t", "0"),
        *("-e", "127.0.0.1:14560", "-e", "127.0.0.1:14561"),
        "127.0.0.1:14550",
    ]


def test_mavproxy() -> None:
    command = mavproxy("python mavproxy.py")(14550, [14560, 14561])
    assert command[:3] == ["python", "mavproxy.py", "--master=udpin:127.0.0.1:14550"]
    outs = [word for word in command if word.startswith("--out=")]
    assert outs == ["--out=udp:127.0.0.1:14560", "--out=udp:127.0.0.1:14561"]
