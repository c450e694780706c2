"""Check that a LoRa node's payloads fit the channel: `firmware/common/lora.h` in Python.

Time on air of a packet with explicit header, CRC and a preamble of 8 symbols: SX1276 datasheet,
revision 7, section 4.1.1.7. The rates are those of `firmware/settings.h`.
"""

import math
from collections.abc import Iterator
from typing import Final

from msgspec.structs import replace

from gateway.flashing.boards import BoardSettings, FlashError, Program

PREFIX_BYTES: Final = 1
IMU_BYTES, BARO_BYTES, GPS_BYTES, STATUS_BYTES = (PREFIX_BYTES + size for size in (31, 14, 32, 31))
"""Sizes of payloads with their prefix; a fix is sent as two payloads."""
BARO_HZ: Final = 2.0
STATUS_HZ: Final = 0.2
MOST_SHARE: Final = 0.45
"""Maximum share of the channel's time for one node. If each of two nodes uses half of it, they lose
1 to 3 % of their packets by collisions."""
BANDS: Final = (
    (433_050, 434_790, 0.1),
    (863_000, 868_000, 0.01),
    (868_000, 868_600, 0.01),
    (868_700, 869_200, 0.001),
    (869_400, 869_650, 0.1),
    (869_700, 870_000, 0.01),
    (902_000, 928_000, 1.0),
)
"""First and last frequency in kHz, and duty cycle, by ERC Recommendation 70-03, annex 1, for
Europe; 902 to 928 MHz is the band of the United States, without a duty cycle."""


def airtime_s(settings: BoardSettings, size: int) -> float:
    """Return the time on air of a packet of this size, s."""
    symbol_s = 2**settings.lora_spreading / (1000 * settings.lora_bandwidth_khz)
    bits = 8 * size + 44 - 4 * settings.lora_spreading
    payload = 8 + math.ceil(bits / (4 * settings.lora_spreading)) * settings.lora_coding
    return float((8 + 4.25 + payload) * symbol_s)


def share(program: Program, settings: BoardSettings) -> float:
    """Return the share of time in which a node transmits."""
    status = STATUS_HZ * airtime_s(settings, STATUS_BYTES)
    if program is Program.IMU:
        imu = settings.imu_send_hz * airtime_s(settings, IMU_BYTES)
        return status + imu + BARO_HZ * airtime_s(settings, BARO_BYTES)
    return status + 2 * settings.gps_rate_hz * airtime_s(settings, GPS_BYTES)


def duty_cycle(frequency_khz: int) -> float | None:
    """Return the share of time allowed in Europe, 0 to 1; None outside its bands."""
    found = (duty for first, last, duty in BANDS if first <= frequency_khz <= last)
    return next(found, None)


def check(program: Program, settings: BoardSettings, most: float = MOST_SHARE) -> float:
    """Return the share of time on air; raises FlashError if it is above `most`.

    The error states settings that would fit.
    """
    if duty_cycle(settings.lora_frequency_khz) is None:
        bands = ", ".join(f"{low / 1000:g} to {high / 1000:g}" for low, high, _ in BANDS)
        raise FlashError(f"{settings.lora_frequency_khz / 1000:g} MHz is in none of {bands} MHz")
    used = share(program, settings)
    if used <= most:
        return used
    fits = next(
        (text for text, other in _slower(program, settings) if share(program, other) <= most), ""
    )
    raise FlashError(
        f"the node would have {100 * used:.0f} % time on air, more than {100 * most:g} %; "
        + (f"{fits} would fit" if fits else "no rate fits: allow more by --duty")
    )


def _slower(program: Program, settings: BoardSettings) -> Iterator[tuple[str, BoardSettings]]:
    """Yield settings with less time on air, those with the least loss of rate or range first."""
    if program is Program.IMU:
        for rate in range(settings.imu_send_hz - 1, 3, -1):
            yield f"--send-rate {rate}", replace(settings, imu_send_hz=rate)
    else:
        for rate in range(settings.gps_rate_hz - 1, 0, -1):
            yield f"--gps-rate {rate}", replace(settings, gps_rate_hz=rate)
    slowest = replace(settings, imu_send_hz=4, gps_rate_hz=1)
    option = "--send-rate 4" if program is Program.IMU else "--gps-rate 1"
    for spreading in range(settings.lora_spreading, 6, -1):
        for width in (w for w in (125, 250, 500) if w >= settings.lora_bandwidth_khz):
            other = replace(slowest, lora_spreading=spreading, lora_bandwidth_khz=width)
            yield f"{option} --spreading {spreading} --bandwidth {width}", other
