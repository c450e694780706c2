"""A stream that is emptied as it is written, for packages that write files themselves."""


class Pieces:
    """Takes what is written until it is taken away; never more than a piece is kept."""

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
        """Do nothing: all is at hand."""

    def close(self) -> None:
        """Take no more."""
        self.closed = True

    def taken(self) -> bytes:
        """Return what was written since the last time."""
        data = b"".join(self._written)
        self._written.clear()
        return data
