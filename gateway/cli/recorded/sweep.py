"""`mavgate sweep`: try settings on flights, and write the best as a settings file."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from gateway.batch.storage import is_url
from gateway.cli.support.loading import Loading, ReferenceOption, SystemOption
from gateway.cli.support.options import (
    ConfigOption,
    load_settings,
    or_refuse,
)
from gateway.cli.support.recording_options import ColumnsOption, ForceOption, SettingsOption
from gateway.cli.support.terminal import refuse

Metric = Literal["held", "interpolated", "reference", "attitude"]


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command()(sweep)


def sweep(
    flights: Annotated[
        list[str] | None,
        typer.Argument(
            help="Recordings by name, flight logs, or a folder; by default the built-in "
            "simulated flight.",
            show_default=False,
        ),
    ] = None,
    *,
    alpha: Annotated[
        str | None, typer.Option(help="Weight of the acceleration: 0.1:0.9:9 or 0.1,0.5.")
    ] = None,
    beta: Annotated[str | None, typer.Option(help="Weight of the velocity, likewise.")] = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(help="Any other setting: gps_latency_s=0:0.4:9, accel_filter=chebyshev,…"),
    ] = None,
    optimise: Annotated[
        int, typer.Option(help="Search the ranges for this many generations, instead of a grid.")
    ] = 0,
    metric: Annotated[
        Metric,
        typer.Option(
            help="Minimise the error at withheld fixes, against interpolated GPS, as in the paper, "
            "or against the reference's position or attitude."
        ),
    ] = "held",
    hold_out: Annotated[int, typer.Option(help="Withhold every n-th fix; 0 for none.", min=0)] = 5,
    gps_interval: Annotated[
        float,
        typer.Option(
            help="Fuse one fix in this many seconds, and withhold all others; 0 for all.", min=0.0
        ),
    ] = 0.0,
    jobs: Annotated[int | None, typer.Option(help="Processes.", min=1)] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Settings file for the best.")
    ] = Path("best.toml"),
    table: Annotated[Path | None, typer.Option("--table", help="CSV file for every trial.")] = None,
    reference: ReferenceOption = None,
    columns: ColumnsOption = None,
    system: SystemOption = None,
    settings: SettingsOption = "recorded",
    config: ConfigOption = None,
    force: ForceOption = False,
) -> None:
    """Try settings on one flight or many, and write the best as a settings file.

    Without a flight the built-in simulated one is used. The filter runs causally and is scored by
    fixes that are withheld from it. With many flights, the choice is scored by flights of other
    aircraft and days.
    """
    # It imports pandas and the optimisers, for which no other command should wait.
    from gateway.cli.support.sweeping import SweepOptions, run_season_sweep, run_sweep

    current = or_refuse(lambda: load_settings(config))
    named = [(name, text) for name, text in (("alpha", alpha), ("beta", beta)) if text]
    options = SweepOptions(
        named, vary or [], optimise, metric, hold_out, gps_interval, jobs, output, table, force
    )
    given = flights or []
    if len(given) > 1 or any(Path(name).is_dir() or is_url(name) for name in given):
        from gateway.cli.support.batch_work import SeasonWork, season_options

        if reference is not None or system is not None:
            refuse("--reference and --system belong to one flight")
        read = season_options(config, columns, settings)
        run_season_sweep(SeasonWork(given, config, jobs), read, current, options)
        return
    run_sweep(
        Path(given[0]) if given else None,
        Loading(current, settings, columns, system, reference),
        options,
    )
