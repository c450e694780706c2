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
from gateway.records import FusedSample, ImuRaw
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
VehicleId = Annotated[int, msgspec.Meta(ge=1, le=255)]


def recorder_verbs(recorder: Recorder, has_vehicle: Callable[[], bool] = lambda: True) -> Verbs:
    """Return the handlers of `record.*`, which answer when the disk has done what was asked."""

    async def settled(do: Callable[[], None]) -> RecorderStatus:
        do()
        await recorder.settle()
        return recorder.status()

    async def rename(name: str) -> RecorderStatus:
        await recorder.save(name)
        return recorder.status()

    def note(text: str) -> RecorderStatus:
        if not text.strip():
            raise ControlError("the note is empty: describe what happens now")
        if not has_vehicle():
            raise ControlError("no vehicle is received, to whose recording the note could be added")
        if not recorder.note(text):
            raise ControlError("sent to the ground stations, but in no file: nothing is recorded")
        return recorder.status()

    return {
        "record.start": lambda: settled(recorder.record),
        "record.stop": lambda: settled(recorder.stop),
        "record.status": recorder.status,
        "record.rename": rename,
        "record.note": note,
        **_folder_verbs(recorder),
    }


def _folder_verbs(recorder: Recorder) -> Verbs:
    # A folder of thousands of files takes long, and must not delay the telemetry.
    async def delete(name: str) -> Recording:
        name = (await asyncio.to_thread(find_recording, recorder.folder, name)).name
        now = recorder.status()
        if name == now.name and now.state != SessionState.IDLE:
            raise ControlError(f"{name} is being recorded; stop it first")
        return await asyncio.to_thread(delete_recording, recorder.folder, name)

    async def listed() -> list[Recording]:
        return await asyncio.to_thread(list_recordings, recorder.folder)

    return {"record.delete": delete, "record.list": listed}


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


def serial_verbs(serial: SerialPort, *, is_simulated: bool) -> Verbs:
    """Return the handlers of `serial.*`; the port of a simulated receiver stays open."""
    own = serial.status([]).wanted

    def check_changeable() -> None:
        if is_simulated:
            raise ControlError("the receiver is simulated: `mavgate run` uses a serial port")

    async def status() -> SerialStatus:
        # In a thread: a USB hub that does not answer delays the list.
        ports = await asyncio.to_thread(list_serial_ports)
        return replace(serial.status(ports), is_fixed=is_simulated)

    async def connect(port: str) -> SerialStatus:
        check_changeable()
        ports = await asyncio.to_thread(list_serial_ports)
        # The port of the settings may be chosen even if this machine does not list it.
        check_listed(port, {AUTO, own, *(each.device for each in ports)})
        try:
            load_entry_points()
        except LibraryError as error:
            raise ControlError(str(error)) from error
        await serial.connect(port)
        return serial.status(ports)

    async def disconnect() -> SerialStatus:
        check_changeable()
        await serial.disconnect()
        return await status()

    return {"serial.status": status, "serial.connect": connect, "serial.disconnect": disconnect}


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
        self._samples: deque[tuple[object, ...]] = deque(maxlen=MAX_SAMPLES)

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
        self._samples.append(msgspec.structs.astuple(raw))

    def _take(self, vehicle_id: VehicleId) -> list[tuple[object, ...]]:
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


def raw_of(values: Sequence[object]) -> ImuRaw:
    """Read a raw sample from its fields."""
    return msgspec.convert(dict(zip(ImuRaw.__struct_fields__, values, strict=True)), ImuRaw)
