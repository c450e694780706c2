"""Options and arguments that several commands have, by their names in the code."""

from pathlib import Path
from typing import Annotated

import typer

from gateway.recordings.table import Position, SettingsChoice

Files = Annotated[list[Path], typer.Argument(help="Recordings.", show_default=False)]
Smooth = Annotated[
    bool,
    typer.Option(
        "--smooth",
        help="Smooth forwards and backwards (Rauch-Tung-Striebel); "
        "an hour of flight takes 120 MB of memory.",
    ),
]
BothEstimates = Annotated[
    bool,
    typer.Option(
        "--beside",
        help="For an autopilot's log: its own estimates and mavgate's, as two vehicles.",
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Overwrite the output.")]
From = Annotated[
    str | None, typer.Option("--from", help="Start: 80, 1:20 or 2026-06-11T14:25:30Z.")
]
To = Annotated[str | None, typer.Option("--to", help="End, written like --from.")]
Jobs = Annotated[
    int | None, typer.Option("--jobs", help="Processes; by default one per core.", min=1)
]
Columns = Annotated[
    Path | None, typer.Option("--columns", help="Column map of another program's CSV (TOML).")
]
Sensor = Annotated[
    list[str] | None,
    typer.Option(
        "--sensor",
        help="For a ULog or DataFlash log: gps=2 for the second GPS; likewise imu, mag and baro. "
        "By default the first with data.",
    ),
]
FuseWith = Annotated[
    SettingsChoice,
    typer.Option("--fuse-with", help="Fuse tables with the recorded or the current settings."),
]
Placing = Annotated[
    Position,
    typer.Option("--position", help="Position as live, or on straight lines between fixes."),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        help="For many recordings, a Dask cluster: tcp://HOST:8786.",
        show_default=False,
    ),
]
Flights = Annotated[
    list[str] | None,
    typer.Argument(
        help="Recordings by name or file, folders of them, and URLs: s3://, sftp://, …; "
        "by default the built-in simulated flight.",
        show_default=False,
    ),
]
Reference = Annotated[
    Path | None,
    typer.Option(
        "--reference",
        help="A mavgate CSV on the flight's clock, with the states to compare with.",
    ),
]
System = Annotated[
    int | None, typer.Option("--system", min=1, max=255, help="Vehicle of a tlog to use.")
]
Plain = Annotated[bool, typer.Option("--plain", help="Log lines instead of the live view.")]
DuplicateIds = Annotated[
    bool,
    typer.Option(
        "--duplicate-ids", help="Send even if another gateway sends the same vehicle id there."
    ),
]
Endpoint = Annotated[
    list[str] | None,
    typer.Option("--endpoint", "-e", help="Endpoint for MAVLink, instead of the settings'."),
]
Port = Annotated[
    str | None, typer.Option("--port", "-p", help="Receiver's port, instead of the settings'.")
]
Simulated = Annotated[
    bool, typer.Option("--simulated", help="Try it on the simulated receiver; saves nothing.")
]
