"""Plain technical English: words that an engineer of the field would not expect are not used."""

import re
from pathlib import Path
from typing import Final

from tests.conftest import ROOT

COVERED: Final = (
    *("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "docs", "firmware/README.md"),
    *("gateway", "tools", "tests"),
)
"""Files and folders that are checked."""

WORDS: Final = {
    r"told|tell(?!\()|tells|telling": "report, indicate, contain",
    r"believe|believes|believed|doubt|doubts|doubted": "accept, reject, inflate the variance",
    r"unsure|less sure|surely": "standard deviation, uncertain",
    r"anew": "again, repeatedly",
    r"(?<!--)beside": "next to, in addition to",
    r"(?<!hard )(?<!soft )(?<!hard-)(?<!soft-)iron(?! and soft)": "hard iron, soft iron",
    r"roughness": "vibration noise",
    r"purse|wish|wishes": "token bucket, requested interval",
    r"sealed|seal": "sequence and sign",
    r"strangers?": "untrusted client",
    r"visitors?|outlets?|inlets?": "client, subscriber, route",
    r"forgets?|forgotten": "reset, clear, discard",
    r"pure rooms?|houses?": "package, module",
    r"namesakes?": "sites of the same name",
    r"silence": "outage, gap, timeout",
}
"""Words that are not used, and terms to use instead."""
ANY_WORD: Final = re.compile(rf"\b(?:{'|'.join(WORDS)})\b", re.IGNORECASE)


def files() -> list[Path]:
    found: list[Path] = []
    for path in map(ROOT.joinpath, COVERED):
        inside = sorted(path.rglob("*")) if path.is_dir() else [path]
        found += [each for each in inside if each.suffix in (".md", ".py")]
    found.remove(Path(__file__).resolve())
    return found


def violations(text: str) -> list[str]:
    """Return each line that contains a word of the list, with the terms to use instead."""
    if not ANY_WORD.search(text):
        return []
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        for pattern, instead in WORDS.items():
            if match := re.search(rf"\b(?:{pattern})\b", line, re.IGNORECASE):
                found.append(f"{number}: {match[0]!r}: {instead}")
    return found


def test_wording_is_plain() -> None:
    found = {path.relative_to(ROOT): violations(path.read_text()) for path in files()}
    assert {path: lines for path, lines in found.items() if lines} == {}


def test_word_list_finds_words_and_accepts_terms() -> None:
    assert violations("the sensor tells its bias; iron nearby; strangers") != []
    assert violations("hard iron, soft-iron matrix, hard iron and soft iron") == []
    assert violations("environment, ironing board, toldy") == []
