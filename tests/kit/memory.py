"""The memory that an object keeps."""

import sys
from collections import deque


def size_of(root: object) -> int:
    """Add up the bytes of everything that hangs on an object."""
    seen: set[int] = set()
    pending, total = [root], 0
    while pending:
        item = pending.pop()
        if id(item) in seen or isinstance(item, type):
            continue
        seen.add(id(item))
        total += sys.getsizeof(item)
        if isinstance(item, dict):
            pending += [*item.keys(), *item.values()]
        elif isinstance(item, list | tuple | set | frozenset | deque):
            pending += list(item)
        pending += list(getattr(item, "__dict__", {}).values())
        slots = getattr(type(item), "__slots__", ())
        pending += [getattr(item, s) for s in slots if isinstance(s, str) and hasattr(item, s)]
    return total
