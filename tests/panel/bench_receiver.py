"""A receiver on a pseudo-terminal, two nodes on a bench: one is turned, one can be silenced."""

import itertools
import math
import os
import threading
import time
import tty
from collections.abc import Iterator

from gateway.records import GpsFixType, ImuFlags, NodeId
from gateway.wire.framing import encode_frame
from gateway.wire.payloads import (
    GpsFixPayload,
    GpsQualityPayload,
    Header,
    ImuPayload,
    NodeStatusPayload,
    Payload,
    encode_payload,
    encode_radio,
)

RATE_HZ = 50
GPS_EVERY = 10
GYRO_BIAS = (33, -21, 12)
"""In counts of 1/32.8 degrees a second: what a calibration at rest finds."""
FIELD = 430
MOST_TILT_RAD = 0.5
"""Too little for a calibration: it goes on until the test ends it, however long that takes."""
IMU, GPS = NodeId(1, 0), NodeId(1, 1)
IMU_SENSORS, GPS_SENSORS = 0b0011, 0b1000


class BenchReceiver(threading.Thread):
    """Sends at a true rate until it is ended, later than due only where it has to wait itself."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        self.is_turned = False
        """Whether the field is felt from many sides, as of a compass that is turned by hand."""
        self.has_gps = True
        self._ended = threading.Event()
        self._numbers = {IMU: itertools.count(), GPS: itertools.count()}

    def run(self) -> None:
        frame_seq = 0
        begun_s = time.monotonic()
        for step in itertools.count():
            # Not a pause after each: the nodes' clocks would run slow, each heard in another way.
            if self._ended.wait(max(begun_s + step / RATE_HZ - time.monotonic(), 0.0)):
                return
            for node, payload in self._payloads(step):
                time_us = step * 1_000_000 // RATE_HZ
                header = Header(node, next(self._numbers[node]) % 65536, time_us)
                radio = encode_radio(
                    frame_seq % 256, node.node_id, time_us, encode_payload(header, payload)
                )
                frame_seq += 1
                # Nobody reads while the gateway begins.
                try:
                    os.write(self._master, encode_frame(radio))
                except BlockingIOError:
                    continue

    def end(self) -> None:
        self._ended.set()
        self.join()
        os.close(self._master)
        os.close(self._slave)

    def _payloads(self, step: int) -> Iterator[tuple[NodeId, Payload]]:
        yield IMU, self._imu(step)
        if self.has_gps and step % GPS_EVERY == 0:
            yield GPS, GpsQualityPayload(_itow_ms(step), 150, 200, 30, 100, 120, 4700, None)
            yield GPS, _fix(step)
        if step % RATE_HZ == 0:
            yield IMU, _status(IMU_SENSORS)
            if self.has_gps:
                yield GPS, _status(GPS_SENSORS)

    def _imu(self, step: int) -> ImuPayload:
        mag = (200, 30, -380)
        if self.is_turned:
            turn, tilt = step * 0.3, math.sin(step * 0.006) * MOST_TILT_RAD
            mag = (
                round(FIELD * math.cos(turn) * math.cos(tilt)),
                round(FIELD * math.sin(turn) * math.cos(tilt)),
                round(FIELD * math.sin(tilt)),
            )
        return ImuPayload(
            accel=(20, -15 + step % 3, 4096),
            gyro=GYRO_BIAS,
            mag=mag,
            temperature=-3900,
            flags=ImuFlags.MAG_NEW,
            accel_range=2,
            gyro_range=2,
            mag_gain=1,
        )


def _itow_ms(step: int) -> int:
    return step * 1000 // RATE_HZ


def _fix(step: int) -> GpsFixPayload:
    return GpsFixPayload(
        itow_ms=_itow_ms(step),
        lat_dege7=470_000_000 + step % 3,
        lon_dege7=80_000_000,
        alt_amsl_mm=431_000,
        vel_n_cmps=(0, 0, 0),
        fix_type=GpsFixType.FIX_3D,
        fix_ok=True,
        satellites=11,
    )


def _status(sensors: int) -> NodeStatusPayload:
    return NodeStatusPayload((1, 0), 0, sensors, 0, 0, 0, 0, 900, RATE_HZ, 3300)
