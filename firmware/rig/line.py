"""The receiver's serial line with the real programs behind it, for `mavgate demo --firmware`."""

from collections.abc import Iterator

from firmware.rig.boards import LORA_PARTS, Parts, Setup
from firmware.rig.build import build
from firmware.rig.flight import FlightWorld
from firmware.rig.tracker import Tracker
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.timed_frame import TimedFrame


def frames(
    settings: SimulatorSettings, start_unix_us: int, radio: str = "nrf24"
) -> Iterator[TimedFrame]:
    """Fly the first simulated aircraft with the firmware in the loop.

    Parameters
    ----------
    settings : SimulatorSettings
        Flight, sensors and loss on the air; rates are the firmware's own.
    start_unix_us : int
        UTC at the start.
    radio : str
        The driver of the boards' radios, nrf24 or sx1276.

    Returns
    -------
    iterator of TimedFrame
        Endless. Each step takes some milliseconds of the processor.

    Raises
    ------
    BuildError
        If a compiler or the simulator is missing.
    """
    vehicle = f"-DVEHICLE_ID={settings.vehicle_id}" if settings.vehicle_id != 1 else ""
    folder = build(vehicle, radio=radio)
    flight = FlightWorld(settings, start_unix_us=start_unix_us)
    setup = Setup(
        seed=settings.seed,
        loss=settings.radio_loss,
        world=flight.world,
        build=folder,
        gps_computing_s=settings.gps_latency_s,
        parts=Parts(**LORA_PARTS) if radio == "sx1276" else Parts(),
    )
    return Tracker(setup, noise=False).frames()
