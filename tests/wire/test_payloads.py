"""Radio payloads and receiver frames: golden bytes both ways, faults for everything else."""

import json
from datetime import datetime
from pathlib import Path

import msgspec
import numpy as np
import pytest

from gateway.records import GpsFixType, NodeId, RadioSignal, RadioState
from gateway.wire import payloads
from gateway.wire.framing import Fault, FaultKind
from tests.kit.payloads import decode_payload

VECTORS = json.loads((Path(__file__).parent.parent / "vectors" / "frames.json").read_text())
RADIO = [vector for vector in VECTORS if "payload_hex" in vector]
STATUS = [vector for vector in VECTORS if vector["kind"] == "ReceiverStatus"]


def as_json(record: object) -> dict:
    """Bring a record to what the table holds: lists for tuples, ISO text for times."""
    plain = msgspec.to_builtins(record, builtin_types=(datetime,))
    return json.loads(json.dumps(plain, default=lambda moment: moment.isoformat()))


def test_scales_are_those_of_the_data_sheets() -> None:
    """HMC5883L, gain settings 0 to 7; QMC5883L and QMC5883P, 8 G; MPU6050, full scales 0 to 3."""
    assert payloads.MAG_LSB_PER_GAUSS == (1370, 1090, 820, 660, 440, 390, 330, 230, 3000, 3750)
    assert payloads.ACCEL_RANGES_G == (2, 4, 8, 16)
    assert payloads.GYRO_RANGES_DPS == (250, 500, 1000, 2000)


@pytest.mark.parametrize("vector", RADIO, ids=lambda v: v["name"])
class TestRadioVectors:
    def test_decode(self, vector: dict) -> None:
        frame = payloads.decode_content(bytes.fromhex(vector["content_hex"]))
        assert isinstance(frame, payloads.RadioFrame)
        assert type(frame.payload).__name__ == vector["kind"]
        assert as_json(frame.payload) == vector["fields"]
        assert as_json(frame.header) == vector["header"]
        assert frame.frame_seq == vector["frame_seq"]
        assert frame.pipe == vector["pipe"]
        assert frame.receiver_time_us == vector["receiver_time_us"]

    def test_encode(self, vector: dict) -> None:
        frame = payloads.decode_content(bytes.fromhex(vector["content_hex"]))
        packet = payloads.encode_payload(frame.header, frame.payload)
        assert len(packet) <= payloads.MAX_PAYLOAD
        assert packet.hex() == vector["payload_hex"]
        content = payloads.encode_radio(frame.frame_seq, frame.pipe, frame.receiver_time_us, packet)
        assert content.hex() == vector["content_hex"]

    def test_any_other_length_is_a_fault(self, vector: dict) -> None:
        packet = bytes.fromhex(vector["payload_hex"])
        for size in set(range(payloads.MAX_PAYLOAD + 4)) - {len(packet)}:
            padded = packet[:size].ljust(size, b"\x01")
            assert isinstance(decode_payload(padded), Fault)


@pytest.mark.parametrize("vector", STATUS, ids=lambda v: v["name"])
def test_receiver_status_equals_its_vector(vector: dict) -> None:
    frame = payloads.decode_content(bytes.fromhex(vector["content_hex"]))
    assert isinstance(frame, payloads.ReceiverStatusFrame)
    assert as_json(frame) == vector["fields"]
    assert payloads.encode_receiver_status(frame).hex() == vector["content_hex"]


SIGNAL_HEAD = "13 07 02 00010203"
"""Version and kind, sequence, pipe, receiver time."""


def test_payload_with_signal_has_the_layout_of_the_protocol() -> None:
    plain = payloads.decode_content(bytes.fromhex(RADIO[0]["content_hex"]))
    packet = bytes.fromhex(RADIO[0]["payload_hex"])
    content = bytes.fromhex(SIGNAL_HEAD + "79 e4") + packet  # -121 dBm, -7 dB
    frame = payloads.decode_content(content)
    head = (7, 2, 0x03020100, plain.header, plain.payload)
    assert frame == payloads.RadioFrame(*head, RadioSignal(-121, -7.0))
    assert payloads.encode_radio(7, 2, 0x03020100, packet, frame.signal) == content


def test_foreign_packet_has_the_layout_of_the_protocol() -> None:
    content = bytes.fromhex("14 07 ff 00010203 50 28") + b"\xff\x07\x21\x00text"
    frame = payloads.decode_content(content)
    text = b"\xff\x07\x21\x00text"
    assert frame == payloads.ForeignFrame(7, 0x03020100, RadioSignal(-80, 10.0), text)


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        ("13 07 02 00010203 79 e4", FaultKind.PAYLOAD),
        ("14 07 ff 00010203 79 e4", FaultKind.PAYLOAD),
        ("13 07 02 00010203 79 e4 21" + "00" * 30, FaultKind.VERSION),
        ("13 07 06 00010203 79 e4" + RADIO[0]["payload_hex"], FaultKind.VALUE),
        ("13 07 02 00010203 79 e4 ff", FaultKind.PAYLOAD),
    ],
)
def test_damaged_frame_with_signal_is_a_fault(content: str, kind: FaultKind) -> None:
    data = bytes.fromhex(content)
    assert payloads.decode_content(data) == Fault(kind, len(data))


@pytest.mark.parametrize("scale", range(16))
def test_unknown_magnetometer_scale_is_a_fault(scale: int) -> None:
    packet = bytes.fromhex("11 15 3412 78563412" + "00" * 22) + bytes([scale << 4])
    decoded = decode_payload(packet)
    if scale < len(payloads.MAG_LSB_PER_GAUSS):
        assert decoded[1].mag_gain == scale
    else:
        assert decoded == Fault(FaultKind.VALUE, len(packet))


@pytest.mark.parametrize("radio", range(16))
def test_unknown_radio_state_is_a_fault(radio: int) -> None:
    status = bytes.fromhex("15 09 0000 00000000 0101") + bytes([radio << 4 | 1]) + bytes(20)
    receiver = bytes.fromhex("12 00 ff 00000000 4c000000") + bytes([radio << 4 | 1]) + bytes(60)
    decoded, frame = decode_payload(status), payloads.decode_content(receiver)
    if radio <= max(RadioState):
        assert (decoded[1].radio, decoded[1].reset_cause) == (RadioState(radio), 1)
        assert (frame.radio, frame.reset_cause) == (RadioState(radio), 1)
    else:
        assert decoded == Fault(FaultKind.VALUE, len(status))
        assert frame == Fault(FaultKind.VALUE, len(receiver))


@pytest.mark.parametrize(
    ("chips", "present", "names"),
    [
        (payloads.Chips(0x68, 0x1E, 0x55), 7, ("MPU6050", "HMC5883L", "BMP180")),
        (payloads.Chips(0x98, 0x2C, 0x60), 7, ("ICM-20689", "QMC5883P", "BME280")),
        (payloads.Chips(0x00, 0x0D), 3, ("MPU6050 look-alike, id 0x00", "QMC5883L")),
        (payloads.Chips(0x68), 0, ()),
        (payloads.Chips(gps=0x1A, gps_baud_hundreds=576), 8, ("u-blox M10 at 57600 baud",)),
        (
            payloads.Chips(gps=0x02, gps_baud_hundreds=576),
            8,
            ("u-blox look-alike at 57600 baud, acknowledges nothing",),
        ),
        (payloads.Chips(gps=0x01, gps_baud_hundreds=96), 8, ("NMEA receiver at 9600 baud",)),
        (payloads.Chips(), 8, ()),
    ],
)
def test_chips_are_named(chips: payloads.Chips, present: int, names: tuple[str, ...]) -> None:
    assert payloads.chip_names(chips, present) == names


FIX = payloads.GpsFixPayload(1000, 10, 20, 30, (1, 2, 3), GpsFixType.FIX_3D, True, 9)
HEADER = payloads.Header(NodeId(1, 1), 1, 1)


@pytest.mark.parametrize(
    ("offset", "value", "kind"),
    [
        (0, 0x23, FaultKind.VERSION),
        (0, 0x1F, FaultKind.KIND),
        (1, 0x01, FaultKind.VALUE),
        (15, 0x7F, FaultKind.VALUE),
        (19, 0x7F, FaultKind.VALUE),
        (30, 0x06, FaultKind.VALUE),
    ],
    ids=["version", "kind", "vehicle 0", "latitude", "longitude", "fix type"],
)
def test_impossible_value_is_a_fault(offset: int, value: int, kind: FaultKind) -> None:
    packet = bytearray(payloads.encode_payload(HEADER, FIX))
    packet[offset] = value
    assert decode_payload(bytes(packet)) == Fault(kind, len(packet))


def test_month_13_is_a_fault_and_a_leap_second_a_time() -> None:
    [vector] = (v for v in RADIO if v["name"] == "gps_quality_utc")
    packet = bytearray.fromhex(vector["payload_hex"])
    packet[30] = 60
    _, quality = decode_payload(bytes(packet))
    assert (quality.utc.second, quality.utc.microsecond) == (59, 990_000)
    packet[26] = 13
    assert decode_payload(bytes(packet)) == Fault(FaultKind.VALUE, len(packet))


def test_pipe_above_five_is_a_fault() -> None:
    packet = payloads.encode_payload(HEADER, payloads.BaroPayload(1, 1))
    content = payloads.encode_radio(0, 6, 0, packet)
    assert payloads.decode_content(content) == Fault(FaultKind.VALUE, len(content))


@pytest.mark.parametrize("seed", range(10))
def test_garbage_gives_only_frames_or_faults(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(500):
        content = bytearray(rng.bytes(int(rng.integers(0, 80))))
        if len(content) > 7:
            content[0] = rng.choice([0x11, 0x12, 0x13])
            content[7] = rng.choice([0x11, 0x12, 0x13, 0x14, 0x15, 0x16])
        kinds = payloads.RadioFrame | payloads.ReceiverStatusFrame | Fault
        assert isinstance(payloads.decode_content(bytes(content)), kinds)
