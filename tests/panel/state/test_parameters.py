import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.panel.state.parameters import (
    MAX_ATTEMPTS,
    MAX_PARAMETERS,
    FileClient,
    ListState,
    ParameterClient,
    parameter_path,
    parse_parameters,
)
from gateway.units import US_PER_S
from tests.kit.vehicle_bench import VehicleBench


def loaded(*, may_change: bool = True) -> tuple[ParameterClient, VehicleBench]:
    """Return a client that has all parameters."""
    client = ParameterClient(1)
    bench = VehicleBench(client, may_change=may_change)
    bench.run(client.load(bench.now_us), 2.0)
    return client, bench


def client_of(*messages: Any) -> ParameterClient:
    """Return a client that has received some messages."""
    client = ParameterClient(1)
    for message in messages:
        client.handle(message, 0)
    return client


def value_of(
    name: str, value: float = 1.0, kind: int = 9, *, index: int = 0, count: int = 2
) -> Any:
    return mavlink.MAVLink_param_value_message(name.encode(), value, kind, count, index)


def beat_of(autopilot: int) -> Any:
    return mavlink.MAVLink_heartbeat_message(1, autopilot, 0, 0, 4, 3)


@pytest.mark.parametrize("lose_every", [0, 3])
def test_parameter_list_is_completed_despite_losses(lose_every: int) -> None:
    client = ParameterClient(1)
    bench = VehicleBench(client, lose_every=lose_every)
    bench.run(client.load(bench.now_us), 40.0 if lose_every else 2.0)
    assert client.state is ListState.COMPLETE
    assert len(client.entries) == client.count > 90


def test_valid_change_is_confirmed_and_invalid_one_refused() -> None:
    client, bench = loaded()
    assert client.entries["PAPER_ALPHA_GYRO"].value != 0.75
    bench.run(client.change("PAPER_ALPHA_GYRO", 0.75, bench.now_us), 0.1)
    assert client.entries["PAPER_ALPHA_GYRO"].value == 0.75
    assert not client.pending
    assert not client.refused
    bench.run(client.change("PAPER_ALPHA_GYRO", 5.0, bench.now_us), 0.1)
    assert client.refused == {"PAPER_ALPHA_GYRO": "the value is out of range"}
    assert client.entries["PAPER_ALPHA_GYRO"].value == 0.75


def test_second_change_before_the_answer_is_not_refused() -> None:
    client, bench = loaded()
    first = client.change("PAPER_ALPHA_GYRO", 0.75, bench.now_us)
    bench.run(first + client.change("PAPER_ALPHA_GYRO", 0.5, bench.now_us), 0.02)
    assert not client.refused
    bench.run([], 0.1)
    assert client.entries["PAPER_ALPHA_GYRO"].value == 0.5
    assert not client.pending
    assert not client.refused


def test_retry_sends_the_newest_value_of_an_unanswered_change() -> None:
    client = client_of(value_of("P"))
    client.change("P", 2.0, 0)
    assert not client.change("P", 3.0, 0)
    [message] = client.poll(US_PER_S)
    assert message.param_value == 3.0


def test_unrequested_value_does_not_complete_the_list() -> None:
    client = ParameterClient(1)
    client.load(0)
    for message in (value_of("NEW", index=65535), value_of("A", index=0)):
        client.handle(message, 0)
    assert client.state is ListState.LOADING
    assert [m.param_index for m in client.poll(2 * US_PER_S)] == [1]
    client.handle(value_of("B", index=1), 0)
    client.handle(value_of("A", index=65535), 0)
    assert client.state is ListState.COMPLETE
    assert {name: entry.index for name, entry in client.entries.items()} == {
        "NEW": 65535, "A": 0, "B": 1,
    }  # fmt: skip


def test_number_of_parameters_is_bounded() -> None:
    values = (value_of(f"P{n}", index=n, count=65_000) for n in range(MAX_PARAMETERS + 3))
    assert len(client_of(*values).entries) == MAX_PARAMETERS


def test_requests_without_an_answer_are_given_up_after_retries() -> None:
    changing, loading, files = client_of(value_of("P")), ParameterClient(1), FileClient(1)
    changes, listings = changing.change("P", 2.0, 0), loading.load(0)
    files.read("/general.json", 0)
    for second in range(1, 40):
        changes += changing.poll(second * US_PER_S)
        listings += loading.poll(second * US_PER_S)
        files.poll(second * US_PER_S)
    assert (len(changes), changing.refused) == (MAX_ATTEMPTS, {"P": "no answer"})
    assert loading.state is ListState.FAILED
    assert len(listings) < 20
    assert (files.content, files.busy) == (None, False)


def test_change_by_an_untrusted_client_is_refused_with_the_reason() -> None:
    client, bench = loaded(may_change=False)
    bench.run(client.change("PAPER_ALPHA_GYRO", 0.75, bench.now_us), 0.1)
    assert "may not change" in client.refused["PAPER_ALPHA_GYRO"]


def test_unknown_name_and_invalid_value_are_not_sent() -> None:
    client = client_of(beat_of(12), value_of("P"), value_of("N", 0.0, 6))
    for name, value, reason in (
        ("NIX", 1.0, "no parameter NIX"),
        ("P", math.nan, "not a number"),
        ("P", 1e39, "P cannot hold"),
        ("N", 1e10, "N cannot hold"),
    ):
        with pytest.raises(ValueError, match=reason):
            client.change(name, value, 0)
    assert not client.pending


def test_change_beyond_a_type_that_is_reported_later_is_refused() -> None:
    client = client_of(beat_of(12), value_of("N", 0.0, 6))
    assert client.change("N", 300.0, 0)
    client.change("N", 301.0, 0)
    client.handle(value_of("N", 0.0, 1), 0)
    assert client.poll(2 * US_PER_S) == []
    assert client.refused == {"N": "N cannot hold 301"}


def test_integers_are_encoded_by_the_convention_of_the_autopilot() -> None:
    """PX4 packs their bytes into the float, ArduPilot writes the number."""
    for autopilot, on_the_wire in ((12, 7.0e-45), (3, 5.0)):
        client = client_of(beat_of(autopilot), value_of("N", on_the_wire, 6))
        assert client.entries["N"].value == 5.0
        [message] = client.change("N", 5.0, 0)
        assert message.param_value == pytest.approx(on_the_wire, rel=0.01)


@pytest.mark.parametrize("lose_every", [0, 5])
def test_metadata_describes_every_parameter(lose_every: int) -> None:
    (parameters, _), files = loaded(), FileClient(1)
    bench = VehicleBench(files, lose_every=lose_every)
    bench.run(files.read("/general.json", bench.now_us), 5.0)
    path = parameter_path(files.content or b"")
    assert path == "/parameter-1.json.xz"
    bench.run(files.read(path, bench.now_us), 60.0 if lose_every else 5.0)
    metas = parse_parameters(files.content or b"")
    assert metas.keys() == parameters.entries.keys()
    meta = metas["PAPER_ALPHA_GYRO"]
    assert (meta.low, meta.high, meta.group) == (0.0, 1.0, "paper")
    assert meta.short
    assert not files.busy


def test_missing_file_is_refused() -> None:
    files = FileClient(1)
    bench = VehicleBench(files)
    bench.run(files.read("/nothing.json", bench.now_us), 0.2)
    assert (files.content, files.busy) == (None, False)


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"{", b"[]", b'{"parameters": 3}', b'{"parameters": [{"name": 3}, 4]}'),
        b"[" * 100_000,
        b'{"metadataTypes": [{"type": 1, "uri": "mftp://general.json"}]}',
    ],
    ids=["empty", "cut", "list", "number", "wrong entries", "deep", "own path"],
)
def test_invalid_metadata_describes_no_parameter(content: bytes) -> None:
    assert parse_parameters(content) == {}
    assert parameter_path(content) is None


def test_limit_of_nan_in_metadata_is_unknown() -> None:
    content = b'{"parameters": [{"name": "A", "min": NaN, "max": 2, "decimalPlaces": Infinity}]}'
    meta = parse_parameters(content)["A"]
    assert math.isnan(meta.low)
    assert meta.high == 2.0
