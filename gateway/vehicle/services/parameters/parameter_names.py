"""Names of parameters: at most 16 characters, made from the settings' own keys.

`paper.alpha_gyro` becomes PAPER_ALPHA_GYRO and `rates.attitude_quaternion_hz` RATE_ATT_QUAT: the
unit goes (it is in the metadata), long words have fixed abbreviations, and what is still too long
loses vowels behind its first word. The name depends on the section's keys alone, so that it stays
the same when settings elsewhere come and go.
"""

from functools import cache
from typing import Final

MAX_NAME: Final = 16

UNITS: Final = frozenset(
    {
        "hz", "s", "ms", "us", "m", "mps", "mps2", "rad", "radps", "deg", "dps", "ut", "db", "pa",
        "hpa", "g", "percent", "ppm", "degc", "degps", "degprs", "degpsprs", "mprs", "mpsprs",
        "mps2prs", "utprs",
    }
)  # fmt: skip

ABBREVIATIONS: Final = {
    "accel": "ACC",
    "accuracy": "ACCUR",
    "altitude": "ALT",
    "attitude": "ATT",
    "calibration": "CAL",
    "chebyshev": "CHEB",
    "complementary": "CF",
    "controller": "CTRL",
    "declination": "DECL",
    "estimation": "EST",
    "extended": "EXT",
    "heading": "HDG",
    "height": "HGT",
    "highpass": "HP",
    "highres": "HR",
    "lowpass": "LP",
    "mission": "MIS",
    "mounting": "MNT",
    "nominal": "NOM",
    "position": "POS",
    "pressure": "PRES",
    "quaternion": "QUAT",
    "rates": "RATE",
    "reference": "REF",
    "satellites": "SATS",
    "scaled": "SCAL",
    "sensing": "SENS",
    "status": "STAT",
    "system": "SYS",
    "takeoff": "TKOFF",
    "tolerance": "TOL",
    "vehicle": "VEH",
    "velocity": "VEL",
}

VOWELS: Final = frozenset("AEIOU")


def without_unit(key: str) -> str:
    """Take the unit off a key."""
    head, _, tail = key.rpartition("_")
    return head if head and tail in UNITS else key


@cache
def parameter_name(section: str, key: str, axis: str = "") -> str:
    """Name the parameter of one setting.

    Parameters
    ----------
    section : str
        The section that holds it, the innermost one.
    key : str
        The setting; its unit is left out by the caller, unless two keys differ in it alone.
    axis : str, optional
        X, Y or Z of a vector; ROLL, PIT or YAW of a rotation.

    Returns
    -------
    str
        At most 16 characters of A to Z, 0 to 9 and underscore.
    """
    words = key.split("_")
    # A key that repeats its section need not do so in the name.
    if words[0] != section:
        words.insert(0, section)
    short = [ABBREVIATIONS.get(word, word.upper()) for word in words]
    room = MAX_NAME - (len(axis) + 1 if axis else 0)
    while len("_".join(short)) > room:
        # The first word stays whole: ground stations group parameters by it.
        longest = max(range(1, len(short)), key=lambda index: len(short[index]))
        short[longest] = _shorten(short[longest])
    return "_".join([*short, axis] if axis else short)


def _shorten(word: str) -> str:
    for index in range(len(word) - 1, 0, -1):
        if word[index] in VOWELS:
            return word[:index] + word[index + 1 :]
    return word[:-1]
