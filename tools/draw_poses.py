"""Draw the six positions of the accelerometer's calibration, for the panel and docs/calibration.md.

    .venv/bin/python tools/draw_poses.py

The aircraft is a solid model, drawn as `gateway/panel/web/pose-SIDE.svg`, where SIDE lies below.
"""

import math
import sys
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from gateway.geometry.quaternion import from_euler, rotate
from gateway.records import Vec3

FloatArray = npt.NDArray[np.float64]
WEB = Path(__file__).resolve().parent.parent / "gateway" / "panel" / "web"
COLOURS: Final = {"accent": (40, 140, 210), "soft": (125, 140, 155)}
EDGE: Final = "#33414e"
SHADOW: Final = "#8c98a4"
"""Legible on light and on dark."""

WIDTH: Final = 140
HEIGHT: Final = 112
SCALE: Final = 28.0
GROUND: Final = 96.0
LIGHT: Final = np.array((-0.35, 0.3, -0.89))
"""Towards the light, NED turned to the eye."""

ATTITUDES: Final[dict[str, tuple[float, float]]] = {
    "down": (0.0, 0.0),
    "up": (180.0, 0.0),
    "left": (-90.0, 0.0),
    "right": (90.0, 0.0),
    "front": (0.0, -90.0),
    "back": (0.0, 90.0),
}
"""Roll and pitch in deg, by the side that lies below; see `calibration_run.SIDES`."""

_BODY: Final = ((1.5, 0, 0), (0.5, 0.24, -0.1), (0.5, -0.24, -0.1), (0.5, 0, 0.28), (-1.2, 0, 0))
_FACES: Final = (
    # The hull, its nose marked by a separate face.
    ((_BODY[0], _BODY[1], _BODY[2]), "accent"),
    ((_BODY[0], _BODY[3], _BODY[1]), "accent"),
    ((_BODY[0], _BODY[2], _BODY[3]), "accent"),
    ((_BODY[4], _BODY[2], _BODY[1]), "soft"),
    ((_BODY[4], _BODY[1], _BODY[3]), "soft"),
    ((_BODY[4], _BODY[3], _BODY[2]), "soft"),
    # Wings, tailplane and fin are thin and seen from both sides.
    (((0.45, 0, -0.04), (0.15, 1.5, -0.08), (-0.15, 1.5, -0.08), (-0.2, 0, -0.04)), "soft"),
    (((0.45, 0, -0.04), (0.15, -1.5, -0.08), (-0.15, -1.5, -0.08), (-0.2, 0, -0.04)), "soft"),
    (((-0.85, 0, -0.02), (-1.05, 0.55, -0.02), (-1.25, 0.55, -0.02), (-1.25, 0, -0.02)), "soft"),
    (((-0.85, 0, -0.02), (-1.05, -0.55, -0.02), (-1.25, -0.55, -0.02), (-1.25, 0, -0.02)), "soft"),
    (((-0.8, 0, -0.05), (-1.15, 0, -0.62), (-1.32, 0, -0.62), (-1.25, 0, 0)), "accent"),
)
"""Corners in body FRD, metres of a toy, and the colour's name in the style sheet."""


def pose_svg(side: str) -> str:
    """Draw the aircraft resting on one of its sides.

    Parameters
    ----------
    side : str
        Which side lies below, one of `ATTITUDES`.

    Returns
    -------
    str
        An SVG document.
    """
    roll_deg, pitch_deg = ATTITUDES[side]
    q_nb = from_euler(math.radians(roll_deg), math.radians(pitch_deg), 0.0)
    faces = [
        (np.array([_to_eye(rotate(q_nb, c)) for c in corners]), ink) for corners, ink in _FACES
    ]
    lowest = max(float(face[:, 1].max()) for face, _ in faces)
    faces.sort(key=lambda item: float(item[0][:, 2].mean()))
    drawn = "".join(_polygon(face, ink, lowest) for face, ink in faces)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}">'
        "<!-- SPDX-License-Identifier: Apache-2.0; made by tools/draw_poses.py -->"
        f'<ellipse cx="{WIDTH / 2}" cy="{GROUND + 6}" rx="52" ry="9" fill="{SHADOW}"'
        f' fill-opacity=".4"/>{drawn}</svg>\n'
    )


def _to_eye(place_n: Vec3) -> tuple[float, float, float]:
    """Project from the front right and above: right, down, towards the eye."""
    turn, down = math.radians(-145.0), math.radians(24.0)
    x = place_n[0] * math.cos(turn) - place_n[1] * math.sin(turn)
    y = place_n[0] * math.sin(turn) + place_n[1] * math.cos(turn)
    z = place_n[2]
    return (y, z * math.cos(down) - x * math.sin(down), -x * math.cos(down) - z * math.sin(down))


def _polygon(face: FloatArray, ink: str, lowest: float) -> str:
    normal = np.cross(face[1] - face[0], face[2] - face[0])
    shine = abs(float(normal @ LIGHT)) / max(float(np.linalg.norm(normal)), 1e-9)
    points = " ".join(
        f"{WIDTH / 2 + x * SCALE:.1f},{GROUND + (y - lowest) * SCALE:.1f}" for x, y, _ in face
    )
    light = 0.2 + 0.6 * shine
    colour = "#" + "".join(f"{round(c + (255 - c) * light):02x}" for c in COLOURS[ink])
    return f'<polygon points="{points}" fill="{colour}" stroke="{EDGE}" stroke-width=".7"/>'


def main() -> None:
    """Write all pictures."""
    for side in ATTITUDES:
        (WEB / f"pose-{side}.svg").write_text(pose_svg(side))


if __name__ == "__main__":
    main()
