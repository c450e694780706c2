"""`mavgate setup`: a guided first start, with our boards, real or simulated, or with a phone."""

from __future__ import annotations

import asyncio
import logging
import secrets
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, NoReturn

import typer
from msgspec.structs import replace
from rich.progress import TimeElapsedColumn

from gateway.cli.live.calibrate import (
    STEPS,
    calibrate_each,
    capture_from,
    listen,
    poses_from,
    poses_on,
    simulated_receiver,
)
from gateway.cli.support import shared_options as opt
from gateway.cli.support.options import argument, option, read_settings, settings_file
from gateway.cli.support.terminal import console_of, progress_bar, refuse, table_of
from gateway.config import ConfigError, GatewaySettings, load_aircraft, save_aircraft, save_values
from gateway.extras import require
from gateway.live.serial_port import PortNotFoundError, SerialPort, SerialSettings, find_receiver
from gateway.printable import figure
from gateway.records import LORA_CHANNEL, GpsFix, LinkReport, NodeStatus, RawRecord, channel_name
from gateway.sensing.calibration import NodeCalibration
from gateway.sources.settings import SourceSettings, parse_source
from gateway.units import MV_PER_V
from gateway.wire.payloads import SENSOR_BARO, SENSOR_GPS, SENSOR_IMU, SENSOR_MAG

if TYPE_CHECKING:
    from gateway.simulator.trajectory import Workbench

LOOK_S: Final = 5.0
"""Listening time after opening: a bootloader takes up to 2 s, boards report once a second."""
GPS_WAIT_S: Final = 60.0
NOISY_PERCENT: Final = 30
LOSSY_PERCENT: Final = 5.0
FEW_LOST: Final = 3
"""Lost payloads that may be chance in this short time."""
WEAK_SATELLITES: Final = 6
SENSORS: Final = {
    SENSOR_IMU: "IMU",
    SENSOR_MAG: "compass",
    SENSOR_BARO: "barometer",
    SENSOR_GPS: "GPS",
}
"""Names of the sensors' bits in a node's report."""
ANY_ADDRESS: Final = "0.0.0.0"
ELSEWHERE: Final = ("192.0.2.1", 9)
"""An address that no machine has; connecting a UDP socket to it sends nothing."""
KIND: Final = "phone:push"
Sources = tuple[SourceSettings, ...]
TOKEN_BYTES: Final = 24
NEXT: Final = (
    "In Sensor Logger (Android, iOS): settings, HTTP Push, paste this URL, shortest batch period.",
    "Record accelerometer, gravity, gyroscope, magnetometer, barometer and location.",
    "On an iPhone switch on Standardise Units & Frames.",
)
console = console_of()
app = typer.Typer()


@app.command()
def setup(
    what: Literal["boards", "phone"] = argument(
        "Our boards, or a phone that posts the readings of its sensors.", "boards"
    ),
    *,
    vehicle: int | None = option("--vehicle", "Its id, if several send.", min=1, max=31),
    port: str | None = opt.PORT,
    simulated: bool = opt.SIMULATED,
) -> None:
    """Guide through the first start: receiver, sensors, radio, GPS, calibration.

    Each calibration is saved when it is done; the exit code is 1 if one is not. The gateway
    must not run at the same time: the receiver's port is read by one program at a time.

    A phone: asks for a password, stores the settings, and shows the QR code that the phone needs.
    """
    settings = read_settings()
    if what == "phone":
        require("a phone", "panel")
        _guide_phone(settings, settings_file())
        return
    serial = settings.serial if port is None else replace(settings.serial, port=port)
    if not simulated:
        _guide(settings, serial, vehicle)
        return
    with simulated_receiver(settings.simulator) as (path, bench):
        _guide(settings, replace(serial, port=path), vehicle, bench)


def _guide(
    settings: GatewaySettings,
    serial: SerialSettings,
    vehicle: int | None,
    bench: Workbench | None = None,
) -> None:
    """Run the steps of the first start; with a simulated aircraft nothing is saved."""
    logging.getLogger(SerialPort.__module__).setLevel(logging.WARNING)
    serial = _find(serial)
    statuses: dict[tuple[int, int], NodeStatus] = {}

    def keep(records: list[RawRecord]) -> bool:
        found = (record for record in records if isinstance(record, NodeStatus))
        statuses.update({(one.node.vehicle_id, one.node.node_id): one for one in found})
        return False

    report = _observe(serial, keep, LOOK_S)
    _check_receiver(report, serial)
    number = _choose(report, vehicle)
    _check_nodes(report, statuses, number)
    _check_gps(serial, number)
    done = _calibrate(settings, serial, number, bench)
    _head("Done" if done == len(STEPS) else f"Calibrated: {done} of {len(STEPS)} steps")
    console.print("Start the gateway with `mavgate run`, and a ground station on UDP port 14550.")
    console.print(f"A step that failed can be repeated: `mavgate calibrate {'`, `'.join(STEPS)}`.")
    if done < len(STEPS):
        raise typer.Exit(1)


def _find(serial: SerialSettings) -> SerialSettings:
    _head("1 of 5: receiver")
    try:
        device = asyncio.run(find_receiver(serial))
    except PortNotFoundError as error:
        _stop(
            str(error),
            "Connect the receiver by USB. Program a new board with `mavgate flash receiver`",
            "`mavgate doctor` checks whether this user may open the port",
            "A running gateway (`mavgate status`) must be stopped first",
        )
    return replace(serial, port=device)


def _check_receiver(report: LinkReport, serial: SerialSettings) -> None:
    receiver = report.receiver
    if receiver is None and not report.nodes:
        sent = "bytes that are not frames" if report.bytes_received else "nothing"
        _stop(
            f"{serial.port} sends {sent}",
            f"`mavgate flash --show --port {serial.port}` reads the program of the board",
            f"The receiver's line has {serial.baud} baud in these settings (serial.baud)",
        )
    if receiver is None:
        _hint(f"{serial.port}: no report of the receiver in {LOOK_S:.0f} s")
        return
    _good(f"{serial.port}, {channel_name(receiver.channel)}, noise {receiver.noise_percent} %")
    if receiver.radio.problem:
        _hint(f"receiver: {receiver.radio.problem}; check its wiring and 3.3 V supply")
    if receiver.noise_percent > NOISY_PERCENT:
        _hint(
            "The channel is noisy: flash all boards with another --frequency of the band"
            if receiver.channel == LORA_CHANNEL
            else "The channel is noisy: move the receiver away from Wi-Fi routers, or flash all "
            "boards with another --channel (76 and above are outside the Wi-Fi band)"
        )


def _choose(report: LinkReport, vehicle: int | None) -> int:
    _head("2 of 5: boards, sensors and radio")
    received = sorted({link.node.vehicle_id for link in report.nodes})
    if not received:
        _stop(
            "no aircraft is received",
            "Is it powered? A node whose LED flashes every 2 s is not acknowledged: channel, rate "
            "and address, or the LoRa settings, must be those of the receiver; compare them with "
            "`mavgate flash --show`",
            "Three flashes: its radio module does not respond: check its wiring and 3.3 V supply",
        )
    listed = ", ".join(map(str, received))
    if vehicle is not None and vehicle not in received:
        _stop(f"nothing is received from vehicle {vehicle}, but from {listed}")
    if vehicle is None and len(received) > 1:
        _stop(f"several aircraft are received: {listed}; choose with --vehicle")
    return received[0] if vehicle is None else vehicle


def _check_nodes(
    report: LinkReport, statuses: dict[tuple[int, int], NodeStatus], vehicle: int
) -> None:
    rows, hints = list[tuple[str, ...]](), list[str]()
    for link in report.nodes:
        if link.node.vehicle_id != vehicle:
            continue
        node = link.node.node_id
        status = statuses.get((vehicle, node))
        share = 100.0 * link.lost / max(link.received + link.lost, 1)
        received = (f"{link.rate_hz:.0f}", f"{share:.1f}")
        if status is None:
            rows.append((str(node), "no report", "", "", *received, ""))
            continue
        failed = _sensors(status.sensors_failed)
        version = "{}.{}".format(*status.firmware_version)
        volts = f"{status.supply_mv / MV_PER_V:.2f}" if status.supply_mv else ""
        present = _sensors(status.sensors_present & ~status.sensors_failed)
        found = ", ".join(status.chips) or present
        rows.append((str(node), version, found, failed, *received, volts))
        if status.radio.problem:
            hints.append(f"Node {node}: {status.radio.problem}; try another module")
        if failed:
            hints.append(f"Node {node}: {failed} missing or failed: check its wiring and supply")
        if share > LOSSY_PERCENT and link.lost > FEW_LOST:
            hints.append(
                f"Node {node}: {share:.0f} % of the payloads are lost: upright antennas, 10 uF "
                "across the radio's supply, or `--air-rate 250` on all boards for range"
            )
    columns = ("node", "firmware", "sensors", "missing", "payloads/s", "lost %", "supply V")
    console.print(table_of(*columns, left=4, rows=rows))
    for hint in hints:
        _hint(hint)
    if not hints:
        _good("all boards report all their sensors")


def _sensors(bits: int) -> str:
    return ", ".join(name for bit, name in SENSORS.items() if bits & bit)


def _check_gps(serial: SerialSettings, vehicle: int) -> None:
    _head("3 of 5: GPS")
    fix: GpsFix | None = None

    def has_fix(records: list[RawRecord]) -> bool:
        nonlocal fix
        for record in records:
            if isinstance(record, GpsFix) and record.node.vehicle_id == vehicle:
                fix = record
        return fix is not None and fix.fix_ok

    _observe(serial, has_fix, GPS_WAIT_S)
    if fix is None:
        _hint("no GPS node is received: position will be missing; see step 2")
    elif not fix.fix_ok:
        _hint(
            f"no fix within {GPS_WAIT_S:.0f} s, {fix.satellites} satellites: go outdoors; a module "
            "that was never used takes up to 15 min the first time"
        )
    else:
        text = f"fix with {fix.satellites} satellites, accuracy {figure(fix.h_acc_m, '.1f', 'm')}"
        _good(text) if fix.satellites >= WEAK_SATELLITES else _hint(f"{text}: wait for more")


def _calibrate(
    settings: GatewaySettings, serial: SerialSettings, vehicle: int, bench: Workbench | None
) -> int:
    """Calibrate and save; return the number of successful steps."""
    _head("4 of 5: calibration of gyroscope, accelerometer, level and magnetometer")
    aircraft = load_aircraft(settings).get(vehicle, settings.default_aircraft)
    capture = capture_from(serial, vehicle)
    poses = poses_from(capture) if bench is None else poses_on(bench, capture)
    results: list[NodeCalibration] = []
    files: set[Path] = set()

    def save(calibration: NodeCalibration) -> None:
        results.append(calibration)
        if bench is None:
            changed = replace(aircraft, calibration=calibration)
            files.add(save_aircraft(settings, vehicle, changed))

    calibrate_each([*STEPS], poses, aircraft.calibration, save)
    _head("5 of 5: saving")
    if bench is not None:
        _hint("not saved: the receiver is simulated")
    elif files:
        _good(f"saved in {', '.join(map(str, files))}")
    else:
        _hint("nothing to save: no step succeeded")
    return len(results)


def _observe(
    serial: SerialSettings, feed: Callable[[list[RawRecord]], bool], limit_s: float
) -> LinkReport:
    """Read the receiver until `feed` has enough, at most for a time; shows progress."""
    with progress_bar(TimeElapsedColumn(), auto_refresh=True) as bar:
        bar.add_task("listening", total=None)
        return asyncio.run(listen(serial, feed, limit_s))[0]


def _head(text: str) -> None:
    console.print(f"\n{text}", style="bold")


def _good(text: str) -> None:
    console.print(f"OK    {text}", style="green")


def _hint(text: str) -> None:
    console.print(f"INFO  {text}", style="yellow")


def _stop(text: str, *hints: str) -> NoReturn:
    refuse("\n".join([text, *(f"- {hint}" for hint in hints)]))


def _own_address() -> str:
    """Return the address of this machine in its network; ends the command if it has none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(ELSEWHERE)
        except OSError:
            refuse("this machine is in no network: connect it to that of the phone")
        return str(probe.getsockname()[0])


def _guide_phone(settings: GatewaySettings, file: Path) -> None:
    """Ask for what is missing, store it, and show the URL that the phone posts to."""
    import segno

    from gateway.panel.logins import hash_password

    _head("1 of 3: network")
    address, panel = _own_address(), settings.panel
    console.print(f"This machine is {address}; the phone must be in the same network.")
    _head("2 of 3: access")
    if not panel.password:
        asked = "Password of the panel, which the network can reach then"
        chosen = typer.prompt(asked, hide_input=True, confirmation_prompt=True)
        panel = replace(panel, password=hash_password(chosen), enabled=True)
    if not (panel.certificate or panel.insecure):
        typer.confirm("Without a certificate the network can read all traffic. Go on?", abort=True)
        panel = replace(panel, insecure=True)
    if panel.address == settings.panel.address != ANY_ADDRESS:
        panel = replace(panel, address=ANY_ADDRESS)
    token, sources = _with_phone(settings.sources)
    _save(file, settings, replace(settings, panel=panel, sources=sources))
    _head("3 of 3: phone")
    url = f"http{'s' if panel.certificate else ''}://{address}:{panel.port}/push/{token}"
    segno.make(url).terminal(sys.stdout, compact=True)
    console.print(url, *NEXT, "Then start `mavgate run`; restart one that runs.", sep="\n")


def _with_phone(sources: Sources) -> tuple[str, Sources]:
    """Keep the token of a phone in the settings, or add one; the app has stored its URL."""
    token = secrets.token_urlsafe(TOKEN_BYTES)
    for each in sources:
        if each.url.startswith(KIND):
            if known := parse_source(each.url).options.get("token"):
                return known, sources
            mark = "&" if "?" in each.url else "?"
            own = SourceSettings(url=f"{each.url}{mark}token={token}")
            return token, tuple(own if one is each else one for one in sources)
    return token, (*sources, SourceSettings(url=f"{KIND}?token={token}"))


def _save(file: Path, before: GatewaySettings, after: GatewaySettings) -> None:
    if before == after:
        return
    old, new = (
        {name: getattr(one.panel, name) for name in ("enabled", "address", "password", "insecure")}
        for one in (before, after)
    )
    panel = dict(new.items() - old.items())
    sources = [{"url": each.url} for each in after.sources]
    try:
        save_values(file, {"panel": panel, "sources": sources})
    except (ConfigError, OSError) as error:
        refuse(f"not saved: {error}")
    console.print(f"saved in {file}")
