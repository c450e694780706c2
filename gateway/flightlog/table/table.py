"""The table format: a CSV with all that is needed to fuse a flight again.

    # mavgate table 1
    # header: {"mavgate_version": …, "vehicle_id": …, "settings": {…}, "calibration": {…}, …}
    time_us,node_id,…
    # state: {"vehicle_id": …, "fits": …, "sensing": …, "estimation": …}
    12000,0,…
    # mark: {"time_us": 12345, "text": "…"}
    # node: {"time_us": 12345, "supply_mv": 3290, "bus_errors": 0, …}
    # header: {…}

A node reports the state of its board once a second. A second header means that the rows after it
were fused with other settings. A state line is the internal state of filters and estimator at that
row, so that a file that begins in flight can be fused again from its first row. Lines that begin
with `#` hold JSON; spreadsheets and pandas (`comment="#"`) skip them. An empty cell means not
known, or nothing new.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Final

import msgspec

from gateway.flightlog.table.row import COLUMNS, TableRow, row_from_cells, row_to_line
from gateway.records import FusionState, NodeStatus

FORMAT_PREFIX: Final = "# mavgate table "
FORMAT_LINE: Final = f"{FORMAT_PREFIX}1"
HEADER_PREFIX: Final = "# header: "
STATE_PREFIX: Final = "# state: "
MARK_PREFIX: Final = "# mark: "
NODE_PREFIX: Final = "# node: "

HEAD_LINES: Final = 3
"""Version, header, names."""
MAX_LINE: Final = 1 << 20
"""Longer than any settings; a disk's zeros without a line's end must not fill the memory."""


class TableHeader(msgspec.Struct, frozen=True, kw_only=True):
    """The head of a table."""

    mavgate_version: str = ""
    vehicle_id: Annotated[int, msgspec.Meta(ge=1, le=255)] = 1
    session: str = ""
    """Recording that the file is a part of."""
    part: int = 1
    """Part of the recording; the states of a later part carry on those of the one before."""
    cold_start: bool = True
    """Whether the first row is the first sample that the estimator ever saw."""
    unix_us_at_zero: int | None = None
    """Civil time of `time_us` zero in µs since 1970, as far as it was known at the start."""
    settings: dict[str, Any] = {}
    """The settings, as in the settings file."""
    calibration: dict[str, Any] = {}
    """The calibration of the aircraft's IMU node."""


REMARK: Final = "Mark: "
"""Begin of the STATUSTEXT with an operator's remark."""


class TableMark(msgspec.Struct, frozen=True):
    """A remark at a moment of the flight."""

    time_us: int
    text: str


@dataclass(frozen=True, slots=True)
class TableFault:
    """A line, or the end of one, that could not be read."""

    line: int
    """Counted from 1."""
    size: int
    reason: str


TableEvent = TableRow | TableMark | TableFault | TableHeader | FusionState | NodeStatus
"""A header here is one after rows: the settings were changed."""


def encode_head(header: TableHeader) -> str:
    """Write everything before the first row."""
    return f"{FORMAT_LINE}\n{encode_header(header)}{','.join(COLUMNS)}\n"


def encode_header(header: TableHeader) -> str:
    """Write a header as a line of its own."""
    return f"{HEADER_PREFIX}{msgspec.json.encode(header).decode()}\n"


def encode_state(state: FusionState) -> str:
    """Write a state as a line of its own."""
    return f"{STATE_PREFIX}{msgspec.json.encode(state).decode()}\n"


def encode_mark(mark: TableMark) -> str:
    """Write a mark as a line of its own."""
    return f"{MARK_PREFIX}{msgspec.json.encode(mark).decode()}\n"


def encode_node(status: NodeStatus) -> str:
    """Write a node's report as a line of its own."""
    return f"{NODE_PREFIX}{msgspec.json.encode(status).decode()}\n"


def encode_line(event: TableRow | TableHeader | FusionState | TableMark | NodeStatus) -> str:
    """Write any line that may follow the head."""
    match event:
        case TableRow():
            return row_to_line(event)
        case TableHeader():
            return encode_header(event)
        case FusionState():
            return encode_state(event)
        case TableMark():
            return encode_mark(event)
        case NodeStatus():
            return encode_node(event)


class TableReader:
    """Decode any chunks of a table into rows, marks and faults; never raises on data.

    Columns are found by name, so a file with more or fewer columns, or in another order, can be
    read too.
    """

    def __init__(self) -> None:
        self.header: TableHeader | None = None
        """None until it is read, or if the file has none."""
        self.lines = 0
        self._rest = b""
        self._skipped = 0
        self._width = 0
        self._places: list[int] | None = None

    def feed(self, data: bytes, *, final: bool = False) -> list[TableEvent]:
        """Take the next bytes of the file.

        Parameters
        ----------
        data : bytes
            Any chunk.
        final : bool
            Whether the file ends with it. A last line without its end may have been cut within a
            number and is dropped.

        Returns
        -------
        list of TableEvent
            In the order of the file.
        """
        *lines, rest = (self._rest + data).split(b"\n")
        events = [event for line in lines if (event := self._take(line)) is not None]
        if len(rest) > MAX_LINE or (self._skipped and not lines):
            self._skipped += len(rest)
            rest = b""
        self._rest = rest
        if final and (rest or self._skipped):
            self.lines += 1
            size = self._skipped + len(rest)
            events.append(TableFault(self.lines, size, "the line has no end"))
        return events

    def _take(self, line: bytes) -> TableEvent | None:
        self.lines += 1
        size, self._skipped = self._skipped + len(line) + 1, 0
        if size > len(line) + 1:
            return TableFault(self.lines, size, "the line is too long")
        try:
            text = line.decode("utf-8-sig" if self.lines == 1 else "utf-8").rstrip("\r")
            if text.startswith("#"):
                return self._take_comment(text)
            if not text:
                return None
            return self._take_cells(text.split(","))
        except (ValueError, msgspec.DecodeError) as error:
            return TableFault(self.lines, size, str(error))

    def _take_comment(self, text: str) -> TableMark | TableHeader | FusionState | NodeStatus | None:
        if text.startswith(FORMAT_PREFIX) and text != FORMAT_LINE:
            version = text.removeprefix(FORMAT_PREFIX)
            raise ValueError(f"table version {version!r}; this mavgate reads 1, a newer one more")
        if text.startswith(MARK_PREFIX):
            return msgspec.json.decode(text.removeprefix(MARK_PREFIX), type=TableMark)
        if text.startswith(NODE_PREFIX):
            return msgspec.json.decode(text.removeprefix(NODE_PREFIX), type=NodeStatus)
        if text.startswith(STATE_PREFIX):
            return msgspec.json.decode(text.removeprefix(STATE_PREFIX), type=FusionState)
        if text.startswith(HEADER_PREFIX):
            header = msgspec.json.decode(text.removeprefix(HEADER_PREFIX), type=TableHeader)
            if self.header is not None:
                return header
            self.header = header
        return None

    def _take_cells(self, cells: list[str]) -> TableRow | None:
        if not self._width:
            self._take_names(cells)
            return None
        if len(cells) != self._width:
            raise ValueError(f"{len(cells)} cells where there should be {self._width}")
        if self._places is not None:
            cells = [cells[place] if place >= 0 else "" for place in self._places]
        return row_from_cells(cells, self.header.vehicle_id if self.header else 1)

    def _take_names(self, names: list[str]) -> None:
        if "time_us" not in names:
            raise ValueError("no line of column names with time_us before the first row")
        self._width = len(names)
        if tuple(names) != COLUMNS:
            self._places = [names.index(name) if name in names else -1 for name in COLUMNS]
