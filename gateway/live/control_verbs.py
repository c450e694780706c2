"""The verbs of the control socket; see docs/control.md."""

import asyncio
import math
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Annotated, Final

import msgspec

from gateway.hub.hub import Hub
from gateway.hub.stats import ClientStats
from gateway.live.control_socket import ControlError, ControlServer, NoParams
from gateway.live.player_edge import PlayerEdge, PlayerStatus
from gateway.live.recorder import Recorder
from gateway.live.serial_port import SerialPort, SerialStatus, list_serial_ports
from gateway.live.session import SessionState
from gateway.recordings.index import (
    Recording,
    RecordingError,
    delete_recording,
    find_recording,
    list_recordings,
)
from gateway.recordings.moment import parse_moment
from gateway.recordings.play import AS_FAST_AS_POSSIBLE
from gateway.records import FusedSample, ImuFlags, ImuRaw, NodeId
from gateway.sensing.calibration import NodeCalibration
from gateway.status import RecorderStatus, Snapshot
from gateway.units import US_PER_S
from gateway.vehicle.plan import Location


class Named(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A recording by its name."""

    name: str


class Url(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An endpoint, as in the settings."""

    url: str


class MarkParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A location to mark; without latitude and longitude the mark is cleared."""

    lat_deg: float | None = None
    lon_deg: float | None = None
    alt_amsl_m: float | None = None
    vehicle_id: int | None = None
    """The aircraft to mark it for; all by default."""


class Text(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A remark."""

    text: str


class To(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A moment as text; see `parse_moment`."""

    to: str


class Steps(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How many frames."""

    count: int = 1


class Speed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How fast; None for as fast as possible."""

    speed: float | None


class Switch(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """On or off."""

    on: bool


class RecorderVerbs:
    """`record.*`.

    Parameters
    ----------
    recorder : Recorder
        The object to control.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder

    def register(self, server: ControlServer) -> None:
        """Register the verbs on a socket."""
        server.register("record.start", NoParams, self._start)
        server.register("record.stop", NoParams, self._stop)
        server.register("record.status", NoParams, self._status)
        server.register("record.save", Named, self._save)
        server.register("record.delete", Named, self._delete)
        server.register("record.list", NoParams, self._list)
        server.register("record.note", Text, self._note)

    async def _start(self, _: NoParams) -> RecorderStatus:
        self._recorder.record()
        await self._recorder.settle()
        return self._recorder.status()

    async def _stop(self, _: NoParams) -> RecorderStatus:
        self._recorder.stop()
        await self._recorder.settle()
        return self._recorder.status()

    def _status(self, _: NoParams) -> RecorderStatus:
        return self._recorder.status()

    async def _save(self, params: Named) -> RecorderStatus:
        try:
            await self._recorder.save(params.name)
        except (RecordingError, OSError) as error:
            raise ControlError(str(error)) from error
        return self._recorder.status()

    # A folder of thousands of files takes long, and must not delay the telemetry.
    async def _delete(self, params: Named) -> Recording:
        folder = self._recorder.folder
        try:
            name = (await asyncio.to_thread(find_recording, folder, params.name)).name
            now = self._recorder.status()
            if name != now.name or now.state == SessionState.IDLE:
                return await asyncio.to_thread(delete_recording, folder, name)
        except (RecordingError, OSError) as error:
            raise ControlError(str(error)) from error
        raise ControlError(f"{name} is being recorded; stop it first")

    async def _list(self, _: NoParams) -> list[Recording]:
        return await asyncio.to_thread(list_recordings, self._recorder.folder)

    def _note(self, params: Text) -> RecorderStatus:
        if not params.text.strip():
            raise ControlError("the note is empty: describe what happens now")
        self._recorder.mark(params.text)
        return self._recorder.status()


class AircraftVerbs:
    """`mark`.

    Parameters
    ----------
    mark : callable
        Marks a place for one aircraft or all, or clears the mark; raises ValueError.
    """

    def __init__(self, mark: Callable[[Location | None, int | None], None]) -> None:
        self._mark = mark

    def register(self, server: ControlServer) -> None:
        """Register the verb on a socket."""
        server.register("mark", MarkParams, self._put)

    def _put(self, params: MarkParams) -> str:
        place = None
        if params.lat_deg is not None and params.lon_deg is not None:
            alt_amsl_m = math.nan if params.alt_amsl_m is None else params.alt_amsl_m
            place = Location(params.lat_deg, params.lon_deg, alt_amsl_m)
        elif (params.lat_deg, params.lon_deg) != (None, None):
            raise ControlError("a mark needs both latitude and longitude")
        try:
            self._mark(place, params.vehicle_id)
        except ValueError as error:
            raise ControlError(str(error)) from error
        return "mark cleared" if place is None else "marked"


class PortParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A serial port, as in the setting `port` of `[serial]`."""

    port: str


class SerialVerbs:
    """`serial.*`.

    Parameters
    ----------
    port : SerialPort
        The receiver's port. The one of its settings may be chosen even if this machine does not
        list it.
    is_simulated : bool
        Whether the receiver is simulated; then its port stays open.
    """

    def __init__(self, port: SerialPort, *, is_simulated: bool) -> None:
        self._port = port
        self._own = port.status([]).wanted
        self._is_simulated = is_simulated

    def register(self, server: ControlServer) -> None:
        """Register the verbs on a socket."""
        server.register("serial.status", NoParams, self._status)
        server.register("serial.connect", PortParams, self._connect)
        server.register("serial.disconnect", NoParams, self._disconnect)

    async def _status(self, _: NoParams) -> SerialStatus:
        # In a thread: a USB hub that does not answer holds up the list.
        ports = await asyncio.to_thread(list_serial_ports)
        return replace(self._port.status(ports), is_fixed=self._is_simulated)

    async def _connect(self, params: PortParams) -> SerialStatus:
        self._check_changeable()
        ports = await asyncio.to_thread(list_serial_ports)
        # No other path: opening some devices has effects, as that of a watchdog, which restarts
        # the machine.
        known = {"auto", self._own, *(port.device for port in ports)}
        if params.port not in known:
            raise ControlError(
                f"{params.port!r} is no serial port of this machine; there are "
                f"{', '.join(sorted(known))}"
            )
        self._port.connect(params.port)
        return self._port.status(ports)

    async def _disconnect(self, params: NoParams) -> SerialStatus:
        self._check_changeable()
        self._port.disconnect()
        return await self._status(params)

    def _check_changeable(self) -> None:
        if self._is_simulated:
            raise ControlError("the receiver is simulated: `mavgate run` uses a serial port")


class HubVerbs:
    """`status`, `reload` and `clients.*`.

    Parameters
    ----------
    hub : Hub
        The hub.
    snapshot : callable
        Returns the present state of the gateway.
    reload : callable
        Applies changed settings and returns a text, to be awaited; raises ControlError.
    """

    def __init__(
        self, hub: Hub, snapshot: Callable[[], Snapshot], reload: Callable[[], Awaitable[str]]
    ) -> None:
        self._hub = hub
        self._snapshot = snapshot
        self._reload = reload

    def register(self, server: ControlServer) -> None:
        """Register the verbs on a socket."""
        server.register("status", NoParams, lambda _: self._snapshot())
        server.register("reload", NoParams, lambda _: self._reload())
        server.register("clients.list", NoParams, self._list)
        server.register("clients.add", Url, self._add)
        server.register("clients.remove", Named, self._remove)

    def _list(self, _: NoParams) -> tuple[ClientStats, ...]:
        return self._hub.clients()

    def _add(self, params: Url) -> tuple[str, ...]:
        try:
            self._hub.add(params.url)
        except ValueError as error:
            raise ControlError(str(error)) from error
        return self._hub.endpoints()

    def _remove(self, params: Named) -> tuple[str, ...]:
        try:
            self._hub.remove(params.name)
        except ValueError as error:
            raise ControlError(str(error)) from error
        return self._hub.endpoints()


class PlayerVerbs:
    """`play.*` and `seek`.

    Parameters
    ----------
    player : PlayerEdge
        The object to control.
    """

    def __init__(self, player: PlayerEdge) -> None:
        self._player = player

    def register(self, server: ControlServer) -> None:
        """Register the verbs on a socket."""
        server.register("seek", To, self._seek)
        server.register("play.pause", NoParams, self._pause)
        server.register("play.resume", NoParams, self._resume)
        server.register("play.step", Steps, self._step)
        server.register("play.speed", Speed, self._speed)
        server.register("play.loop", Switch, self._loop)
        server.register("play.status", NoParams, self._status)

    def _seek(self, params: To) -> PlayerStatus:
        try:
            moment = parse_moment(params.to)
        except ValueError as error:
            raise ControlError(str(error)) from error
        if moment.time_us is not None:
            self._player.seek_time(moment.time_us)
        else:
            self._player.seek(moment.offset_s or 0.0, relative=moment.relative)
        return self._player.status()

    def _pause(self, _: NoParams) -> PlayerStatus:
        self._player.pause()
        return self._player.status()

    def _resume(self, _: NoParams) -> PlayerStatus:
        self._player.resume()
        return self._player.status()

    def _step(self, params: Steps) -> PlayerStatus:
        self._player.step(params.count)
        return self._player.status()

    def _speed(self, params: Speed) -> PlayerStatus:
        speed = AS_FAST_AS_POSSIBLE if params.speed is None else params.speed
        try:
            self._player.set_speed(speed)
        except ValueError as error:
            raise ControlError(str(error)) from error
        return self._player.status()

    def _loop(self, params: Switch) -> PlayerStatus:
        self._player.set_loop(params.on)
        return self._player.status()

    def _status(self, _: NoParams) -> PlayerStatus:
        return self._player.status()


MAX_SAMPLES: Final = 400
"""Between two requests: some seconds, and less than a line of the control socket may hold."""
IDLE_US: Final = 5 * US_PER_S
"""Without a request for so long nothing is collected any more."""

Values = tuple[int, ...]
"""Time, accelerometer, gyroscope and magnetometer counts, temperature, three ranges, flags."""

VehicleId = Annotated[int, msgspec.Meta(ge=1, le=255)]


class ImuParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Of which aircraft."""

    vehicle_id: VehicleId


class CalibrationParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The calibration of an aircraft's IMU node, as in its settings file."""

    vehicle_id: VehicleId
    calibration: NodeCalibration


class ImuTap:
    """Collects the raw samples of one aircraft while a client asks for them.

    Parameters
    ----------
    calibration : callable
        Returns the calibration of an aircraft; raises LookupError for an unknown one.
    calibrate : callable
        Called with a vehicle id and its new calibration; raises ControlError if it is refused.
    """

    def __init__(
        self,
        calibration: Callable[[int], NodeCalibration],
        calibrate: Callable[[int, NodeCalibration], None],
    ) -> None:
        self._calibration, self._calibrate = calibration, calibrate
        self._vehicle_id = 0
        self._asked_us: int | None = None
        self._samples: deque[Values] = deque(maxlen=MAX_SAMPLES)

    def register(self, server: ControlServer) -> None:
        """Register the verbs on a socket."""
        server.register("imu.samples", ImuParams, self._take)
        server.register("imu.calibration", ImuParams, self._get)
        server.register("imu.calibrate", CalibrationParams, self._set)

    def add(self, fused: FusedSample) -> None:
        """Collect a sample, if a client asks for those of its aircraft."""
        raw = fused.imu
        if raw is None or fused.vehicle_id != self._vehicle_id:
            return
        self._asked_us = raw.time_us if self._asked_us is None else self._asked_us
        if raw.time_us - self._asked_us > IDLE_US:
            self._vehicle_id = 0
            self._samples.clear()
            return
        self._samples.append(values_of(raw))

    def _take(self, params: ImuParams) -> list[Values]:
        if params.vehicle_id != self._vehicle_id:
            self._samples.clear()
        self._vehicle_id, self._asked_us = params.vehicle_id, None
        found = [*self._samples]
        self._samples.clear()
        return found

    def _get(self, params: ImuParams) -> NodeCalibration:
        try:
            return self._calibration(params.vehicle_id)
        except LookupError as error:
            raise ControlError(f"the gateway has no aircraft {params.vehicle_id}") from error

    def _set(self, params: CalibrationParams) -> str:
        self._get(ImuParams(params.vehicle_id))
        self._calibrate(params.vehicle_id, params.calibration)
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
