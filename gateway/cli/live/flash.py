"""`mavgate flash`: programs and settings of boards."""

from pathlib import Path
from typing import Any, Final, Literal, get_args

import msgspec
import typer
from intelhex import IntelHex

from gateway.cli.support.options import argument, option, output_file
from gateway.cli.support.terminal import console_of, refuse, table_of
from gateway.flashing import airtime, boards
from gateway.live.serial_port import Port, PortNotFoundError, find_port, list_serial_ports
from gateway.output import write_new
from gateway.printable import reason_of
from gateway.settings import Field, fields_of

FIELDS: Final = {field.name: field for field in fields_of(boards.BoardSettings)}
OPTIONS: Final = {
    "vehicle_id": "--vehicle",
    "node_id": "--node",
    "radio_pipe": "--pipe",
    "radio_channel": "--channel",
    "radio_kbps": "--air-rate",
    "radio_power_dbm": "--power",
    "radio_address": "--address",
    "imu_send_hz": "--send-rate",
    "imu_raw": "--raw",
    "accel_range_g": "--accel-range",
    "gyro_range_dps": "--gyro-range",
    "gps_rate_hz": "--gps-rate",
    "gps_dynamic_model": "--gps-model",
    "lora_frequency_khz": "--frequency",
    "lora_bandwidth_khz": "--bandwidth",
    "lora_spreading": "--spreading",
    "lora_coding": "--coding",
    "lora_sync_word": "--sync-word",
    "lora_foreign": "--foreign/--own-only",
    "lora_power_dbm": "--power",
}

console = console_of()
app = typer.Typer()


def _allowed(field: Field) -> str:
    literals = ", ".join(map(str, get_args(field.type.__origin__)))
    return f"{literals or field.range} {field.unit}".strip()


def _panel(name: str) -> str:
    if name in ("vehicle_id", "node_id", "radio_pipe"):
        return "Aircraft"
    if name.startswith("lora_"):
        return "LoRa"
    return "nRF24L01+" if name.startswith("radio_") else "Sensors"


def _option(name: str) -> Any:
    field = FIELDS[name]
    names = "--raw/--filtered" if name == "imu_raw" else OPTIONS[name]
    unbounded = ("imu_raw", "radio_address", "lora_foreign")
    allowed = "" if name in unbounded else f" {_allowed(field)}."
    text = f"{field.meaning}{allowed}"
    return option(names, text, show_default=False, rich_help_panel=_panel(name))


@app.command()
def flash(
    board: Literal["imu", "gps", "receiver"] | None = argument(
        "Program to write; without it, list the boards."
    ),
    *,
    port: str = option("--port -p", "As serial.port: device, usb:VID:PID or auto.", "auto"),
    show: bool = option("--show", "Read the program, version and settings of a board.", False),
    keep: bool = option("--keep", "Keep present settings that are not given.", False),
    clock: int = option("--clock", "Crystal: 16 or 8 MHz.", 16),
    output: Path | None = output_file("Write the image to this file, not to a board.", (".hex",)),
    force: bool = option("--force", "Replace an existing file.", False),
    radio: boards.Radio = option("--radio", "The radio of all boards: nRF24L01+ or LoRa.", "nrf24"),
    power: int | None = option(
        "--power", "Transmit power: -18, -12, -6, 0 dBm; with LoRa 2 to 20."
    ),
    vehicle: int | None = _option("vehicle_id"),
    node: int | None = _option("node_id"),
    pipe: int | None = _option("radio_pipe"),
    send_rate: int | None = _option("imu_send_hz"),
    raw: bool | None = _option("imu_raw"),
    accel_range: int | None = _option("accel_range_g"),
    gyro_range: int | None = _option("gyro_range_dps"),
    gps_rate: int | None = _option("gps_rate_hz"),
    gps_model: int | None = _option("gps_dynamic_model"),
    channel: int | None = _option("radio_channel"),
    air_rate: int | None = _option("radio_kbps"),
    address: str | None = _option("radio_address"),
    frequency: float | None = option(
        "--frequency", "Centre of the channel, MHz; the same on all boards.", rich_help_panel="LoRa"
    ),
    bandwidth: int | None = _option("lora_bandwidth_khz"),
    spreading: int | None = _option("lora_spreading"),
    coding: int | None = _option("lora_coding"),
    sync_word: int | None = _option("lora_sync_word"),
    foreign: bool | None = _option("lora_foreign"),
    duty: float | None = option(
        "--duty",
        "Maximum time on air, percent; by default 45, with a warning.",
        rich_help_panel="LoRa",
    ),
) -> None:
    """Write a ready-made program with its settings to a board, or read them back.

    Needs avrdude, and no compiler. Listing, reading and writing restart the board.
    """
    khz = None if frequency is None else round(1000 * frequency)
    nrf24_power, lora_power = (power, None) if radio == "nrf24" else (None, power)
    given: tuple[object, ...] = (
        *(vehicle, node, pipe, channel, air_rate, nrf24_power, _address(address)),
        *(send_rate, raw, accel_range, gyro_range, gps_rate, gps_model),
        *(khz, bandwidth, spreading, coding, sync_word, foreign, lora_power),
    )
    changes = {n: v for n, v in zip(OPTIONS, given, strict=True) if v is not None}
    if clock not in boards.CLOCKS_MHZ:
        refuse(f"--clock {clock}: 16 or 8")
    try:
        if show:
            device = find_port(port, list_serial_ports())
            with boards.reserved(device):
                written = boards.read_flash(device, boards.require_bootloader(device))
            _print(device, boards.block_of(written))
        elif board is None:
            _list()
        else:
            program = boards.Program[board.upper()]
            _check(program, radio, changes)
            image = boards.read_image(boards.image_path(program, clock, radio))
            if output is None:
                _write(program, image, changes, port=port, keep=keep, duty=duty)
            else:
                settings = _changed(program, boards.block_of(image).settings, changes, duty)
                write_new(output, [boards.with_settings(image, settings)], overwrite=force)
    except FileExistsError:
        refuse(f"{output} already exists; use --force to overwrite")
    except OSError as error:
        refuse(f"{error.filename or port}: {reason_of(error)}")
    except (boards.FlashError, PortNotFoundError) as error:
        refuse(str(error))


def _address(text: str | None) -> int | None:
    try:
        return None if text is None else int(text, 16)
    except ValueError:
        refuse(f"--address {text}: eight hexadecimal digits, such as d35ac396")


def _list() -> None:
    found = list_serial_ports()
    if not any(port.usb_id for port in found):
        refuse("no USB adapter is connected: connect a board by USB, then list again")
    rows = ((port.device, port.usb_id, port.description, _bootloader_text(port)) for port in found)
    console.print(table_of("device", "USB id", "adapter", "bootloader", left=4, rows=rows))
    console.print("Next: `mavgate flash imu --port DEVICE`, or gps, or receiver")


def _bootloader_text(port: Port) -> str:
    if not port.usb_id:
        return "not tried"
    try:
        with boards.reserved(port.device):
            loader = boards.find_bootloader(port.device)
    except boards.FlashError as error:
        return str(error).removeprefix(f"{port.device}: ")
    return "no response" if loader is None else f"{loader.name}, {loader.baud} baud"


def _write(
    program: boards.Program,
    image: IntelHex,
    changes: dict[str, Any],
    *,
    port: str,
    keep: bool,
    duty: float | None,
) -> None:
    # Invalid settings are refused before a port is opened.
    settings = _changed(program, boards.block_of(image).settings, changes, duty)
    device = find_port(port, list_serial_ports())
    with boards.reserved(device):
        loader = boards.require_bootloader(device)
        if keep:
            kept = boards.block_of(boards.read_flash(device, loader))
            if kept.program is not program:
                refuse(f"--keep: the board holds the program {kept.program.name.lower()}")
            if kept.settings.radio != settings.radio:
                refuse(f"--keep: the board's program is for the radio {kept.settings.radio}")
            settings = _changed(program, kept.settings, changes, duty)
        settings = msgspec.structs.replace(settings, soft_restart=loader.leaves_watchdog_on)
        boards.write_flash(device, loader, boards.with_settings(image, settings))
    _print(device, boards.block_of(image))


def _check(program: boards.Program, radio: boards.Radio, changes: dict[str, Any]) -> None:
    """End the command if an option does not apply to the program, or its value is invalid."""
    for name, value in changes.items():
        option = OPTIONS[name]
        if name not in boards.used_by(program, radio):
            other = next((r for r in boards.RADIOS if name in boards.used_by(program, r)), None)
            no_such = f"the program {program.name.lower()} has no such setting"
            refuse(f"{option}: {f'needs --radio {other}' if other else no_such}")
        try:
            msgspec.convert(value, FIELDS[name].type)
        except msgspec.ValidationError:
            refuse(f"{option} {value}: must be {_allowed(FIELDS[name])}")
    least, most = boards.IMU_SEND_HZ[radio]
    if not least <= changes.get("imu_send_hz", most) <= most:
        refuse(f"--send-rate {changes['imu_send_hz']}: must be {least} to {most} Hz")


def _changed(
    program: boards.Program,
    before: boards.BoardSettings,
    changes: dict[str, Any],
    duty: float | None,
) -> boards.BoardSettings:
    """Apply the options, with a pipe for another vehicle, and check the time on the air of LoRa."""
    after = msgspec.structs.replace(before, **changes)
    if "vehicle_id" in changes and "radio_pipe" not in changes:
        pipe = boards.default_pipe(program, after.vehicle_id)
        after = msgspec.structs.replace(after, radio_pipe=pipe)
    if after.radio == "sx1276" and program is not boards.Program.RECEIVER:
        _check_airtime(program, after, duty)
    return after


def _check_airtime(
    program: boards.Program, settings: boards.BoardSettings, duty: float | None
) -> None:
    """Refuse settings that overload the channel; warn if they exceed the limit of the band."""
    most = airtime.MOST_SHARE if duty is None else duty / 100
    used = airtime.check(program, settings, most)
    console.print(f"time on air: {100 * used:.1f} %")
    allowed = airtime.duty_cycle(settings.lora_frequency_khz)
    if duty is None and allowed is not None and used > allowed:
        console.print(
            f"warning: {settings.lora_frequency_khz / 1000:g} MHz allows {100 * allowed:g} % in "
            f"Europe; --duty {100 * allowed:g} refuses longer times on air"
        )


def _print(device: str, block: boards.SettingsBlock) -> None:
    major, minor = block.firmware_version
    name = block.program.name.lower()
    console.print(f"{device}: {name}, version {major}.{minor}, for {block.clock_mhz} MHz")
    values = msgspec.to_builtins(block.settings)
    values["radio_address"] = f"{values['radio_address']:08x}"
    rows = (
        (name, str(values[name]), FIELDS[name].unit, OPTIONS.get(name, ""))
        for name in ("radio", *boards.used_by(block.program, block.settings.radio))
    )
    console.print(table_of("setting", "value", "unit", "option", left=4, rows=rows))
