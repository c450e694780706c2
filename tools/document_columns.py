"""Write the table of the columns of a recording into docs/recordings.md.

    python -m tools.document_columns

Columns, types and units are those of `gateway.recordings.columns`, which also define the head of a
CSV and the schema of a Parquet file.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from gateway.recordings.columns import (
    BARO_CODEC,
    GPS_CODEC,
    HEAD_COLUMNS,
    NAV_CODEC,
    RAW_CODEC,
    SI_CODEC,
    TRUTHS,
    WHOLE_COLUMNS,
    unit_of,
)

PAGE: Final = Path(__file__).resolve().parents[1] / "docs" / "recordings.md"
BEGIN, END = "<!-- columns: python -m tools.document_columns -->\n", "<!-- end of columns -->\n"
GROUPS: Final = {
    "IMU sample": HEAD_COLUMNS,
    "counts": RAW_CODEC.patterns,
    "calibrated": SI_CODEC.patterns,
    "barometer": BARO_CODEC.patterns,
    "GPS": GPS_CODEC.patterns,
    "state": NAV_CODEC.patterns,
}


def rows() -> Iterator[tuple[str, str, str, str]]:
    """Yield the rows of the table, beginning with the head."""
    yield "group", "columns", "type", "unit"
    for group, patterns in GROUPS.items():
        for pattern in patterns:
            before, _, rest = pattern.partition("{")
            parts, _, after = rest.partition("}")
            name = before + parts.split(",")[0] + after
            whole = "bool" if name in TRUTHS else "int" if name in WHOLE_COLUMNS else "float"
            yield group, f"`{pattern}`", whole, unit_of(name)


def table() -> str:
    """Return the table, aligned."""
    cells = list(rows())
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    cells.insert(1, ("-" * widths[0], "-" * widths[1], "-" * widths[2], "-" * widths[3]))
    lines = [" | ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in cells]
    return "".join(f"| {line} |\n" for line in lines)


def with_table(page: str) -> str:
    """Return the page with the present table between its marks."""
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n{table()}\n{END}{after}"


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
