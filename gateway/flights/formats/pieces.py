"""A stream that is read while it is written, for packages that write files themselves."""


class Pieces:
    """Buffer written bytes until they are taken."""

    def __init__(self) -> None:
        self.closed = False
        self._written: list[bytes] = []
        self._size = 0

    def write(self, data: bytes) -> int:
        """Take more of the file."""
        self._written.append(bytes(data))
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Return how much was written in all."""
        return self._size

    def flush(self) -> None:
        """Do nothing: nothing is buffered elsewhere."""

    def close(self) -> None:
        """Close the stream."""
        self.closed = True

    def taken(self) -> bytes:
        """Return what was written since the last time."""
        data = b"".join(self._written)
        self._written.clear()
        return data
