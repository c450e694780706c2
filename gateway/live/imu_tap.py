"""Raw IMU samples for `mavgate calibrate` while the gateway runs, and its result."""

from collections import deque
from collections.abc import Callable
from typing import Annotated, Final

import msgspec

from gateway.live.control_socket import ControlError, ControlServer
from gateway.records import FusedSample, ImuFlags, ImuRaw, NodeId
from gateway.sensing.calibration import NodeCalibration
from gateway.units import US_PER_S

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
