"""NMEA 0183 for chart plotters, gpsd and antenna trackers: GGA, RMC, VTG and HDT of one vehicle.

    nmea:udp:HOST:PORT  nmea:tcp:HOST:PORT  nmea:tcp-listen:HOST:PORT  nmea:serial:DEVICE:BAUD

Without a valid position GGA has quality 0, RMC is void, and there is no VTG.

References
----------
.. [1] NMEA 0183, version 3.01.
"""

import math
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.hub.endpoint import EndpointKind
from gateway.outputs.output import Output, station_of
from gateway.units import FIX_2D, KMH_PER_MPS, KNOTS_PER_MPS, US_PER_S
from gateway.vehicle_state.antenna import Pointing, pointing_of
from gateway.vehicle_state.newest import NewestState
from gateway.vehicle_state.positions import Position
from gateway.wire.framing import xor_of

MINUTE_PARTS: Final = 10**5
"""Units per minute in written coordinates; one is 2 cm."""
QUALITIES: Final = {
    mavlink.GPS_FIX_TYPE_DGPS: (2, "D"),
    mavlink.GPS_FIX_TYPE_RTK_FLOAT: (5, "F"),
    mavlink.GPS_FIX_TYPE_RTK_FIXED: (4, "R"),
}
"""Quality of GGA, and mode of RMC and VTG, by GPS_FIX_TYPE; (1, A) for other types."""
ESTIMATED: Final = (6, "E")
"""The same for a position without a GPS fix, for example by visual navigation."""


def sentence(body: str) -> str:
    """Return a sentence with its checksum and line end."""
    return f"${body}*{xor_of(body.encode('ascii')):02X}\r\n"


class NmeaOutput(Output):
    """NMEA sentences of one vehicle."""

    carriers = (
        EndpointKind.UDP,
        EndpointKind.UDP_BROADCAST,
        EndpointKind.UDP_MULTICAST,
        EndpointKind.TCP,
        EndpointKind.TCP_LISTEN,
        EndpointKind.SERIAL,
    )

    def compose(self, now_us: int) -> Iterable[bytes]:
        """Return the sentences for the present state as one datagram."""
        state = self.chosen(now_us)
        if state is None:
            return []
        position = state.valid_position(now_us)
        unix_us = self.unix_us() if position is None else self.position_unix_us(state, now_us)
        sentences = [sentence(each) for each in bodies(state, position, unix_us, now_us)]
        if "station" in self.endpoint.added:
            station = station_of(self.endpoint)
            if found := pointing_of(station, state, self.vehicles.states, now_us):
                sentences.append(sentence(pointing_body(found)))
        return ["".join(sentences).encode("ascii")]


def bodies(
    state: NewestState, position: Position | None, unix_us: int, now_us: int
) -> Iterator[str]:
    """Yield the sentences for a vehicle, without checksum."""
    at = datetime.fromtimestamp(unix_us / US_PER_S, UTC)
    clock, date = f"{at:%H%M%S}.{at.microsecond // 10_000:02d}", f"{at:%d%m%y}"
    satellites = _written(state.satellites(), "02.0f")
    if position is None:
        yield f"GPGGA,{clock},,,,,0,{satellites},,,M,,M,,"
        yield f"GPRMC,{clock},V,,,,,,,{date},,,N"
    else:
        report = state.fix()
        hdop, separation = (report.hdop, report.separation_m) if report else (math.nan, math.nan)
        quality, mode = _quality(state)
        where = f"{_angle(position.lat_deg, 2, 'NS')},{_angle(position.lon_deg, 3, 'EW')}"
        height, above = _written(position.alt_amsl_m, ".1f"), _written(separation, ".1f")
        yield (
            f"GPGGA,{clock},{where},{quality},{satellites},{_written(hdop, '.1f')},"
            f"{height},M,{above},M,,"
        )
        speed_mps, course = position.groundspeed_mps, _written(state.course_deg(position), ".1f")
        knots = _written(speed_mps * KNOTS_PER_MPS, ".1f")
        yield f"GPRMC,{clock},A,{where},{knots},{course},{date},,,{mode}"
        yield f"GPVTG,{course},T,,M,{knots},N,{_written(speed_mps * KMH_PER_MPS, '.1f')},K,{mode}"
    heading = state.true_heading_deg(now_us)
    if math.isfinite(heading):
        yield f"GPHDT,{heading:.1f},T"


def pointing_body(pointing: Pointing) -> str:
    """Return the proprietary sentence with an antenna's direction, without checksum."""
    return (
        f"PMAVG,POINT,{pointing.azimuth_deg:.2f},T,{pointing.elevation_deg:.2f},"
        f"{pointing.distance_m:.0f},M"
    )


def _quality(state: NewestState) -> tuple[int, str]:
    report = state.fix()
    if report is not None and report.fix_type < FIX_2D:
        return ESTIMATED
    return QUALITIES.get(report.fix_type if report else 0, (1, "A"))


def _written(value: float, form: str) -> str:
    return format(value, form) if math.isfinite(value) else ""


def _angle(angle_deg: float, digits: int, signs: str) -> str:
    """Format degrees and minutes, and the hemisphere."""
    degrees, parts = divmod(round(abs(angle_deg) * 60 * MINUTE_PARTS), 60 * MINUTE_PARTS)
    minutes = f"{parts // MINUTE_PARTS:02d}.{parts % MINUTE_PARTS:05d}"
    return f"{degrees:0{digits}d}{minutes},{signs[angle_deg < 0]}"
