"""A pipeline without a hub: it takes bytes of sources or records, and keeps the sent messages."""

from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from gateway.aircraft import AircraftSettings, Outputs
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.records import RawRecord, VehicleReport
from gateway.sources.kinds import make_sources
from gateway.sources.settings import SourceSettings
from gateway.units import US_PER_S


class PipelineBench:
    """A pipeline, its time, and the messages that it has sent.

    `source` is the source of the URL, if there is one.
    """

    def __init__(self, settings: AircraftSettings | None = None, url: str = "") -> None:
        sources = make_sources((SourceSettings(url=url),), str) if url else []
        self.source: Any = next(iter(sources), None)
        self.pipeline = Pipeline(PipelineSettings(settings or AircraftSettings(), sources=sources))
        self.now_us = 0
        self.messages: list[Any] = []
        self._parser = mavlink.MAVLink(None)

    def keep(self, out: Outputs) -> Outputs:
        """Keep the messages of one step of the pipeline."""
        self.messages += [self._parser.decode(bytearray(sent.frame)) for sent in out.frames]
        return out

    def wait(self, seconds: float) -> None:
        """Let time pass, polling ten times a second."""
        end_us = self.now_us + round(seconds * US_PER_S)
        while self.now_us < end_us:
            self.now_us = min(self.now_us + 100_000, end_us)
            self.keep(self.pipeline.poll(self.now_us))

    def take(self, record: RawRecord | VehicleReport) -> Outputs:
        return self.keep(self.pipeline.feed_record(record, self.now_us))

    def feed(self, data: bytes) -> Outputs:
        """Feed bytes of the source."""
        return self.keep(self.pipeline.feed_source(self.source, data, self.now_us))

    def newest(self, kind: str) -> Any:
        return next((m for m in reversed(self.messages) if m.get_type() == kind), None)

    @property
    def texts(self) -> list[str]:
        return [m.text for m in self.messages if m.get_type() == "STATUSTEXT"]
