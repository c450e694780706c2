"""`mavgate map`: copy an area of a map for the panel, for use without a network."""

from contextlib import suppress
from pathlib import Path

import typer
from rich.progress import Progress

from gateway.cli.support.options import argument, folder_of, option, read_options, read_settings
from gateway.cli.support.recordings import files_of, name_of
from gateway.cli.support.terminal import NEGATIVE_NUMBERS, console_of, refuse
from gateway.extras import require

app = typer.Typer()


@app.command("map", context_settings=NEGATIVE_NUMBERS)
def get_map(
    around: str = argument("A recording, or LATITUDE,LONGITUDE in degrees.", ...),
    source: str = argument(
        "A PMTiles file of raster tiles: an https:// address whose owner permits "
        "extracts, or a path.",
        ...,
    ),
    *,
    radius: str = option("--radius", "Margin: 5km, 800m, 3mi.", "5km"),
    zoom: int = option("--zoom", "Greatest zoom.", 16, min=1, max=22),
    name: str | None = option("--name", "Name of the map style; by default the area's."),
) -> None:
    """Fetch an area of a map for the panel, for use without a network.

    It is offered as a map style. Only what the area needs is fetched, one request at a time.
    """
    require("a map", "panel")
    from gateway.panel import map_area
    from gateway.panel.flight_page import read_flight

    settings = read_settings()
    positions = [] if (pair := _coordinates(around)) is None else [pair]
    if not positions:
        files = files_of([Path(around)], folder_of(settings), "tlogs")
        around = name_of(Path(around), files)
        flight = read_flight(files, read_options(settings), around)
        for history in (one.vehicle.history for one in flight.aircraft.values()):
            positions += zip(history.columns["lat_deg"], history.columns["lon_deg"], strict=True)
    folder = Path(settings.panel.tiles_folder).expanduser()
    target = folder / f"{_file_name(name or around)}.pmtiles"
    try:
        box = map_area.box_around(positions, map_area.length_m(radius))
        folder.mkdir(parents=True, exist_ok=True)
        with Progress(console=console_of(stderr=True), transient=True) as progress:
            task = progress.add_task("fetching tiles", total=None)
            count = map_area.extract_area(
                *(map_area.open_source(source), target, box, zoom),
                lambda done, total: progress.update(task, completed=done, total=total),
            )
    except FileExistsError:
        refuse(f"{target} already exists; delete it, or choose another --name")
    except (map_area.MapAreaError, ValueError, OSError) as error:
        with suppress(FileNotFoundError):
            target.unlink()
        refuse(str(error))
    print(f"{target}: {count} tiles, {target.stat().st_size / 1e6:.1f} MB")


def _coordinates(text: str) -> tuple[float, float] | None:
    """Return latitude and longitude if the text is a valid pair of them."""
    try:
        lat_deg, lon_deg = (float(part) for part in text.split(","))
    except ValueError:
        return None
    return (lat_deg, lon_deg) if abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0 else None


def _file_name(text: str) -> str:
    return "".join(letter if letter.isalnum() or letter in " .-_" else "_" for letter in text)[:32]
