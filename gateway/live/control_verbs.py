"""The verbs of a gateway's control socket; see docs/control.md."""

import asyncio
import hmac
import math
import os
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final

import msgspec

from gateway.compiled.entry_point import LibraryError, load_entry_points
from gateway.extras import how_to_add, missing
from gateway.hub.endpoint import ADDED_KINDS, Endpoint, EndpointKind, parse_endpoint
from gateway.hub.hub import Hub
from gateway.hub.transports.url_files import check_files
from gateway.live.control_socket import ControlError, Verbs
from gateway.live.recorder import Recorder
from gateway.live.serial_port import AUTO, SerialPort, SerialStatus, list_serial_ports
from gateway.live.session import SessionState
from gateway.live.source_port import SourcePort
from gateway.printable import reason_of
from gateway.recordings.index import Recording, delete_recording, find_recording, list_recordings
from gateway.records import FusedSample, ImuFlags, ImuRaw, NodeId
from gateway.sensing.calibration import NodeCalibration
from gateway.status import RecorderStatus
from gateway.units import US_PER_S
from gateway.vehicle.plan import Location

MAX_FRAMES: Final = 200
"""Maximum frames of an answer: some 60 bytes each, and a line of the control socket has 64 kB."""
MAX_SAMPLES: Final = 400
"""Maximum samples between two requests: some seconds, and less than a line of the socket."""
NEEDED_EXTRAS: Final = {"mqtt": "mqtt", EndpointKind.ZENOH: "fleet"}
"""Extras by kind of endpoint."""
IDLE_US: Final = 5 * US_PER_S
"""Samples are no longer collected after this time without a request."""
Values = tuple[int, ...]
"""Time, accelerometer, gyroscope and magnetometer counts, temperature, three ranges, flags."""
VehicleId = Annotated[int, msgspec.Meta(ge=1, le=255)]


class RecorderVerbs:
    """The verbs `record.*`, which answer when the disk has done what was asked."""

    def __init__(self, recorder: Recorder, has_vehicle: Callable[[], bool] = lambda: True) -> None:
        self._recorder, self._has_vehicle = recorder, has_vehicle

    def verbs(self) -> Verbs:
        """Return the handlers."""
        return {
            "record.start": self._start,
            "record.stop": self._stop,
            "record.status": self._recorder.status,
            "record.rename": self._rename,
            "record.delete": self._delete,
            "record.list": self._list,
            "record.note": self._note,
        }

    async def _start(self) -> RecorderStatus:
        self._recorder.record()
        await self._recorder.settle()
        return self._recorder.status()

    async def _stop(self) -> RecorderStatus:
        self._recorder.stop()
        await self._recorder.settle()
        return self._recorder.status()

    async def _rename(self, name: str) -> RecorderStatus:
        await self._recorder.save(name)
        return self._recorder.status()

    # A folder of thousands of files takes long, and must not delay the telemetry.
    async def _delete(self, name: str) -> Recording:
        folder = self._recorder.folder
        name = (await asyncio.to_thread(find_recording, folder, name)).name
        now = self._recorder.status()
        if name == now.name and now.state != SessionState.IDLE:
            raise ControlError(f"{name} is being recorded; stop it first")
        return await asyncio.to_thread(delete_recording, folder, name)

    async def _list(self) -> list[Recording]:
        return await asyncio.to_thread(list_recordings, self._recorder.folder)

    def _note(self, text: str) -> RecorderStatus:
        if not text.strip():
            raise ControlError("the note is empty: describe what happens now")
        if not self._has_vehicle():
            raise ControlError("no vehicle is received, to whose recording the note could be added")
        if not self._recorder.note(text):
            raise ControlError("sent to the ground stations, but in no file: nothing is recorded")
        return self._recorder.status()


def source_verbs(ports: Sequence[SourcePort]) -> Verbs:
    """Return the handlers of `source.*`: tokens of sources that take posts, and their content."""
    taking = [port for port in ports if port.token]

    def push(token: str, text: str) -> None:
        for port in taking:
            if hmac.compare_digest(port.token.encode(), token.encode()):
                port.push(text.encode())
                return
        for port in taking:
            port.refuse(len(text))
        raise ControlError("no source has this token")

    return {
        "source.tokens": lambda: {port.token: port.name for port in taking},
        "source.push": push,
    }


def mark_verbs(mark: Callable[[Location | None, int | None], None]) -> Verbs:
    """Return the handler of `mark`, which marks a location for one aircraft or all, or clears it.

    `mark` is called with the location, or None, and the aircraft, or None for all.
    """

    def set_mark(
        lat_deg: float | None = None,
        lon_deg: float | None = None,
        alt_amsl_m: float | None = None,
        vehicle_id: int | None = None,
    ) -> str:
        if lat_deg is None and lon_deg is None:
            mark(None, vehicle_id)
            return "mark cleared"
        if lat_deg is None or lon_deg is None:
            raise ControlError("a mark needs both latitude and longitude")
        alt_amsl_m = math.nan if alt_amsl_m is None else alt_amsl_m
        mark(Location(lat_deg, lon_deg, alt_amsl_m), vehicle_id)
        return "marked"

    return {"mark": set_mark}


class SerialVerbs:
    """`serial.*`; the port of a simulated receiver stays open."""

    def __init__(self, port: SerialPort, *, is_simulated: bool) -> None:
        self._port = port
        self._own = port.status([]).wanted
        self._is_simulated = is_simulated

    def verbs(self) -> Verbs:
        """Return the handlers."""
        return {
            "serial.status": self._status,
            "serial.connect": self._connect,
            "serial.disconnect": self._disconnect,
        }

    async def _status(self) -> SerialStatus:
        # In a thread: a USB hub that does not answer delays the list.
        ports = await asyncio.to_thread(list_serial_ports)
        return replace(self._port.status(ports), is_fixed=self._is_simulated)

    async def _connect(self, port: str) -> SerialStatus:
        self._check_changeable()
        ports = await asyncio.to_thread(list_serial_ports)
        # The port of the settings may be chosen even if this machine does not list it.
        check_listed(port, {AUTO, self._own, *(each.device for each in ports)})
        try:
            load_entry_points()
        except LibraryError as error:
            raise ControlError(str(error)) from error
        await self._port.connect(port)
        return self._port.status(ports)

    async def _disconnect(self) -> SerialStatus:
        self._check_changeable()
        await self._port.disconnect()
        return await self._status()

    def _check_changeable(self) -> None:
        if self._is_simulated:
            raise ControlError("the receiver is simulated: `mavgate run` uses a serial port")


def check_listed(port: str, known: set[str]) -> None:
    """Refuse a device that is not a known serial port.

    Opening a device may have effects: that of a watchdog restarts the machine.
    """
    if {port, os.path.realpath(port)}.isdisjoint(known):
        listed = ", ".join(sorted(known)) or "none"
        raise ControlError(f"{port!r} is not a serial port here; there are {listed}")


def _check_added(endpoint: Endpoint, folder: Path | None) -> None:
    """Raise ControlError for an endpoint with a device or file that only the settings may name."""
    word, _, rest = endpoint.host.partition(":")
    if endpoint.kind in ADDED_KINDS and word == EndpointKind.SERIAL:
        # The carrier of an output.
        _check_added(parse_endpoint(f"{word}:{rest}"), folder)
    if endpoint.kind is EndpointKind.SERIAL:
        check_listed(endpoint.host, {each.device for each in list_serial_ports()})
    try:
        check_files(endpoint, folder)
    except OSError as error:
        raise ControlError(reason_of(error)) from error


def client_verbs(hub: Hub, folder: Path | None = None) -> Verbs:
    """Return the handlers of `clients.*`; an added URL names only files below the folder."""

    async def add(url: str) -> tuple[str, ...]:
        endpoint = parse_endpoint(url)
        extra = NEEDED_EXTRAS.get(endpoint.kind, "")
        if extra and missing(extra):
            raise ControlError(how_to_add(f"an endpoint {endpoint.kind}:", extra))
        await asyncio.to_thread(_check_added, endpoint, folder)
        hub.add(url)
        return hub.endpoints()

    def remove(name: str) -> tuple[str, ...]:
        hub.remove(name)
        return hub.endpoints()

    return {"clients.list": hub.clients, "clients.add": add, "clients.remove": remove}


def introduction_verb(introduction: Callable[[int], list[bytes]]) -> Verbs:
    """Return the handler of `vehicle.introduction`: parameters, version and plans as frames."""

    def get(vehicle_id: VehicleId, first: int = 0) -> list[bytes]:
        try:
            frames = introduction(vehicle_id)
        except LookupError as error:
            raise ControlError(f"the gateway has no aircraft {vehicle_id}") from error
        return frames[first : first + MAX_FRAMES]

    return {"vehicle.introduction": get}


class ImuTap:
    """Collect the raw samples of one aircraft while a client requests them.

    `calibration` returns the calibration of an aircraft, and raises LookupError for an unknown one;
    `calibrate` sets it, and raises ControlError if it is refused.
    """

    def __init__(
        self,
        calibration: Callable[[int], NodeCalibration],
        calibrate: Callable[[int, NodeCalibration], None],
    ) -> None:
        self._calibration, self._calibrate = calibration, calibrate
        self._vehicle_id = 0
        self._requested_us: int | None = None
        self._samples: deque[Values] = deque(maxlen=MAX_SAMPLES)

    def verbs(self) -> Verbs:
        """Return the handlers."""
        return {"imu.samples": self._take, "imu.calibration": self._get, "imu.calibrate": self._set}

    def add(self, fused: FusedSample) -> None:
        """Collect a sample, if a client requests those of its aircraft."""
        raw = fused.imu
        if raw is None or fused.vehicle_id != self._vehicle_id:
            return
        self._requested_us = raw.time_us if self._requested_us is None else self._requested_us
        if raw.time_us - self._requested_us > IDLE_US:
            self._vehicle_id = 0
            self._samples.clear()
            return
        self._samples.append(values_of(raw))

    def _take(self, vehicle_id: VehicleId) -> list[Values]:
        if vehicle_id != self._vehicle_id:
            self._samples.clear()
        self._vehicle_id, self._requested_us = vehicle_id, None
        found = [*self._samples]
        self._samples.clear()
        return found

    def _get(self, vehicle_id: VehicleId) -> NodeCalibration:
        try:
            return self._calibration(vehicle_id)
        except LookupError as error:
            raise ControlError(f"the gateway has no aircraft {vehicle_id}") from error

    def _set(self, vehicle_id: VehicleId, calibration: NodeCalibration) -> str:
        self._get(vehicle_id)
        self._calibrate(vehicle_id, calibration)
        return "calibrated"


def values_of(raw: ImuRaw) -> Values:
    """Write a raw sample as numbers."""
    return (
        *(raw.time_us, *raw.accel_raw, *raw.gyro_raw, *raw.mag_raw, raw.temperature_raw),
        *(raw.accel_range_g, raw.gyro_range_dps, raw.mag_lsb_per_gauss, int(raw.flags)),
    )


def raw_of(values: Values, vehicle_id: int) -> ImuRaw:
    """Read a raw sample from its numbers."""
    time_us, ax, ay, az, gx, gy, gz, mx, my, mz, temperature = values[:11]
    range_g, range_dps, lsb_per_gauss, flags = values[11:]
    return ImuRaw(
        time_us, NodeId(vehicle_id, 0), time_us, (ax, ay, az), (gx, gy, gz), (mx, my, mz),
        temperature, range_g, range_dps, lsb_per_gauss, ImuFlags(flags),
    )  # fmt: skip
