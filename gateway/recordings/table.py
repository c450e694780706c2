"""The table format: a CSV with everything that is needed to fuse a flight again.

    # mavgate table 1
    # header: {"mavgate_version": …, "vehicle_id": …, "settings": {…}, "calibration": {…}, …}
    time_us,node_id,…
    # state: {"vehicle_id": …, "fits": …, "estimation": …}
    12000,0,…
    # note: {"time_us": 12345, "text": "…"}
    # node: {"time_us": 12345, "supply_mv": 3290, "bus_errors": 0, …}
    # header: {…}

A node reports the state of its board once a second. A second header means that the rows after it
were fused with other settings. A state line contains the internal state of filters and estimator at
that row, so that a file that begins in flight can be fused again from its first row. Lines that
begin with `#` contain JSON; spreadsheets and pandas (`comment="#"`) skip them. An empty cell means
not known, or no new value.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway.recordings.columns import COLUMNS, Cell, FloatArray
from gateway.recordings.rows import TableRow, cells_of, row_of_cells, row_to_line
from gateway.recordings.table_lines import normalise, read_cells, read_lines, write_lines
from gateway.records import FusionState, NodeStatus

FORMAT_PREFIX: Final = "# mavgate table "
FORMAT_LINE: Final = f"{FORMAT_PREFIX}1"
HEADER_PREFIX: Final = "# header: "
STATE_PREFIX: Final = "# state: "
NOTE_PREFIX: Final = "# note: "
NODE_PREFIX: Final = "# node: "

HEAD_LINES: Final = 3
"""Lines of the head: version, header, names."""
MAX_LINE: Final = 1 << 20
"""Maximum length of a line, more than any settings require; it bounds the memory for a file of
zeros without line ends."""


Position = Literal["causal", "interpolated"]
"""Positions of a table that is fused again."""
SettingsChoice = Literal["recorded", "current"]
"""Settings that a table is fused again with."""
TimeUs = Annotated[int, msgspec.Meta(ge=-(1 << 62), le=1 << 62)]
"""A time in µs; the sum of two fits 64 bits."""
IntArray = NDArray[np.int64]
NOTE: Final = "Note: "
"""Prefix of the STATUSTEXT with an operator's remark."""
NO_ROWS: Final = np.empty((0, len(COLUMNS)))
BLOCK_ROWS: Final = 1000
"""Number of another program's rows that are converted to columns at a time."""


class TableHeader(msgspec.Struct, frozen=True, kw_only=True):
    """The head of a table."""

    mavgate_version: str = ""
    vehicle_id: Annotated[int, msgspec.Meta(ge=1, le=255)] = 1
    session: str = ""
    """Recording to which the file belongs."""
    part: int = 1
    """Number of the part; the states of a later part continue those of the one before."""
    cold_start: bool = True
    """Whether the first row is the first sample that the estimator processed."""
    unix_us_at_zero: TimeUs | None = None
    """Civil time at `time_us` zero, µs since 1970, as far as it was known at the start."""
    settings: dict[str, Any] = {}
    """Settings in the form of the settings file."""
    calibration: dict[str, Any] = {}
    """The calibration of the aircraft's IMU node."""


class TableNote(msgspec.Struct, frozen=True):
    """A remark at a moment of the flight."""

    time_us: TimeUs
    text: str


@dataclass(frozen=True, slots=True)
class TableFault:
    """A line, or a part of one, that could not be read."""

    line: int
    """Line number, from 1."""
    size: int
    reason: str
    is_cut: bool = False
    """Whether the file ends within the line: it is being written, or was cut off."""


_COMMENTS: Final[dict[str, Any]] = {
    HEADER_PREFIX: TableHeader,
    STATE_PREFIX: FusionState,
    NOTE_PREFIX: TableNote,
    NODE_PREFIX: NodeStatus,
}

TableEvent = TableRow | TableNote | TableFault | TableHeader | FusionState | NodeStatus
"""A TableHeader here is one between rows: the settings were changed."""


def encode_head(header: TableHeader) -> str:
    """Write all lines before the first row."""
    return f"{FORMAT_LINE}\n{encode_line(header)}{','.join(COLUMNS)}\n"


def encode_line(event: TableRow | TableHeader | FusionState | TableNote | NodeStatus) -> str:
    """Write any line of a table: a row, or a comment line."""
    if isinstance(event, TableRow):
        return row_to_line(event)
    prefix = next(prefix for prefix, kind in _COMMENTS.items() if isinstance(event, kind))
    return f"{prefix}{msgspec.json.encode(event).decode()}\n"


TableComment = TableHeader | TableNote | TableFault | FusionState | NodeStatus
"""A line between rows."""


@dataclass(frozen=True, slots=True)
class TableBlock:
    """Some rows of a table as columns, and the lines between them."""

    cells: FloatArray
    """Shape (n, len(COLUMNS)); NaN is an empty cell."""
    comments: tuple[tuple[int, TableComment], ...] = ()
    """Comments in the order of the file, each with the index of the row after it, up to n."""

    def __len__(self) -> int:
        return len(self.cells)

    def events(self, vehicle_id: int) -> Iterator[TableEvent]:
        """Yield rows and the lines between them one by one, for this aircraft."""
        begin = 0
        for row, comment in (*self.comments, (len(self), None)):
            for cells in self.cells[begin:row].tolist():
                yield row_of_cells(cells, vehicle_id)
            begin = row
            if comment is not None:
                yield comment

    def pieces(self, rows: int) -> "Iterator[TableBlock]":
        """Split the block into smaller ones of this number of rows."""
        for begin in range(0, max(len(self), 1), rows):
            end = begin + rows if begin + rows < len(self) else len(self) + 1
            comments = ((row - begin, c) for row, c in self.comments if begin <= row < end)
            yield TableBlock(self.cells[begin:end], tuple(comments))


def block_of(events: Iterable[TableEvent]) -> TableBlock:
    """Arrange rows as columns, and keep the lines between them."""
    rows: list[tuple[Cell, ...]] = []
    comments: list[tuple[int, TableComment]] = []
    for event in events:
        if isinstance(event, TableRow):
            rows.append(cells_of(event))
        else:
            comments.append((len(rows), event))
    cells = np.array(rows, np.float64).reshape(-1, len(COLUMNS))
    return TableBlock(cells, tuple(comments))


def encode_block(block: TableBlock) -> bytes:
    """Write rows and the lines between them, except faults."""
    text, begin = b"", 0
    for row, comment in (*block.comments, (len(block), None)):
        text += write_lines(block.cells[begin:row])
        begin = row
        if comment is not None and not isinstance(comment, TableFault):
            text += encode_line(comment).encode()
    return text


class TableReader:
    """Decode any chunks of a table into rows, notes and faults; never raises on data.

    Columns are identified by name, so files with more or fewer columns, or in another order, can be
    read too.
    """

    def __init__(self) -> None:
        self.header: TableHeader | None = None
        """None before it is read, or if the file has none."""
        self.lines = 0
        self._rest = b""
        self._skipped = 0
        self._width = 0
        self._indices: list[int] | None = None

    @property
    def vehicle_id(self) -> int:
        """The aircraft of the table; 1 if the table does not state it."""
        return 1 if self.header is None else self.header.vehicle_id

    def feed(self, data: bytes, *, final: bool = False) -> list[TableEvent]:
        """Process the next bytes of the file, and return their rows and other lines one by one.

        See `feed_block`.
        """
        return [*self.feed_block(data, final=final).events(self.vehicle_id)]

    def feed_block(self, data: bytes, *, final: bool = False) -> TableBlock:
        """Process the next bytes of the file."""
        text, newline, rest = (self._rest + data).rpartition(b"\n")
        block = self._read_text(text + newline) if newline else TableBlock(NO_ROWS)
        if len(rest) > MAX_LINE or (self._skipped and not newline):
            self._skipped += len(rest)
            rest = b""
        self._rest = rest
        if final and (rest or self._skipped):
            self.lines += 1
            size = self._skipped + len(rest)
            is_cut = not self._skipped and b"\0" not in rest
            cut = TableFault(self.lines, size, "the line has no end", is_cut)
            block = TableBlock(block.cells, (*block.comments, (len(block), cut)))
        return block

    def _read_text(self, text: bytes) -> TableBlock:
        """Read whole lines, all at once if they are all rows."""
        if self._width and not self._skipped and b"#" not in text:
            cells = self._read(text)
            if cells is not None and not normalise(cells):
                self.lines += len(cells)
                return TableBlock(cells)
        rows: list[bytes] = []
        lines: list[int] = []
        comments: list[tuple[int, TableComment]] = []
        for line in text.split(b"\n")[:-1]:
            self.lines += 1
            size, self._skipped = self._skipped + len(line) + 1, 0
            if size > len(line) + 1:
                comments.append((self.lines, TableFault(self.lines, size, "the line is too long")))
            elif self._width and line.rstrip(b"\r") and not line.startswith(b"#"):
                rows.append(line)
                lines.append(self.lines)
            elif (comment := self._comment_of(line)) is not None:
                comments.append((self.lines, comment))
        return self._joined(rows, np.array(lines, np.int64), comments)

    def _joined(
        self, rows: list[bytes], lines: IntArray, comments: list[tuple[int, TableComment]]
    ) -> TableBlock:
        """Read rows, and put the other lines between them by their line numbers."""
        if not rows:
            return TableBlock(NO_ROWS, tuple((0, comment) for _, comment in comments))
        text = b"\n".join([*rows, b""])
        cells = self._read(text.replace(b"\r\n", b"\n") if b"\r" in text else text)
        faults: dict[int, str] = {}
        if cells is None:
            cells, faults = self._read_singly(rows)
        faults = {**normalise(cells), **faults}
        for row, reason in faults.items():
            number = int(lines[row])
            comments.append((number, TableFault(number, len(rows[row]) + 1, reason)))
        sound = np.delete(lines, [*faults])
        comments.sort(key=lambda placed: placed[0])
        at = np.searchsorted(sound, [number for number, _ in comments]).tolist()
        placed = zip(at, (comment for _, comment in comments), strict=True)
        return TableBlock(np.delete(cells, [*faults], axis=0), tuple(placed))

    def _read(self, text: bytes) -> FloatArray | None:
        cells = read_lines(text, self._width)
        if cells is None or self._indices is None:
            return cells
        # The appended column of NaN replaces columns that the file lacks.
        return np.column_stack([cells, np.full(len(cells), np.nan)])[:, self._indices]

    def _read_singly(self, rows: list[bytes]) -> tuple[FloatArray, dict[int, str]]:
        """Read rows one by one; malformed ones are reported, and their cells stay empty."""
        cells = np.full((len(rows), len(COLUMNS)), np.nan)
        faults: dict[int, str] = {}
        for row, line in enumerate(rows):
            try:
                cells[row] = read_cells(line.rstrip(b"\r"), self._width, self._indices)
            except ValueError as error:
                faults[row] = str(error)
        return cells, faults

    def _comment_of(self, line: bytes) -> TableComment | None:
        """Read a line of the head, or a line between rows that is not a row."""
        try:
            return self._read_other(line)
        except ValueError as error:
            return TableFault(self.lines, len(line) + 1, str(error))

    def _read_other(self, line: bytes) -> TableComment | None:
        text = line.decode("utf-8-sig" if self.lines == 1 else "utf-8").rstrip("\r")
        if text and not text.startswith("#"):
            self._read_names(text.split(","))
        elif text.startswith(FORMAT_PREFIX) and text != FORMAT_LINE:
            version = text.removeprefix(FORMAT_PREFIX)
            raise ValueError(f"table version {version!r}; this mavgate reads 1: use a newer one")
        for prefix, kind in _COMMENTS.items():
            if text.startswith(prefix):
                found: TableComment = msgspec.json.decode(text.removeprefix(prefix), type=kind)
                if isinstance(found, TableHeader) and self.header is None:
                    self.header = found
                    return None
                return found
        return None

    def _read_names(self, names: list[str]) -> None:
        if "time_us" not in names:
            raise ValueError("no line of column names with time_us before the first row")
        self._width = len(names)
        if tuple(names) != COLUMNS:
            self._indices = [names.index(name) if name in names else -1 for name in COLUMNS]
