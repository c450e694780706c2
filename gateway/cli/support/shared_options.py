"""Options and arguments that several commands have, by their names in the code."""

from typing import Final

from gateway.cli.support.options import argument, option

FILES: Final = argument("Recordings.", ..., show_default=False)
SMOOTH: Final = option(
    "--smooth",
    "Smooth forwards and backwards (Rauch-Tung-Striebel); an hour of flight takes 120 MB of "
    "memory.",
    False,
)
BOTH_ESTIMATES: Final = option(
    "--beside",
    "For an autopilot's log: its own estimates and mavgate's, as two vehicles.",
    False,
)
FORCE: Final = option("--force", "Overwrite the output.", False)
FROM: Final = option("--from", "Start: 80, 1:20 or 2026-06-11T14:25:30Z.")
TO: Final = option("--to", "End, written like --from.")
JOBS: Final = option("--jobs", "Processes; by default one per core.", min=1)
COLUMNS: Final = option("--columns", "Column map of another program's CSV (TOML).")
SENSOR: Final = option(
    "--sensor",
    "For a ULog or DataFlash log: gps=2 for the second GPS; likewise imu, mag and baro. By default "
    "the first with data.",
)
FUSE_WITH: Final = option(
    "--fuse-with", "Fuse tables with the recorded or the current settings.", "recorded"
)
PLACING: Final = option(
    "--position", "Position as live, or on straight lines between fixes.", "causal"
)
SCHEDULER: Final = option(
    "--scheduler",
    "For many recordings, a Dask cluster: tcp://HOST:8786.",
    show_default=False,
)
FLIGHTS: Final = argument(
    "Recordings by name or file, folders of them, and URLs: s3://, sftp://, …; by default the "
    "built-in simulated flight.",
    show_default=False,
)
REFERENCE: Final = option(
    "--reference", "A mavgate CSV on the flight's clock, with the states to compare with."
)
SYSTEM: Final = option("--system", "Vehicle of a tlog to use.", min=1, max=255)
PLAIN: Final = option("--plain", "Log lines instead of the live view.", False)
DUPLICATE_IDS: Final = option(
    "--duplicate-ids", "Send even if another gateway sends the same vehicle id there.", False
)
ENDPOINT: Final = option("--endpoint -e", "Endpoint for MAVLink, instead of the settings'.")
PORT: Final = option("--port -p", "Receiver's port, instead of the settings'.")
SIMULATED: Final = option("--simulated", "Try it on the simulated receiver; saves nothing.", False)
