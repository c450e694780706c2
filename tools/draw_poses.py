"""Draw positions and orientations for the panel's calibration and docs/calibration.md.

    .venv/bin/python tools/draw_poses.py

`gateway/panel/web/poses.svg` shows the six positions of the accelerometer's calibration, each also
as a view of the file with the name of the lower side: `poses.svg#left`. `mounting.svg` shows the
orientations of a board in the aircraft, with their angles.
"""

import math
import sys
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from gateway.geometry.quaternion import from_euler, rotate
from gateway.panel.state.calibration import ORIENTATIONS, SIDE_NAMES
from gateway.records import Vec3

FloatArray = npt.NDArray[np.float64]
WEB = Path(__file__).resolve().parent.parent / "gateway" / "panel" / "web"
COLOURS: Final = {"accent": (40, 140, 210), "soft": (125, 140, 155)}
EDGE: Final = "#33414e"
SHADOW: Final = "#8c98a4"
INK: Final = "#6f7d8a"
"""Colour that is legible on light and dark backgrounds."""

WIDTH: Final = 140
HEIGHT: Final = 112
SCALE: Final = 28.0
GROUND: Final = 96.0
LIGHT: Final = np.array((-0.35, 0.3, -0.89))
"""Direction of the light, in NED as seen by the viewer."""

ATTITUDES: Final[dict[str, tuple[float, float]]] = {
    "down": (0.0, 0.0),
    "up": (180.0, 0.0),
    "left": (-90.0, 0.0),
    "right": (90.0, 0.0),
    "front": (0.0, -90.0),
    "back": (0.0, 90.0),
}
"""Roll and pitch in deg, by the lower side."""
CAPTION: Final = 22
"""Height of the line below a picture."""
FROM_ABOVE: Final = (
    "M0-48c5 0 7 7 7 16v10l46 20v12L7 0v22l16 10v8L0 34l-23 6v-8l16-10V0l-46 10V-2L-7-22v-10"
    "c0-9 2-16 7-16z"
)
"""Outline of an aircraft whose nose points up."""

_BODY: Final = ((1.5, 0, 0), (0.5, 0.24, -0.1), (0.5, -0.24, -0.1), (0.5, 0, 0.28), (-1.2, 0, 0))
_FACES: Final = (
    # The hull, with a separate face for its nose.
    ((_BODY[0], _BODY[1], _BODY[2]), "accent"),
    ((_BODY[0], _BODY[3], _BODY[1]), "accent"),
    ((_BODY[0], _BODY[2], _BODY[3]), "accent"),
    ((_BODY[4], _BODY[2], _BODY[1]), "soft"),
    ((_BODY[4], _BODY[1], _BODY[3]), "soft"),
    ((_BODY[4], _BODY[3], _BODY[2]), "soft"),
    # Wings, tailplane and fin are thin and visible from both sides.
    (((0.45, 0, -0.04), (0.15, 1.5, -0.08), (-0.15, 1.5, -0.08), (-0.2, 0, -0.04)), "soft"),
    (((0.45, 0, -0.04), (0.15, -1.5, -0.08), (-0.15, -1.5, -0.08), (-0.2, 0, -0.04)), "soft"),
    (((-0.85, 0, -0.02), (-1.05, 0.55, -0.02), (-1.25, 0.55, -0.02), (-1.25, 0, -0.02)), "soft"),
    (((-0.85, 0, -0.02), (-1.05, -0.55, -0.02), (-1.25, -0.55, -0.02), (-1.25, 0, -0.02)), "soft"),
    (((-0.8, 0, -0.05), (-1.15, 0, -0.62), (-1.32, 0, -0.62), (-1.25, 0, 0)), "accent"),
)
"""Corners in body FRD, m of a small model, and the name of the colour in the style sheet."""


def poses_svg() -> str:
    """Draw the aircraft resting on each of its sides, and a view of each."""
    parts = []
    for number, side in enumerate(ATTITUDES):
        left = number * WIDTH
        parts.append(f'<view id="{side}" viewBox="{left} 0 {WIDTH} {HEIGHT}"/>')
        parts.append(f'<g transform="translate({left})">{_pose(side)}</g>')
        parts.append(_text(left + WIDTH / 2, HEIGHT + 12, SIDE_NAMES[side]))
    return _document(len(ATTITUDES) * WIDTH, HEIGHT + CAPTION, "".join(parts))


def mounting_svg() -> str:
    """Draw the board in the aircraft, seen from above, in each of its orientations."""
    parts = []
    for number, (name, (roll_deg, pitch_deg, yaw_deg)) in enumerate(ORIENTATIONS.items()):
        x, y = (number % 4 + 0.5) * 1.4 * WIDTH, 62 + number // 4 * 158
        is_up = roll_deg != 0.0
        look = 'fill="#2f7d5b"' if is_up else 'fill="#f4f1e6" stroke-dasharray="3 2"'
        # The side with the chips shows them.
        chips = '<path d="M-7-2h6v6h-6zM3 3h5v5h-5z" fill="#1c2329"/>' if is_up else ""
        ink = "#ffffff" if is_up else EDGE
        parts.append(
            f'<g transform="translate({x} {y})"><path d="{FROM_ABOVE}" fill="#dfe5ea"'
            f' stroke="{EDGE}" stroke-width=".8"/><g transform="rotate({yaw_deg:.0f})">'
            f'<rect x="-13" y="-17" width="26" height="34" rx="3" {look} stroke="{EDGE}"/>{chips}'
            f'<path d="M0 12V-11M-5-6 0-13 5-6" fill="none" stroke="{ink}" stroke-width="2"/>'
            "</g></g>"
        )
        parts.append(_text(x, y + 62, name))
        angles = f"roll {roll_deg:.0f}°, pitch {pitch_deg:.0f}°, yaw {yaw_deg:.0f}°"
        parts.append(_text(x, y + 77, angles))
        parts.append(f'<view id="way{number}" viewBox="{x - WIDTH / 2:.0f} {y - 51} {WIDTH} 100"/>')
    return _document(round(5.6 * WIDTH), 312, "".join(parts))


def _document(width: int, height: int, content: str) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">'
        "<!-- SPDX-License-Identifier: Apache-2.0; made by tools/draw_poses.py -->"
        f"{content}</svg>\n"
    )


def _text(x: float, y: float, text: str) -> str:
    look = f'font-family="sans-serif" font-size="12" fill="{INK}" text-anchor="middle"'
    return f'<text x="{x:.0f}" y="{y:.0f}" {look}>{text}</text>'


def _pose(side: str) -> str:
    """Draw the aircraft resting on one of its sides."""
    roll_deg, pitch_deg = ATTITUDES[side]
    q_nb = from_euler(math.radians(roll_deg), math.radians(pitch_deg), 0.0)
    faces = [
        (np.array([_to_eye(rotate(q_nb, c)) for c in corners]), ink) for corners, ink in _FACES
    ]
    lowest = max(float(face[:, 1].max()) for face, _ in faces)
    faces.sort(key=lambda item: float(item[0][:, 2].mean()))
    drawn = "".join(_polygon(face, ink, lowest) for face, ink in faces)
    return (
        f'<ellipse cx="{WIDTH / 2}" cy="{GROUND + 6}" rx="52" ry="9" fill="{SHADOW}"'
        f' fill-opacity=".4"/>{drawn}'
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
    """Write both pictures."""
    (WEB / "poses.svg").write_text(poses_svg())
    (WEB / "mounting.svg").write_text(mounting_svg())


if __name__ == "__main__":
    main()
