"""One writer: nothing that exists is lost by mistake, and nothing half written stays."""

import errno
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.output import PRIVATE, check_folder, check_output, write_new, written_together

pytestmark = pytest.mark.io


def content(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder, and those in its folders."""
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_new_file_has_permissions_of_umask(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        assert write_new(tmp_path / "a", [b"12", b"3"]) == 3
    finally:
        os.umask(before)
    assert content(tmp_path) == {"a": b"123"}
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o640


@pytest.mark.parametrize("rights", [None, PRIVATE], ids=["its rights", "given rights"])
def test_existing_file_is_replaced_only_with_overwrite_and_stays_private(
    tmp_path: Path, rights: int | None
) -> None:
    file = tmp_path / "a"
    file.write_bytes(b"old")
    file.chmod(0o600 if rights is None else 0o644)
    with pytest.raises(FileExistsError):
        write_new(file, [b"new"])
    assert content(tmp_path) == {"a": b"old"}
    write_new(file, [b"new"], overwrite=True, rights=rights)
    assert content(tmp_path) == {"a": b"new"}
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


@pytest.mark.parametrize("kind", ["link", "broken link", "fifo", "folder", "device"])
def test_only_regular_files_are_replaced(tmp_path: Path, kind: str) -> None:
    path = Path("/dev/null") if kind == "device" else tmp_path / "out"
    (tmp_path / "other").write_bytes(b"kept")
    if kind.endswith("link"):
        path.symlink_to(tmp_path / ("other" if kind == "link" else "none"))
    elif kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    before = path.lstat()
    with pytest.raises(OSError, match="is not a regular file"):
        write_new(path, [b"new"], overwrite=True)
    assert os.path.samestat(before, path.lstat())
    assert (tmp_path / "other").read_bytes() == b"kept"
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("way", ["same", "hard link", "dots", "link"])
def test_output_that_is_an_input_is_rejected(tmp_path: Path, way: str) -> None:
    flight = tmp_path / "flight.csv"
    flight.write_bytes(b"precious")
    out = {"same": flight, "dots": tmp_path / "." / "flight.csv"}.get(way, tmp_path / "out")
    if way == "hard link":
        os.link(flight, out)
    elif way == "link":
        out.symlink_to(flight)
    with pytest.raises(OSError, match="is an input"):
        write_new(out, [b"new"], overwrite=True, inputs=[None, flight])
    assert flight.read_bytes() == b"precious"


@pytest.mark.parametrize("before", [{}, {"a": b"old"}], ids=["new", "replaced"])
@pytest.mark.parametrize(
    "error",
    [KeyboardInterrupt(), OSError(errno.EIO, "broken", "input.csv")],
    ids=["interrupted", "broken input"],
)
def test_interrupted_write_leaves_previous_content(
    tmp_path: Path, before: dict[str, bytes], error: BaseException
) -> None:
    def broken() -> Iterator[bytes]:
        yield b"half"
        raise error

    for name, old in before.items():
        (tmp_path / name).write_bytes(old)
    with pytest.raises(type(error)) as caught:
        write_new(tmp_path / "a", broken(), overwrite=True)
    assert content(tmp_path) == before
    assert getattr(caught.value, "filename", "input.csv") == "input.csv", "it names the input"


def no_links(*_: object) -> None:
    raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))


@pytest.mark.parametrize("on_fat", [False, True], ids=["with hard links", "on FAT"])
def test_file_created_during_write_is_not_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_fat: bool
) -> None:
    def slow() -> Iterator[bytes]:
        yield b"first"
        write_new(tmp_path / "a", [b"other"])

    if on_fat:
        monkeypatch.setattr(os, "link", no_links)
    with pytest.raises(FileExistsError) as refused:
        write_new(tmp_path / "a", slow())
    assert refused.value.filename == str(tmp_path / "a")
    assert content(tmp_path) == {"a": b"other"}


@pytest.mark.parametrize("overwrite", [False, True], ids=["new", "replaced"])
@pytest.mark.parametrize("name", ["a", "飛" * 83 + ".csv"], ids=["short name", "long name"])
def test_file_appears_only_when_complete(tmp_path: Path, name: str, overwrite: bool) -> None:
    """A gateway that is killed while it writes a mission must not find it empty afterwards."""

    def looking() -> Iterator[bytes]:
        assert not (tmp_path / name).exists()
        yield b"1"

    write_new(tmp_path / name, looking(), overwrite=overwrite)
    assert content(tmp_path) == {name: b"1"}


def test_folder_that_is_not_empty_needs_overwrite(tmp_path: Path) -> None:
    check_folder(tmp_path / "new")
    check_folder(tmp_path)
    (tmp_path / "a").touch()
    with pytest.raises(FileExistsError):
        check_folder(tmp_path)
    check_folder(tmp_path, overwrite=True)
    for below in (tmp_path / "a", tmp_path / "a" / "b" / "c"):
        with pytest.raises(OSError, match="is not a folder"):
            check_folder(below, overwrite=True)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a disk that is always full")
def test_error_of_a_full_disk_names_the_requested_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = os.open("/dev/full", os.O_WRONLY)
    monkeypatch.setattr(tempfile, "mkstemp", lambda **_: (full, str(tmp_path / ".a.csv.1")))
    with pytest.raises(OSError, match="No space left") as caught:
        write_new(tmp_path / "a.csv", [b"1"])
    assert caught.value.filename == str(tmp_path / "a.csv")


@pytest.mark.parametrize("is_there", [False, True], ids=["new folder", "old folder"])
def test_files_of_a_folder_are_replaced_together_or_not_at_all(
    tmp_path: Path, is_there: bool
) -> None:
    folder = tmp_path / "report"
    if is_there:
        folder.mkdir()
        (folder / "page").write_bytes(b"old")

    def fill_disk() -> None:
        with written_together(folder) as fresh:
            write_new(fresh / "page", [b"new"])
            raise OSError(errno.ENOSPC, "full", str(fresh / "figure"))

    with pytest.raises(OSError, match="full") as caught:
        fill_disk()
    assert caught.value.filename == str(folder / "figure")
    assert content(tmp_path) == ({"page": b"old"} if is_there else {})
    assert folder.exists() == is_there
    with written_together(folder) as fresh:
        write_new(fresh / "page", [b"new"])
        write_new(fresh / "figure", [b"1"])
    assert content(folder) == {"page": b"new", "figure": b"1"}


def test_error_of_unwritable_folder_names_requested_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_suffix: object, prefix: str, folder: Path) -> str:
        raise OSError(errno.ENOSPC, "full", str(folder / f"{prefix}x"))

    monkeypatch.setattr("tempfile.mkdtemp", refuse)
    with pytest.raises(OSError, match="full") as caught, written_together(tmp_path / "new"):
        pytest.fail("nothing can be written")
    assert caught.value.filename == str(tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_missing_or_read_only_folder_is_reported_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_output(tmp_path / "a")
    assert content(tmp_path) == {}
    with pytest.raises(FileNotFoundError, match="folder that does not exist"):
        check_output(tmp_path / "none" / "a.csv")
    check_folder(tmp_path / "none" / "report")
    monkeypatch.setattr(os, "access", lambda path, _: Path(path) != tmp_path)
    with pytest.raises(PermissionError, match="cannot be written"):
        check_output(tmp_path / "a.csv")
    with pytest.raises(PermissionError, match="cannot be written"):
        check_folder(tmp_path / "none" / "report")
