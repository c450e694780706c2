"""`mavgate source`: describe the data that a tracker sends."""

import asyncio

import typer

from gateway.cli.support.options import argument, option
from gateway.cli.support.terminal import refuse
from gateway.clock import GatewayClock
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.live.source_port import SourcePort, read_map
from gateway.printable import printable
from gateway.sources.kinds import make_sources
from gateway.sources.settings import SourceSettings
from gateway.sources.source import SourceInput
from gateway.sources.trial import SourceTrial, describe

app = typer.Typer()

SHOWN = 5
"""Records of each kind that are shown; further ones are counted."""


@app.command("source")
def try_source(
    url: str = argument("Such as lines:/dev/ttyUSB0 or crsf:/dev/ttyACM0.", ...),
    seconds: float = option("--seconds", "Duration of the test, s.", 10.0, min=0.1, max=3600),
) -> None:
    """Test a tracker: show its data, its rates, and data missing for attitude and position.

    The exit code is 1 if no record was decoded.
    """
    try:
        (source,) = make_sources((SourceSettings(url=url),), read_map)
    except ValueError as error:
        refuse(str(error))
    trial = asyncio.run(_listen(source, seconds))
    for line in trial.summary(seconds, source.reason):
        print(printable(line))
    if not trial.records:
        raise typer.Exit(1)


async def _listen(source: SourceInput, seconds: float) -> SourceTrial:
    trial, clock = SourceTrial(source.url), GatewayClock()

    def show(found: SourceInput, data: bytes) -> None:
        trial.look_at(data)
        for event in found.events(data, clock()):
            if trial.feed(event) <= SHOWN:
                print(printable(describe(event)))

    # Not started: only its limits and its clock are used.
    port = SourcePort(source, show, Hub(HubSettings(), lambda _: None, clock))
    port.start()
    await asyncio.sleep(seconds)
    port.close()
    return trial
