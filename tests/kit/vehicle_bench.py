"""The gateway's vehicle and a client of it, with a line between them that may lose messages."""

from typing import Any

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from gateway.estimation.select import EstimationSettings
from gateway.records import Incoming, Vec3
from gateway.sensing.calibration import NodeCalibration
from gateway.units import US_PER_S
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import RateSettings, VehicleSettings
from tests.kit.records import sample_at, state_at

STEP_US = 10_000
G_MPS2 = 9.80665


class VehicleBench:
    """A clock, the vehicle, and a client with the verbs `handle` and `poll`."""

    def __init__(self, client: Any, *, lose_every: int = 0, may_change: bool = True) -> None:
        self.client = client
        self.now_us = 10 * US_PER_S
        sections = {"estimation": EstimationSettings(), "calibration": NodeCalibration()}
        settings = VehicleSettings(rates=RateSettings(highres_imu_hz=50.0))
        self._vehicle = Vehicle(settings, 1, sections=sections)
        self._mav = mavlink.MAVLink(None, 253, 25)
        self._rng = np.random.default_rng(1)
        self._lose_every, self._count, self._may_change = lose_every, 0, may_change
        self._waiting: list[Any] = []

    def send(self, *messages: Any) -> None:
        """Let the vehicle handle messages of the client."""
        for message in messages:
            incoming = Incoming(1, message.pack(self._mav), self._may_change)
            self._receive(self._vehicle.handle(incoming, self.now_us))

    def run(self, messages: list[Any], seconds: float) -> None:
        """Send messages, and let the time pass, with the client's further messages."""
        self._waiting += messages
        for _ in range(round(seconds * US_PER_S / STEP_US)):
            self.now_us += STEP_US
            self._receive(self._vehicle.poll(self.now_us))
            waiting, self._waiting = self._waiting, []
            self.send(*waiting)
            self._waiting += self.client.poll(self.now_us) or []

    def hold(
        self,
        seconds: float,
        accel: Vec3 = (0.0, 0.0, -G_MPS2),
        gyro: Vec3 = (0.0, 0.0, 0.0),
        mag: Vec3 | None = None,
    ) -> None:
        """Let the time pass with samples of the sensors, with a little noise."""
        for _ in range(round(seconds * US_PER_S / STEP_US)):
            noise = self._rng.normal(scale=0.005, size=(2, 3))
            values: dict[str, Any] = {
                "accel_b_mps2": tuple((np.array(accel) + noise[0]).tolist()),
                "gyro_b_radps": tuple((np.array(gyro) + noise[1]).tolist()),
            }
            if mag is not None:
                values["mag_b_ut"] = mag
            sample = sample_at(self.now_us + STEP_US, **values)
            self._receive(self._vehicle.on_state(state_at(sample.time_us), sample, sample.time_us))
            self.run([], STEP_US / US_PER_S)

    def _receive(self, actions: Any) -> None:
        for action in actions:
            if hasattr(action, "frame") and not self._is_lost():
                message = self._mav.decode(bytearray(action.frame))
                self._waiting += self.client.handle(message, self.now_us) or []

    def _is_lost(self) -> bool:
        self._count += 1
        return bool(self._lose_every) and self._count % self._lose_every == 0
