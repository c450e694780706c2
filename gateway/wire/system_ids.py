"""Fields of messages that contain system ids, for links on which systems have other ids.

In addition to the sender in its header a message may contain: the system that it addresses; a
system that it reports, such as the one in control of a gimbal; and a system in a parameter of a
command or of a mission item, such as the vehicle to follow or the target of a camera.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import all as dialect

from gateway.wire.frame_editing import Sign, edit_frame
from gateway.wire.mavlink_messages import MESSAGE_NAMES, layout_of
from gateway.wire.mavlink_splitter import MavFrame

LAST_ID: Final = 255

FIELD_NAMES: Final = (
    *("target_system", "gcs_system_id", "primary_control_sysid", "secondary_control_sysid"),
    *("gcs_main", "gcs_secondary"),
)
"""Names of fields that contain a system id in all messages."""
FIELDS: Final[dict[int, tuple[str, ...]]] = {
    message_id: names
    for message_id in MESSAGE_NAMES
    if (names := tuple(name for name in layout_of(message_id).names or () if name in FIELD_NAMES))
} | {dialect.MAVLINK_MSG_ID_MANUAL_CONTROL: ("target",)}
"""Fields with a system id, or an array of them, by message id."""

REQUEST_OPERATOR_CONTROL: Final = 32100
"""MAV_CMD_REQUEST_OPERATOR_CONTROL, which pymavlink's dialects lack."""
REQUEST_CONTROL: Final = 1
RELEASE_CONTROL: Final = 0
"""Values of the action of that command."""
TIMEOUTS_S: Final = (3, 60)
"""Shortest and longest timeout of a request, by which the two orders of parameters differ."""
COMMANDS: Final = {
    dialect.MAV_CMD_DO_FOLLOW: (1,),
    dialect.MAV_CMD_DO_SET_ROI_SYSID: (1,),
    dialect.MAV_CMD_DO_GUIDED_MASTER: (1,),
    dialect.MAV_CMD_DO_SET_SYS_CMP_ID: (1,),
    dialect.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE: (1, 3),
    dialect.MAV_CMD_ARM_AUTHORIZATION_REQUEST: (1,),
    REQUEST_OPERATOR_CONTROL: (4, 5),
}
"""Numbers of the parameters that are system ids, by command."""
FORMER_CONTROL: Final = (1,)
"""The same for operator control in its former order of parameters."""
CARRIERS: Final = frozenset(
    message_id
    for message_id in FIELDS
    if {"command", "param1"} <= set(layout_of(message_id).names or ())
)
"""Messages that contain a command."""


def is_former_control(params: Sequence[float], sender: int) -> bool:
    """Return whether MAV_CMD_REQUEST_OPERATOR_CONTROL has its former order of parameters.

    If both are possible, it has the present one: action, takeover, timeout, sender. The former one
    is sender or 0, action, takeover, timeout. See `vehicle.services.operator_control`.
    """
    first, second, third, fourth = (round(p) if math.isfinite(p) else 0 for p in params[:4])
    shortest, longest = TIMEOUTS_S
    return first not in (RELEASE_CONTROL, REQUEST_CONTROL) or (
        (first, second) == (0, REQUEST_CONTROL)
        and third in (0, 1)
        and shortest <= fourth <= longest
        and fourth != sender
    )


def rename_systems(
    frame: MavFrame,
    sender: int,
    rename: Callable[[int], int],
    *,
    sign: Sign | None = None,
    drop_signature: bool = False,
) -> MavFrame | None:
    """Return a frame with other system ids in its header and fields.

    `rename` returns the new id of a system, 1 to 255. A frame that changes is signed by `sign` if
    it is signed, or becomes unsigned by `drop_signature`. Returns the same frame if nothing
    changes, and None if it must change and cannot; see `edit_frame`.
    """
    fields = _renamed_fields(frame, rename) if frame.message_id in FIELDS else {}
    if sender == frame.origin[0] and not fields:
        return frame
    return edit_frame(
        frame, system=sender, fields=fields, sign=sign if frame.signed else None,
        drop_signature=drop_signature,
    )  # fmt: skip


def _renamed_fields(frame: MavFrame, rename: Callable[[int], int]) -> dict[str, Any]:
    message_id = frame.message_id
    layout = layout_of(message_id)
    values = np.frombuffer(frame.payload.ljust(layout.itemsize, b"\0"), layout, 1)[0]
    names = FIELDS[message_id]
    if message_id in CARRIERS:
        numbers = COMMANDS.get(int(values["command"]), ())
        if values["command"] == REQUEST_OPERATOR_CONTROL:
            params = [float(values[f"param{number}"]) for number in range(1, 5)]
            numbers = FORMER_CONTROL if is_former_control(params, frame.origin[0]) else numbers
        for number in numbers:
            # The fifth parameter of messages with a position is x.
            name = f"param{number}"
            names += (name if name in values.dtype.names else "x",)
    found: dict[str, Any] = {}
    for name in names:
        before = values[name].tolist()
        after = _renamed(before, rename)
        if after != before:
            found[name] = after
    return found


def _renamed(value: Any, rename: Callable[[int], int]) -> Any:
    if isinstance(value, list):
        return [_renamed(each, rename) for each in value]
    # NaN and negative numbers, as in the command for gimbals, are not ids.
    return rename(int(value)) if 0 < value <= LAST_ID else value
