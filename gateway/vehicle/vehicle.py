"""One aircraft as a MAVLink system: records in, frames out; requests in, answers out."""

from collections.abc import Iterable
from typing import Any, Final

from gateway.records import (
    BaroSample,
    GpsFix,
    ImuSample,
    LinkReport,
    NavFlags,
    NavState,
    NodeStatus,
    Outgoing,
)
from gateway.vehicle.encoder import Encoder
from gateway.vehicle.events import CRITICAL, INFO, NOTICE, WARNING, Announcer, Told
from gateway.vehicle.health import Health
from gateway.vehicle.settings import VehicleSettings
from gateway.vehicle.telemetry import Telemetry

FLAG_TEXTS: Final = (
    (NavFlags.ATTITUDE_VALID, Told(INFO, "Attitude valid"), Told(WARNING, "Attitude not valid")),
    (NavFlags.HEADING_VALID, Told(INFO, "Heading valid"), Told(WARNING, "Heading not valid")),
    (
        NavFlags.DEAD_RECKONING,
        Told(WARNING, "Position is dead-reckoned"),
        Told(INFO, "Position follows GPS again"),
    ),
    (NavFlags.GPS_REJECTED, Told(WARNING, "GPS fixes rejected"), Told(INFO, "GPS accepted again")),
    (
        NavFlags.MAG_DISTURBED,
        Told(WARNING, "Magnetic field disturbed"),
        Told(INFO, "Magnetic field normal again"),
    ),
    (NavFlags.SENSOR_FAULT, Told(CRITICAL, "Sensor fault"), Told(NOTICE, "Sensors well again")),
    (NavFlags.DEGRADED, Told(WARNING, "Estimator degraded"), Told(INFO, "Estimator well again")),
)
"""A flag of the estimator, what is told when it rises, and what when it falls."""


class Vehicle:
    """The MAVLink side of one aircraft.

    All methods return the frames to send, in order; none raises on data.
    """

    def __init__(
        self, settings: VehicleSettings, system_id: int, vehicle_id: int | None = None
    ) -> None:
        """Begin with nothing known.

        Parameters
        ----------
        settings : VehicleSettings
            The `[vehicle]` section.
        system_id : int
            MAVLink system id, 1 to 250.
        vehicle_id : int, optional
            The id in the radio payloads, if it is not the system id.
        """
        self.system_id = system_id
        self.health = Health(
            system_id if vehicle_id is None else vehicle_id, settings.node_silent_s
        )
        self.telemetry = Telemetry(settings, self.health)
        self._encoder = Encoder(system_id)
        self._announcer = Announcer()
        self._flags = NavFlags(0)

    def on_state(self, state: NavState, sample: ImuSample, now_us: int) -> list[Outgoing]:
        """Take in what the estimator made of one IMU sample."""
        self.health.on_state(state, sample)
        found = self.telemetry.on_state(state, sample)
        if state.flags != self._flags:
            found += self._announce_flags(state.flags, now_us)
        return self._encode(found)

    def on_baro(self, sample: BaroSample, _now_us: int) -> list[Outgoing]:
        """Take in one barometer sample."""
        self.health.on_baro(sample)
        return self._encode(self.telemetry.on_baro(sample))

    def on_gps(self, fix: GpsFix, now_us: int) -> list[Outgoing]:
        """Take in one GPS fix."""
        self.health.on_gps(fix)
        had_home = self.telemetry.home is not None
        found = self.telemetry.on_gps(fix)
        if self.telemetry.home is not None and not had_home:
            found += self._announcer.say(Told(INFO, "Home set by GPS"), now_us)
        found += self._announce_fix(now_us)
        return self._encode(found)

    def on_node_status(self, status: NodeStatus, _now_us: int) -> list[Outgoing]:
        """Take in a node's report about itself."""
        self.health.on_node_status(status)
        return []

    def on_link(self, report: LinkReport, now_us: int) -> list[Outgoing]:
        """Take in the state of the serial link and of all radio links."""
        self.health.on_link(report)
        lost = Told(CRITICAL, f"Receiver lost: {report.port}")
        back = Told(NOTICE, f"Receiver connected: {report.port}")
        found = self._announcer.track(
            "link", report.connected, back if report.connected else lost, now_us
        )
        silent = self.health.silent_nodes(now_us)
        for node in sorted(self.health.known_nodes()) if report.connected else ():
            text = Told(NOTICE, f"Node {node} is back")
            if node in silent:
                text = Told(CRITICAL, f"Node {node} silent")
            found += self._announcer.track(
                f"node {node}", node not in silent, text, now_us, initially=True
            )
        return self._encode(found)

    def poll(self, now_us: int) -> list[Outgoing]:
        """Send what is due by time."""
        found = self.telemetry.poll(now_us)
        found += self._announce_fix(now_us)
        found += self._announcer.poll(now_us)
        return self._encode(found)

    def next_due_us(self) -> int:
        """Tell when `poll` is to be called next, at the latest."""
        due = (self.telemetry.next_due_us(), self._announcer.next_due_us())
        return min(time_us for time_us in due if time_us is not None)

    def set_recording(self, recording: bool) -> None:
        """Note whether a recording runs; the armed bit may follow it."""
        self.health.recording = recording

    def _announce_flags(self, flags: NavFlags, now_us: int) -> list[Any]:
        changed, self._flags = flags ^ self._flags, flags
        found = []
        for flag, raised, fallen in FLAG_TEXTS:
            if changed & flag:
                text = raised if flags & flag else fallen
                found += self._announcer.track(
                    str(flag.name), bool(flags & flag), text, now_us, initially=False
                )
        return found

    def _announce_fix(self, now_us: int) -> list[Any]:
        fixed = self.health.has_fix(now_us)
        text = Told(NOTICE, "GPS fix") if fixed else Told(WARNING, "GPS fix lost")
        return self._announcer.track("GPS", fixed, text, now_us, initially=False)

    def _encode(self, found: Iterable[Any]) -> list[Outgoing]:
        return [self._encoder.encode(message) for message in found]
